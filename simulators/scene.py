"""A shift of work and its noise, before anything is hidden: the same scene with other effects has the same noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig
from simulators.dataset import SimulatedObservations, prisms_mm, travel_m
from simulators.effect_draws import EffectDraws
from simulators.effects.base import Effect
from simulators.noise import FixNoise, NoiseSettings, draw_noise, read_joints
from simulators.pose_plans import PosePlan
from simulators.shift import Shift, draw_shift, visit
from simulators.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class SceneSettings:
    """What kind of data.

    Attributes:
        plan: see `pose_plans.draw_poses`.
        poses, held_out: how many poses are trained on, and how many are kept to judge by; both are of one plan and one
            shift, mixed at random.
        prisms: measured at each pose; the one farthest along the machine where there is none.
        repeats: fixes of a prism in a pose.
        hours: length of the shift.
        perturbation: how many build tolerances the machine deviates from its rig file.
        moving: share of the poses that are measured while joints creep through them.
        decoy_temperature: the temperature follows the time, in place of a daily course.
        decoys: how many signals are recorded that nothing depends on.
        missing: columns that the data lacks: names, or endings that begin with `_` (`_dir`).
        sigma_columns: the data says how uncertain each fix is.
        noise: see `NoiseSettings`.
    """

    plan: PosePlan = "wide"
    poses: int = 250
    held_out: int = 150
    prisms: tuple[str, ...] = ()
    repeats: int = 1
    hours: float = 8.0
    perturbation: float = 1.0
    moving: float = 0.3
    decoy_temperature: bool = False
    decoys: int = 0
    missing: tuple[str, ...] = ()
    sigma_columns: bool = True
    noise: NoiseSettings = field(default_factory=NoiseSettings)


@dataclass(frozen=True)
class Fixes:
    """n fixes as they truly are.

    Attributes:
        prism: (n,) names.
        pose: (n,) number of the standstill.
        joints: joint name -> (n,) at the instant of the fix, deg or mm.
        columns: everything that effects may depend on, without any sensor's error -> (n,).
    """

    prism: Strings
    pose: NDArray[np.intp]
    joints: Mapping[str, Floats]
    columns: Mapping[str, Floats]

    def places_mm(self, machine: RigTruth, joints: Mapping[str, Floats] | None = None) -> Floats:
        """(n, 3) fixes without noise, for these joints or others."""
        return prisms_mm(machine, self.prism, self.joints if joints is None else joints, self.columns)


@dataclass(frozen=True)
class MeasuredFixes(Fixes):
    """n fixes as they truly are, and how they and everything else is measured.

    Attributes:
        readings: joint name -> (n,) what encoders and transducers say, deg or mm.
        recorded: further columns as their sensors give them -> (n,).
        noise: of the fixes.
        stated_sigma_mm: (n, 3) what the data says of it.
    """

    readings: Mapping[str, Floats]
    recorded: Mapping[str, Floats]
    noise: FixNoise
    stated_sigma_mm: Floats


@dataclass(frozen=True)
class Observed:
    """Data of a machine with something hidden.

    Attributes:
        training: what a search may see. Its `oracle_mm` is where the machine has the prisms if the joints are as read.
        held_out: other poses of the same shift without any noise, to judge by.
    """

    training: SimulatedObservations
    held_out: SimulatedObservations


@dataclass(frozen=True)
class Scene:
    """A shift of work and its noise, before anything is hidden.

    Attributes:
        truth: the machine, without effects.
        settings: as drawn with.
        training: what is measured.
        held_out: what is kept to judge by.
        misjudged: factor from the noise's sigma to what the data says of it.
        draws: what may be hidden in it.
    """

    truth: RigTruth
    settings: SceneSettings
    training: MeasuredFixes
    held_out: Fixes
    misjudged: float
    draws: EffectDraws

    def shift_mm(self, effects: Sequence[Effect]) -> Floats:
        """(n, 3) by what effects move the fixes of the training, mm in the station's frame."""
        return self.training.places_mm(self.machine(effects)) - self._plain_mm

    def machine(self, effects: Sequence[Effect]) -> RigTruth:
        """The machine with hidden effects; where they leave it open, they count time and warmth from the training's."""
        zero = self.draws.first_s, self.draws.mean_degC
        return replace_effects(self.truth, [effect.anchored(*zero) for effect in effects])

    @cached_property
    def noise_rms_mm(self) -> float:
        """RMS of the 3-D difference of fixes and a perfect model at the readings, in training; without outliers."""
        from_readings = self._plain_mm - self.training.places_mm(self.truth, self.training.readings)
        off = (self.training.noise.shift_mm + from_readings)[~self.training.noise.is_outlier]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    @cached_property
    def _plain_mm(self) -> Floats:
        return self.training.places_mm(self.truth)

    def observe(self, effects: Sequence[Effect]) -> Observed:
        """The data of the machine with hidden effects; without any: its twin, of the same noise."""
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
        """The data of k further poses, taken after the training's in the order given.

        Args:
            effects: hidden ones, the same as of the training.
            poses: joint name -> (k,) deg or mm.
            seed: of the noise.
            columns: how they are taken where that matters (`theta4_dir`, `L2_rate`, `payload_kg`, `dwell_s`,
                `temperature_degC`, `time_s`), and how many `fixes` of each prism -> (k,). Else each is a standstill of
                20 s, a minute after the one before and straight from it, with the payload and the temperature of the
                training's end.
        """
        rng = np.random.default_rng([seed, 43])
        before = self.training
        last = {name: float(values[-1]) for name, values in before.columns.items()}
        here = {name: float(values[-1]) for name, values in before.joints.items()}
        shift = visit(self.truth, {k: np.asarray(v, float) for k, v in poses.items()}, here, last, columns or {}, rng)
        way = travel_m(self.truth.rig, {k: np.concatenate([[here[k]], v]) for k, v in shift.joints.items()})
        travelled = {name: last[name] + metres[1:] for name, metres in way.items()}
        first = int(before.pose[-1]) + 1
        settings, repeats = self.settings, (columns or {}).get("fixes")
        further = _measure(
            self.truth, shift, travelled, None, settings, self.misjudged, rng, first=first, repeats=repeats
        )
        return self._observations(further, self.machine(effects))

    def _observations(self, taken: MeasuredFixes, machine: RigTruth) -> SimulatedObservations:
        measured_mm = taken.places_mm(machine) + taken.noise.shift_mm
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
    """A machine, a shift of work and its noise.

    Args:
        rig: the description.
        seed: the same seed draws the same scene.
        settings: what kind of data.

    Raises:
        ValueError: settings that mean nothing; the message says which.
        KeyError: no such prism.
    """
    settings = settings or SceneSettings()
    _check(settings)
    rng = np.random.default_rng([seed, 40])
    truth = RigTruth(rig, seed, perturbation=settings.perturbation)
    total = settings.poses + settings.held_out
    shift = draw_shift(
        truth,
        total,
        settings.plan,
        rng,
        hours=settings.hours,
        moving=settings.moving,
        decoy_temperature=settings.decoy_temperature,
        decoys=settings.decoys,
    )
    # The first and the last pose are trained on: nothing is asked of times beyond the data's.
    is_training = np.zeros(total, dtype=bool)
    is_training[[0, total - 1, *(1 + rng.permutation(total - 2)[: settings.poses - 2])]] = True
    travelled = _travelled(rig, shift, is_training)
    misjudged = 1.0 + settings.noise.misjudged * float(rng.uniform(-1.0, 1.0))
    training = _measure(truth, shift, travelled, is_training, settings, misjudged, rng)
    taken = training.columns
    draws = EffectDraws(
        rig,
        _prisms(rig, settings),
        first_s=float(taken["time_s"].min()),
        last_s=float(taken["time_s"].max()),
        mean_degC=float(taken["temperature_degC"].mean()),
    )
    held_out = _fixes(rig, shift, travelled, np.flatnonzero(~is_training), settings)
    return Scene(truth, settings, training, held_out, misjudged, draws)


def _measure(
    truth: RigTruth,
    shift: Shift,
    travelled: Mapping[str, Floats],
    chosen: Flags | None,
    settings: SceneSettings,
    misjudged: float,
    rng: np.random.Generator,
    *,
    first: int = 0,
    repeats: Floats | None = None,
) -> MeasuredFixes:
    """Measure the chosen poses of a shift; None is all of them. Their numbers begin at `first`.

    `repeats` says how many fixes of each prism, where that is not as the settings have it.
    """
    rig, n = truth.rig, len(shift.columns["time_s"])
    which = np.arange(n) if chosen is None else np.flatnonzero(chosen)
    fixes = _fixes(rig, shift, travelled, which, settings, repeats)
    order = fixes.pose
    noise = draw_noise(rig.station, fixes.places_mm(truth), order, settings.noise, rng)
    readings = read_joints(rig, shift.joints, shift.columns, settings.noise, rng)
    recorded = {k: v[order] for k, v in shift.recorded(rig, rng).items()}
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


def _travelled(rig: Rig, shift: Shift, is_training: Flags) -> dict[str, Floats]:
    """`<joint>_travel_m` -> (n,) as the training's poses alone make it: the others count as not visited in between."""
    time_s = shift.columns["time_s"]
    path = travel_m(rig, {k: v[is_training] for k, v in shift.joints.items()})
    return {k: np.interp(time_s, time_s[is_training], v) for k, v in path.items()}


def _fixes(
    rig: Rig,
    shift: Shift,
    travelled: Mapping[str, Floats],
    chosen: NDArray[np.intp],
    settings: SceneSettings,
    repeats: Floats | None = None,
) -> Fixes:
    """Every prism, so many times, at each of the chosen poses; a fix a second."""
    names = np.array(_prisms(rig, settings), dtype=np.str_)
    of_each = np.full(len(chosen), settings.repeats) if repeats is None else repeats.astype(np.intp)
    count = len(names) * of_each
    pose = np.repeat(chosen, count)
    shot = np.arange(len(pose)) - np.repeat(np.cumsum(count) - count, count)
    prism: Strings = names[shot // np.repeat(of_each, count)]
    columns = {k: v[pose] for k, v in (dict(shift.columns) | dict(travelled)).items()}
    standing = columns["dwell_s"] > 0.0
    columns |= {"time_s": columns["time_s"] + shot, "dwell_s": columns["dwell_s"] + shot * standing}
    return Fixes(prism, pose, {k: v[pose] for k, v in shift.joints.items()}, columns)


def _prisms(rig: Rig, settings: SceneSettings) -> tuple[str, ...]:
    names = settings.prisms or (max(rig.prisms, key=lambda prism: prism.frame).name,)
    return tuple(rig.prism(name).name for name in names)


def _check(settings: SceneSettings) -> None:
    if settings.poses < 3 or settings.held_out < 1 or settings.repeats < 1:
        raise ValueError("a scene takes 3 poses or more, 1 held-out pose or more, and 1 fix or more of each")
    if settings.hours <= 0.0 or not 0.0 <= settings.moving <= 1.0 or settings.decoys < 0:
        raise ValueError("a scene takes hours above 0, a moving share from 0 to 1, and no negative number of decoys")
