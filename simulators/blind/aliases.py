"""Scenes in which two effects are confounded: poses and signals are chosen so that either effect explains the data."""

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

# Given some fixes, returns the new true values of some of their columns.
Change = Callable[[Fixes], Mapping[str, Floats]]


def alias_scene(scene: Scene, families: str, rng: np.random.Generator) -> tuple[Scene, str]:
    """Return a scene in which two effects cannot be distinguished, and the place of both.

    Args:
        scene: poses and noise.
        families: one of `cells.ALIASES`.
        rng: chooses the place if there are several.

    Raises:
        UnreachableError: this rig has no suitable place.
        KeyError: `families` is not a known pair.
    """
    return _MADE[families](scene, rng)


def _two_visits(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Two short visits, hours apart: a drift and a step between them look the same."""
    del rng
    return _at_other_times(scene, lambda fixes: {"time_s": _visits(scene, fixes)[0]}), "base"


def _creeping_later(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Two short visits with motion only in the second, so the clock's offset in the first is invisible."""
    del rng
    rates = [f"{name}_rate" for name in scene.truth.rig.joint_names]

    def change(fixes: Fixes) -> dict[str, Floats]:
        time_s, visit = _visits(scene, fixes)
        return {"time_s": time_s, **{name: fixes.columns[name] * visit for name in rates}}

    return _at_other_times(scene, change), "clock"


def _visits(scene: Scene, fixes: Fixes) -> tuple[Floats, Floats]:
    """Move the fixes from one duty cycle into two visits.

    Returns:
        (n,) instants in s; (n,) 0 in the first visit and 1 in the second.
    """
    first, last = scene.draws.first_s, scene.draws.last_s
    part = 2.0 * (fixes.columns["time_s"] - first) / (last - first)
    visit = (part >= 1.0).astype(float)
    return first + 3600.0 * (visit * _NEXT_VISIT_H + (part - visit) * _VISIT_H), visit


def _at_other_times(scene: Scene, change: Change) -> Scene:
    made = _changed(scene, change)
    time_s = made.training.columns["time_s"]
    return replace(made, draws=replace(made.draws, first_s=float(time_s.min()), last_s=float(time_s.max())))


def _lowered(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """A joint that always comes to rest in the direction of its load: its friction looks like elasticity."""
    where = _one_of(
        [p for p in scene.draws.places("load_hysteresis") if p in scene.draws.places("joint_compliance")], rng
    )

    def change(fixes: Fixes) -> dict[str, Floats]:
        side = np.sign(scene.truth.gravity_load(where, fixes.joints, fixes.columns))
        return {f"{where}_dir": side, f"{where}_rate": np.abs(fixes.columns[f"{where}_rate"]) * side}

    return _changed(scene, change), where


def _from_the_other_side(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Two short visits, with a joint approaching from below in the first and from above in the second.

    The joint's play then looks like a step of its zero between the visits.
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
    """A pressure that follows the stroke: the cylinder's compression looks like a wrong scale."""
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
    """Replace columns; recorded values keep the errors of their sensors, but zero is recorded as zero."""
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
    """Return the joints that move the prism at least as much as the median joint; play of others is hardly visible."""
    moved = {p: scene.displacement_mm([ZeroStep(p, time_s=-np.inf)]) for p in sorted(joints)}
    size = {p: float(np.sqrt(np.mean(mm**2))) for p, mm in moved.items()}
    return [p for p in size if size[p] >= np.median(list(size.values()))]


def _one_of(places: list[str], rng: np.random.Generator) -> str:
    if not places:
        raise UnreachableError("this rig has no place for this pair of effects")
    return str(rng.choice(places))
