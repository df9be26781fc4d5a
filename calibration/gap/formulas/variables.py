"""Sources of error and the variables that they may depend on, as used by detection and the grammar."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.boom import boom_in
from calibration.gap.projected.projection import Projection
from calibration.observations import Floats
from calibration.rig.columns import own_columns
from calibration.rig.description import Joint
from calibration.rig.signals import is_read_anyway

Unit = Mapping[str, int]  # symbol -> power

_HARMONICS = 12
_CROSS_HARMONICS = 3  # harmonics of other joints' angles
_LEAST_CYCLE = 0.25  # smallest part of a cycle within the range of an angle; less looks like a parabola
_PER_CYCLE = 3.0  # required number of different readings per cycle of a harmonic
_STEPS = 16
_LEAST_KNOWN = 0.5  # smallest share of rows in which a column must be known
_INCIDENCE = (1, 2, 3, 6)  # harmonics; a 360 degree prism consists of six reflectors
_FEW_SIGNALS = 4  # largest number of signals in products, as each would add about a hundred terms
_MOST_OF_FIXES = 0.01  # largest relative error of fixes by instrument or atmosphere
_MOST_OF_LENGTHS = 0.05  # largest relative error of a structure's lengths
_NOTHING: Unit = {}


@dataclass(frozen=True)
class Variable:
    """A quantity that an error may be proportional to.

    Attributes:
        text: the variable as written in a formula.
        topic: the quantity that it is a function of, as listed by detection.
        unit: unit of the values.
        values: (m,) values for the samples.
    """

    text: str
    topic: str
    unit: Unit
    values: Floats

    def times(self, other: Variable) -> Variable:
        """Return the product of two variables."""
        unit = {symbol: self.unit.get(symbol, 0) + other.unit.get(symbol, 0) for symbol in {**self.unit, **other.unit}}
        topic = self.topic if other.topic == self.topic else f"{self.topic} x {other.topic}"
        return Variable(f"{self.text} {other.text}", topic, unit, self.values * other.values)


@dataclass(frozen=True)
class ErrorSource:
    """A quantity of the machine or its measurement that may have an error.

    Attributes:
        where: place of the source, as in all outputs.
        quantity: noun phrase for the error.
        unit: unit of the error.
        moved_mm: (m, 3) displacement of the prism per unit of the error, in the station's frame.
        joint: the joint, if the source is a joint's value.
        coupled: True for the rows that the joint drives in addition to its own, without its own row.
        constant: text and topic of a constant error; None if a constant error is a parameter of the kinematics.
        own: variables of this source only.
        most: largest physically possible error, in `unit`.
    """

    where: str
    quantity: str
    unit: Unit
    moved_mm: Floats
    joint: Joint | None = None
    coupled: bool = False
    constant: tuple[str, str] | None = None
    own: tuple[Variable, ...] = ()
    most: float = math.inf

    def coefficient_unit(self, variable: Variable) -> str:
        """Return the unit of the coefficient of a variable in a formula for this source."""
        powers = {s: self.unit.get(s, 0) - variable.unit.get(s, 0) for s in {**self.unit, **variable.unit}}
        above = " ".join(_power(s, p) for s, p in powers.items() if p > 0) or "1"
        below = [_power(s, -p) for s, p in powers.items() if p < 0]
        if not below:
            return above
        return f"{above}/{below[0]}" if len(below) == 1 else f"{above}/({' '.join(below)})"


class Variables:
    """Sources of error and the variables that they may depend on, for the samples.

    Args:
        projection: projection at the fit.
        instants_s: further instants, as in `time_s`, at which an error may have jumped.
    """

    def __init__(self, projection: Projection, instants_s: Collection[float] = ()) -> None:
        self._samples, self._context = projection.samples, projection.context
        self._joint_jacobian = projection.joint_jacobian
        joints = self._context.rig.joints
        self._angles = tuple(j for j in joints if j.kind == "revolute")
        self._strokes = tuple(j for j in joints if j.kind == "prismatic")
        readings = projection.samples.data.readings
        self._reading = {name: readings[:, index] for name, index in self._context.chain.joint_index.items()}
        self._slow = tuple(self._environment())
        self._signals = tuple(self._machine_signals())
        self._course = tuple(
            v for w in self._slow if w.topic == "time" for v in (_squared(w), *_steps(w), *self._jumps(instants_s))
        )
        self._incidence = tuple(self._incidences())
        self._boom_length = tuple(self._lengths())
        self._shape = {j.name: _shapes(j, self._reading[j.name]) for j in joints}
        self._load = {j.name: tuple(self._loads(j)) for j in joints}

    # -- places ---------------------------------------------------------------------------------------------------

    def sources(self) -> tuple[ErrorSource, ...]:
        """Return all sources of error in this machine and in its measurement."""
        return (*self._joint_sources(), *self._boom_sources(), *self._base_sources(), *self._station_sources())

    def _joint_sources(self) -> Iterator[ErrorSource]:
        context, facing = self._context, self._context.facing
        for joint in (*self._angles, *self._strokes):
            what, turn = ("angle", math.degrees(1.0)) if joint.kind == "revolute" else ("length", 1.0)
            unit: Unit = {"rad": 1} if joint.kind == "revolute" else {"mm": 1}
            index = context.chain.joint_index[joint.name]
            moved = self._joint_jacobian[:, :, index] * turn
            yield ErrorSource(joint.name, f"{joint.name} {what} error", unit, moved, joint)
            _, *others = (i for i, (_, driving) in enumerate(context.machine.drives) if driving == index)
            if others:
                alone = context.to_station(facing.by_drive[:, :, others].sum(axis=2, keepdims=True))[:, :, 0]
                moved = self._samples.average(alone) * turn
                yield ErrorSource(
                    joint.name, f"{what} error of the row coupled to {joint.name}", unit, moved, joint, True
                )

    def _boom_sources(self) -> Iterator[ErrorSource]:
        """Yield rotations of the boom about its middle, which describe deflection and slope of a beam's tip."""
        context, boom = self._context, boom_in(self._context)
        if boom is None or not boom.carries_prism.any():
            return
        middle_mm = 0.5 * (boom.root_mm + boom.tip_mm)
        arm_mm = (context.located.prism_mm - middle_mm) * boom.carries_prism[:, None]
        across = np.cross(boom.axis, boom.down)
        moment = np.zeros((len(context), 3))
        if context.rig.masses:
            points_mm, newton = boom.weights
            force = (newton * boom.hanging)[:, :, None] * boom.down[:, None]
            moment = np.cross((points_mm - boom.tip_mm[:, None]) / 1e3, force).sum(axis=1)
        turns = (("twist", boom.axis), ("downward bend", across), ("sideways bend", np.cross(boom.axis, across)))
        for name, about in turns:
            moved = context.to_station(np.cross(about, arm_mm)[:, :, None])[:, :, 0]
            turning = (moment * about).sum(axis=1)
            loads: tuple[tuple[str, Unit, Floats], ...] = (
                ("its moment", {"N": 1, "m": 1}, turning),
                ("its moment length", {"N": 1, "m": 2}, turning * boom.length_mm / 1e3),
                ("sign(its moment)", _NOTHING, np.sign(turning)),
                ("sign(its moment) length", {"m": 1}, np.sign(turning) * boom.length_mm / 1e3),
            )
            own = tuple(v for text, unit, x in loads for v in self._measured(text, "torque", unit, x))
            yield ErrorSource("boom", f"{name} of the boom", {"rad": 1}, self._samples.average(moved), own=own)

    def _lengths(self) -> Iterator[Variable]:
        """Yield the length of a boom, on which a beam's deflection under a load depends."""
        boom = boom_in(self._context)
        if boom is not None:
            length = self._samples.average(boom.length_mm) / 1e3
            yield Variable("length of the boom", f"{boom.joint} extension", {"m": 1}, length)

    def _base_sources(self) -> Iterator[ErrorSource]:
        """Yield motions of the machine on its jacks, without rotation about the vertical, which the first joint has."""
        context, average = self._context, self._samples.average
        moved = context.base_motion_mm(np.ones(len(context)))
        for number, axis in enumerate("xy"):
            yield ErrorSource("base", f"base tilt about {axis}", {"rad": 1}, average(moved[:, :, number]))
        yield ErrorSource("base", "base height error", {"mm": 1}, average(moved[:, :, 2]))
        if context.rig.masses:
            leaning = (moved[:, :, :2] @ context.overturning_Nm[:, :, None])[:, :, 0]
            soft: Unit = {"rad": 1, "N": -1, "m": -1}
            yield ErrorSource("base", "base tilt", soft, average(leaning), constant=("moment of all weights", "torque"))
        grown = context.to_station(context.located.prism_mm[:, :, None])[:, :, 0]
        yield ErrorSource("boom", "relative error of all lengths", _NOTHING, average(grown), most=_MOST_OF_LENGTHS)

    def _station_sources(self) -> Iterator[ErrorSource]:
        context, average = self._context, self._samples.average
        position, scale = average(context.located.position_mm), "relative error of all fixes"
        yield ErrorSource("station", scale, _NOTHING, position, constant=("", "distance"), most=_MOST_OF_FIXES)
        velocity = context.velocity_mm_per_s
        if velocity.any():
            yield ErrorSource("clock", "error of instants", {"s": 1}, average(velocity), constant=("", "velocity"))
        line = context.line_of_sight
        for prism in context.rig.prism_names:
            seen = context.rows_of_prism(prism)
            if seen.any():
                along = average(np.where(seen[:, None], line, 0.0))
                below = average(np.where(seen[:, None], [0.0, 0.0, -1.0], 0.0))
                what, fixed = f"range error of prism {prism}", ("", "constant")
                yield ErrorSource(prism, what, {"mm": 1}, along, constant=fixed, own=self._incidence)
                yield ErrorSource(prism, f"sag of prism {prism}", {"mm": 1}, below, constant=fixed)

    # -- variables ------------------------------------------------------------------------------------------------

    def singles(self, source: ErrorSource) -> tuple[Variable, ...]:
        """Return single variables that the error of a source may depend on, simplest first."""
        joint = source.joint
        strokes = self._extensions(source)
        around = (*self._slow, *strokes, *map(_squared, strokes))
        if joint is not None:
            curves = _curves(joint, self._reading[joint.name])
            return (
                *self._shape[joint.name],
                *self._load[joint.name],
                *self._drags(joint),
                *around,
                *self._course,
                *self._signals,
                *curves,
            )
        if source.constant is None:
            return (*source.own, *around, *self._course)
        text, topic = source.constant
        fixed = Variable(text, topic, _NOTHING, np.ones(len(self._samples)))
        return (fixed, *source.own, *((fixed.times(v) for v in around) if text else around))

    def crossings(self, source: ErrorSource) -> tuple[Variable, ...]:
        """Return variables of other joints that the error of a joint's value, or the base's, may depend on."""
        if source.coupled or (source.joint is None and (source.where != "base" or source.constant is not None)):
            return ()
        most = 1 if source.joint is None else _CROSS_HARMONICS
        others = [j for j in self._angles if j.name != source.where]
        return tuple(v for j in others for v in _crossing(j, self._reading[j.name], most))

    def products(self, source: ErrorSource) -> Iterator[Variable]:
        """Yield products of two variables that the error of a joint's value may depend on."""
        if source.joint is None or source.coupled:
            return
        shapes, loads, strokes = self._shape[source.where], self._load[source.where], self._extensions(source)
        slow = (*self._slow, *strokes, *(self._signals if len(self._signals) <= _FEW_SIGNALS else ()))
        pairs = itertools.chain(
            itertools.product(shapes, (*loads, *slow)),
            itertools.combinations((*loads, *slow), 2),
            itertools.product(loads, self._boom_length),
        )
        yield from (first.times(second) for first, second in pairs if first.topic != second.topic)
        for joint in self._angles:
            if joint.name != source.where:
                waves = _harmonics(joint, self._reading[joint.name], _CROSS_HARMONICS, f"{joint.name} angle")
                yield from (wave.times(_from_mean(stroke)) for wave, stroke in itertools.product(waves, strokes))

    def conditions(self, where: str) -> tuple[Variable, ...]:
        """Return single variables that the size of an effect at a source may depend on."""
        strokes = [v for joint in self._strokes for v in self._shape[joint.name]]
        shapes = [v for own in self._shape.values() for v in own]
        around = (*self._slow, *map(_squared, (*self._slow, *strokes)))
        return (*shapes, *self._load.get(where, ()), *around, *self._course, *self._signals)

    def _extensions(self, source: ErrorSource) -> tuple[Variable, ...]:
        """Return the strokes of other joints."""
        others = [j for j in self._strokes if j.name != source.where]
        return tuple(Variable(j.name, f"{j.name} extension", {"m": 1}, self._reading[j.name] / 1e3) for j in others)

    def _loads(self, joint: Joint) -> Iterator[Variable]:
        """Yield the direction, load and rate of a joint."""
        name, context = joint.name, self._context
        revolute = joint.kind == "revolute"
        yield from self._measured(f"dir({name})", "direction", _NOTHING, context.extra(f"{name}_dir"))
        load = "torque" if revolute else "force"
        if context.greatest_torque(name) > 0.0:
            torque = context.torque(name)
            unit: Unit = {"N": 1, "m": 1} if revolute else {"N": 1}
            yield from self._measured(f"{load}({name})", load, unit, torque)
            yield from self._measured(f"|{load}({name})|", load, unit, np.abs(torque))
            yield from self._measured(f"sign({load}({name}))", load, _NOTHING, np.sign(torque))
        rate = context.extra(f"{name}_rate") * (math.radians(1.0) if revolute else 1.0)
        speed: Unit = {"rad" if revolute else "mm": 1, "s": -1}
        yield from self._measured(f"rate({name})", "velocity", speed, rate)

    def _drags(self, joint: Joint) -> Iterator[Variable]:
        """Yield the functions of a joint's velocity that friction follows."""
        name = joint.name
        rate = self._context.extra(f"{name}_rate") * (math.radians(1.0) if joint.kind == "revolute" else 1.0)
        speed: Unit = {"rad" if joint.kind == "revolute" else "mm": 1, "s": -1}
        yield from self._measured(f"|rate({name})|", "velocity", speed, np.abs(rate))
        yield from self._measured(f"sign(rate({name}))", "velocity", _NOTHING, np.sign(rate))

    def _incidences(self) -> Iterator[Variable]:
        """Yield harmonics of the station's azimuth about the z axis of each prism's frame."""
        context = self._context
        back = -(context.rotation.transpose(0, 2, 1) @ context.line_of_sight[:, :, None])
        toward = (context.facing.axes @ back)[:, :, 0]
        azimuth = np.arctan2(toward[:, 1], toward[:, 0])
        for k in _INCIDENCE:
            multiple = f"{k} incidence" if k > 1 else "incidence"
            yield from self._measured(f"cos({multiple})", "incidence", _NOTHING, np.cos(k * azimuth))
            yield from self._measured(f"sin({multiple})", "incidence", _NOTHING, np.sin(k * azimuth))

    def _environment(self) -> Iterator[Variable]:
        """Yield temperature, time, dwell and payload."""
        extra = self._context.extra
        for v in self._measured("dT", "temperature", {"K": 1}, extra("temperature_degC")):
            yield Variable(v.text, v.topic, v.unit, v.values - v.values.mean())
        for v in self._measured("t", "time", {"h": 1}, extra("time_s") / 3600.0):
            yield Variable(v.text, v.topic, v.unit, v.values - v.values.min())
        dwell = np.maximum(extra("dwell_s"), 0.0)
        yield from self._measured("dwell", "dwell", {"s": 1}, dwell)
        yield from self._measured("log(1 + dwell/s)", "dwell", _NOTHING, np.log1p(dwell))
        yield from self._measured("payload", "payload", {"kg": 1}, extra("payload_kg"))

    def _jumps(self, instants_s: Collection[float]) -> Iterator[Variable]:
        """Yield a step at each of the instants."""
        time_s = self._context.extra("time_s")
        for instant_s in sorted(instants_s):
            text = _after((instant_s - float(np.nanmin(time_s))) / 3600.0)
            yield from self._measured(text, "time", _NOTHING, np.where(time_s > instant_s, 1.0, 0.0))

    def _machine_signals(self) -> Iterator[Variable]:
        """Yield pressures, currents and the signals of the rig file."""
        rig = self._context.rig
        own = own_columns(rig.joint_names)
        units = {signal.column: signal.unit for signal in (*rig.channels, *rig.signals) if signal.column not in own}
        for column in sorted(self._context.observations.extra):
            unit = units.get(column, column.rpartition("_")[2] if is_read_anyway(column) else None)
            if unit is not None:
                powers = {symbol: power for symbol, power in zip(unit.split("/"), (1, -1), strict=False) if symbol}
                yield from self._measured(column, column, powers, self._context.extra(column))

    def _measured(self, text: str, topic: str, unit: Unit, values: Floats) -> Iterator[Variable]:
        """Yield a variable of (n,) values if most rows have it and it varies; missing values become the mean."""
        known = np.isfinite(values)
        if len(values) and known.mean() >= _LEAST_KNOWN and np.ptp(values[known]) > 0.0:
            yield Variable(text, topic, unit, self._samples.average(np.where(known, values, values[known].mean())))


def _shapes(joint: Joint, reading: Floats) -> tuple[Variable, ...]:
    """Return the simplest functions of a joint's own value."""
    if joint.kind == "prismatic":
        return (Variable(joint.name, "extension", {"m": 1}, reading / 1e3),)
    return (Variable(joint.name, "angle", {"rad": 1}, np.radians(reading)), *_waves(joint.name, reading, 1, "angle"))


def _curves(joint: Joint, reading: Floats) -> tuple[Variable, ...]:
    """Return powers of a joint's own value about the middle of its range, and its higher harmonics."""
    revolute = joint.kind == "revolute"
    topic, unit = ("angle", "rad") if revolute else ("extension", "m")
    value = np.radians(reading) if revolute else reading / 1e3
    middle = round(float(value.min() + value.max()) / 2.0, 2)
    about = _less(joint.name, middle)
    powers = (Variable(f"{about}^{k}", topic, {unit: k}, (value - middle) ** k) for k in (2, 3))
    return (*powers, *(_harmonics(joint, reading, _HARMONICS, topic)[2:] if revolute else ()))


def _crossing(joint: Joint, reading: Floats, most: int) -> tuple[Variable, ...]:
    """Return functions of the angle of a different joint."""
    topic = f"{joint.name} angle"
    linear = Variable(joint.name, topic, {"rad": 1}, np.radians(reading))
    return (linear, *_harmonics(joint, reading, most, topic))


def _harmonics(joint: Joint, reading: Floats, most: int, topic: str) -> tuple[Variable, ...]:
    """Return cosines and sines of an angle, and of its multiples that the readings resolve."""
    turns = float(np.ptp(reading)) / 360.0
    different = len(np.unique(np.rint(reading / max(joint.resolution, joint.sigma))))
    orders = [k for k in range(2, most + 1) if k * turns >= _LEAST_CYCLE and different >= _PER_CYCLE * k * turns]
    return tuple(v for k in (1, *orders) for v in _waves(joint.name, reading, k, topic))


def _waves(name: str, reading: Floats, order: int, topic: str) -> Iterable[Variable]:
    multiple = f"{order} {name}" if order > 1 else name
    angle = order * np.radians(reading)
    yield Variable(f"cos({multiple})", topic, _NOTHING, np.cos(angle))
    yield Variable(f"sin({multiple})", topic, _NOTHING, np.sin(angle))


def _squared(variable: Variable) -> Variable:
    unit = {symbol: 2 * power for symbol, power in variable.unit.items()}
    return Variable(f"{variable.text}^2", variable.topic, unit, variable.values**2)


def _from_mean(variable: Variable) -> Variable:
    """Return a variable minus its mean, as in a product the mean would represent the other factor alone."""
    mean = round(float(variable.values.mean()), 2)
    return replace(variable, text=_less(variable.text, mean), values=variable.values - mean)


def _steps(time: Variable) -> Iterator[Variable]:
    """Yield steps that divide the fixes into sixteen equal parts."""
    for after in np.unique(np.quantile(time.values, np.arange(1, _STEPS) / _STEPS)).tolist():
        yield Variable(_after(after), time.topic, _NOTHING, np.where(time.values > after, 1.0, 0.0))


def _after(hours: float) -> str:
    return f"(t > {hours:.2g} h)"


def _less(name: str, middle: float) -> str:
    return f"({name} {'-' if middle >= 0.0 else '+'} {abs(middle):g})"


def _power(symbol: str, power: int) -> str:
    return symbol if power == 1 else f"{symbol}^{power}"
