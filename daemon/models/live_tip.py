"""The present position of the tip, predicted from the latest joint readings, or the reason why it is unknown.

`on_records` runs in the writer's thread and only notes the joiner's state of the machine; the model is evaluated in the
callers' threads. Each way in which a position could be wrong without notice has its own status: no model, an unusable
model, old or bad readings, joints beyond their limits or with a zero unknown to the model, and poses outside the
training region.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.observations import Observations
from calibration.rig.description import Joint, Rig
from calibration.rig.limits import beyond_limits, on_one_turn
from daemon.acquisition.joiner import MachineState, ObservationJoiner
from daemon.commands import CommandError
from daemon.models.live_model import LiveModel, Loaded, Missing
from drivers.can.tip_frames import TipMessage, TipStatus
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import DeviceEvent, EventKind, Record

if TYPE_CHECKING:
    from calibration.model.model import CalibratedModel

log = logging.getLogger(__name__)

FRESH_S = 1.0  # older readings give no position
_AHEAD_S = 0.1  # how far a timestamp may be ahead of the clock, as kernel timestamps are converted from another clock
_BEYOND = 0.02  # tolerated excess over a joint's limits, as a share of its range: its zero may be off by this much
_NO_STATION_MM = 1e-3  # negligible, so that the result is the standard deviation of the tip and not of a fix

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Tip:
    """The corrected position of a prism.

    Attributes:
        status: quality of the position.
        reason: why there is no position, a sentence; "" if there is one.
        prism: name of the prism.
        model: number of the live model; None if none is loaded.
        utc_ns: time of the position; None until all joints were read in this boot.
        age_s: age of the position.
        joints: observations column -> joint reading used; angles are on the turn of the joint's limits.
        base_mm: x, y, z in the base frame.
        sigma_mm: expected RMS of the 3-D error, from parameters, readings, timing and deficiencies of the model. The
            base frame is the one that the calibration has placed relative to its stations.
        setup: set-up of the station, if the station has not moved and the model knows the set-up.
        station_mm, station_sigma_mm: x, y, z in that station's frame as it would measure them, including errors of its
            fixes and movement of the base, and their standard deviations.
        warnings: conditions that the model was not trained on.
    """

    status: TipStatus
    reason: str
    prism: str
    model: int | None = None
    utc_ns: int | None = None
    age_s: float | None = None
    joints: Mapping[str, float] = field(default_factory=dict)
    base_mm: Place | None = None
    sigma_mm: float | None = None
    setup: str | None = None
    station_mm: Place | None = None
    station_sigma_mm: Place | None = None
    warnings: tuple[str, ...] = ()

    def message(self) -> TipMessage:
        """Return the message for CAN."""
        return TipMessage(self.status, self.base_mm, self.sigma_mm, self.age_s)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object for the control socket."""
        return asdict(self) | {"status": self.status.name.lower(), "warnings": list(self.warnings)}


class LiveTip:
    """The present position of any prism.

    Args:
        rig: the machine.
        joiner: supplies the latest readings; fed in the thread that calls `on_records`.
        model: the live model.
        setup: returns the station's set-up; None if there is none or the station has moved.
        clock: for the readings' age.
        prism: default prism of `rigcal tip`; None if none is configured.
        fresh_s: readings older than this, in seconds of `clock`, give no position.
    """

    def __init__(
        self,
        rig: Rig,
        joiner: ObservationJoiner,
        model: LiveModel,
        setup: Callable[[], str | None],
        clock: Clock,
        prism: str | None,
        fresh_s: float,
    ) -> None:
        self._rig, self._joiner, self._model, self._setup = rig, joiner, model, setup
        self._clock, self._prism, self._fresh_s = clock, prism, fresh_s
        self._state: MachineState | str = "no joint was read yet"
        self._is_failing = False

    def on_records(self, records: Sequence[Record]) -> bool:
        """Note the joiner's state, which includes these records already; cheap while no model is live.

        Returns:
            True if a joint's encoder has jumped. Then there is no tip until the model is loaded again
            (`LiveModel.changed`), which must wait until the jump is stored.
        """
        joints = self._rig.joint_names
        has_jumped = any(
            isinstance(one, DeviceEvent) and one.kind is EventKind.PRESET_JUMP and one.device in joints
            for one in records
        )
        if has_jumped:
            self._model.void()
        if isinstance(self._model.now(), Loaded):
            self._state = self._joiner.latest()
        return has_jumped

    def tip_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the present position of a prism, by default the configured one."""
        prism = arguments.get("prism", self._prism)
        names = ", ".join(self._rig.prism_names)
        if prism is None:
            raise CommandError(f"name a prism with --prism, or configure [tip] prism; the rig has {names}")
        if prism not in self._rig.prism_names:
            raise CommandError(f"rig {self._rig.name!r} has no prism {prism!r:.80}; it has {names}")
        return self.tip(str(prism), self._setup()).as_dict()

    def tip(self, prism: str, setup: str | None = None) -> Tip:
        """Return the present position of a prism; from any thread.

        Args:
            prism: a prism of the rig.
            setup: set-up for an additional position in its station's frame; None for none.
        """
        # Read the state before the model: once the state includes a jump, the model from before it is out of use.
        state = self._state
        live = self._model.now()
        if not isinstance(live, Loaded) or live.jumped or isinstance(state, str):
            return _unknown(live, state, prism)
        known = self._as_read(state, prism, live.id)
        if known.status is not TipStatus.OK:
            return known
        joints = known.joints
        beyond = [text for joint in self._rig.joints if (text := _beyond(joint, joints[joint.column]))]
        if beyond:
            return replace(known, status=TipStatus.OUT_OF_LIMITS, reason="; ".join(beyond))
        try:
            tip = _predicted(live, self._rig, state, known, setup)
        except Exception as error:  # after any error there is no position, and the receiver must see that
            if not self._is_failing:
                log.warning("the prediction of the live model failed", exc_info=error)
            self._is_failing = True
            return replace(known, status=TipStatus.FAILED, reason=f"the prediction of the live model failed: {error}")
        self._is_failing = False
        return tip

    def _as_read(self, state: MachineState, prism: str, model: int) -> Tip:
        """Return the readings and their age, without a position yet; STALE if they are not current."""
        now = self._clock.now()
        joints = _readings(self._rig, state)
        if now.boot_id != state.boot_id:  # the joiner also gets captures that a killed run left undecoded
            reason = "the joints were last read before the computer was restarted; is the bus silent?"
            return Tip(TipStatus.STALE, reason, prism, model, joints=joints)
        old_ns = now.monotonic_ns - state.monotonic_ns
        age_s = old_ns / NS_PER_S
        known = Tip(TipStatus.OK, "", prism, model, now.utc_ns - old_ns, age_s, joints)
        if age_s < -_AHEAD_S:
            reason = f"the joint readings are {-age_s:.1f} s ahead of the clock; check the timestamps of {state.oldest}"
            return replace(known, status=TipStatus.STALE, reason=reason)
        if age_s > self._fresh_s:
            reason = f"the joints were last read together {age_s:.1f} s ago; is {state.oldest} silent?"
            return replace(known, status=TipStatus.STALE, reason=reason)
        return known


def _unknown(live: Loaded | Missing, state: MachineState | str, prism: str) -> Tip:
    """Return a tip with the reason why this model and these readings give no prediction."""
    if not isinstance(live, Loaded):
        return Tip(TipStatus.MODEL_UNUSABLE if live.is_defect else TipStatus.NO_MODEL, live.reason, prism)
    if live.jumped:
        reason = (
            f"{', '.join(live.jumped)} jumped since the live model was trained; check the zero, then confirm it with "
            "`rigcal model zeros-checked`, or calibrate again"
        )
        return Tip(TipStatus.ZERO_LOST, reason, prism, live.id)
    return Tip(TipStatus.STALE, str(state), prism, live.id)


def _predicted(live: Loaded, rig: Rig, state: MachineState, known: Tip, setup: str | None) -> Tip:
    from calibration.model.prediction import Predictor
    from calibration.model.warnings import model_warnings

    model, predictor = live.model, Predictor.of(live.model)
    is_known = setup is not None and setup in model.placements
    at = setup if setup is not None and is_known else list(model.placements)[-1]
    row = _observation(live, rig, state, known, at)
    prediction = predictor.predict(row)
    position, sigma = prediction.position_mm[0], prediction.formal_mm[0]
    warnings = (*model_warnings(model, row), *_travelled(model))
    return replace(
        known,
        status=TipStatus.DOUBTFUL if warnings else TipStatus.OK,
        base_mm=_place(predictor.base_mm(row)[0]),
        sigma_mm=float(np.linalg.norm(sigma)),
        setup=at if is_known else None,
        station_mm=_place(position) if is_known else None,
        station_sigma_mm=_place(sigma) if is_known else None,
        warnings=warnings,
    )


def _travelled(model: CalibratedModel) -> Iterator[str]:
    """Yield a warning for each effect that depends on travel, which one instant does not determine."""
    from calibration.effects.library import library

    for effect in model.effects:
        if library()[effect.family].depends_on_travel:
            yield (
                f"{effect.family}@{effect.where} grows with the distance that {effect.where} travels, which is unknown "
                f"since the training; calibrate again if it has travelled far"
            )


def _readings(rig: Rig, state: MachineState) -> dict[str, float]:
    """Return column -> joint reading, on the same turn as in training."""
    read = {joint.name: np.array([state.values[joint.column]]) for joint in rig.joints}
    turned = on_one_turn(rig, read)
    return {joint.column: float(turned[joint.name][0]) for joint in rig.joints}


def _observation(live: Loaded, rig: Rig, state: MachineState, known: Tip, setup: str) -> Observations:
    """Return one row in the form of the training data: the joints, and all else that is known of the machine."""
    joints = {joint.name: np.array([known.joints[joint.column]]) for joint in rig.joints}
    extra = {name: np.array([value]) for name, value in state.values.items() if name not in known.joints}
    if state.dwell_s is not None:
        extra["dwell_s"] = np.array([state.dwell_s])
    if known.utc_ns is not None:
        at_s = live.time_axis.present(Stamp(known.utc_ns, state.monotonic_ns, state.boot_id))
        if at_s is not None:
            extra["time_s"] = np.array([at_s])
    return Observations(
        prism=np.array([known.prism]),
        joints=joints,
        position_mm=np.full((1, 3), np.nan),
        sigma_mm=np.full((1, 3), _NO_STATION_MM),
        setup=np.array([setup]),
        session=np.array([""]),
        pose=np.array([""]),
        extra=extra,
    )


def _beyond(joint: Joint, value: float) -> str:
    """Return a clause about a reading outside the joint's limits; "" if it is inside."""
    if not beyond_limits(joint, np.array([value]), _BEYOND).any():
        return ""
    low, high = joint.limits
    return f"{joint.name} reads {value:.2f} {joint.unit}, outside its limits {low:g} .. {high:g} {joint.unit}"


def _place(vector: np.ndarray) -> Place:
    x, y, z = (float(value) for value in vector)
    return x, y, z
