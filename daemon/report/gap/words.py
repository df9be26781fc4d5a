"""The result of the gap workflow in sentences, shared by its report, the commands and the jobs."""

from __future__ import annotations

from typing import NamedTuple

from calibration.gap.result import GapResult
from daemon.report.front import Verdict, judge
from daemon.report.words import number, place_name, spoken


def gap_headline(gap: GapResult) -> str:
    """Return the verdict in one sentence; a second sentence warns if held-out rows contradict it."""
    if gap.raises_held_out and gap.held_out is not None:
        before, after = gap.held_out
        against = f"held-out rows fit worse with it, {number(after)} mm instead of {number(before)} mm"
        return f"{_verdict(gap)} But {against}: do not use this model there."
    return _verdict(gap)


def _verdict(gap: GapResult) -> str:
    if gap.verdict == "named":
        return f"The simulation lacked {spoken([(e.family, e.where) for e in gap.effects])}."
    if gap.verdict == "none":
        but = f", except for {_outliers(gap)}: check these first" if gap.model.outliers else ""
        return f"Simulation and measurement agree within the noise{but}."
    if gap.verdict == "indistinguishable":
        one_of = " or ".join(place_name(c.family, c.where) for c in gap.indistinguishable)
        return f"The simulation lacks {one_of}: these data cannot show which."
    return "The simulation lacks something that no effect of the library explains."


class ShownError(NamedTuple):
    """The error of the simulation that reports show.

    Attributes:
        before_mm: root mean square without the effects.
        after_mm: root mean square with the effects.
        rows: words for the fixes, e.g. `on the held-out fixes`.
        can_pass: True if nothing was fitted to these fixes and none of them was left out.
    """

    before_mm: float
    after_mm: float
    rows: str
    can_pass: bool


def before_and_after(gap: GapResult) -> ShownError:
    """Return the error without and with the effects: on held-out rows if there are any."""
    if gap.held_out is not None:
        shared = f", {gap.shared} rows of which were fitted" if gap.shared else ""
        return ShownError(*gap.held_out, f"on the held-out fixes{shared}", can_pass=not gap.shared)
    if gap.rounds and not gap.rounds[-1].adopted:
        left_out = f", {_outliers(gap)} left out" if gap.model.outliers else ""
        rows = f"on poses held out in turn{left_out}"
        before_mm, after_mm = gap.rounds[0].held_out_mm, gap.rounds[-1].held_out_mm
        return ShownError(before_mm, after_mm, rows, can_pass=not gap.model.outliers)
    return ShownError(gap.before_mm, gap.after_mm, "on the fixes themselves", can_pass=False)


def tolerance_verdict(gap: GapResult, tolerance_mm: float | None) -> Verdict | None:
    """Compare the error with the effects to a tolerance; it can pass only on complete rows that nothing was fitted to.

    Args:
        gap: result of the workflow.
        tolerance_mm: permitted root mean square error; None if none is stated.
    """
    error = before_and_after(gap)
    return judge(tolerance_mm, error.after_mm, is_held_out=error.can_pass, rows=error.rows)


def _outliers(gap: GapResult) -> str:
    """Return the number of outliers and the largest deviation, in words."""
    worst = max(outlier.sigma for outlier in gap.model.outliers)
    some = f"{len(gap.model.outliers)} of {len(gap.observations)} fixes"
    return f"{some} that are up to {worst:,.0f} sigma off"


def closed_share(before_mm: float, after_mm: float, noise_mm: float) -> float | None:
    """Return the share of the gap above the noise floor that is closed, 0 to 1; None if there was no gap."""
    gap_mm2 = before_mm**2 - noise_mm**2
    return min(max((before_mm**2 - after_mm**2) / gap_mm2, 0.0), 1.0) if gap_mm2 > 0.0 else None


def dependence(gap: GapResult) -> str:
    """Return a clause on what the structure that no effect of the library explains depends on."""
    subject = "The remaining error" if gap.effects else "It"
    return f"{subject} depends on this: {gap.description}"


def remaining(gap: GapResult) -> str:
    """Return a clause stating that structure is left, without its size if the noise of all rows together hides it."""
    return f"Structure of {number(gap.remaining_mm)} mm is left" if gap.remaining_mm > 0.0 else "Structure is left"
