"""Cases of the benchmark: observations, label and twin of a cell, and measurements of further poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from calibration.rig.description import Rig
from simulators.blind.aliases import alias_scene
from simulators.blind.alternatives import MARGIN, nearest_alternative
from simulators.blind.cells import Cell
from simulators.blind.duty_cycle import PosePlan
from simulators.blind.hiding import HiddenEffect, UnreachableError, hide
from simulators.blind.machine import draw_machine, draw_unknown
from simulators.blind.regime import BORDER_WITHIN, draw_regime
from simulators.blind.scene import Scene, SceneSettings, draw_scene
from simulators.blind.visibility import Visibility, reading_covariance_mm2, timing_covariance_mm2
from simulators.effects.base import Effect
from simulators.effects.library import LIBRARY
from simulators.effects.part import PartialEffect
from simulators.rig.dataset import SimulatedObservations
from simulators.rig.noise import NoiseSettings

POSES = {"wide": 250, "face": 250, "sparse": 60, "many": 500, "path": 250}
HELD_OUT = {"wide": 150, "face": 150, "sparse": 60, "many": 150, "path": 60}
_PLANS: Mapping[str, PosePlan] = {"wide": "wide", "face": "face", "sparse": "sparse", "many": "wide", "path": "path"}
ENCODER_STEP_DEG = {"fine": 0.0, "stepped": 0.02, "coarse": 0.1}
_WITH_TWIN = ("single", "pair", "triple", "machine")
# An error of a joint's own angle is also a curve of the angle: if the specific family is missing, the general one is
# true. A carrier that leans to its loaded side is compliant, whatever its law.
_GENERAL = {
    "encoder_harmonic": ("joint_error_map",),
    "angle_scale": ("joint_error_map",),
    "base_rocking": ("base_compliance",),
    "jack_lean": ("base_compliance",),
}
_STEP_VARIANCE = 1.0 / 12.0  # of a reading in whole steps, in squared steps
_POSITION_COLUMNS = ("x_mm", "y_mm", "z_mm")
# Columns of which one case in three lacks one, provided that no hidden effect of the case depends on it
_MAY_LACK = ("temperature_degC", "dwell_s", "_rate", "_bar", "_mA")
_LACKING = 1 / 3
# Of a path: the error that wanders along it in units of the noise, its correlation length in rows, and the share of
# cases that lack the time columns
_PATH_WANDER, _PATH_ROWS = (0.5, 3.0), (5.0, 60.0)
_TIMELESS, _TIMES = 0.5, ("time_s", "dwell_s")

RULES = (
    f"{POSES['wide']} poses and one prism if poses are wide, face or path, {POSES['sparse']} if they are sparse, "
    f"{POSES['many']} if they are many",
    "Visible size: RMS of the effect's displacement in units of the noise (station and readings), without the part "
    "that constants within one build tolerance, the prism's offset and a free base can explain",
    "Amplitudes are capped at the library's hard bounds; a case that cannot reach its size anywhere is dropped",
    f"Separable, decided from the truth before any answer: the nearest family is beaten by ln odds of {MARGIN:g} in "
    "all but 2 % of the draws of the noise; loads are those of the machine, sizes go up to the hard bounds; a free "
    "curve of a joint's angle is not an alternative",
    "A set where one family could have been named: the nearest family is beaten in all but 0.1 % of the draws",
    "Right: every hidden family that the library has is named, and no other family",
    "With encoder_harmonic or angle_scale left out, joint_error_map is a true name and not a wrong one, because it is "
    "any curve of the joint's own angle",
    "Right location, of an effect outside the library: the first result about it (the place named, the description, or "
    "the foremost disagreement) is at its place; for the boom, also at the joints at its tip",
    "Gap closed: (before^2 - after^2) / (before^2 - oracle^2) at held-out poses against their noise-free places; "
    "before and after are the workflow's kinematics without and with effects, the oracle is the kinematics of the twin "
    "without effects; cases in which kinematics alone come within 2 % of the oracle are left out",
    "Of a machine: a name at a place where it is not hidden is wrong; base_compliance in addition to a leaning carrier "
    "is neither right nor wrong; the twin has the unknown structure",
    f"Of an effect in a part of the data: a border is right within {100 * BORDER_WITHIN:g} % of its variable's range",
)


@dataclass(frozen=True)
class Drawn:
    """A case.

    Attributes:
        train: observations as CSV.
        held_out: readings of further poses, without positions, as CSV.
        twin: observations of the same machine with the same noise and no effects, as CSV; None if no score needs it.
        without: families that the analysis may not use.
        label: hidden effects, and everything else that the scoring needs.
    """

    train: str
    held_out: str
    twin: str | None
    without: tuple[str, ...]
    label: dict[str, Any]


def families(rig: Rig) -> tuple[str, ...]:
    """Return the families of the library for which a rig has a place."""
    draws = draw_scene(rig, 0, SceneSettings(poses=3, held_out=1)).draws
    return tuple(name for name in LIBRARY if draws.places(name))


def draw(rig: Rig, cell: Cell) -> Drawn | None:
    """Draw the case of a cell; None if its effects cannot reach the wanted visible size."""
    try:
        made = _make(rig, cell)
    except UnreachableError:
        return None
    scene, hidden = made.scene, made.hidden
    observed = scene.observe(made.effects)
    nearest = nearest_alternative(scene, made.visibility, hidden[0].effect) if cell.kind == "single" else None
    twin = scene.observe(made.unknown) if cell.kind in _WITH_TWIN else None
    without = cell.families if cell.kind == "left_out" else ()
    label = {
        "kind": cell.kind,
        "poses": cell.poses,
        "noise": cell.noise,
        "size": cell.size,
        "seed": cell.seed,
        "effects": [_effect_label(rig, h, without) for h in hidden],
        "unknown": [asdict(effect) | {"family": effect.family} for effect in made.unknown],
        "separable": nearest is None or nearest.is_separable,
        "plain": nearest is None or nearest.is_plain,
        "alternative": "" if nearest is None else nearest.alternative,
        "regime": made.regime,
        "aliases": cell.families[0].split("|") if cell.kind == "alias" else [],
        "general": _general(made, without),
        "noise_rms_mm": scene.noise_rms_mm,
        "lacking": list(scene.settings.missing),
        "truth_mm": observed.held_out.oracle_mm.round(4).tolist(),
        "twin_mm": None if twin is None else twin.held_out.oracle_mm.round(4).tolist(),
    }
    twin_text = None if twin is None else twin.training.csv_text()
    return Drawn(observed.training.csv_text(), _readings(observed.held_out), twin_text, without, label)


def measured(rig: Rig, cell: Cell, poses: Sequence[Mapping[str, Any]]) -> str:
    """Measure further poses of a case; return all its observations as CSV.

    Args:
        rig: description of the rig.
        cell: cell of the case.
        poses: rows of a plan, with a column for every joint and optionally `<joint>_dir`, `fixes` and other columns.

    Raises:
        ValueError: there is no pose, or a pose lacks a joint.
    """
    if missing := [j.column for j in rig.joints if not poses or any(j.column not in row for row in poses)]:
        raise ValueError(f"the plan has no pose, or a pose without {missing[0]}")
    made = _make(rig, cell)
    scene, effects = made.scene, made.effects
    joints = {j.name: np.array([float(row[j.column]) for row in poses]) for j in rig.joints}
    how = [k for k in (*scene.training.columns, "fixes") if all(k in row for row in poses)]
    columns = {k: np.array([float(row[k]) for row in poses]) for k in how}
    before, after = scene.observe(effects).training, scene.measure(effects, joints, cell.seed, columns=columns)
    table = {name: np.concatenate([values, after.columns[name]]) for name, values in before.columns.items()}
    return replace(before, columns=table).csv_text()


@dataclass(frozen=True)
class _Made:
    """A case before it is observed.

    Attributes:
        scene: the scene that will be observed.
        visibility: visible part of displacements in the scene.
        hidden: effects that the analysis should name or describe.
        unknown: effects that form structure without a name; the twin has them too.
        regime: the part of the data in which the hidden effect acts, for the scorer; None for all data.
    """

    scene: Scene
    visibility: Visibility
    hidden: tuple[HiddenEffect, ...] = ()
    unknown: tuple[Effect, ...] = ()
    regime: Mapping[str, Any] | None = None

    @property
    def effects(self) -> list[Effect]:
        return [*(h.effect for h in self.hidden), *self.unknown]


def _make(rig: Rig, cell: Cell) -> _Made:
    """Draw a cell's scene and its hidden effects; the same seed always gives the same result."""
    rng = np.random.default_rng([cell.seed, 50])
    settings = SceneSettings(
        plan=_PLANS[cell.poses],
        poses=POSES[cell.poses],
        held_out=HELD_OUT[cell.poses],
        is_decoy=cell.kind == "decoy",
        sigma_columns=bool(rng.random() < 0.5),
        noise=NoiseSettings(encoder_step_deg=ENCODER_STEP_DEG[cell.noise]),
    )
    make = {"machine": _make_machine, "regime": _make_regime, "path": _make_path}.get(cell.kind, _make_named)
    made = make(rig, cell, settings, rng)
    return replace(made, scene=_lacking(made.scene, made.effects, rng))


def _make_named(rig: Rig, cell: Cell, settings: SceneSettings, rng: np.random.Generator) -> _Made:
    """Draw a case with the effects that its cell names."""
    scene = draw_scene(rig, cell.seed, settings)
    wanted, where = cell.families, None
    if cell.kind == "alias":
        scene, where = alias_scene(scene, cell.families[0], rng)
        wanted = (str(rng.choice(cell.families[0].split("|"))),)
    visibility = _visibility(scene)
    hidden = hide(scene, wanted, cell.size, visibility.size, cell.seed, where=(where,)) if wanted else ()
    return _Made(scene, visibility, hidden)


def _make_machine(rig: Rig, cell: Cell, settings: SceneSettings, rng: np.random.Generator) -> _Made:
    """Draw a machine with many effects in addition to unknown structure."""
    sizes = draw_unknown(rng)
    noise = replace(settings.noise, excess_wander=sizes.wander, wander_poses=sizes.wander_poses)
    scene = draw_scene(rig, cell.seed, replace(settings, noise=noise))
    visibility = _visibility(scene)
    hidden, unknown = draw_machine(scene, visibility, sizes, cell.seed)
    return _Made(scene, visibility, hidden, unknown)


def _make_regime(rig: Rig, cell: Cell, settings: SceneSettings, rng: np.random.Generator) -> _Made:
    """Draw a case with an effect that acts only in a part of the data."""
    scene = draw_scene(rig, cell.seed, settings)
    visibility = _visibility(scene)
    regime = draw_regime(scene, visibility, cell.size, rng)
    if regime.by_row:
        scene = replace(scene, settings=replace(settings, missing=("time_s",)))
    return _Made(scene, visibility, (regime.hidden,), regime=regime.label)


def _make_path(rig: Rig, cell: Cell, settings: SceneSettings, rng: np.random.Generator) -> _Made:
    """Draw a case without effects, with an error that wanders along a path."""
    wander, rows = float(rng.uniform(*_PATH_WANDER)), float(rng.uniform(*_PATH_ROWS))
    noise = replace(settings.noise, excess_wander=wander, wander_poses=rows)
    missing = _TIMES if rng.random() < _TIMELESS else ()
    scene = draw_scene(rig, cell.seed, replace(settings, noise=noise, missing=missing))
    return _Made(scene, _visibility(scene))


def _general(made: _Made, without: Sequence[str]) -> list[str]:
    """Return the families that also describe the hidden effects, although these have a different name or none."""
    nameless = [h.effect.family for h in made.hidden if h.effect.family in without or h.effect.family not in LIBRARY]
    nameless += [effect.family for effect in made.unknown]
    return sorted({name for family in nameless for name in _GENERAL.get(family, ())})


def _visibility(scene: Scene) -> Visibility:
    """Return the visibility against a scene's noise without outliers: station, resolution and timing of readings."""
    settings, fixes, rig = scene.settings.noise, scene.training, scene.truth.rig
    n = len(fixes.prism)
    sigma = {}
    for joint in rig.joints:
        step = joint.resolution
        if joint.kind == "revolute" and settings.encoder_step_deg:
            step = settings.encoder_step_deg
        sigma[joint.name] = np.full(n, np.sqrt(joint.sigma**2 + _STEP_VARIANCE * step**2))
    late = {joint.name: fixes.columns[f"{joint.name}_rate"] * settings.jitter_s for joint in rig.joints}
    readings = reading_covariance_mm2(scene.truth, fixes.prism, fixes.joints, sigma)
    timing = timing_covariance_mm2(scene.truth, fixes.prism, fixes.joints, late)
    return Visibility(scene.truth, fixes.prism, fixes.joints, fixes.noise.covariance_mm2 + readings + timing)


def _lacking(scene: Scene, effects: Sequence[Effect], rng: np.random.Generator) -> Scene:
    """Remove a column from one case in three, but never one on which a hidden effect depends."""
    name = str(rng.choice(_MAY_LACK))
    if rng.random() >= _LACKING or scene.settings.missing:
        return scene
    fixes = scene.training
    left = {k: v for k, v in fixes.columns.items() if not k.endswith(name)}
    try:
        replace(fixes, columns=left).places_mm(scene.machine(effects))
    except ValueError:
        return scene
    return replace(scene, settings=replace(scene.settings, missing=(name,)))


def _effect_label(rig: Rig, hidden: HiddenEffect, without: Sequence[str]) -> dict[str, Any]:
    effect = hidden.effect.effect if isinstance(hidden.effect, PartialEffect) else hidden.effect
    plausible = type(effect)(where=effect.where)
    at_the_tip = {name for row in rig.rows if "a" in row.drive for driven in row.drive.values() for name in driven}
    return {
        "family": effect.family,
        "where": effect.where,
        "has_name": effect.family in LIBRARY and effect.family not in without,
        # An effect of the boom is visible at its tip, at the joints of that row
        "places": [effect.where, *(sorted(at_the_tip) if effect.where == "boom" else ())],
        "coefficients": {name: float(getattr(effect, name)) for name in effect.amplitudes},
        "scale": {name: abs(float(getattr(plausible, name))) for name in effect.amplitudes},
        "size": hidden.size,
        "separable": hidden.separable,
    }


def _readings(observations: SimulatedObservations) -> str:
    """Return observations without positions as CSV."""
    columns = {k: v for k, v in observations.columns.items() if k not in _POSITION_COLUMNS}
    return replace(observations, columns=columns).csv_text()
