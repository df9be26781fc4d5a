"""Scenes in which two effects are confounded: the poses and signals are chosen so that both explain the data."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import numpy as np

from simulators.blind.hiding import UnreachableError
from simulators.blind.scene import Fixes, Scene
from simulators.effects.families.encoders import ZeroStep
from simulators.rig.screws import Floats

_VISIT_H, _NEXT_VISIT_H = 0.2, 5.0
_IDLE_BAR, _FULL_STROKE_BAR = 60.0, 250.0

# True columns, and the same as recorded, of some fixes.
Change = Callable[[Fixes], Mapping[str, Floats]]


def alias_scene(scene: Scene, families: str, rng: np.random.Generator) -> tuple[Scene, str]:
    """Return a scene in which two effects cannot be told apart, and the place of both.

    Args:
        scene: poses and noise.
        families: one of `cells.ALIASES`.
        rng: chooses the place where there are several.

    Raises:
        UnreachableError: this rig has no such place.
        KeyError: no such pair.
    """
    return _MADE[families](scene, rng)


def _two_visits(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Two short visits, hours apart: a drift and a step in between are the same."""
    del rng
    return _at_other_times(scene, lambda fixes: {"time_s": _visits(scene, fixes)[0]}), "base"


def _creeping_later(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Two short visits, and motion in the second alone: how the clock was in the first does not show."""
    del rng
    rates = [f"{name}_rate" for name in scene.truth.rig.joint_names]

    def change(fixes: Fixes) -> dict[str, Floats]:
        time_s, visit = _visits(scene, fixes)
        return {"time_s": time_s, **{name: fixes.columns[name] * visit for name in rates}}

    return _at_other_times(scene, change), "clock"


def _visits(scene: Scene, fixes: Fixes) -> tuple[Floats, Floats]:
    """(n,) instants of fixes in two visits instead of one duty cycle, s; (n,) 0 in the first and 1 in the second."""
    first, last = scene.draws.first_s, scene.draws.last_s
    part = 2.0 * (fixes.columns["time_s"] - first) / (last - first)
    visit = (part >= 1.0).astype(float)
    return first + 3600.0 * (visit * _NEXT_VISIT_H + (part - visit) * _VISIT_H), visit


def _at_other_times(scene: Scene, change: Change) -> Scene:
    made = _changed(scene, change)
    time_s = made.training.columns["time_s"]
    return replace(made, draws=replace(made.draws, first_s=float(time_s.min()), last_s=float(time_s.max())))


def _lowered(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """A joint that always comes to rest in the direction of its load: friction there is as elasticity."""
    where = _one_of(
        [p for p in scene.draws.places("load_hysteresis") if p in scene.draws.places("joint_compliance")], rng
    )

    def change(fixes: Fixes) -> dict[str, Floats]:
        side = np.sign(scene.truth.gravity_load(where, fixes.joints, fixes.columns))
        return {f"{where}_dir": side, f"{where}_rate": np.abs(fixes.columns[f"{where}_rate"]) * side}

    return _changed(scene, change), where


def _from_the_other_side(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Two short visits, and a joint that comes from below in the first and from above in the second.

    Its play is then as a zero that stepped in between.
    """
    where = _one_of(
        _far_reaching(scene, set(scene.draws.places("backlash")) & set(scene.draws.places("zero_step"))), rng
    )

    def change(fixes: Fixes) -> dict[str, Floats]:
        time_s, visit = _visits(scene, fixes)
        side = 1.0 - 2.0 * visit
        rate = np.abs(fixes.columns[f"{where}_rate"]) * side
        return {"time_s": time_s, f"{where}_dir": side, f"{where}_rate": rate}

    return _at_other_times(scene, change), where


def _pressed(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """A pressure that follows the stroke: its compression of the cylinder is as a wrong scale."""
    where = _one_of(list(scene.draws.places("cylinder_compression")), rng)
    stroke = max(abs(limit) for limit in scene.truth.rig.joint(where).limits)

    def change(fixes: Fixes) -> dict[str, Floats]:
        return {f"{where}_bar": _IDLE_BAR + _FULL_STROKE_BAR * fixes.joints[where] / stroke}

    return _changed(scene, change), where


_MADE: Mapping[str, Callable[[Scene, np.random.Generator], tuple[Scene, str]]] = {
    "base_settlement|base_step": _two_visits,
    "load_hysteresis|joint_compliance": _lowered,
    "cylinder_compression|transducer_scale": _pressed,
    "latency|clock_drift": _creeping_later,
    "backlash|zero_step": _from_the_other_side,
}


def _changed(scene: Scene, change: Change) -> Scene:
    """Replace columns, recorded with the same errors of their sensors; zero is recorded as zero."""
    training, held_out, new = scene.training, scene.held_out, change(scene.training)
    recorded = {
        name: np.where(values == 0.0, 0.0, training.recorded[name] + values - training.columns[name])
        for name, values in new.items()
    }
    return replace(
        scene,
        training=replace(training, columns={**training.columns, **new}, recorded={**training.recorded, **recorded}),
        held_out=replace(held_out, columns={**held_out.columns, **change(held_out)}),
    )


def _far_reaching(scene: Scene, joints: Collection[str]) -> list[str]:
    """Return the joints that move the prism by as much as the median one, or more: play of others hardly shows."""
    moved = {p: scene.displacement_mm([ZeroStep(p, time_s=-np.inf)]) for p in sorted(joints)}
    size = {p: float(np.sqrt(np.mean(mm**2))) for p, mm in moved.items()}
    return [p for p in size if size[p] >= np.median(list(size.values()))]


def _one_of(places: list[str], rng: np.random.Generator) -> str:
    if not places:
        raise UnreachableError("this rig has no place for such a pair")
    return str(rng.choice(places))
