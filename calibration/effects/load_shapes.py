"""Uncertainty of the load on a joint due to uncertain masses in the rig file, as booms are not weighed part by part.

An effect c * load becomes c * (load + parts @ p), where p are standard normal numbers, one for each uncertain weight
and each uncertain distance of a centre of gravity. Much of this only scales the whole load, which no pose can
distinguish from a larger or smaller c. This part is left out of the fit and included in the standard error of c. The
changes of the load's course over the work volume are spanned by a few shapes, each with its own coefficient. Given c,
the prior of a coefficient is normal, so its plausible size is that of c. If the data scale the plausible size of c,
that of the shapes is scaled too (`Choice`).
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
_LEAST_SHAPE = 1e-3  # smallest shape as a share of the load; a smaller share of a deflection is not measurable
_MOST_PARTS = 100
_MOST_SIGMAS = 3.0  # largest plausible value of a shape, a mixture of weights and centres that are within +-15 %
_CHANCE = 2.0  # standard errors


@dataclass(frozen=True)
class LoadShapes:
    """Shapes by which uncertain weights change a load over the poses.

    Attributes:
        share: (parts,) relative change of the whole load per sigma of each part.
        mixing: (parts, r) combination of the remaining changes into r shapes, each of 1 sigma.
    """

    share: Floats
    mixing: Floats

    def __len__(self) -> int:
        return int(self.mixing.shape[1])

    @property
    def load_sigma(self) -> float:
        """Relative uncertainty of the whole load, 1 sigma."""
        return float(np.linalg.norm(self.share))

    def __call__(self, load: Floats, parts: Floats) -> Floats:
        """Return the change of a load (n, r), N m per sigma of each shape; 0 in rows where no part is known.

        Args:
            load: (n,) load, N m.
            parts: (n, parts) change of the load per sigma of each part, N m.
        """
        known = parts.any(axis=1)
        left = parts - np.where(known, load, 0.0)[:, None] * self.share
        shapes: Floats = left @ self.mixing
        return shapes


def load_shapes(load: Floats, parts: Floats, *, constant: bool = False) -> LoadShapes:
    """Compute the shapes of a load over a work volume of n poses, largest first.

    Args:
        load: (n,) load, N m.
        parts: (n, k) change of the load per sigma of each part, N m.
        constant: True to include changes that are constant over the poses. They matter where the sign of a load counts;
            otherwise an encoder's zero absorbs them.
    """
    level = np.column_stack([np.zeros(len(load)) if constant else np.ones(len(load)), load])
    share = np.linalg.lstsq(level, parts)[0][1]
    _, size, directions = np.linalg.svd(parts - load[:, None] * share, full_matrices=False)
    mixing = directions[size > _LEAST_SHAPE * np.linalg.norm(load)].T
    # The sign of a direction is arbitrary; make its largest component positive.
    return LoadShapes(share, mixing * np.sign(mixing[np.abs(mixing).argmax(axis=0), np.arange(mixing.shape[1])]))


_shapes: WeakKeyDictionary[Chain, dict[str, LoadShapes]] = WeakKeyDictionary()


def shapes_by_design(
    context: EffectContext,
    load: str,
    volume: Callable[[EffectContext], tuple[Floats, Floats]],
    *,
    constant: bool = False,
) -> LoadShapes:
    """Return the shapes of a load on the machine as designed, over its work volume; cached for each chain.

    Args:
        context: a context of the chain.
        load: name of the load, the cache key.
        volume: function that returns the load (n,) and its parts (n, k) in a work volume.
        constant: as for `load_shapes`.
    """
    if not context.rig.masses:
        return LoadShapes(np.zeros(0), np.zeros((0, 0)))
    known = _shapes.setdefault(context.chain, {})
    if load not in known:
        known[load] = load_shapes(*volume(context.as_designed.work_volume), constant=constant)
    return known[load]


def gravity_shapes(context: EffectContext, where: str, *, constant: bool = False) -> LoadShapes:
    """Return the shapes of the gravity load on a joint; `constant` as for `load_shapes`."""
    return shapes_by_design(
        context,
        f"{where} with its constant part" if constant else where,
        lambda volume: (volume.torque(where), volume.torque_parts(where)),
        constant=constant,
    )


def load_columns(
    load: Floats, settings: Settings, shapes: Callable[[], LoadShapes], parts: Callable[[], Floats]
) -> Floats:
    """Return a load, and its change for each shape coefficient of a variant.

    Args:
        load: (n,) load, N m, 0 where not known.
        settings: a variant as returned by `load_variants`.
        shapes: function that returns the shapes of the load; called only if the variant has shapes.
        parts: function that returns the change (n, parts) per sigma of each part; called likewise.

    Returns:
        (n, 1 + r) N m.

    Raises:
        ModelError: the variant belongs to different shapes, of a different version of this program.
    """
    names = part_names(settings)
    if not names:
        return load[:, None]
    found = shapes()
    if len(names) != len(found):
        raise ModelError(f"the model has {len(names)} shapes of a load, its rig {len(found)}; calibrate again")
    return np.column_stack([load, found(load, parts())])


def load_variants(shapes: LoadShapes, plausible: float) -> tuple[Settings, ...]:
    """Return the variants of an effect proportional to a load: without and with shapes of the load.

    Args:
        shapes: shapes of the load; empty where the load is measured.
        plausible: plausible size of the effect's own coefficient, rad per N m.
    """
    if shapes.load_sigma == 0.0:
        return ({},)
    plain = {_LOAD_SIGMA: shapes.load_sigma}
    return (plain, {**plain, _ABOUT: plausible, _PARTS: float(len(shapes))}) if len(shapes) else (plain,)


def part_names(settings: Settings) -> tuple[str, ...]:
    """Return the names of the coefficients that shape the load.

    Raises:
        ValueError: the settings are not those of `load_variants`.
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
    """Return the coefficients that shape the load, with hard limits +-`bound`, rad per N m."""
    return tuple(Coefficient(name, UNIT, settings[_ABOUT], -bound, bound) for name in part_names(settings))


class UncertainLoadFamily(Family):
    """An effect proportional to an uncertain load: its own coefficient, followed by those of the load's shapes."""

    limit_sigma = MASS_SIGMA  # the limits are derived from the largest load

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the effect's own coefficient alone, with the uncertainty of the whole load in its standard error."""
        own = coefficients[0]
        error = math.hypot(own.standard_error, settings.get(_LOAD_SIGMA, 0.0) * own.value)
        return (replace(own, standard_error=error),)

    def has_implausible_shape(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        """Return True if the shapes imply implausible weights: the fit then follows a different effect."""
        del settings
        most = _MOST_SIGMAS * (abs(values[0]) + _CHANCE * standard_errors[0])
        return bool((np.abs(values[1:]) > most + _CHANCE * standard_errors[1:]).any())


class TorqueFamily(JointFamily):
    """An effect at a revolute joint that depends only on the load of this joint."""

    load_kind = "torque"
    kind = "revolute"

    def needs(self, where: str) -> str:
        return f"masses in the rig file or the column {where}_Nm"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        return np.isfinite(context.torque(where))
