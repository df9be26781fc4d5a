"""Uncertainty of the load on a joint by that of a rig file's masses: nobody has weighed a boom part by part.

An effect c * load becomes c * (load + parts @ p), p standard normal numbers, one for each weight and for each distance
of a centre of gravity that is uncertain. Much of that only makes the whole load larger or smaller, which no pose tells
from a larger or smaller c: it stays out of the fit and counts in the standard error of c. What changes the load's
course over the work volume are few shapes; each gets a coefficient of its own. Its prior is normal for a given c, so
its plausible size is that of c; where the data say that c is larger or smaller, the shapes' are with it (`Choice`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Family, FittedCoefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.errors import ModelError
from calibration.kinematics.chain import Chain
from calibration.kinematics.torques import MASS_SIGMA
from calibration.observations import Floats

UNIT = "rad/(N m)"
_LOAD_SIGMA, _ABOUT, _PARTS = "load_sigma", "about_rad_per_Nm", "parts"
_LEAST_SHAPE = 1e-3  # of the load; less than this of a deflection is invisible
_MOST_PARTS = 100
_MOST_SIGMAS = 3.0  # of a shape, a mixture of weights and centres that are within +-15 %
_CHANCE = 2.0  # standard errors


@dataclass(frozen=True)
class LoadShapes:
    """Shapes by which uncertain weights change a load over the poses.

    Attributes:
        share: (parts,) by how much of itself the load is larger when a part is 1 sigma larger.
        mixing: (parts, r) how the rest makes up r shapes, each 1 sigma.
    """

    share: Floats
    mixing: Floats

    def __len__(self) -> int:
        return int(self.mixing.shape[1])

    @property
    def load_sigma(self) -> float:
        """Uncertainty of the whole load, as a share of it."""
        return float(np.linalg.norm(self.share))

    def __call__(self, load: Floats, parts: Floats) -> Floats:
        """Return the change of a load (n, r), N m per sigma of each shape; 0 where no part is known.

        Args:
            load: (n,) N m.
            parts: (n, parts) change of it per sigma of each part.
        """
        known = parts.any(axis=1)
        left = parts - np.where(known, load, 0.0)[:, None] * self.share
        shapes: Floats = left @ self.mixing
        return shapes


def load_shapes(load: Floats, parts: Floats, *, constant: bool = False) -> LoadShapes:
    """Find the shapes of a load over a work volume of n poses, the largest first.

    Args:
        load: (n,) N m.
        parts: (n, k) its change per sigma of each part.
        constant: True if a change that is constant over the poses counts as well, as it does where a load changes its
            sign. An encoder's zero takes it up otherwise.
    """
    level = np.column_stack([np.zeros(len(load)) if constant else np.ones(len(load)), load])
    share = np.linalg.lstsq(level, parts)[0][1]
    _, size, directions = np.linalg.svd(parts - load[:, None] * share, full_matrices=False)
    mixing = directions[size > _LEAST_SHAPE * np.linalg.norm(load)].T
    # A direction has no sign; the largest part decides.
    return LoadShapes(share, mixing * np.sign(mixing[np.abs(mixing).argmax(axis=0), np.arange(mixing.shape[1])]))


_shapes: WeakKeyDictionary[Chain, dict[str, LoadShapes]] = WeakKeyDictionary()


def shapes_by_design(
    context: EffectContext,
    load: str,
    volume: Callable[[EffectContext], tuple[Floats, Floats]],
    *,
    constant: bool = False,
) -> LoadShapes:
    """Return the shapes of a load on the machine as designed, from its work volume; found once for each chain.

    Args:
        context: whose chain it is.
        load: a name to remember it by.
        volume: the load (n,) and its parts (n, k) in a work volume.
        constant: as for `load_shapes`.
    """
    if not context.rig.masses:
        return LoadShapes(np.zeros(0), np.zeros((0, 0)))
    known = _shapes.setdefault(context.chain, {})
    if load not in known:
        known[load] = load_shapes(*volume(context.as_designed.work_volume), constant=constant)
    return known[load]


def gravity_shapes(context: EffectContext, where: str, *, constant: bool = False) -> LoadShapes:
    """Return the shapes of gravity's load on a joint; `constant` as for `load_shapes`."""
    return shapes_by_design(
        context,
        f"{where} with its constant part" if constant else where,
        lambda volume: (volume.torque(where), volume.torque_parts(where)),
        constant=constant,
    )


def load_columns(
    load: Floats, settings: Settings, shapes: Callable[[], LoadShapes], parts: Callable[[], Floats]
) -> Floats:
    """Return a load, and its change for each coefficient of a variant that shapes it.

    Args:
        load: (n,) N m, 0 where not known.
        settings: the variant, as `load_variants` makes them.
        shapes: returns the shapes of the load; asked only if the variant has some.
        parts: returns its change (n, parts) per sigma of each part; likewise.

    Returns:
        (n, 1 + r) N m.

    Raises:
        ModelError: the variant is of other shapes, made by another version of this program.
    """
    names = part_names(settings)
    if not names:
        return load[:, None]
    found = shapes()
    if len(names) != len(found):
        raise ModelError(f"the model has {len(names)} shapes of a load that has {len(found)}; calibrate again")
    return np.column_stack([load, found(load, parts())])


def load_variants(shapes: LoadShapes, plausible: float) -> tuple[Settings, ...]:
    """Return the variants of an effect in proportion to a load: without its shapes and with them.

    Args:
        shapes: of its load; none where the load is measured.
        plausible: size of the effect's own coefficient, rad per N m.
    """
    if shapes.load_sigma == 0.0:
        return ({},)
    plain = {_LOAD_SIGMA: shapes.load_sigma}
    return (plain, {**plain, _ABOUT: plausible, _PARTS: float(len(shapes))}) if len(shapes) else (plain,)


def part_names(settings: Settings) -> tuple[str, ...]:
    """Return the names of the coefficients that shape the load.

    Raises:
        ValueError: settings that `load_variants` does not make.
    """
    if set(settings) <= {_LOAD_SIGMA} and settings.get(_LOAD_SIGMA, 0.0) >= 0.0:
        return ()
    if (
        set(settings) != {_LOAD_SIGMA, _ABOUT, _PARTS}
        or settings[_LOAD_SIGMA] < 0.0
        or settings[_ABOUT] <= 0.0
        or not 1.0 <= settings[_PARTS] <= _MOST_PARTS
    ):
        raise ValueError(
            f"the settings are {_LOAD_SIGMA}, and {_ABOUT} with {_PARTS}, the number of shapes of the load"
        )
    return tuple(f"part{number}_rad_per_Nm" for number in range(1, int(settings[_PARTS]) + 1))


def part_coefficients(settings: Settings, bound: float) -> tuple[Coefficient, ...]:
    """Return the coefficients that shape the load, within +-`bound`, rad per N m."""
    return tuple(Coefficient(name, UNIT, settings[_ABOUT], -bound, bound) for name in part_names(settings))


class OfUncertainLoad(Family):
    """An effect in proportion to a load: its own coefficient, and after it those of what is uncertain of the load."""

    limit_sigma = MASS_SIGMA  # limits are what it may do at the largest load

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the effect's own coefficient alone, with the uncertainty of the whole load in its standard error."""
        own = coefficients[0]
        error = math.hypot(own.standard_error, settings.get(_LOAD_SIGMA, 0.0) * own.value)
        return (replace(own, standard_error=error),)

    def strained(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        """Return True if the shapes ask for weights that no machine has: the fit follows another effect."""
        del settings
        most = _MOST_SIGMAS * (abs(values[0]) + _CHANCE * standard_errors[0])
        return bool((np.abs(values[1:]) > most + _CHANCE * standard_errors[1:]).any())


class TorqueFamily(JointFamily):
    """An effect at a revolute joint in whose load it lies alone."""

    goes_with = "torque"
    kind = "revolute"

    def needs(self, where: str) -> str:
        return f"masses in the rig file or the column {where}_Nm"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        return np.isfinite(context.torque(where))
