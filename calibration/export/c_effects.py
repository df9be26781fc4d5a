"""C code of the effects that are functions of the joint readings and of a few inputs of the caller.

Loads are sums over the weights of each frame. The fitted corrections of uncertain weights are therefore written as a
table of weights and first moments for every effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from calibration.effects.boom import Boom, boom_in
from calibration.effects.context import EffectContext
from calibration.effects.families import boom_droop, gravity_flip_play, joint_compliance
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.effects.links import LinkFamily
from calibration.effects.load_shapes import LoadShapes, gravity_shapes, part_names
from calibration.export.motions import Carriers
from calibration.kinematics.torques import MASS_SIGMA, STANDARD_GRAVITY
from calibration.observations import Floats
from calibration.rig.description import Rig

_LATER = ("time_s", "row")  # variables of a regime that, after the training, are always above its border


@dataclass
class EffectCode:
    """C code of a model's effects.

    Attributes:
        tables: definitions of tables.
        lines: statements that add to `change` and to the shifts of `points`.
        inputs: fields of the caller's inputs that the statements use.
        needs_pose: True if the statements use the machine's pose.
    """

    tables: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    inputs: set[str] = field(default_factory=set)
    needs_pose: bool = False


@dataclass(frozen=True)
class EffectWriter:
    """Writes the effects of one model as C code.

    Args:
        context: any observations of the model's machine; they determine the shapes of its uncertain loads.
        tree: the motions of the machine.
    """

    context: EffectContext
    tree: Carriers

    def code(self, effects: Mapping[int, FittedEffect]) -> EffectCode:
        """Return the C code of effects.

        Args:
            effects: number of each effect -> the effect, which `can_write` accepts.
        """
        out = EffectCode()
        for number, effect in effects.items():
            lines = list(self._lines(number, effect, out))
            acts = self._acts(number, effect, out)
            out.lines += [f"    if ({acts}) {{", *(f"        {line}" for line in lines), "    }"] if acts else lines
        return out

    def can_write(self, effect: FittedEffect) -> bool:
        """Return True if an effect can be written as C code."""
        known = effect.family in _WRITERS or isinstance(library()[effect.family], LinkFamily)
        regime = effect.regime
        columns = {joint.column for joint in self._rig.joints}
        told = regime is None or regime.variable in (*columns, *_LATER) or regime.variable.startswith("torque(")
        return known and told

    @property
    def _rig(self) -> Rig:
        return self.context.rig

    def _lines(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        yield f"/* {effect.family}@{effect.where} */"
        family = library()[effect.family]
        if isinstance(family, LinkFamily):
            yield from self._link(number, effect, family, out)
        else:
            yield from _WRITERS[effect.family](self, number, effect, out)

    def _acts(self, number: int, effect: FittedEffect, out: EffectCode) -> str:
        """Return the C condition under which an effect acts; "" if it always acts."""
        regime = effect.regime
        if regime is None:
            return ""
        if regime.variable in _LATER:
            return "1" if regime.above else "0"
        border = _c(regime.border)
        if regime.variable.startswith("torque("):
            joint = self._joint(regime.variable.removeprefix("torque(").removesuffix(")"))
            table = self._table(f"part{number}", self._weights(), out)
            out.needs_pose = True
            value = f"rigcal_load(at, {table}, {joint})"
        else:
            value = f"q[{[joint.column for joint in self._rig.joints].index(regime.variable)}]"
        return f"{value} {'>' if regime.above else '<='} {border}"

    def _joint(self, name: str) -> int:
        return self._rig.joint_names.index(name)

    # -- readings alone ------------------------------------------------------------------------------------------------

    def _scale(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        del number, out
        joint = self._joint(effect.where)
        yield f"change[{joint}] += {_c(effect.coefficients[0].value)} * q[{joint}];"

    def _quadratic(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        del number, out
        joint = self._joint(effect.where)
        middle = sum(self._rig.joints[joint].limits) / 2.0
        from_middle = f"((q[{joint}] - {_c(middle)}) / 1e3)"
        yield f"change[{joint}] += {_c(effect.coefficients[0].value)} * {from_middle} * {from_middle};"

    def _constant(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        """Write a step change, which has happened at any time after the training."""
        del number, out
        value = effect.coefficients[0].value * (math.degrees(1.0) if self._turns(effect) else 1.0)
        yield f"change[{self._joint(effect.where)}] += {_c(value)};"

    def _turns(self, effect: FittedEffect) -> bool:
        return effect.coefficients[0].unit == "rad"

    def _harmonic(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        del number, out
        joint, values = self._joint(effect.where), [c.value for c in effect.coefficients]
        for times, (cosine, sine) in enumerate(zip(values[::2], values[1::2], strict=True), 1):
            angle = f"{_c(effect.settings['k'] * times * math.radians(1.0))} * q[{joint}]"
            terms = f"{_c(math.degrees(cosine))} * cos({angle}) + {_c(math.degrees(sine))} * sin({angle})"
            yield f"change[{joint}] += {terms};"

    def _map(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        joint, settings = self._joint(effect.where), effect.settings
        weights = _list(math.degrees(c.value) for c in effect.coefficients)
        count = len(effect.coefficients)
        out.tables.append(f"static const double rigcal_map{number}[{count}] = {weights};")
        is_turn = "low_deg" not in settings
        low, high = settings.get("low_deg", 0.0), settings.get("high_deg", 360.0)
        yield (
            f"change[{joint}] += rigcal_splines(q[{joint}], {_c(low)}, {_c(high)}, {int(settings['pieces'])}, "
            f"{int(is_turn)}, {count}, rigcal_map{number});"
        )

    # -- inputs of the caller ------------------------------------------------------------------------------------------

    def _backlash(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        del number
        out.inputs.add("direction")
        joint, half = self._joint(effect.where), math.degrees(effect.coefficients[0].value) / 2.0
        yield f"if (in) change[{joint}] += {_c(half)} * in->direction[{joint}];"

    def _thermal(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        del number
        out.inputs.add("temperature_degC")
        out.needs_pose = True
        links = "mounting_as_it_is" in effect.settings
        yield "if (in && in->temperature_degC == in->temperature_degC)"
        yield "    for (int p = 0; p < points->count; p++) {"
        yield "        double grown[3] = {points->place[p][0], points->place[p][1], points->place[p][2]};"
        if links:
            prism = "points->prism[p]"
            yield f"        rigcal_place(at, rigcal_prism_motion[{prism}], rigcal_prism_mount[{prism}], grown);"
        share = f"{_c(effect.coefficients[0].value)} * (in->temperature_degC - {_c(effect.settings['mean_degC'])})"
        yield f"        for (int i = 0; i < 3; i++) points->shift[p][i] += {share} * grown[i];"
        yield "    }"

    # -- the pose ------------------------------------------------------------------------------------------------------

    def _coupling(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        del number
        out.needs_pose = True
        joint, first_drive = self._joint(effect.where), 0
        found: list[tuple[int, int]] = []
        for index, motion in enumerate(self.tree.motions):
            found += [(index, first_drive + i) for i, (driving, _) in enumerate(motion.drive) if driving == joint]
            first_drive += len(motion.drive)
        amount = f"{_c(effect.coefficients[0].value)} * q[{joint}]"
        yield from (f"rigcal_follow(at, {k}, {drive}, {amount}, points);" for k, drive in found[1:])

    def _compliance(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        settings, values = effect.settings, np.array([c.value for c in effect.coefficients])
        joint, degrees = self._joint(effect.where), math.degrees(1.0)
        if "bend_rad" not in settings:
            weights = values[0] * self._weights()
            if part_names(settings):
                shapes = gravity_shapes(self.context, effect.where)
                weights = weights + np.tensordot(values[1:], self._shaped(shapes, self._parts()), axes=1)
            yield f"change[{joint}] += {self._load(f'load{number}', degrees * weights, joint, out)};"
            return
        load = self._load(f"load{number}", self._weights(), joint, out)
        power = settings.get("knot_power")
        knots, line = joint_compliance.shape_of_curve(power)
        count = len(values) - 1
        wide = np.zeros((2, 16))
        wide[:, :count] = line
        out.tables.append(f"static const double rigcal_knots{number}[{len(knots)}] = {_list(knots)};")
        out.tables.append(f"static const double rigcal_line{number}[2][16] = {_list(wide)};")
        out.tables.append(f"static const double rigcal_bend{number}[{count}] = {_list(degrees * values[1:])};")
        if power is None:
            low, high = settings["low_Nm"], settings["high_Nm"]
            s = f"(2.0 * load - {_c(low)} - {_c(high)}) / ({_c(high)} - {_c(low)})"
        else:
            s = f"load / {_c(settings['torque_Nm'])}"
        curve = f"{count}, rigcal_knots{number}, rigcal_line{number}, rigcal_bend{number}, {int(power is not None)}"
        yield "{"
        yield f"    const double load = {load};"
        yield f"    change[{joint}] += {_c(degrees * values[0])} * load + rigcal_curve({s}, {curve});"
        yield "}"

    def _flip(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        settings, values = effect.settings, [math.degrees(c.value) / 2.0 for c in effect.coefficients]
        joint = self._joint(effect.where)
        load = self._load(f"load{number}", self._weights(), joint, out)
        if not settings:
            yield f"change[{joint}] += {_c(values[0])} * rigcal_sign({load});"
            return
        shapes = gravity_shapes(self.context, effect.where, constant=True)
        at, open_to = gravity_flip_play.places_and_spreads(settings, len(shapes))
        tables = self._shaped(shapes, self._parts())
        yield "{"
        yield f"    double load = {load}, wide = {_c(gravity_flip_play.other_newton_m(settings) ** 2)}, part;"
        for index, (weights, spread) in enumerate(zip(tables, open_to, strict=True)):
            yield f"    part = {self._load(f'load{number}_{index}', weights, joint, out)};"
            yield f"    wide += part * part * {_c(spread**2)};"
            if index < len(at):
                yield f"    load += {_c(at[index])} * part;"
        yield "    const double u = 0.5 * erfc(-load / sqrt(2.0 * wide));"
        yield f"    change[{joint}] += {_c(values[0])} * (2.0 * u - 1.0);"
        for term, value in enumerate(values[1:], 1):
            size = value * math.sqrt(8.0) / (math.pi * term)
            yield f"    change[{joint}] += {_c(size)} * sin({_c(math.pi * term)} * u);"
        yield "}"

    def _link(self, number: int, effect: FittedEffect, family: LinkFamily, out: EffectCode) -> Iterator[str]:
        out.needs_pose = True
        row = family.row(self._rig, effect.where)
        values = np.array([c.value for c in effect.coefficients])
        weights = values[0] * self._weights()
        if part_names(effect.settings):
            shapes = family.shapes(self.context, effect.where)
            weights = weights + np.tensordot(values[1:], self._shaped(shapes, self._parts(row)), axes=1)
        table = self._table(f"load{number}", weights, out)
        along = int(effect.family == "passive_compliance")
        yield f"rigcal_bend(at, {table}, {self.tree.turning[row]}, {along}, 1.0, points);"

    def _droop(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        out.needs_pose = True
        boom = self._boom()
        points = self._points()
        newton = boom.weights[1][0]
        factors = boom_droop.load_factors(boom, tuple(c.name for c in effect.coefficients))
        tip, moment, centre, own = np.split(factors @ [c.value for c in effect.coefficients], 4)
        weights = np.zeros((len(self._rig.rows) + 1, 4))
        for (frame, offset_mm), force, of_whole, of_centre in zip(points, newton, moment, centre, strict=True):
            weights[frame, 0] += force * of_whole
            weights[frame, 1:] += force * (of_whole + of_centre) * offset_mm
        table = self._table(f"load{number}", weights, out)
        forces = f"{_c(newton @ tip)}, {_c(newton @ own)}"
        yield f"rigcal_droop(at, {boom.root}, {boom.row}, {table}, {forces}, points);"

    def _pads(self, number: int, effect: FittedEffect, out: EffectCode) -> Iterator[str]:
        out.needs_pose = True
        boom, rig = self._boom(), self._rig
        hanging = self._weights()
        hanging[[boom.row not in rig.path(frame) for frame in range(len(hanging))]] = 0.0
        table = self._table(f"load{number}", hanging, out)
        low, high = rig.joint(boom.joint).limits
        left = effect.settings["left"] * (high - low)
        overlap = f"fmax({_c(high)} - q[{self._joint(boom.joint)}], 0.0) + {_c(left)}"
        yield (
            f"rigcal_pads(at, {boom.root}, {boom.row}, {table}, {_c(boom.outer_mm)}, {overlap}, "
            f"{_c(effect.coefficients[0].value)}, points);"
        )

    def _boom(self) -> Boom:
        boom = boom_in(self.context)
        assert boom is not None  # an effect of the boom is only on rigs that have one
        return boom

    def _points(self) -> list[tuple[int, Floats]]:
        """Return frame and position of each point of weight, in the order of `GravityModel`."""
        found: list[tuple[int, Floats]] = []
        for mass in self._rig.masses:
            frames = (mass.frame,) if mass.centre_mm is not None else (mass.frame, mass.frame + 1)
            found += [(frame, np.array(mass.centre_mm or (0.0, 0.0, 0.0))) for frame in frames]
        return found

    # -- weights -------------------------------------------------------------------------------------------------------

    def _load(self, name: str, weights: Floats, joint: int, out: EffectCode) -> str:
        out.needs_pose = True
        return f"rigcal_load(at, {self._table(name, weights, out)}, {joint})"

    def _table(self, name: str, weights: Floats, out: EffectCode) -> str:
        """Add a table of weights and return its name.

        Args:
            name: its name without the prefix `rigcal_`.
            weights: (frames, 4); the table has (motions, 4) weights that each motion carries, in its own axes.
            out: the code to which the table is added.
        """
        carried = np.zeros((len(self.tree.motions), 4))
        for (motion, place), (newton, *moment) in zip(self.tree.frames, weights, strict=True):
            if motion >= 0:  # weights fixed to the base do not load a joint
                carried[motion, 0] += newton
                carried[motion, 1:] += place[:3, :3] @ moment + newton * place[:3, 3]
        out.tables.append(f"static const double rigcal_{name}[RIGCAL_MOTIONS][4] = {_list(carried)};")
        return f"rigcal_{name}"

    def _weights(self, mass: int | None = None) -> Floats:
        """Return (frames, 4) weight in N and its moment about the frame's origin in N mm, of one mass or of all."""
        rig = self._rig
        out = np.zeros((len(rig.rows) + 1, 4))
        for index, one in enumerate(rig.masses):
            if mass in (None, index):
                newton = STANDARD_GRAVITY * one.kg
                if one.centre_mm is None:
                    out[[one.frame, one.frame + 1], 0] += newton / 2.0
                else:
                    out[one.frame] += newton * np.array([1.0, *one.centre_mm])
        return out

    def _parts(self, row: int | None = None) -> Floats:
        """Return (parts, frames, 4) changes of the weights by one sigma of each uncertain weight and centre.

        The order is that of `GravityModel.parts`, or of `Link.parts_newton_m` for a row.
        """
        rig, parts = self._rig, []
        beyond = [row is None or row in rig.path(frame) for frame in range(len(rig.rows) + 1)]
        for index, mass in enumerate(rig.masses):
            weights = MASS_SIGMA * self._weights(index)
            carried = beyond[mass.frame] or (mass.midway and beyond[mass.frame + 1])
            if row is not None and (mass.kg == 0.0 or not carried):
                continue
            parts.append(weights)
            if mass.centre_mm is not None and any(mass.centre_mm):
                parts.append(weights * np.array([0.0, 1.0, 1.0, 1.0]))
        return np.array(parts).reshape(-1, len(beyond), 4)

    def _shaped(self, shapes: LoadShapes, parts: Floats) -> Floats:
        """Return (r, frames, 4) weights that produce the change of a load by each of its r shapes."""
        left = parts - shapes.share[:, None, None] * self._weights()
        return np.tensordot(shapes.mixing.T, left, axes=1)


_Writer = Callable[[EffectWriter, int, FittedEffect, EffectCode], Iterator[str]]
_WRITERS: Mapping[str, _Writer] = {
    "angle_scale": EffectWriter._scale,
    "transducer_scale": EffectWriter._scale,
    "transducer_quadratic": EffectWriter._quadratic,
    "transducer_index_jump": EffectWriter._constant,
    "zero_step": EffectWriter._constant,
    "encoder_harmonic": EffectWriter._harmonic,
    "joint_error_map": EffectWriter._map,
    "backlash": EffectWriter._backlash,
    "thermal_expansion": EffectWriter._thermal,
    "linkage_coupling": EffectWriter._coupling,
    "joint_compliance": EffectWriter._compliance,
    "gravity_flip_play": EffectWriter._flip,
    "boom_droop": EffectWriter._droop,
    "pad_play": EffectWriter._pads,
}


def _c(value: float) -> str:
    """Return a number as a C literal that reads back exactly, in parentheses if negative."""
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


def _list(values: object) -> str:
    """Return numbers, nested or not, as a C initialiser."""
    if isinstance(values, np.ndarray) and values.ndim > 1:
        return "{" + ", ".join(_list(row) for row in values) + "}"
    assert hasattr(values, "__iter__")
    return "{" + ", ".join(repr(float(v)) for v in values) + "}"
