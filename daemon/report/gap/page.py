"""The gap report: one HTML page on the effects that the simulation lacks, and the evidence for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np

from calibration.effects.base import FittedCoefficient
from calibration.effects.context import EffectContext
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.gap.result import Candidate, Forecast, GapResult
from daemon.report import drawing, markup
from daemon.report.calibration.from_model import facts_of
from daemon.report.front import Accuracy, Facts, front, signatures
from daemon.report.gap import figures
from daemon.report.gap.figures import Bar, Interval
from daemon.report.gap.words import (
    before_and_after,
    closed_share,
    dependence,
    gap_headline,
    remaining,
    tolerance_verdict,
)
from daemon.report.plain_names import coefficient_words, in_words, unit_words
from daemon.report.words import (
    DASH,
    INTERVAL_SIGMAS,
    PLUS_MINUS,
    chance,
    listed,
    number,
    odds,
    place_name,
    probability,
    readable_unit,
    spoken,
)

_Key = TypeVar("_Key", bound=Hashable)
_CANDIDATES_SHOWN = 6
_POSES_SHOWN = 12
_LEAST_SEPARATION = 0.1
_COLUMNS = {
    "time_s": ("Time", "time since the first fix, hours", 3600.0),
    "temperature_degC": ("Temperature", "degrees Celsius", 1.0),
}


def gap_report(gap: GapResult, sources: Mapping[str, str], facts: Facts | None = None) -> str:
    """Return one self-contained HTML document; the same input gives the same bytes.

    Args:
        gap: result of the workflow.
        sources: label -> origin of the data.
        facts: the first lines of the report; derived from rows and model by default.
    """
    with drawing.styled():
        parts = [
            _head(gap, facts or facts_of(gap.observations, gap.model)),
            _steps(gap),
            _found(gap),
            _where(gap),
            _candidates(gap),
            _not_shown(gap),
            _next(gap),
            markup.sources_section(sources),
            signatures(),
        ]
    return markup.page(f"Gap between simulation and {gap.model.rig.name}", "".join(parts))


def intervals(gap: GapResult) -> list[Interval]:
    """Return every adopted coefficient that has bounds, in readable units."""
    found = []
    for effect in gap.effects:
        bounds = coefficient_bounds(gap, effect)
        for coefficient in effect.reported:
            if coefficient.name not in bounds:
                continue
            lower, upper = bounds[coefficient.name]
            scale, unit = readable_unit(coefficient.unit, _size(coefficient))
            found.append(
                Interval(
                    f"{place_name(effect.family, effect.where)}, {coefficient_words(coefficient.name)}",
                    coefficient.value * scale,
                    coefficient.standard_error * scale,
                    coefficient.prior_sigma * scale,
                    lower * scale,
                    upper * scale,
                    unit_words(unit),
                )
            )
    return found


def _size(coefficient: FittedCoefficient) -> float:
    """Return the larger of value and interval half-width; these determine the unit, the bounds do not."""
    return max(abs(coefficient.value), INTERVAL_SIGMAS * coefficient.standard_error)


def coefficient_bounds(gap: GapResult, effect: FittedEffect) -> dict[str, tuple[float, float]]:
    """Return coefficient -> its finite hard limits: those of the comparison, else those of the library."""
    context = EffectContext(gap.model.chain, gap.model.values, gap.observations)
    family = library()[effect.family]
    limits = {c.name: (c.lower, c.upper) for c in family.coefficients(context, effect.where, effect.settings)}
    limits |= family.reported_limits()
    for candidate in (c for round_ in gap.rounds for c in round_.candidates):
        if (candidate.family, candidate.where) == (effect.family, effect.where):
            limits |= candidate.bounds
    return {name: ends for name, ends in limits.items() if all(map(math.isfinite, ends)) and ends[1] > ends[0]}


# ---- sections --------------------------------------------------------------------------------------------------------


def _head(gap: GapResult, facts: Facts) -> str:
    before, after, rows, _ = before_and_after(gap)
    verdict = tolerance_verdict(gap, facts.tolerance_mm)
    accuracy = Accuracy(
        f"Accuracy: {number(after)} mm root mean square {rows}; the noise is {number(gap.noise_mm)} mm."
    )
    tiles = [markup.Tile(f"error of the simulation, {rows}", number(before))]
    if gap.effects:
        share = closed_share(before, after, gap.noise_mm)
        closed = DASH if share is None else f"{100 * share:.0f}"
        tiles += [
            markup.Tile("error with the effects found", number(after), kind="after"),
            markup.Tile("of the gap above the noise closed", closed, "%", "after"),
        ]
    tiles.append(markup.Tile(f"noise floor, {gap.noise_source}", number(gap.noise_mm)))
    title, first = f"Gap report: {gap.model.rig.name}", front(facts, verdict, accuracy)
    notes = [in_words(text) for text in gap.warnings]
    return markup.header(title, first, gap_headline(gap), _meaning(gap), tiles) + markup.notice(notes)


def _meaning(gap: GapResult) -> str:
    sentences = []
    if gap.verdict == "named":
        sentences.append("The model now includes what was missing, fitted together with the lengths and angles.")
    if gap.verdict == "indistinguishable":
        sentences.append("None of them was added to the model. The measurements proposed below distinguish them.")
        if gap.effects:
            named = spoken([(e.family, e.where) for e in gap.effects])
            sentences.append(f"Already certain, and part of the model: {named}.")
    if gap.description:
        sentences.append(f"{in_words(dependence(gap))}.")
    if gap.remaining_significant:
        sentences.append(f"{remaining(gap)} that was not named; a learned residual may absorb it.")
    elif gap.verdict in ("named", "none"):
        sentences.append("The noise explains the remaining error.")
    return " ".join(sentences)


def _steps(gap: GapResult) -> str:
    if not gap.rounds:
        return ""
    return markup.section(
        "From the simulation down to the noise",
        markup.paragraph(
            "Error of the simulation in poses that it was not fitted to, after each effect that was added. Where the "
            "bars reach the dashed line, nothing is left to find."
        ),
        drawing.picture(
            figures.steps(list(bars(gap)), gap.noise_mm),
            "Held-out error round by round, and the noise floor",
            f"Root mean square error {before_and_after(gap).rows}. The noise floor is {gap.noise_source}.",
        ),
    )


def bars(gap: GapResult) -> Iterator[Bar]:
    """Yield a bar for each round; a round's error is the one before its own effects were adopted."""
    label = "calibrated kinematics"
    for number_, round_ in enumerate(gap.rounds):
        if number_ == 0 or gap.rounds[number_ - 1].adopted:
            yield Bar(label, round_.held_out_mm)
        label = "+ " + spoken([(family, where) for family, _, where in (a.partition("@") for a in round_.adopted)])


def _found(gap: GapResult) -> str:
    if not gap.effects:
        return ""
    rows = []
    for effect in gap.effects:
        posterior = probability(gap.posterior[str(effect)])
        name = effect.family.replace("_", " ")
        head = [f"{name} ({effect.form})" if effect.form else name, effect.where]
        bounds = coefficient_bounds(gap, effect)
        for c in effect.reported:
            ends = bounds.get(c.name)
            scale, unit = readable_unit(c.unit, _size(c))
            limits = f"{number(ends[0] * scale)} .. {number(ends[1] * scale)}" if ends else ""
            interval = f"{PLUS_MINUS} {number(INTERVAL_SIGMAS * c.standard_error * scale, 2)}"
            words = coefficient_words(c.name)
            rows.append([*head, words, number(c.value * scale), interval, unit_words(unit), limits, posterior])
            head, posterior = ["", ""], ""
    columns = [
        "effect",
        "where",
        "coefficient",
        "value",
        "95 % interval",
        "unit",
        "hard bounds",
        "posterior probability",
    ]
    lines = intervals(gap)
    drawn = lines and drawing.picture(
        figures.coefficients(lines),
        "Coefficients with their intervals between their hard bounds",
        "Each bar spans the hard bounds (black); light blue is the range that is plausible beforehand (1 sigma). The "
        "dot is the fitted value, the line its 95 % interval.",
    )
    names = dict.fromkeys(effect.family for effect in gap.effects)
    return markup.section(
        "What was missing",
        "".join(
            markup.paragraph(f"{name.replace('_', ' ').capitalize()}: {library()[name].equation}.") for name in names
        ),
        markup.table(columns, rows, text_columns=(0, 1, 2, 5)),
        drawn or "",
    )


def _where(gap: GapResult) -> str:
    rows = [[d.where, d.variable, chance(d.p)] for d in gap.disagreements]
    found = (
        markup.paragraph(
            "Patterns in the residuals of the calibrated kinematics that chance does not explain, corrected for the "
            "number of patterns tested."
        )
        + markup.table(["where", "depends on", "probability by chance"], rows, text_columns=(0, 1))
        if rows
        else markup.paragraph("Chance explains every pattern in the residuals of the calibrated kinematics.")
    )
    content = [
        found,
        "<h3>Over the work volume</h3>",
        drawing.picture(
            figures.error_maps(gap),
            "Error over the work volume in plan and side view",
            "Prism positions in the rig's base frame; the cross is its origin, dark is worse.",
        ),
        "<h3>Joint by joint</h3>",
        drawing.picture(
            figures.by_joint(gap),
            "Apparent error of each joint against its reading",
            "The error each joint would have if it alone caused all errors, with running medians. A joint that causes "
            "errors shows a curve; the joints next to it show an echo.",
        ),
    ]
    direction = figures.by_direction(gap)
    if direction is not None:
        content += [
            "<h3>By direction of approach</h3>",
            drawing.picture(
                direction,
                "Mean apparent error of each joint by the direction of its last motion",
                "Mean error of each joint with its 95 % interval, after its reading fell (\N{DOWNWARDS ARROW}) and "
                "after it rose (\N{UPWARDS ARROW}). A slope is play or friction.",
            ),
        ]
    for column, (title, label, unit) in _COLUMNS.items():
        values = gap.observations.extra.get(column)
        if values is None or np.unique(values[np.isfinite(values)]).size < 2:
            continue
        shown = (values - (np.nanmin(values) if column == "time_s" else 0.0)) / unit
        content += [
            f"<h3>{title}</h3>",
            drawing.picture(
                figures.against(gap, shown, label),
                f"Components of the error against {title.lower()}",
                "Measured minus simulated, in the station's frame, with running medians.",
            ),
        ]
    content += [
        "<h3>By prism and component</h3>",
        drawing.picture(figures.by_prism(gap), "Error by prism and by component", "All fixes, including outliers."),
    ]
    return markup.section("Where simulation and measurement disagree", *content)


def _candidates(gap: GapResult) -> str:
    content = [
        markup.paragraph(
            "Every effect of the library was compared with all others and with no effect. The posterior probability is "
            "that of the family among all families. The Bayes factor compares the effect with no effect at all."
        )
    ]
    for place, round_ in enumerate(gap.rounds, start=1):
        if not round_.candidates:
            continue
        shown = round_.candidates[:_CANDIDATES_SHOWN]
        rows = [_candidate_row(c, place, gap) for c in shown]
        classes = ["best" if f"{c.family}@{c.where}" in round_.adopted else "" for c in shown]
        title = f"<h3>Round {place}</h3>" if len(gap.rounds) > 1 else ""
        columns = ["effect", "verdict", "coefficients", "posterior probability", "Bayes factor"]
        content.append(title + markup.table(columns, rows, text_columns=(0, 1, 2), classes=classes))
    if len(content) == 1:
        return ""
    return markup.section("Candidates, and why they were rejected", *content)


def _candidate_row(candidate: Candidate, place: int, gap: GapResult) -> list[str]:
    name = f"{candidate.family}@{candidate.where}"
    pending = any(name == f"{c.family}@{c.where}" for c in gap.indistinguishable)
    verdict = candidate.reason or ("cannot be distinguished" if pending else "")
    for number_, round_ in enumerate(gap.rounds, start=1):
        if number_ >= place and name in round_.adopted:
            verdict = "adopted" if number_ == place else f"adopted in round {number_}"
            break
    values = []
    for c in candidate.coefficients:
        scale, unit = readable_unit(c.unit, max(map(abs, candidate.bounds.get(c.name, (c.value,)))))
        values.append(f"{number(c.value * scale)} {unit_words(unit)}".rstrip())
    return [
        place_name(candidate.family, candidate.where),
        in_words(verdict),
        ", ".join(values),
        probability(candidate.posterior),
        odds(candidate.log_bayes_factor),
    ]


def _not_shown(gap: GapResult) -> str:
    hidden = [f for f in gap.forecasts if not math.isfinite(f.nameable)]
    alike = [
        f for f in gap.forecasts if math.isfinite(f.nameable) and f.alternative and f.separation < _LEAST_SEPARATION
    ]
    content = [
        markup.paragraph(
            "An effect that is not named may be absent, or these data could not show it. Before the comparison, it was "
            "computed how each effect would appear in exactly these poses."
        )
    ]
    if hidden:
        rows = [
            [
                family.replace("_", " "),
                listed([f.where for f in own]),
                _share_range([f.visible for f in own]),
                f"{number(max(f.visible_mm for f in own), 2)} mm",
            ]
            for family, own in _by(hidden, lambda f: f.family).items()
        ]
        columns = ["effect", "where", "share that calibration cannot absorb", "at most, at a plausible size"]
        content += [
            "<h3>Too small to be named, even at its hard bound</h3>",
            markup.table(columns, rows, text_columns=(0, 1)),
        ]
    if alike:
        rows = [
            [
                pair[0].replace("_", " "),
                listed([f.where for f in own]),
                pair[1].replace("_", " "),
                _share_range([f.separation for f in own]),
            ]
            for pair, own in _by(alike, lambda f: (f.family, f.alternative.partition("@")[0])).items()
        ]
        columns = ["effect", "where", "closest alternative", "share that the alternative cannot imitate"]
        content += [
            "<h3>Hard to distinguish from a different effect</h3>",
            markup.table(columns, rows, text_columns=(0, 1, 2)),
        ]
    if gap.disabled:
        content += [
            "<h3>Not searched for</h3>",
            markup.items(
                f"{family.replace('_', ' ')}: {in_words(reason)}" for family, reason in sorted(gap.disabled.items())
            ),
        ]
    seen = [f for f in gap.forecasts if math.isfinite(f.nameable)]
    if seen:
        content.append(markup.details(f"What these data could have shown ({len(seen)} effects)", _forecast_table(seen)))
    return markup.section("What these data could not have shown", *content)


def _by(forecasts: Sequence[Forecast], key: Callable[[Forecast], _Key]) -> dict[_Key, list[Forecast]]:
    """Group forecasts by a key."""
    found: dict[_Key, list[Forecast]] = {}
    for forecast in forecasts:
        found.setdefault(key(forecast), []).append(forecast)
    return found


def _share_range(shares: Sequence[float]) -> str:
    low, high = (f"{100 * share:.0f}" for share in (min(shares), max(shares)))
    return f"{low} %" if low == high else f"{low} to {high} %"


def _forecast_table(forecasts: Sequence[Forecast]) -> str:
    rows = []
    for f in sorted(forecasts, key=lambda f: (f.family, f.where)):
        scale, unit = readable_unit(f.unit, f.nameable)
        rows.append(
            [
                f.family.replace("_", " "),
                f.where,
                f"{number(f.nameable * scale, 2)} {unit_words(unit)}".rstrip(),
                f"{100 * f.visible:.0f} %",
                f.alternative.replace("_", " ").replace("@", " at "),
                f"{100 * f.separation:.0f} %" if f.alternative else "",
            ]
        )
    columns = [
        "effect",
        "where",
        "smallest size that would be named",
        "visible",
        "closest alternative",
        "share that the alternative cannot imitate",
    ]
    return markup.table(columns, rows, text_columns=(0, 1, 4))


def _next(gap: GapResult) -> str:
    if not gap.experiments:
        return ""
    poses = [dict(row) for experiment in gap.experiments for row in experiment.poses]
    return markup.section(
        "What to measure next",
        markup.items(in_words(experiment.text) for experiment in gap.experiments),
        _pose_table(poses) if poses else "",
    )


def _pose_table(poses: Sequence[Mapping[str, object]]) -> str:
    columns = list(dict.fromkeys(name for row in poses for name in row))
    rows = [[_cell(row.get(name, "")) for name in columns] for row in poses[:_POSES_SHOWN]]
    more = len(poses) - len(rows)
    note = markup.paragraph(f"and {more} more; plan.csv next to this report lists them all", "note") if more else ""
    return markup.table(columns, rows, caption="Next poses, in the form that `rigcal plan` writes") + note


def _cell(value: object) -> str:
    if isinstance(value, float):
        return number(value, 4)
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
