"""What the load on a joint may be beside what a rig file's masses make it: nobody has weighed a boom part by part.

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
from typing import ClassVar, Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Family, FittedCoefficient, JointFamily, Settings, Situation
from calibration.errors import ModelError
from calibration.kinematics import Chain
from calibration.observations import Floats
from calibration.torques import MASS_SIGMA

UNIT = "rad/(N m)"
_LOAD_SIGMA, _ABOUT, _PARTS = "load_sigma", "about_rad_per_Nm", "parts"
_LEAST_SHAPE = 1e-3  # of the load; less than this of a deflection is invisible
_MOST_PARTS = 100
_MOST_SIGMAS = 3.0  # of a shape, a mixture of weights and centres that are within +-15 %
_CHANCE = 2.0  # standard errors


@dataclass(frozen=True)
class LoadShapes:
    """What uncertain weights do to a load.

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
        """(n, r) change of the load, N m per sigma of each shape; none where there are no parts, as of a measured load.

        Args:
            load: (n,) N m.
            parts: (n, parts) change of it per sigma of each part.
        """
        known = parts.any(axis=1)
        left = parts - np.where(known, load, 0.0)[:, None] * self.share
        shapes: Floats = left @ self.mixing
        return shapes


def load_shapes(load: Floats, parts: Floats, *, constant: bool = False) -> LoadShapes:
    """The shapes of a load (n,) with parts (n, k) over a work volume of n poses, the largest first.

    Args:
        load, parts: N m, and its change per sigma of each part.
        constant: whether what is constant over the poses counts as well, as it does where a load changes its sign. It
            goes with the load itself otherwise: an encoder's zero takes it up.
    """
    level = np.column_stack([np.zeros(len(load)) if constant else np.ones(len(load)), load])
    share = np.linalg.lstsq(level, parts)[0][1]
    _, size, directions = np.linalg.svd(parts - load[:, None] * share, full_matrices=False)
    mixing = directions[size > _LEAST_SHAPE * np.linalg.norm(load)].T
    # A direction has no sign; the largest part decides.
    return LoadShapes(share, mixing * np.sign(mixing[np.abs(mixing).argmax(axis=0), np.arange(mixing.shape[1])]))


_shapes: WeakKeyDictionary[Chain, dict[str, LoadShapes]] = WeakKeyDictionary()


def shapes_by_design(
    situation: Situation,
    load: str,
    volume: Callable[[Situation], tuple[Floats, Floats]],
    *,
    constant: bool = False,
) -> LoadShapes:
    """The shapes of a load on the machine as designed, from its work volume; worked out once a chain.

    Args:
        situation: whose chain it is.
        load: which, a name to remember it by.
        volume: the load (n,) and its parts (n, k) in a work volume.
        constant: as for `load_shapes`.
    """
    if not situation.rig.masses:
        return LoadShapes(np.zeros(0), np.zeros((0, 0)))
    known = _shapes.setdefault(situation.chain, {})
    if load not in known:
        known[load] = load_shapes(*volume(situation.as_designed.work_volume), constant=constant)
    return known[load]


def gravity_shapes(situation: Situation, where: str, *, constant: bool = False) -> LoadShapes:
    """The shapes of what gravity makes a joint carry; `constant` as for `load_shapes`."""
    return shapes_by_design(
        situation,
        f"{where} with its constant part" if constant else where,
        lambda volume: (volume.torque(where), volume.torque_parts(where)),
        constant=constant,
    )


def shape_columns(shapes: LoadShapes, load: Floats, parts: Floats, settings: Settings) -> Floats:
    """(n, r) change of a load for the variant's coefficients that shape it, N m; `load` and `parts` as for the shapes.

    Raises:
        ModelError: the variant is of other shapes, made by another version of this program.
    """
    names = part_names(settings)
    if not names:
        return np.empty((len(load), 0))
    if len(names) != len(shapes):
        raise ModelError(f"the model has {len(names)} shapes of a load that has {len(shapes)}; calibrate again")
    return shapes(np.nan_to_num(load), parts)


def load_variants(shapes: LoadShapes, plausible: float) -> tuple[Settings, ...]:
    """The variants of an effect in proportion to a load: with the nominal shape, and with what may be beside it.

    Args:
        shapes: of its load; none where the load is measured.
        plausible: size of the effect's own coefficient, rad per N m.
    """
    if shapes.load_sigma == 0.0:
        return ({},)
    plain = {_LOAD_SIGMA: shapes.load_sigma}
    return (plain, {**plain, _ABOUT: plausible, _PARTS: float(len(shapes))}) if len(shapes) else (plain,)


def part_names(settings: Settings) -> tuple[str, ...]:
    """Names of the coefficients that shape the load; ValueError for settings that `load_variants` does not make."""
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
    """The coefficients that shape the load, within +-`bound`, rad per N m."""
    return tuple(Coefficient(name, UNIT, settings[_ABOUT], -bound, bound) for name in part_names(settings))


class OfUncertainLoad(Family):
    """An effect in proportion to a load: its own coefficient, and after it those of what is uncertain of the load."""

    limit_sigma: ClassVar[float] = MASS_SIGMA  # limits are what it may do at the largest load

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """The effect's own coefficient alone, the uncertainty of the whole load in its standard error."""
        own = coefficients[0]
        error = math.hypot(own.standard_error, settings.get(_LOAD_SIGMA, 0.0) * own.value)
        return (replace(own, standard_error=error),)

    def strained(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        """Whether the shapes ask for weights that no machine has; a fit that needs them follows another effect."""
        del settings
        most = _MOST_SIGMAS * (abs(values[0]) + _CHANCE * standard_errors[0])
        return bool((np.abs(values[1:]) > most + _CHANCE * standard_errors[1:]).any())


class TorqueFamily(JointFamily):
    """An effect at a revolute joint in whose load it lies alone."""

    goes_with: ClassVar[Literal["", "torque", "weights"]] = "torque"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def needs(self, where: str) -> str:
        return f"masses in the rig file or the column {where}_Nm"

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        return np.isfinite(situation.torque(where))
