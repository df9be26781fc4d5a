"""What may be wrong between data and rig file: every single mistake that the ranges of the data do not exclude."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from calibration.identification.samples import Samples
from calibration.kinematics import Chain, ChainData
from calibration.observations import Floats, spread_mm
from calibration.rig import Joint, Rig

_T = TypeVar("_T")

_LENGTHS = {"m": 1000.0, "cm": 10.0, "micrometres": 1e-3, "inches": 25.4, "feet": 304.8}
_ANGLES = {"radians": math.degrees(1.0), "gon": 0.9}
_SPAN = 1.3  # times the span of the limits that readings in another unit may fill
_SIZE = 4.0  # how far, as a factor, positions may be from the size that the nominal rig has
_MOST_RADIANS = 4.0 * math.pi  # of a joint that reads on any turn; one that turns often says so by its limits


@dataclass(frozen=True)
class Supposition:
    """One mistake in the data or the rig file, as a change of the data that makes it good.

    Attributes:
        what: the mistake, in words.
        remedy: what to do about it.
        subjects: whatever it concerns; nothing is supposed twice of one subject, save that a reversed joint may be
            turned as well.
        column: (joints,) which column each joint is read from.
        factor: (joints,) what the readings are multiplied by.
        turn_deg: (joints,) and then turned by.
        prism: (prisms,) which prism each label means.
        rows_up: by how many rows the readings of all joints are moved up, beside the fixes.
        size: what the positions are multiplied by.
        mirrored: whether they are also mirrored.
    """

    what: str
    remedy: str
    subjects: frozenset[str]
    column: tuple[int, ...]
    factor: tuple[float, ...]
    turn_deg: tuple[float, ...]
    prism: tuple[int, ...]
    rows_up: int = 0
    size: float = 1.0
    mirrored: bool = False

    @property
    def is_turn(self) -> bool:
        """True where a parameter of the model can make it good as well."""
        return any(self.turn_deg)

    @property
    def is_reversal(self) -> bool:
        """True where joints run the other way round."""
        return min(self.factor) < 0.0

    def applied(self, samples: Samples) -> Samples:
        """The samples, all of them and in the order of their rows, as they would be without the mistake."""
        data = samples.data
        readings = np.roll(data.readings[:, list(self.column)] * self.factor + self.turn_deg, -self.rows_up, axis=0)
        changed = ChainData(readings, np.array(self.prism, dtype=np.intp)[data.prism], data.setup)
        signs = np.array([1.0, -1.0, 1.0]) if self.mirrored else np.ones(3)
        return replace(samples, data=changed, position_mm=samples.position_mm * (self.size * signs))


def conceivable_mistakes(chain: Chain, samples: Samples) -> Iterator[Supposition]:
    """Everything that the ranges of the data do not exclude."""
    rig, readings = chain.rig, samples.data.readings
    nothing = Supposition(
        "",
        "",
        frozenset(),
        tuple(range(len(rig.joints))),
        (1.0,) * len(rig.joints),
        (0.0,) * len(rig.joints),
        tuple(range(len(rig.prisms))),
    )
    units = list(_units(rig, readings, nothing))
    yield from _signs_and_turns(rig, nothing)
    yield from _ratios(rig, nothing)
    yield from units
    yield from _exchanges(rig, sorted(set(samples.data.prism.tolist())), nothing)
    yield replace(
        nothing,
        what="the coordinates are mirrored",
        remedy="x = east, y = north, z = up is right-handed: swap the two axes that are exchanged, or turn one round",
        subjects=frozenset({"handedness"}),
        mirrored=True,
    )
    for rows_up, where, way in ((1, "below", "up"), (-1, "above", "down")):
        yield replace(
            nothing,
            what=f"the readings are a row {where} the fixes that they belong to",
            remedy=f"move the columns of the joints a row {way}",
            subjects=frozenset({"order of rows"}),
            rows_up=rows_up,
        )
    # Who writes positions in m writes readings in SI units as well, and neither alone would show.
    for before in (nothing, *(unit for unit in units if len(unit.subjects) > 1)):
        yield from _sizes(chain, samples, before)


def _sizes(chain: Chain, samples: Samples, before: Supposition) -> Iterator[Supposition]:
    """Positions in another unit, beside what is supposed already."""
    samples = before.applied(samples)
    # The nominal rig tells the size of the work volume, wherever it stands.
    expected_mm = spread_mm(chain.positions_mm(np.zeros(len(chain)), samples.data), samples.data.setup)
    measured_mm = spread_mm(samples.position_mm, samples.data.setup)
    for unit, factor in _LENGTHS.items():
        if 1.0 / _SIZE < factor * measured_mm / max(expected_mm, 1e-9) < _SIZE:
            yield replace(
                before,
                what=f"{before.what} and the positions in {unit}" if before.what else f"the positions are in {unit}",
                remedy=f"{before.remedy}, and x_mm, y_mm and z_mm to mm"
                if before.what
                else "convert x_mm, y_mm and z_mm to mm",
                subjects=before.subjects | {"x_mm"},
                size=factor,
            )


def _signs_and_turns(rig: Rig, nothing: Supposition) -> Iterator[Supposition]:
    turning = [joint.kind == "revolute" for joint in rig.joints]
    if sum(turning) > 1:
        yield replace(
            nothing,
            what="all angles run the other way",
            remedy="reverse the sign of their coefficients in the rig file, or of their columns",
            subjects=frozenset(joint.column for joint in rig.joints if joint.kind == "revolute"),
            factor=tuple(-1.0 if turns else 1.0 for turns in turning),
        )
    for i, joint in enumerate(rig.joints):
        yield replace(
            nothing,
            what=f"{joint.name} runs the other way",
            remedy=f"reverse the sign of the coefficients of {joint.name} in the rig file, or of column {joint.column}",
            subjects=frozenset({joint.column}),
            factor=_at(nothing.factor, i, -1.0),
        )
        for turn_deg in (90.0, 180.0, -90.0) if joint.kind == "revolute" else ():
            reads = "180" if turn_deg == 180.0 else f"{-turn_deg:+.0f}"
            yield replace(
                nothing,
                what=f"{joint.name} reads {reads} deg off",
                remedy=f"correct the theta of the row that {joint.name} drives in the rig file, or use --prior "
                f"as-built, which finds turned joints by itself",
                subjects=frozenset({joint.column}),
                turn_deg=_at(nothing.turn_deg, i, turn_deg),
            )


def _ratios(rig: Rig, nothing: Supposition) -> Iterator[Supposition]:
    """A unit that the rig file converts though the column is converted already, or a gear that is not there."""
    for i, joint in enumerate(rig.joints):
        ratio = max(abs(coefficient) for _, _, name, coefficient in rig.couplings() if name == joint.name)
        if ratio != 1.0:
            yield replace(
                nothing,
                what=f"{joint.name} drives {ratio:.3g} to 1 in the rig file and 1 to 1 in the data",
                remedy=f"divide the coefficients of {joint.name} in the rig file by {ratio:.3g}",
                subjects=frozenset({joint.column}),
                factor=_at(nothing.factor, i, 1.0 / ratio),
            )


def _units(rig: Rig, readings: Floats, nothing: Supposition) -> Iterator[Supposition]:
    def supposed(what: str, target: str, factors: dict[int, float]) -> Supposition:
        return replace(
            nothing,
            what=what,
            remedy=f"convert {target}",
            subjects=frozenset(rig.joints[i].column for i in factors),
            factor=tuple(factors.get(i, 1.0) for i in range(len(rig.joints))),
        )

    metres: dict[int, float] = {}
    for i, joint in enumerate(rig.joints):
        for unit, size in _LENGTHS.items() if joint.kind == "prismatic" else ():
            if _fits(joint, readings[:, i], size):
                yield supposed(f"{joint.column} is in {unit}", "it to mm", {i: size})
                if unit == "m":
                    metres[i] = size
    for unit, size in _ANGLES.items():
        angles = {i: size for i, joint in enumerate(rig.joints) if _may_be(joint, readings[:, i], unit)}
        for i in angles:
            yield supposed(f"{rig.joints[i].column} is in {unit}", "it to degrees", {i: size})
        if len(angles) > 1:
            yield supposed(f"all angles are in {unit}", "them to degrees", angles)
        if angles and metres:
            what = f"all angles are in {unit} and the length transducers in m"
            yield supposed(what, "them to degrees and mm", angles | metres)
    if len(metres) > 1:
        yield supposed("all length transducers are in m", "them to mm", metres)


def _exchanges(rig: Rig, seen: Sequence[int], nothing: Supposition) -> Iterator[Supposition]:
    for i, k in itertools.combinations(range(len(rig.joints)), 2):
        one, other = rig.joints[i], rig.joints[k]
        if one.kind == other.kind:
            yield replace(
                nothing,
                what=f"columns {one.column} and {other.column} are exchanged",
                remedy="exchange them",
                subjects=frozenset({one.column, other.column}),
                column=_at(_at(nothing.column, i, k), k, i),
            )
    for i, k in itertools.combinations(seen, 2):
        one_prism, other_prism = rig.prism_names[i], rig.prism_names[k]
        yield replace(
            nothing,
            what=f"prisms {one_prism!r} and {other_prism!r} are exchanged",
            remedy="exchange their names in column prism",
            subjects=frozenset({f"prism {one_prism}", f"prism {other_prism}"}),
            prism=_at(_at(nothing.prism, i, k), k, i),
        )


def _may_be(joint: Joint, values: Floats, unit: str) -> bool:
    """Whether readings of an angle may be in a unit."""
    if joint.kind != "revolute":
        return False
    few = unit != "radians" or float(np.abs(values).max()) <= _MOST_RADIANS
    return few or _fits(joint, values, _ANGLES[unit])


def _fits(joint: Joint, values: Floats, factor: float) -> bool:
    """Whether values in another unit lie about the joint's limits."""
    low, high = joint.limits
    margin = (_SPAN - 1.0) * (high - low)
    return bool(factor * values.min() > low - margin and factor * values.max() < high + margin)


def _at(values: tuple[_T, ...], index: int, value: _T) -> tuple[_T, ...]:
    return (*values[:index], value, *values[index + 1 :])
