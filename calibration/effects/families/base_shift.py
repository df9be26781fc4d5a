"""A carrier that moved suddenly over the ground: it slid, was pushed, or was set down at a slightly different place."""

from __future__ import annotations

from calibration.effects.base import Coefficient, FittedCoefficient, Settings, check_sizes
from calibration.effects.context import EffectContext
from calibration.effects.timing import STEP_SETTINGS, SizedStepFamily, check_step, refined_steps, step_grid
from calibration.observations import Floats

_ON_THE_SPOT = "on_the_spot"
_ON_THE_SPOT_ODDS = 0.25
_HEADING = Coefficient("heading_rad", "rad", 1e-3, -10e-3, 10e-3)


class BaseShift(SizedStepFamily):
    """The base has a different position on the ground and a different heading in all rows after one instant.

    Tilts and rise belong to `base_step`; a carrier that slips off a jack shows both effects. A pedestal that turns in
    its foot turns about the upright axis through the base's origin: a variant with the heading alone.
    """

    name = "base_shift"
    equation = "shifts along the base's level x and y axes and turn about its upright axis, for t > time_s"
    source = "rigid motion of the set-up over the ground at one instant: a carrier that slides or is moved"
    confused_with = ("base_step", "zero_step", "prism_seat_step")
    revealed_by = "a prism on the carrier, and control points on the ground, before and after"
    fixed = (Coefficient("x_mm", "mm", 5.0, -50.0, 50.0), Coefficient("y_mm", "mm", 5.0, -50.0, 50.0), _HEADING)
    place = "base"
    moves_machine = False

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        steps = step_grid(context.extra("time_s"))
        turns = tuple({**step, _ON_THE_SPOT: 1.0} for step in steps)
        return self.sized(context, where, (*steps, *turns))

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        form = {_ON_THE_SPOT: 1.0} if _ON_THE_SPOT in settings else {}
        finer = refined_steps(context.extra("time_s"), settings)
        return self.sized(context, where, [{**step, **form} for step in finer])

    def odds(self, settings: Settings) -> float:
        return super().odds(settings) * (_ON_THE_SPOT_ODDS if _ON_THE_SPOT in settings else 1.0)

    def form(self, settings: Settings) -> str:
        return "turned on the spot" if _ON_THE_SPOT in settings else ""

    def check_settings(self, settings: Settings) -> None:
        form = (_ON_THE_SPOT,) if _ON_THE_SPOT in settings else ()
        check_sizes(settings, (*STEP_SETTINGS, *form), 1 if form else len(self.fixed))
        check_step(settings)

    def names(self, settings: Settings) -> tuple[str, ...]:
        self.check_settings(settings)
        return tuple(c.name for c in _coefficients(settings))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del context, where
        return _coefficients(settings)

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return shifts, heading and instant; the shifts of a carrier that turned on the spot are zero."""
        listed = super().reported(settings, coefficients)
        if _ON_THE_SPOT in settings:
            listed = (*(FittedCoefficient(c.name, c.unit, 0.0, 0.0, c.sigma) for c in self.fixed[:2]), *listed)
        return listed

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        moved = context.base_shift_mm(self.after(context, where, settings))
        return moved[:, :, 2:] if _ON_THE_SPOT in settings else moved


def _coefficients(settings: Settings) -> tuple[Coefficient, ...]:
    return (_HEADING,) if _ON_THE_SPOT in settings else BaseShift.fixed


FAMILY = BaseShift()
