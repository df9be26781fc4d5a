"""Hypotheses of single mistakes in data or rig file, except those that the ranges of the data exclude."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.identification.samples import Samples
from calibration.kinematics.chain import Chain, ChainData
from calibration.observations import Floats, spread_mm
from calibration.rig.description import Joint, Rig

_LENGTHS = {"m": 1000.0, "cm": 10.0, "micrometres": 1e-3, "inches": 25.4, "feet": 304.8}
_ANGLES = {"radians": math.degrees(1.0), "gon": 0.9}
_SPAN = 1.3  # times the span of the limits, within which readings converted from another unit may lie
_SIZE = 4.0  # greatest ratio, either way, of the extent of the positions to that of the nominal rig's
_MOST_RADIANS = 4.0 * math.pi  # of any joint; larger readings must also lie about the joint's limits


@dataclass(frozen=True, eq=False)
class Fault:
    """A mistake in the data or the rig file, with the change of the data that corrects it.

    Attributes:
        what: the mistake, in words.
        remedy: what to do about it.
        subjects: the columns, prisms or properties that it concerns. Two faults of one hypothesis never share a
            subject, except that a reversed joint may be turned as well.
        column: joint whose column holds the readings of a joint, by joint.
        factor: factor to apply to the readings, by joint.
        turn_deg: angle to add to the readings, by joint.
        prism: prism that a label really means, by label.
        rows_up: number of rows to move the readings of all joints up, relative to the fixes.
        size: factor to apply to the positions.
        mirrored: whether to mirror the positions as well.
    """

    what: str
    remedy: str
    subjects: frozenset[str]
    column: Mapping[int, int] = field(default_factory=dict)
    factor: Mapping[int, float] = field(default_factory=dict)
    turn_deg: Mapping[int, float] = field(default_factory=dict)
    prism: Mapping[int, int] = field(default_factory=dict)
    rows_up: int = 0
    size: float = 1.0
    mirrored: bool = False

    @property
    def is_turn(self) -> bool:
        """True if the fault turns joints, which parameters of the model can correct as well."""
        return bool(self.turn_deg)

    @property
    def is_reversal(self) -> bool:
        """True if the fault reverses joints."""
        return any(factor < 0.0 for factor in self.factor.values())

    def corrected(self, samples: Samples) -> Samples:
        """Return the samples without the mistake; `samples` must be complete and in the order of their rows."""
        data = samples.data
        readings = data.readings.copy()
        for joint, column in self.column.items():
            readings[:, joint] = data.readings[:, column]
        for joint, factor in self.factor.items():
            readings[:, joint] *= factor
        for joint, turn_deg in self.turn_deg.items():
            readings[:, joint] += turn_deg
        prism = data.prism.copy()
        for label, meant in self.prism.items():
            prism[data.prism == label] = meant
        changed = ChainData(np.roll(readings, -self.rows_up, axis=0), prism, data.setup)
        signs = np.array([1.0, -1.0, 1.0]) if self.mirrored else np.ones(3)
        return replace(samples, data=changed, position_mm=samples.position_mm * (self.size * signs))


def possible_faults(chain: Chain, samples: Samples) -> Iterator[Fault]:
    """Yield every fault that the ranges of the data do not exclude."""
    rig, readings = chain.rig, samples.data.readings
    units = list(_units(rig, readings))
    yield from _signs_and_turns(rig)
    yield from _ratios(rig)
    yield from units
    yield from _exchanges(rig, sorted(set(samples.data.prism.tolist())))
    yield Fault(
        "the coordinates are mirrored",
        "x = east, y = north, z = up is right-handed: swap the two axes that are exchanged, or reverse one",
        frozenset({"handedness"}),
        mirrored=True,
    )
    for rows_up, where, way in ((1, "below", "up"), (-1, "above", "down")):
        yield Fault(
            f"the readings are a row {where} the fixes that they belong to",
            f"move the columns of the joints a row {way}",
            frozenset({"order of rows"}),
            rows_up=rows_up,
        )
    # Positions in m often come with readings in SI units, and correcting only one of them shows no improvement.
    for before in (None, *(unit for unit in units if len(unit.subjects) > 1)):
        yield from _sizes(chain, samples, before)


def _sizes(chain: Chain, samples: Samples, before: Fault | None) -> Iterator[Fault]:
    """Yield faults of positions in another unit, together with a fault `before` of the readings if there is one."""
    samples = before.corrected(samples) if before else samples
    # The nominal rig gives the extent of the work volume, independent of where the rig stands.
    expected_mm = spread_mm(chain.positions_mm(np.zeros(len(chain)), samples.data), samples.data.setup)
    measured_mm = spread_mm(samples.position_mm, samples.data.setup)
    for unit, factor in _LENGTHS.items():
        if 1.0 / _SIZE < factor * measured_mm / max(expected_mm, 1e-9) < _SIZE:
            subject = frozenset({"x_mm"})
            if before is None:
                yield Fault(f"the positions are in {unit}", "convert x_mm, y_mm and z_mm to mm", subject, size=factor)
            else:
                yield replace(
                    before,
                    what=f"{before.what} and the positions in {unit}",
                    remedy=f"{before.remedy}, and x_mm, y_mm and z_mm to mm",
                    subjects=before.subjects | subject,
                    size=factor,
                )


def _signs_and_turns(rig: Rig) -> Iterator[Fault]:
    turning = {i: joint for i, joint in enumerate(rig.joints) if joint.kind == "revolute"}
    if len(turning) > 1:
        yield Fault(
            "all angles run the other way",
            "reverse the sign of their coefficients in the rig file, or of their columns",
            frozenset(joint.column for joint in turning.values()),
            factor=dict.fromkeys(turning, -1.0),
        )
    for i, joint in enumerate(rig.joints):
        yield Fault(
            f"{joint.name} runs the other way",
            f"reverse the sign of the coefficients of {joint.name} in the rig file, or of column {joint.column}",
            frozenset({joint.column}),
            factor={i: -1.0},
        )
        for turn_deg in (90.0, 180.0, -90.0) if i in turning else ():
            reads = "180" if turn_deg == 180.0 else f"{-turn_deg:+.0f}"
            yield Fault(
                f"{joint.name} reads {reads} deg off",
                f"correct the theta of the row that {joint.name} drives in the rig file, or use --prior "
                f"as-built, which finds turned joints by itself",
                frozenset({joint.column}),
                turn_deg={i: turn_deg},
            )


def _ratios(rig: Rig) -> Iterator[Fault]:
    """Yield faults of a unit that the rig file converts a second time, or of a gear that does not exist."""
    for i, joint in enumerate(rig.joints):
        ratio = max(abs(coefficient) for _, _, name, coefficient in rig.couplings() if name == joint.name)
        if ratio != 1.0:
            yield Fault(
                f"{joint.name} drives {ratio:.3g} to 1 in the rig file and 1 to 1 in the data",
                f"divide the coefficients of {joint.name} in the rig file by {ratio:.3g}",
                frozenset({joint.column}),
                factor={i: 1.0 / ratio},
            )


def _units(rig: Rig, readings: Floats) -> Iterator[Fault]:
    def fault(what: str, target: str, factors: Mapping[int, float]) -> Fault:
        return Fault(what, f"convert {target}", frozenset(rig.joints[i].column for i in factors), factor=factors)

    metres: dict[int, float] = {}
    for i, joint in enumerate(rig.joints):
        for unit, size in _LENGTHS.items() if joint.kind == "prismatic" else ():
            if _fits(joint, readings[:, i], size):
                yield fault(f"{joint.column} is in {unit}", "it to mm", {i: size})
                if unit == "m":
                    metres[i] = size
    for unit, size in _ANGLES.items():
        angles = {i: size for i, joint in enumerate(rig.joints) if _may_be(joint, readings[:, i], unit)}
        for i in angles:
            yield fault(f"{rig.joints[i].column} is in {unit}", "it to degrees", {i: size})
        if len(angles) > 1:
            yield fault(f"all angles are in {unit}", "them to degrees", angles)
        if angles and metres:
            what = f"all angles are in {unit} and the length transducers in m"
            yield fault(what, "them to degrees and mm", angles | metres)
    if len(metres) > 1:
        yield fault("all length transducers are in m", "them to mm", metres)


def _exchanges(rig: Rig, seen: Sequence[int]) -> Iterator[Fault]:
    for i, k in itertools.combinations(range(len(rig.joints)), 2):
        one, other = rig.joints[i], rig.joints[k]
        if one.kind == other.kind:
            columns = frozenset({one.column, other.column})
            what = f"columns {one.column} and {other.column} are exchanged"
            yield Fault(what, "exchange them", columns, column={i: k, k: i})
    for i, k in itertools.combinations(seen, 2):
        one_prism, other_prism = rig.prism_names[i], rig.prism_names[k]
        yield Fault(
            f"prisms {one_prism!r} and {other_prism!r} are exchanged",
            "exchange their names in column prism",
            frozenset({f"prism {one_prism}", f"prism {other_prism}"}),
            prism={i: k, k: i},
        )


def _may_be(joint: Joint, values: Floats, unit: str) -> bool:
    """Return True if the readings of a joint may be angles in a unit."""
    if joint.kind != "revolute":
        return False
    few = unit != "radians" or float(np.abs(values).max()) <= _MOST_RADIANS
    return few or _fits(joint, values, _ANGLES[unit])


def _fits(joint: Joint, values: Floats, factor: float) -> bool:
    """Return True if the values, multiplied by the factor of their unit, lie about within the joint's limits."""
    low, high = joint.limits
    margin = (_SPAN - 1.0) * (high - low)
    return bool(factor * values.min() > low - margin and factor * values.max() < high + margin)
