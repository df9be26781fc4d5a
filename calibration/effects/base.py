"""Effects: known physical causes of errors, each with a few coefficients to fit.

To add one:

1. Write one file in `calibration/effects/families`, named as the effect, that binds an instance of a subclass to
   `FAMILY`. Nothing else needs an edit: `calibration.effects.library` finds every file of that folder.
2. Subclass `JointFamily` for an effect that makes a joint's true value differ from its reading, and implement
   `columns`. Subclass `PrismFamily` for an effect that moves the prism or its fix, and implement `shift_mm`. Both
   return the change per unit of each coefficient: effects are linear in their coefficients.
3. Set the class attributes (`name`, `equation`, `source`, ...) and the coefficients with their plausible sizes and hard
   limits in `fixed`. Override `coefficients` and `names` where these depend on the machine or on the variant.
4. Override `needs` and `known` if the effect needs more than one optional column, and `variants` if its form depends on
   numbers other than coefficients (`Settings`): an instant, a number of knots, the mean temperature of the training
   data.

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
"""Fixed numbers of a variant, by name. They are set in training and used in prediction; fits do not change them."""


@dataclass(frozen=True)
class Coefficient:
    """A coefficient to fit.

    Attributes:
        name: name in all outputs; it ends in the unit where there is one.
        unit: unit of the value; `1` for a plain ratio.
        sigma: plausible size, 1 sigma: the standard deviation of the normal prior with mean 0.
        lower: hard lower limit; a fit below it does not count as evidence for the effect.
        upper: hard upper limit, likewise.
    """

    name: str
    unit: str
    sigma: float
    lower: float
    upper: float


@dataclass(frozen=True)
class FittedCoefficient:
    """A fitted coefficient.

    Attributes:
        name: as the family's `Coefficient`.
        unit: as the family's `Coefficient`.
        value: posterior mean.
        standard_error: posterior standard deviation.
        prior_sigma: plausible size, as the family's `Coefficient`; the fit may have used a multiple (`Choice.scale`).
    """

    name: str
    unit: str
    value: float
    standard_error: float
    prior_sigma: float


class Family(ABC):
    """Base class of all effects; subclass `JointFamily` or `PrismFamily` instead.

    In all methods, `context` is the context of n observations, `where` one of `places`, and `settings` a variant.

    Attributes:
        name: name in all outputs.
        equation: formula of the change that the effect causes.
        source: publication, standard or derivation of the equation.
        confused_with: families that look similar in most data.
        revealed_by: phrase naming the motion or experiment that distinguishes the effect from `confused_with`.
        fixed: the coefficients, where they are the same on every machine and for every variant.
        load_kind: the load on which the effect depends: `torque` of its own joint, measured or computed; `weights`,
            which are always computed; or empty.
        column: the optional column that the effect needs, with `{where}` for its place; empty for none.
        least_known: smallest share of training rows in which the inputs must be known.
        limit_sigma: relative uncertainty of the hard limits, where they are derived from a load.
        shape_sigma: share of the change by which a real machine may deviate from the equation. It limits how much
            evidence for the effect is trusted in the presence of unexplained structure.
        depends_on_readings_only: True if the columns depend only on the readings, not on the kinematics.
        depends_on_travel: True if the effect grows with the path that its joint travels.
        secondary_to: families with the same load as cause that are usually larger. In the presence of unexplained
            structure, this effect is searched for only after all of these that the data support.
        moves_machine: True if the effect moves prisms in the base frame; False where only the fixes are wrong, or where
            the base moves with the whole machine.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]]
    revealed_by: ClassVar[str]
    fixed: ClassVar[tuple[Coefficient, ...]] = ()
    load_kind: ClassVar[Literal["", "torque", "weights"]] = ""
    column: ClassVar[str] = ""
    least_known: ClassVar[float] = 0.5
    limit_sigma: ClassVar[float] = 0.0
    shape_sigma: ClassVar[float] = 0.14
    depends_on_readings_only: ClassVar[bool] = False
    depends_on_travel: ClassVar[bool] = False
    secondary_to: ClassVar[tuple[str, ...]] = ()
    moves_machine: ClassVar[bool] = True

    # -- places and required data --------------------------------------------------------------------------------------

    @abstractmethod
    def places(self, rig: Rig) -> tuple[str, ...]:
        """Return the possible places of the effect in a rig: names of joints, or words such as `base`."""

    def needs(self, where: str) -> str:
        """Return a noun phrase for the inputs needed in addition to the joint readings; empty for none."""
        return f"the column {self.column.format(where=where)}" if self.column else ""

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows in which all inputs of the effect are known."""
        if not self.column:
            return np.ones(len(context), dtype=bool)
        return np.isfinite(context.extra(self.column.format(where=where)))

    # -- variants ------------------------------------------------------------------------------------------------------

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        """Return the possible variants, of which the data select one; empty if the effect cannot occur here."""
        del context, where
        return ({},)

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        """Return finer variants around a chosen one, including it; empty if `variants` is already complete."""
        del context, where, settings
        return ()

    def posterior_settings(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the settings for the model, given the posterior of the `refined` variants.

        Args:
            forms: m variants.
            probability: (m,) their posterior probabilities.
        """
        return forms[int(np.argmax(probability))]

    def at_new_setups(self, context: EffectContext, where: str, settings: Settings) -> Settings:
        """Return the settings for new set-ups, whose bases are fitted to the observations of a context."""
        del context, where
        return settings

    def check_settings(self, settings: Settings) -> None:
        """Raise ValueError for invalid settings, such as those of a damaged model file."""
        if settings:
            raise ValueError(f"unknown settings: {', '.join(settings)}")

    def odds(self, settings: Settings) -> float:
        """Return the prior odds of a variant relative to the others; together they share the odds of the effect."""
        del settings
        return 1.0

    def form(self, settings: Settings) -> str:
        """Return a phrase that describes a variant; empty for the plain one."""
        del settings
        return ""

    def depends_on_order(self, settings: Settings) -> bool:
        """Return True if the change in a row depends on the preceding rows, so that all must be passed together."""
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
        """Return the coefficients of a variant, in the order of `names`."""
        del context, where, settings
        return self.fixed

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the numbers to report: fitted coefficients and informative settings."""
        del settings
        return coefficients

    def reported_limits(self) -> Mapping[str, tuple[float, float]]:
        """Return the hard limits, by name, of numbers that `reported` returns instead of coefficients."""
        return {}

    def has_implausible_shape(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        """Return True if coefficients that only shape the effect are implausibly and significantly large.

        Such a fit is not evidence for this variant; simpler variants of the same effect may be right.

        Args:
            settings: the variant.
            values: (k,) coefficients.
            standard_errors: (k,) standard errors of the coefficients.
        """
        del settings, values, standard_errors
        return False

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean squared effect in rows that lack its inputs.

        Args:
            values: (k,) coefficients.
            plausible: (k,) plausible sizes of the coefficients in the model, 1 sigma.
            settings: the variant.

        Returns:
            Variance of the joint's value, deg^2 or mm^2; for a prism family variance of each coordinate, mm^2.
        """
        del values, plausible, settings
        return 0.0


class JointFamily(Family):
    """An effect at a single joint: the true value differs from the reading.

    Attributes:
        kind: kind of the joints at which the effect may occur.
    """

    kind: ClassVar[Literal["revolute", "prismatic"]]

    def places(self, rig: Rig) -> tuple[str, ...]:
        return tuple(j.name for j in rig.joints if j.kind == self.kind)

    @abstractmethod
    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        """Return (n, k): true value minus reading, deg or mm, per unit of each coefficient.

        Zero in rows that lack inputs of the effect.
        """


class PrismFamily(Family):
    """An effect that moves the prism or its fix without a joint error: of a beam, the base, the station or a clock.

    Attributes:
        place: the only place of the effect, on every rig; override `places` if a rig may have none or several.
    """

    place: ClassVar[str]

    def places(self, rig: Rig) -> tuple[str, ...]:
        del rig
        return (self.place,)

    @abstractmethod
    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        """Return (n, 3, k) displacements of the prism in the station's frame, mm per unit of each coefficient.

        Zero in rows that lack inputs of the effect.
        """


class SizedFamily(PrismFamily):
    """A prism family whose settings hold the RMS size of its columns in the training rows (`sizes`).

    In rows that lack inputs of the effect, its RMS is assumed to be as in training.
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
    """Return the names of the settings that `sizes` returns."""
    return tuple(f"size{number}_mm" for number in range(1, coefficients + 1))


def check_sizes(settings: Settings, others: Sequence[str], coefficients: int) -> None:
    """Raise ValueError unless the settings are valid.

    Args:
        settings: the settings to check.
        others: names of all settings except the sizes.
        coefficients: number of coefficients, each with a size.
    """
    expected = {*others, *size_names(coefficients)}
    if set(settings) != expected:
        raise ValueError(f"the settings are {', '.join(sorted(expected))}")
    negative = [name for name in size_names(coefficients) if settings[name] < 0.0]
    if negative:
        raise ValueError(f"the setting {negative[0]} is negative")
