"""Effects: known physical causes of errors, each with a few coefficients that a fit finds.

To add one:

1. Write one file in `calibration/effects/families`, named as the effect, that binds an instance of a subclass to
   `FAMILY`. Nothing else needs an edit: `calibration.effects.library` finds every file of that folder.
2. Subclass `JointFamily` for an effect that changes what a joint's reading means, and write `columns`; subclass
   `PrismFamily` for one that moves the prism or its fix, and write `shift_mm`. Both return the change per unit of each
   coefficient: effects are linear in their coefficients.
3. State the class attributes (`name`, `equation`, `source`, ...) and the coefficients with their plausible sizes and
   hard limits in `fixed`. Override `coefficients` and `names` where these depend on the machine or on the variant.
4. Override `needs` and `known` if the effect needs more than one optional column, and `variants` if its form depends on
   numbers other than coefficients (`Settings`): an instant, a number of knots, the mean temperature of the training.

`calibration/effects/families/angle_scale.py` is the shortest example, `leak_down.py` one with variants.
`tests/calibration/effects/test_effects_library.py` checks every family it finds: units, derivatives, missing columns.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.effects.context import EffectContext
from calibration.observations import Floats
from calibration.rig.description import Rig

Settings = Mapping[str, float]
"""The numbers of a variant, which hold from training to prediction; fits do not change them."""


@dataclass(frozen=True)
class Coefficient:
    """One number that a fit finds.

    Attributes:
        name: as in every output; it ends in its unit where it has one.
        unit: of its value; `1` for a plain ratio.
        sigma: plausible size, 1 sigma: the standard deviation of its normal prior about 0.
        lower: hard limit; a fit below it is no evidence for this effect.
        upper: hard limit, likewise.
    """

    name: str
    unit: str
    sigma: float
    lower: float
    upper: float


@dataclass(frozen=True)
class FittedCoefficient:
    """One number that a fit found.

    Attributes:
        name: as the family's `Coefficient`.
        unit: as the family's `Coefficient`.
        value: posterior mean.
        standard_error: posterior standard deviation.
        prior_sigma: plausible size, as the family's `Coefficient`; a fit may have used a multiple (`Choice.scale`).
    """

    name: str
    unit: str
    value: float
    standard_error: float
    prior_sigma: float


class Family(ABC):
    """A kind of effect; `JointFamily` and `PrismFamily` are the two kinds there are.

    Attributes:
        name: as in every output.
        equation: the change that it makes, as a formula.
        source: publication, standard or derivation of the equation.
        confused_with: families that look alike in most data.
        revealed_by: the motion or experiment that tells it from those, a phrase.
        fixed: its coefficients, where they are the same on every machine and for every variant.
        goes_with: the load that it depends on: `torque` of its own joint, measured or computed; `weights`, which are
            always computed; or nothing.
        column: the optional column that it needs, `{where}` in it for its place; empty for none.
        limit_sigma: relative uncertainty of the hard limits, where they follow from a load.
        shape_sigma: share of the change that a machine may make in another way than the equation says; it decides how
            far evidence of any size can be trusted beside structure that has no name.
        goes_by_readings: True if its columns depend on the readings alone, whatever the kinematics are.
        goes_by_travel: True if it grows with the path that its joint travels.
        comes_after: families that the same load causes and that are the larger ones as a rule: beside structure without
            a name it is looked for only when all of them that the data ask for are there.
        moves_machine: True if it moves prisms in the base frame; False where only fixes err, or where the base moves
            and all the machine with it.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]]
    revealed_by: ClassVar[str]
    fixed: ClassVar[tuple[Coefficient, ...]] = ()
    goes_with: ClassVar[Literal["", "torque", "weights"]] = ""
    column: ClassVar[str] = ""
    limit_sigma: ClassVar[float] = 0.0
    shape_sigma: ClassVar[float] = 0.14
    goes_by_readings: ClassVar[bool] = False
    goes_by_travel: ClassVar[bool] = False
    comes_after: ClassVar[tuple[str, ...]] = ()
    moves_machine: ClassVar[bool] = True

    # -- where it may be, and from which data it is known --------------------------------------------------------------

    @abstractmethod
    def places(self, rig: Rig) -> tuple[str, ...]:
        """Return the places in a rig where it may be: names of joints, or words such as `base`."""

    def needs(self, where: str) -> str:
        """Return what it needs beside the readings of the joints, as a noun phrase; empty for nothing."""
        return f"the column {self.column.format(where=where)}" if self.column else ""

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows that have what it needs."""
        if not self.column:
            return np.ones(len(context), dtype=bool)
        return np.isfinite(context.extra(self.column.format(where=where)))

    # -- variants ------------------------------------------------------------------------------------------------------

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        """Return the forms it may take, of which the data choose one; none where it cannot be at this place."""
        del context, where
        return ({},)

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        """Return finer forms about a chosen one, including that; none where `variants` has all there are."""
        del context, where, settings
        return ()

    def settled(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the form that a model keeps, given the posterior probabilities (m,) of the `refined` forms."""
        return forms[int(np.argmax(probability))]

    def elsewhere(self, context: EffectContext, where: str, settings: Settings) -> Settings:
        """Return the settings at set-ups whose bases are fitted anew on the observations of a context."""
        del context, where
        return settings

    def check_settings(self, settings: Settings) -> None:
        """Raise ValueError for settings that are none of this family's, as a damaged model file may have them."""
        if settings:
            raise ValueError(f"there are no settings {', '.join(settings)}")

    def odds(self, settings: Settings) -> float:
        """Return the prior odds of a variant beside the others; all of them share the odds of the effect."""
        del settings
        return 1.0

    def form(self, settings: Settings) -> str:
        """Return a phrase that names the form of a variant; empty where there is nothing to tell."""
        del settings
        return ""

    def goes_by_order(self, settings: Settings) -> bool:
        """Return True if the change in a row depends on the rows before it, so that they must be given together."""
        del settings
        return False

    # -- coefficients --------------------------------------------------------------------------------------------------

    def names(self, settings: Settings) -> tuple[str, ...]:
        """Return the names of a variant's coefficients.

        Raises:
            ValueError: as `check_settings`.
        """
        self.check_settings(settings)
        return tuple(c.name for c in self.fixed)

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        """Return the coefficients of one of the variants, as many and in the same order as `names`."""
        del context, where, settings
        return self.fixed

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the numbers that outputs list: fitted coefficients and settings that are worth reading."""
        del settings
        return coefficients

    def reported_limits(self) -> Mapping[str, tuple[float, float]]:
        """Return hard limits, by name, of numbers that `reported` lists in place of coefficients."""
        return {}

    def strained(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        """Return True if coefficients that only shape the effect are implausibly large, beyond chance.

        Such a fit is no evidence for this form; simpler forms of the same effect may be right.

        Args:
            settings: the variant.
            values: (k,) its coefficients.
            standard_errors: (k,) of these.
        """
        del settings, values, standard_errors
        return False

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean squared effect in rows that lack its inputs.

        Args:
            values: (k,) its coefficients.
            plausible: (k,) their plausible sizes in the model, 1 sigma.
            settings: the variant.

        Returns:
            deg^2 or mm^2 of the joint's value; mm^2 of each coordinate for a prism family.
        """
        del values, plausible, settings
        return 0.0


class JointFamily(Family):
    """An effect at a single joint: the true value differs from the reading.

    Attributes:
        kind: of the joints it may be at.
    """

    kind: ClassVar[Literal["revolute", "prismatic"]]

    def places(self, rig: Rig) -> tuple[str, ...]:
        return tuple(j.name for j in rig.joints if j.kind == self.kind)

    @abstractmethod
    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        """Return (n, k): true value minus reading, deg or mm, per unit of each coefficient.

        Zero in rows that lack what the effect needs.
        """


class PrismFamily(Family):
    """An effect that moves the prism, or its fix, where no joint errs: a beam, the base, the station, a clock.

    Attributes:
        place: the one place where it is, on every rig; override `places` if a rig may have none or several.
    """

    place: ClassVar[str]

    def places(self, rig: Rig) -> tuple[str, ...]:
        del rig
        return (self.place,)

    @abstractmethod
    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        """Return (n, 3, k) displacements of the prism in the station's frame, mm per unit of each coefficient.

        Zero in rows that lack what the effect needs.
        """


class SizedFamily(PrismFamily):
    """A prism family whose settings hold the RMS size of its columns in the training rows (`sizes`).

    In rows that lack what the effect needs, it is taken to be as large as it was in training.
    """

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return sum((float(v) * settings[name]) ** 2 for v, name in zip(values, size_names(len(values)), strict=True))


def sizes(shift_mm: Floats) -> dict[str, float]:
    """Return the settings `size1_mm` ...: RMS of each coordinate per unit of each coefficient.

    Args:
        shift_mm: (n, 3, k) columns in the training rows.
    """
    rms = np.sqrt((shift_mm**2).mean(axis=(0, 1))) if len(shift_mm) else np.zeros(shift_mm.shape[2])
    return {name: float(value) for name, value in zip(size_names(len(rms)), rms, strict=True)}


def size_names(coefficients: int) -> tuple[str, ...]:
    """Return the names of the settings that `sizes` makes."""
    return tuple(f"size{number}_mm" for number in range(1, coefficients + 1))


def check_sizes(settings: Settings, others: Sequence[str], coefficients: int) -> None:
    """Raise ValueError unless the settings are `others` and the sizes of so many coefficients."""
    expected = {*others, *size_names(coefficients)}
    if set(settings) != expected:
        raise ValueError(f"the settings are {', '.join(sorted(expected))}")
    negative = [name for name in size_names(coefficients) if settings[name] < 0.0]
    if negative:
        raise ValueError(f"the setting {negative[0]} is negative")
