"""Library effects that act in a part of the data, drawn so that the data distinguish this part from all others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from simulators.blind.alternatives import MARGIN, SIGMAS, effect_columns_mm, library_columns_mm, weigh
from simulators.blind.hiding import HiddenEffect, UnreachableError
from simulators.blind.scene import Scene
from simulators.blind.visibility import Visibility
from simulators.effects.library import LIBRARY
from simulators.effects.part import Part, PartialEffect
from simulators.rig.screws import Floats

KINDS = ("own joint", "other joint", "load", "warmth", "time", "rows")
BORDER_WITHIN = 0.1  # tolerance of a border as a share of the variable's range
ROW = "row"  # row number, used as the variable if the data have no time

_QUANTILES = 0.3, 0.7  # quantiles of the variable's values between which the border lies
_TRIALS = 8  # attempts per family to find an effect that is visible and distinguishable
_SCALINGS = 3
_ELSEWHERE = np.linspace(0.1, 0.9, 17)  # quantiles of the borders of alternative parts
# Families that cannot act in a part of the data: those that act from an instant on, depend on time or temperature
# themselves, or act in the line of sight, and those that a free curve or the sign of a load can partly describe.
_WHOLE = (
    "joint_error_map",
    "gravity_flip_play",
    "base_settlement",
    "base_step",
    "base_shift",
    "zero_step",
    "prism_seat_step",
    "transducer_index_jump",
    "transducer_cumulative",
    "thermal_expansion",
    "solar_bow",
    "clock_drift",
    "latency",
    "station_scale",
    "prism_constant",
    "prism_incidence",
)


@dataclass(frozen=True)
class Regime:
    """An effect in a part of the data.

    Attributes:
        hidden: the effect, a `PartialEffect`.
        by_row: the data have no time, and the part begins or ends with a row.
        label: data for the scorer: `variable`, `above`, `border`, and the limits `low` and `high` of a right border.
    """

    hidden: HiddenEffect
    by_row: bool
    label: Mapping[str, Any]


def draw_regime(scene: Scene, visibility: Visibility, size: float, rng: np.random.Generator) -> Regime:
    """Draw an effect that acts in a part of a scene's data and is distinguishable from every other effect and part.

    Args:
        scene: the data.
        visibility: visible part of displacements in the scene.
        size: visible size of the effect over all rows, in units of the noise.
        rng: random generator.

    Raises:
        UnreachableError: no such effect reaches this size within its hard bounds.
    """
    kind = str(rng.choice(KINDS))
    known = [name for name in LIBRARY if name not in _WHOLE and scene.draws.places(name)]
    alternatives = _Alternatives(scene, visibility)
    for family in np.repeat(rng.permutation(known), _TRIALS).tolist():
        drawn = scene.draws.draw(family, str(rng.choice(scene.draws.places(family))), rng)
        variables = _variables(scene, kind, drawn.effect.where)
        if not variables:
            continue
        part = _part(scene, str(rng.choice(variables)), rng)
        factor = 1.0
        for _ in range(_SCALINGS):
            acting = PartialEffect(drawn.effect.where, drawn.scaled(factor), part)
            shown = visibility.size(scene.displacement_mm([acting]))
            factor = min(factor * size / shown, drawn.most) if shown > 0.0 else drawn.most
        if abs(shown - size) <= 0.05 * size and alternatives.are_told_from(acting):
            return Regime(HiddenEffect(acting, shown), kind == "rows", _label(scene, part, by_row=kind == "rows"))
    raise UnreachableError(f"found no effect of size {size:g} in a part of the data that differs from all others")


def _variables(scene: Scene, kind: str, where: str) -> list[str]:
    """Return the variables of one kind that can define the part for an effect at a place."""
    names, columns = scene.truth.rig.joint_names, scene.training.columns
    if kind == "own joint":
        return [where] if where in names else []
    if kind == "other joint":
        return [name for name in names if name != where]
    if kind == "load":
        torque = [f"torque({where})"] if where in scene.draws.places("joint_compliance") else []
        changes = "payload_kg" in columns and np.ptp(columns["payload_kg"]) > 0.0
        return [*torque, *(["payload_kg"] if changes else [])]
    return ["temperature_degC"] if kind == "warmth" else ["time_s"]


def _part(scene: Scene, variable: str, rng: np.random.Generator) -> Part:
    values = _values(scene, variable)
    border = float(np.quantile(values, rng.uniform(*_QUANTILES)))
    if len(np.unique(values)) == 2:  # on or off
        border = float(values.min() + values.max()) / 2.0
    return Part(variable, bool(rng.random() < 0.5), border)


def _values(scene: Scene, variable: str) -> Floats:
    """Return the (n,) values of a part's variable in the training rows, without sensor errors."""
    fixes = scene.training
    if variable.startswith("torque("):
        joint = variable.removeprefix("torque(").removesuffix(")")
        return scene.truth.gravity_load(joint, fixes.joints, fixes.columns)
    return fixes.joints[variable] if variable in fixes.joints else fixes.columns[variable]


def _label(scene: Scene, part: Part, *, by_row: bool) -> dict[str, Any]:
    """Return the scorer's label of a part; any border that leaves all rows on their side counts as right."""
    values, border, variable = _values(scene, part.variable), part.border, part.variable
    if by_row:
        number = np.arange(float(len(values)))  # rows are ordered by time
        border, values, variable = float(number[values <= border].max()) + 0.5, number, ROW
    margin = BORDER_WITHIN * float(np.ptp(values))
    low, high = float(values[values <= border].max()) - margin, float(values[values > border].min()) + margin
    return {"variable": variable, "above": part.above, "border": border, "low": low, "high": high}


class _Alternatives:
    """Every other explanation of an effect in a part of a scene's data."""

    def __init__(self, scene: Scene, visibility: Visibility) -> None:
        self._scene = scene
        self._visibility = visibility
        self._library = library_columns_mm(scene)

    def are_told_from(self, acting: PartialEffect) -> bool:
        """Return True if the effect in its part beats all others by `MARGIN` in all but 2 % of draws of the noise."""
        signal = self._visibility.seen(self._scene.displacement_mm([acting])[:, :, None])[:, 0]
        inside = acting.part.holds(_values(self._scene, acting.part.variable)).astype(float)
        whole_mm = effect_columns_mm(self._scene, acting.effect)
        own, fit = weigh(self._visibility.seen(whole_mm * inside[:, None, None]), signal)
        for columns_mm in self._others(acting, whole_mm, inside):
            evidence, imitation = weigh(self._visibility.seen(columns_mm), signal)
            if own - evidence - SIGMAS * float(np.linalg.norm(fit - imitation)) < MARGIN:
                return False
        return True

    def _others(self, acting: PartialEffect, whole_mm: Floats, inside: Floats) -> Iterator[Floats]:
        """Yield the (n, 3, k) columns in mm of each alternative.

        Alternatives are the effect in all rows or in other parts, and other effects in all rows or in this part.
        """
        yield whole_mm
        label = _label(self._scene, acting.part, by_row=False)
        for variable in self._part_variables():
            values = _values(self._scene, variable)
            for border in np.unique(np.quantile(values, _ELSEWHERE)):
                is_right = variable == acting.part.variable and label["low"] <= border <= label["high"]
                for above in (True, False):
                    if not (is_right and above == acting.part.above):
                        holds = Part(variable, above, float(border)).holds(values).astype(float)
                        yield whole_mm * holds[:, None, None]
        for form, columns_mm in self._library:
            if (form.family, form.where) != (acting.effect.family, acting.effect.where):
                yield columns_mm
                yield columns_mm * inside[:, None, None]

    def _part_variables(self) -> list[str]:
        rig, columns = self._scene.truth.rig, self._scene.training.columns
        torques = [f"torque({joint})" for joint in self._scene.draws.places("joint_compliance")]
        further = [name for name in ("payload_kg", "temperature_degC", "time_s") if name in columns]
        return [*rig.joint_names, *torques, *further]
