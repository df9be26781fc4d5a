"""A boom that bends under its load."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calibration.effects.base import Coefficient, Settings
from calibration.effects.boom import Boom, BoomFamily, boom_in
from calibration.effects.context import EffectContext
from calibration.effects.load_shapes import LoadShapes, UncertainLoadFamily, shapes_by_design
from calibration.errors import ModelError
from calibration.kinematics.torques import MASS_SIGMA
from calibration.observations import Floats

_FLEXIBILITY = "flexibility_per_Nm2"
_UNIT = "1/(N m^2)"
_SIGMA_MM = 20.0  # plausible droop of the tip at full reach
_BOUND_MM = 300.0
_OWN_SIGMA = 1.0 / math.sqrt(3.0)  # of the effect of the boom's own weight, whose distribution is unknown: +-100 %
_AHEAD_MM = 3000.0  # distance ahead of the tip of a second point, which also makes the slope visible
_MOST_PARTS = 100


class BoomDroop(UncertainLoadFamily, BoomFamily):
    """An Euler-Bernoulli cantilever from the boom's root to its tip, longer as it extends.

    The tip carries the weights F of all parts beyond it, with their moment M about the tip. Weights W that are fixed to
    the root section are spread evenly over the length. All parts beyond the tip move with it as a rigid body.

    Weights and centres of gravity are known to +-15 % only, and the distribution of the boom's own weight is unknown.
    The resulting uncertainty of the droop's course over the work volume is described by the shapes of `load_shapes`,
    which the variants with `about_per_Nm2` add. A common factor on the whole droop is not a shape; its uncertainty is
    part of the standard error.
    """

    name = "boom_droop"
    equation = "shift = (F L^3/3 + M L^2/2 + W L^3/8) / EI, slope = (F L^2/2 + M L + W L^2/6) / EI"
    source = "Euler-Bernoulli beam theory: cantilever with a load and a moment at its end"
    confused_with = ("joint_compliance", "transducer_quadratic", "pad_play")
    revealed_by = "the same attitude of the boom retracted and extended, once with a load and once without"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        boom = boom_in(context)
        if boom is None or not boom.carries_prism.any() or _greatest_mm(context) == 0.0:
            return ()
        shapes = _shapes(context)
        plain = {"load_sigma": shapes.load_sigma}
        sigma = self.coefficients(context, where, plain)[0].sigma
        return (plain, {**plain, "about_per_Nm2": sigma, "parts": float(len(shapes))}) if len(shapes) else (plain,)

    def names(self, settings: Settings) -> tuple[str, ...]:
        shaped = settings.keys() - {"load_sigma"}
        sound = settings.get("load_sigma", -1.0) >= 0.0
        if shaped:
            sound = sound and shaped == {"about_per_Nm2", "parts"} and settings["about_per_Nm2"] > 0.0
            sound = sound and 1.0 <= settings["parts"] <= _MOST_PARTS
        if not sound:
            raise ValueError("the settings are load_sigma, and about_per_Nm2 with parts, the number of shapes")
        return (_FLEXIBILITY, *(f"part{number}_per_Nm2" for number in range(1, int(settings.get("parts", 0.0)) + 1)))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del where
        most = _greatest_mm(context)
        first, *others = self.names(settings)
        bound = _BOUND_MM / most
        return (
            Coefficient(first, _UNIT, _SIGMA_MM / most, 0.0, bound),
            *(Coefficient(name, _UNIT, settings["about_per_Nm2"], -bound, bound) for name in others),
        )

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        boom, (_, *shaped) = boom_in(context), self.names(settings)
        if boom is None or not context.rig.masses:
            return np.zeros((len(context), 3, 1 + len(shaped)))
        loads = load_factors(boom, self.names(settings))
        moved = _moved_mm(boom, context.located.prism_mm - boom.tip_mm, loads)
        return context.to_station(moved * boom.carries_prism[:, None, None])


def load_factors(boom: Boom, names: Sequence[str]) -> Floats:
    """Return the factors on each point weight for every coefficient.

    Args:
        boom: the boom.
        names: names of the k coefficients.

    Returns:
        (4 * points, k) factors of four load cases: force at the tip, moment about the tip, moment of the centre of
        gravity, and weight along the boom.

    Raises:
        ModelError: the coefficients belong to different load shapes, of a different version of this program.
    """
    loads, shaped = _whole(boom), names[1:]
    if not shaped:
        return loads
    shapes = _shapes(boom.context)
    if len(shapes) != len(shaped):
        raise ModelError(f"the model has {len(shaped)} shapes of a droop, its rig {len(shapes)}; calibrate again")
    return np.hstack([loads, (_parts(boom) - loads * shapes.share) @ shapes.mixing])


def _greatest_mm(context: EffectContext) -> float:
    """Return the largest droop of the tip in the work volume, mm per unit of flexibility; 0 without a load."""
    boom = boom_in(context.work_volume)
    if boom is None or not context.rig.masses:
        return 0.0
    moved = _moved_mm(boom, np.zeros((len(boom.context), 3)), _whole(boom))
    return float(np.linalg.norm(moved[:, :, 0], axis=1).max())


def _shapes(context: EffectContext) -> LoadShapes:
    """Return the shapes of the droop's uncertainty due to uncertain weights."""
    return shapes_by_design(context, BoomDroop.name, _in_volume)


def _in_volume(volume: EffectContext) -> tuple[Floats, Floats]:
    """Return the sag of the tip and a point ahead of it per unit of flexibility, mm: total (m,), parts (m, parts)."""
    boom = boom_in(volume)
    assert boom is not None  # only called for rigs with a boom
    loads = np.hstack([_whole(boom), _parts(boom)])
    sunk = [
        np.einsum("ni,nik->nk", boom.down, _moved_mm(boom, ahead_mm * boom.axis, loads))
        for ahead_mm in (0.0, _AHEAD_MM)
    ]
    both = np.concatenate(sunk)
    return both[:, 0], both[:, 1:]


def _whole(boom: Boom) -> Floats:
    """Return the (4 * points, 1) factors of the nominal weights; load cases as in `load_factors`."""
    none = np.zeros(len(boom.hanging))
    return np.concatenate([boom.hanging, boom.hanging, none, boom.own])[:, None]


def _parts(boom: Boom) -> Floats:
    """Return the (4 * points, parts) factors for a change by one sigma of every uncertain part of the weights."""
    mass_of = boom.context.loads.point_mass
    none = np.zeros(len(mass_of))
    parts = []
    for index, mass in enumerate(boom.context.rig.masses):
        hangs = MASS_SIGMA * (boom.hanging & (mass_of == index))
        if mass.kg > 0.0 and hangs.any():
            parts.append(np.concatenate([hangs, hangs, none, none]))
            if mass.centre_mm is not None and any(mass.centre_mm):
                parts.append(np.concatenate([none, none, hangs, none]))
    if boom.own.any():
        parts.append(np.concatenate([none, none, none, _OWN_SIGMA * boom.own]))
    return np.array(parts).reshape(-1, 4 * len(none)).T


def _moved_mm(boom: Boom, arm_mm: Floats, loads: Floats) -> Floats:
    """Return the displacement (n, 3, k) in the base frame at `arm_mm` (n, 3) from the tip, mm per unit of 1 / EI.

    Notation: e is the boom's axis, g the direction of gravity, s the vector from the tip to the point. A weight w at
    the tip bends the boom by the component of w g across e and turns it about e x g. A weight at r from the tip adds
    the moment m = w r x g without its component along e.
    """
    places_mm, newton = boom.weights
    tip, moment, centre, own = np.split(loads, 4)
    weighed = newton[:, :, None] * 1e-3
    first = (weighed * (places_mm - boom.tip_mm[:, None, :])).transpose(0, 2, 1) @ moment
    if centre.any():
        origins_mm = boom.context.located.frames_mm[:, boom.context.loads.point_frame]
        first += (weighed * (places_mm - origins_mm)).transpose(0, 2, 1) @ centre
    e, g, s = boom.axis, boom.down, arm_mm * 1e-3
    length = boom.length_mm[:, None] * 1e-3
    across, turning = g - (e * g).sum(axis=1)[:, None] * e, boom.lowered(s)
    at_tip = across * length**3 / 3.0 + turning * length**2 / 2.0
    along = across * length**3 / 8.0 + turning * length**2 / 6.0
    # The moment shifts the tip by m x e L^2 / 2 and turns it by (m - (m e) e) L, so that the point at s moves by
    # m x (e L^2 / 2 + s L) - (m e) e x s L, with m = -g x (w r).
    twist = _crossing(e) @ (s * length)[:, :, None]
    by_moment = _crossing(e * length**2 / 2.0 + s * length) + twist * e[:, None, :]
    moved: Floats = (by_moment @ _crossing(g)) @ first
    moved += at_tip[:, :, None] * (newton @ tip)[:, None, :] + along[:, :, None] * (newton @ own)[:, None, :]
    return 1e3 * moved


def _crossing(v: Floats) -> Floats:
    """Return the cross product matrices (n, 3, 3) of vectors (n, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 1, 0], out[:, 2, 1], out[:, 0, 2] = v[:, 2], v[:, 0], v[:, 1]
    return out - out.transpose(0, 2, 1)


FAMILY = BoomDroop()
