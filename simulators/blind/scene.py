"""A recording of a duty cycle with fixed poses, readings and noise, to which effects can be added one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.blind.duty_cycle import DutyCycle, PosePlan, continue_duty_cycle, draw_duty_cycle
from simulators.blind.effect_draws import EffectDraws
from simulators.effects.base import Effect
from simulators.rig.dataset import SimulatedObservations, prisms_mm, travel_m
from simulators.rig.noise import FixNoise, NoiseSettings, draw_noise, read_joints
from simulators.rig.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]
Flags = NDArray[np.bool_]

_MISJUDGED = 0.05  # the stated sigma is wrong by a factor of up to 1 -+ this


@dataclass(frozen=True)
class SceneSettings:
    """Settings of a scene.

    Attributes:
        plan: see `duty_cycle.draw_poses`.
        poses, held_out: number of training poses and of hold-out poses; both come from one plan and one duty cycle,
            mixed at random.
        repeats: number of fixes in a pose, of the prism farthest along the machine.
        moving: share of the poses that are measured while joints creep through them.
        is_decoy: the temperature follows the time instead of a daily course, and signals are recorded on which nothing
            depends.
        missing: columns that the data lack: names, or endings that begin with `_` (`_dir`).
        sigma_columns: the data contain the uncertainty of each fix.
        noise: see `NoiseSettings`.
    """

    plan: PosePlan = "wide"
    poses: int = 250
    held_out: int = 150
    repeats: int = 1
    moving: float = 0.3
    is_decoy: bool = False
    missing: tuple[str, ...] = ()
    sigma_columns: bool = True
    noise: NoiseSettings = field(default_factory=NoiseSettings)


@dataclass(frozen=True)
class Fixes:
    """n fixes without measurement errors.

    Attributes:
        prism: (n,) names of the prisms.
        pose: (n,) number of the standstill.
        joints: joint name -> (n,) value at the instant of the fix, deg or mm.
        columns: name -> (n,) true value of a quantity on which effects may depend, without sensor errors.
    """

    prism: Strings
    pose: NDArray[np.intp]
    joints: Mapping[str, Floats]
    columns: Mapping[str, Floats]

    def places_mm(self, machine: RigTruth, joints: Mapping[str, Floats] | None = None) -> Floats:
        """Return the (n, 3) true positions; with the fixes' own joints if `joints` is None."""
        return prisms_mm(machine, self.prism, self.joints if joints is None else joints, self.columns)


@dataclass(frozen=True)
class MeasuredFixes(Fixes):
    """n fixes with their true values and their measurement errors.

    Attributes:
        readings: joint name -> (n,) readings of encoders and transducers, deg or mm.
        recorded: name -> (n,) further columns, with sensor errors.
        noise: noise of the fixes.
        stated_sigma_mm: (n, 3) standard deviation that the data state.
    """

    readings: Mapping[str, Floats]
    recorded: Mapping[str, Floats]
    noise: FixNoise
    stated_sigma_mm: Floats


@dataclass(frozen=True)
class Observed:
    """Data of a machine with hidden effects.

    Attributes:
        training: rows that a search may see. Its `oracle_mm` has the prisms' positions at the joints' readings.
        held_out: hold-out poses of the same duty cycle, without any noise.
    """

    training: SimulatedObservations
    held_out: SimulatedObservations


@dataclass(frozen=True)
class Scene:
    """A recording without effects, to which effects can be added.

    Attributes:
        truth: the machine, without effects.
        settings: settings with which the scene was drawn.
        training: training fixes.
        held_out: hold-out fixes.
        misjudged: factor from the true sigma of the noise to the stated sigma.
        draws: generator of effects that can be hidden in the scene.
    """

    truth: RigTruth
    settings: SceneSettings
    training: MeasuredFixes
    held_out: Fixes
    misjudged: float
    draws: EffectDraws

    def displacement_mm(self, effects: Sequence[Effect]) -> Floats:
        """Return the (n, 3) displacement of the training fixes by effects, mm in the station's frame."""
        return self.training.places_mm(self.machine(effects)) - self._plain_mm

    def machine(self, effects: Sequence[Effect]) -> RigTruth:
        """Return the machine with effects, whose open time and temperature references are set to the training's."""
        zero = self.draws.first_s, self.draws.mean_degC
        return replace_effects(self.truth, [effect.anchored(*zero) for effect in effects])

    @cached_property
    def noise_rms_mm(self) -> float:
        """RMS of the 3-D difference between training fixes and a perfect model at the readings, without outliers."""
        from_readings = self._plain_mm - self.training.places_mm(self.truth, self.training.readings)
        off = (self.training.noise.error_mm + from_readings)[~self.training.noise.is_outlier]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    @cached_property
    def _plain_mm(self) -> Floats:
        return self.training.places_mm(self.truth)

    def observe(self, effects: Sequence[Effect]) -> Observed:
        """Return the data of the machine with effects; with no effects, of its twin with the same noise."""
        machine, there = self.machine(effects), self.held_out
        exact_mm = there.places_mm(machine)
        columns = {name: there.columns[name] for name in self.training.recorded}
        held_out = SimulatedObservations(self._table(there, there.joints, exact_mm, columns), exact_mm, exact_mm)
        return Observed(self._observations(self.training, machine), held_out)

    def measure(
        self,
        effects: Sequence[Effect],
        poses: Mapping[str, Floats],
        seed: int,
        *,
        columns: Mapping[str, Floats] | None = None,
    ) -> SimulatedObservations:
        """Return the data of k further poses, measured after the training poses in the given order.

        Args:
            effects: the hidden effects, the same as for the training.
            poses: joint name -> (k,) deg or mm.
            seed: seed of the noise.
            columns: conditions (`theta4_dir`, `L2_rate`, `payload_kg`, `dwell_s`, `temperature_degC`, `time_s`) and
                number of `fixes` -> (k,). The defaults are standstills of 20 s, a minute apart and
                straight from pose to pose, with the payload and the temperature of the training's end.
        """
        rng = np.random.default_rng([seed, 43])
        before = self.training
        last = {name: float(values[-1]) for name, values in before.columns.items()}
        here = {name: float(values[-1]) for name, values in before.joints.items()}
        further_poses = {name: np.asarray(values, float) for name, values in poses.items()}
        duty = continue_duty_cycle(self.truth, further_poses, here, last, columns or {}, rng)
        way = travel_m(self.truth.rig, {k: np.concatenate([[here[k]], v]) for k, v in duty.joints.items()})
        travelled = {name: last[name] + metres[1:] for name, metres in way.items()}
        first = int(before.pose[-1]) + 1
        settings, repeats = self.settings, (columns or {}).get("fixes")
        further = _measure(
            self.truth, duty, travelled, None, settings, self.misjudged, rng, first=first, repeats=repeats
        )
        return self._observations(further, self.machine(effects))

    def _observations(self, taken: MeasuredFixes, machine: RigTruth) -> SimulatedObservations:
        measured_mm = taken.places_mm(machine) + taken.noise.error_mm
        table = self._table(taken, taken.readings, measured_mm, taken.recorded)
        if self.settings.sigma_columns:
            table |= {f"sigma_{axis}_mm": taken.stated_sigma_mm[:, i] for i, axis in enumerate("xyz")}
        return SimulatedObservations(table, measured_mm, taken.places_mm(machine, taken.readings))

    def _table(
        self, fixes: Fixes, readings: Mapping[str, Floats], places_mm: Floats, recorded: Mapping[str, Floats]
    ) -> dict[str, Floats | Strings]:
        table: dict[str, Floats | Strings] = {"prism": fixes.prism}
        table |= {j.column: readings[j.name] for j in self.truth.rig.joints}
        table |= {f"{axis}_mm": places_mm[:, i] for i, axis in enumerate("xyz")}
        table["pose"] = fixes.pose.astype(np.str_)
        return table | {k: v for k, v in recorded.items() if not self._lacks(k)}

    def _lacks(self, column: str) -> bool:
        return any(column == name or (name[:1] == "_" and column.endswith(name)) for name in self.settings.missing)


def draw_scene(rig: Rig, seed: int, settings: SceneSettings | None = None) -> Scene:
    """Draw a machine, its duty cycle and its noise.

    Args:
        rig: description of the rig.
        seed: the same seed draws the same scene.
        settings: settings of the scene; None for the defaults.

    Raises:
        ValueError: a setting is impossible; the message names it.
    """
    settings = settings or SceneSettings()
    _check(settings)
    rng = np.random.default_rng([seed, 40])
    truth = RigTruth(rig, seed)
    total = settings.poses + settings.held_out
    duty = draw_duty_cycle(truth, total, settings.plan, rng, moving=settings.moving, is_decoy=settings.is_decoy)
    # The first and the last pose are training poses, so that no hold-out pose lies outside the training's time
    is_training = np.zeros(total, dtype=bool)
    is_training[[0, total - 1, *(1 + rng.permutation(total - 2)[: settings.poses - 2])]] = True
    travelled = _travelled(rig, duty, is_training)
    misjudged = 1.0 + _MISJUDGED * float(rng.uniform(-1.0, 1.0))
    training = _measure(truth, duty, travelled, is_training, settings, misjudged, rng)
    taken = training.columns
    draws = EffectDraws(
        rig,
        (_last_prism(rig),),
        first_s=float(taken["time_s"].min()),
        last_s=float(taken["time_s"].max()),
        mean_degC=float(taken["temperature_degC"].mean()),
    )
    held_out = _fixes(rig, duty, travelled, np.flatnonzero(~is_training), settings)
    return Scene(truth, settings, training, held_out, misjudged, draws)


def _measure(
    truth: RigTruth,
    duty: DutyCycle,
    travelled: Mapping[str, Floats],
    chosen: Flags | None,
    settings: SceneSettings,
    misjudged: float,
    rng: np.random.Generator,
    *,
    first: int = 0,
    repeats: Floats | None = None,
) -> MeasuredFixes:
    """Measure the chosen poses of a duty cycle (all if None) and number them from `first` on.

    `repeats` is the number of fixes of each pose; None for the number in the settings.
    """
    rig, n = truth.rig, len(duty.columns["time_s"])
    which = np.arange(n) if chosen is None else np.flatnonzero(chosen)
    fixes = _fixes(rig, duty, travelled, which, settings, repeats)
    order = fixes.pose
    noise = draw_noise(rig.station, fixes.places_mm(truth), order, settings.noise, rng)
    readings = read_joints(rig, duty.joints, duty.columns, settings.noise, rng)
    recorded = {k: v[order] for k, v in duty.recorded(rig, rng).items()}
    recorded |= {name: fixes.columns[name] for name in ("time_s", "dwell_s")}
    return MeasuredFixes(
        fixes.prism,
        first + order,
        fixes.joints,
        fixes.columns,
        {k: v[order] for k, v in readings.items()},
        recorded,
        noise,
        noise.sigma_mm * misjudged,
    )


def _travelled(rig: Rig, duty: DutyCycle, is_training: Flags) -> dict[str, Floats]:
    """Return `<joint>_travel_m` -> (n,) along the training poses only, as if the others had not been visited."""
    time_s = duty.columns["time_s"]
    path = travel_m(rig, {k: v[is_training] for k, v in duty.joints.items()})
    return {k: np.interp(time_s, time_s[is_training], v) for k, v in path.items()}


def _fixes(
    rig: Rig,
    duty: DutyCycle,
    travelled: Mapping[str, Floats],
    chosen: NDArray[np.intp],
    settings: SceneSettings,
    repeats: Floats | None = None,
) -> Fixes:
    """Return fixes of the last prism, `repeats` times at each of the chosen poses, one per second."""
    of_each = np.full(len(chosen), settings.repeats) if repeats is None else repeats.astype(np.intp)
    pose = np.repeat(chosen, of_each)
    shot = np.arange(len(pose)) - np.repeat(np.cumsum(of_each) - of_each, of_each)
    prism: Strings = np.full(len(pose), _last_prism(rig))
    columns = {k: v[pose] for k, v in (dict(duty.columns) | dict(travelled)).items()}
    standing = columns["dwell_s"] > 0.0
    columns |= {"time_s": columns["time_s"] + shot, "dwell_s": columns["dwell_s"] + shot * standing}
    return Fixes(prism, pose, {k: v[pose] for k, v in duty.joints.items()}, columns)


def _last_prism(rig: Rig) -> str:
    """Return the name of the prism farthest along the machine."""
    return max(rig.prisms, key=lambda prism: prism.frame).name


def _check(settings: SceneSettings) -> None:
    if settings.poses < 3 or settings.held_out < 1 or settings.repeats < 1:
        raise ValueError("a scene needs at least 3 poses, 1 held-out pose and 1 fix of each")
    if not 0.0 <= settings.moving <= 1.0:
        raise ValueError("the moving share of a scene must be from 0 to 1")
