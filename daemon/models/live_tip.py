"""The present place of the tip: the latest joint readings through the live model, or why that is not known.

`on_records` runs in the writer's thread and only notes what the joiner knows of the machine; the model is asked in the
threads of those who want to know. Every way in which a position could be wrong without looking so has a status of its
own: no model, a model that cannot be used, readings that are old or bad, joints beyond their limits or with a zero that
the model does not know, and poses beyond what it was trained on.
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

FRESH_S = 1.0  # readings older than this give no position
_AHEAD_S = 0.1  # a reading's stamp may be this far ahead of the clock: a kernel's stamps are brought to it from another
_BEYOND = 0.02  # of a joint's range: its zero may be off by so much
_NO_STATION_MM = 1e-3  # the tip's own standard deviation is wanted, not that of a fix of it

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Tip:
    """The corrected place of a prism.

    Attributes:
        status: what it is worth.
        reason: why there is no position, a sentence; "" where there is one.
        prism: whose place it is.
        model: number of the live model; None where none is loaded.
        utc_ns: the instant that it is of; None before all joints were read in this boot.
        age_s: how long ago that was.
        joints: the readings it follows from, by their observations column; angles on the turn of the joint's limits.
        base_mm: x, y, z in the base frame.
        sigma_mm: RMS of the 3-D error to be expected: parameters, readings, timing, what the model lacks. The base
            frame is the one that the calibration has placed before its stations.
        setup: the set-up that the station stands in, where it has not moved and the model knows it.
        station_mm, station_sigma_mm: x, y, z in that station's frame as it would measure them, with what its fixes err
            by and how the base has moved, and their standard deviations.
        warnings: what the model was not trained on.
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
    """The present place of any prism.

    Args:
        rig: the machine.
        joiner: what is known of the joints; fed in the thread that calls `on_records`.
        model: the live model.
        setup: the set-up that the station stands in, None without one and where it has moved.
        clock: for the readings' age.
        prism: of `rigcal tip` where no other is named; None where none is configured.
        fresh_s: readings older than this, on that clock, give no position.
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

    def on_records(self, records: Sequence[Record]) -> None:
        """Note what the joiner knows, which has these records already; costs next to nothing while no model is live."""
        joints = self._rig.joint_names
        if any(isinstance(r, DeviceEvent) and r.kind is EventKind.PRESET_JUMP and r.device in joints for r in records):
            self._model.changed()  # the store knows of the jump by now
        if isinstance(self._model.now(), Loaded):
            self._state = self._joiner.latest()

    def tip_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the present place of a prism, by default the configured one."""
        prism = arguments.get("prism", self._prism)
        names = ", ".join(self._rig.prism_names)
        if prism is None:
            raise CommandError(f"name a prism with --prism, or configure [tip] prism; the rig has {names}")
        if prism not in self._rig.prism_names:
            raise CommandError(f"rig {self._rig.name!r} has no prism {prism!r:.80}; it has {names}")
        return self.tip(str(prism), self._setup()).as_dict()

    def tip(self, prism: str, setup: str | None = None) -> Tip:
        """Return the present place of a prism; from any thread.

        Args:
            prism: of the rig.
            setup: a set-up in whose station's frame the place is wanted, too.
        """
        # The state before the model: when it shows a jump, the model from before the jump is in use no more.
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
        except Exception as error:  # whatever fails, there is no position, and the receiver must know
            if not self._is_failing:
                log.warning("the live model does not predict", exc_info=error)
            self._is_failing = True
            return replace(known, status=TipStatus.FAILED, reason=f"the live model does not predict here: {error}")
        self._is_failing = False
        return tip

    def _as_read(self, state: MachineState, prism: str, model: int) -> Tip:
        """The readings and their age, with no place yet; STALE where they are not of now."""
        now = self._clock.now()
        joints = _readings(self._rig, state)
        if now.boot_id != state.boot_id:  # the joiner is fed with what a killed run left undecoded, too
            reason = "the joints were last read before the computer was started anew; is the bus silent?"
            return Tip(TipStatus.STALE, reason, prism, model, joints=joints)
        old_ns = now.monotonic_ns - state.monotonic_ns
        age_s = old_ns / NS_PER_S
        known = Tip(TipStatus.OK, "", prism, model, now.utc_ns - old_ns, age_s, joints)
        if age_s < -_AHEAD_S:
            reason = f"the joints' readings are {-age_s:.1f} s ahead of the clock; what stamps {state.oldest}?"
            return replace(known, status=TipStatus.STALE, reason=reason)
        if age_s > self._fresh_s:
            reason = f"the joints were last read together {age_s:.1f} s ago; is {state.oldest} silent?"
            return replace(known, status=TipStatus.STALE, reason=reason)
        return known


def _unknown(live: Loaded | Missing, state: MachineState | str, prism: str) -> Tip:
    """Return a tip that says why nothing can be predicted with this model and these readings."""
    if not isinstance(live, Loaded):
        return Tip(TipStatus.MODEL_UNUSABLE if live.is_defect else TipStatus.NO_MODEL, live.reason, prism)
    if live.jumped:
        reason = (
            f"{', '.join(live.jumped)} jumped since the live model was trained; check the zero, then say so with "
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
    """A doubt about every effect that one instant does not tell."""
    from calibration.effects.library import library

    for effect in model.effects:
        if library()[effect.family].depends_on_travel:
            yield (
                f"{effect.family}@{effect.where} grows with the path that {effect.where} travels, which is not known "
                f"since the training: calibrate again where that is much"
            )


def _readings(rig: Rig, state: MachineState) -> dict[str, float]:
    """Column -> the joint's reading, on the turn that training saw it on."""
    read = {joint.name: np.array([state.values[joint.column]]) for joint in rig.joints}
    turned = on_one_turn(rig, read)
    return {joint.column: float(turned[joint.name][0]) for joint in rig.joints}


def _observation(live: Loaded, rig: Rig, state: MachineState, known: Tip, setup: str) -> Observations:
    """One row as training saw it: the joints, and whatever else is known of the machine."""
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
    """Say how a reading lies outside the joint's limits; "" inside them."""
    if not beyond_limits(joint, np.array([value]), _BEYOND).any():
        return ""
    low, high = joint.limits
    return f"{joint.name} reads {value:.2f} {joint.unit}, outside its limits {low:g} .. {high:g} {joint.unit}"


def _place(vector: np.ndarray) -> Place:
    x, y, z = (float(value) for value in vector)
    return x, y, z
