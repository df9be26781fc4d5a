"""The gap workflow's report: one HTML file that says what the simulation lacks, and how that is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.gap.result import Candidate, Forecast, Gap
from daemon.report import gap_figures as figures
from daemon.report.drawing import styled, svg_image
from daemon.report.gap_figures import Bar, Interval
from daemon.report.gap_words import (
    before_and_after,
    chance,
    closed_share,
    dependence,
    gap_headline,
    listed,
    odds,
    place_name,
    probability,
    remaining,
    spoken,
)
from daemon.report.markup import escape, items, number, page, paragraph, picture, section, table
from daemon.report.units import readable_unit

_Key = TypeVar("_Key", bound=Hashable)
_CANDIDATES_SHOWN = 6
_POSES_SHOWN = 12
_LEAST_SEPARATION = 0.1
_CHANCE = 2.0  # standard errors of a 95 % interval
_COLUMNS = {
    "time_s": ("Time", "time since the first fix, h", 3600.0),
    "temperature_degC": ("Temperature", "deg C", 1.0),
}


def gap_report(gap: Gap, sources: Mapping[str, str]) -> str:
    """One self-contained HTML document, the same bytes for the same input; `sources` says where the data are from."""
    with styled():
        parts = [
            _head(gap),
            _steps(gap),
            _found(gap),
            _where(gap),
            _candidates(gap),
            _not_shown(gap),
            _next(gap),
            section("Where this comes from", table((), [list(s) for s in sources.items()], text_columns=(0, 1))),
        ]
    return page(f"Gap between simulation and {gap.model.rig.name}", "".join(parts))


def intervals(gap: Gap) -> list[Interval]:
    """Every adopted coefficient that has bounds, in units for people."""
    found = []
    for effect in gap.effects:
        bounds = coefficient_bounds(gap, effect)
        for coefficient in effect.reported:
            if coefficient.name not in bounds:
                continue
            lower, upper = bounds[coefficient.name]
            scale, unit = readable_unit(coefficient.unit, max(abs(lower), abs(upper)))
            found.append(
                Interval(
                    f"{place_name(effect.family, effect.where)}, {coefficient.name}",
                    coefficient.value * scale,
                    coefficient.standard_error * scale,
                    coefficient.prior_sigma * scale,
                    lower * scale,
                    upper * scale,
                    unit,
                )
            )
    return found


def coefficient_bounds(gap: Gap, effect: FittedEffect) -> dict[str, tuple[float, float]]:
    """Name of a coefficient -> its hard limits, where it has any: those it was weighed with, else the library's."""
    situation = Situation(gap.model.chain, gap.model.values, gap.observations)
    family = library()[effect.family]
    limits = {c.name: (c.lower, c.upper) for c in family.coefficients(situation, effect.where, effect.settings)}
    limits |= family.reported_limits()
    for candidate in (c for round_ in gap.rounds for c in round_.candidates):
        if (candidate.family, candidate.where) == (effect.family, effect.where):
            limits |= candidate.bounds
    return {name: ends for name, ends in limits.items() if all(map(math.isfinite, ends)) and ends[1] > ends[0]}


# ---- sections --------------------------------------------------------------------------------------------------------


def _head(gap: Gap) -> str:
    before, after, what = before_and_after(gap)
    tiles = [("", f"error of the simulation, {what}", number(before), "mm")]
    if gap.effects:
        share = closed_share(before, after, gap.noise_mm)
        closed = "\N{EN DASH}" if share is None else f"{100 * share:.0f}"
        tiles += [
            ("after", "error with the effects found", number(after), "mm"),
            ("after", "of the gap above the noise closed", closed, "%"),
        ]
    tiles.append(("", f"noise floor, {gap.noise_source}", number(gap.noise_mm), "mm"))
    figures_ = "".join(
        f'<div class="{kind}"><dt>{escape(label)}</dt><dd>{escape(value)} <small>{unit}</small></dd></div>'
        for kind, label, value, unit in tiles
    )
    notice = f'<div class="notice" role="note"><strong>Please note</strong>{items(gap.warnings)}</div>'
    return (
        f"<header><h1>Gap report: {escape(gap.model.rig.name)}</h1>"
        f"{paragraph(f'{len(gap.observations)} fixes; verdict: {gap.verdict}')}"
        f'<p class="headline">{escape(gap_headline(gap))}</p>{paragraph(_meaning(gap), "lead")}'
        f'<dl class="figures">{figures_}</dl></header>{notice if gap.warnings else ""}'
    )


def _meaning(gap: Gap) -> str:
    sentences = []
    if gap.verdict == "named":
        sentences.append("It is part of the model now, fitted together with the lengths and angles.")
    if gap.verdict == "indistinguishable":
        sentences.append("None of them was added to the model; the measurements proposed below tell them apart.")
        if gap.effects:
            named = spoken([(e.family, e.where) for e in gap.effects])
            sentences.append(f"Certain already, and part of the model: {named}.")
    if gap.description:
        sentences.append(f"{dependence(gap)}.")
    if gap.remaining_significant:
        sentences.append(f"{remaining(gap)} that was not named; a learned residual may take it.")
    elif gap.verdict in ("named", "none"):
        sentences.append("What is left is what the noise explains.")
    return " ".join(sentences)


def _steps(gap: Gap) -> str:
    if not gap.rounds:
        return ""
    return section(
        "From the simulation down to the noise",
        paragraph(
            "How far the simulation is off in poses that it was not fitted to, each time after the effect that the "
            "data named was added. Where the bars reach the dashed line there is nothing left to find."
        ),
        picture(
            svg_image(
                figures.steps(list(bars(gap)), gap.noise_mm), "Held-out error round by round, and the noise floor"
            ),
            f"Root mean square error {before_and_after(gap)[2]}. The noise floor is {gap.noise_source}.",
        ),
    )


def bars(gap: Gap) -> Iterator[Bar]:
    """The rounds as steps; a round's error is that before its own effects were adopted."""
    label = "calibrated kinematics"
    for number_, round_ in enumerate(gap.rounds):
        if number_ == 0 or gap.rounds[number_ - 1].adopted:
            yield Bar(label, round_.held_out_mm)
        label = "+ " + spoken([(family, where) for family, _, where in (a.partition("@") for a in round_.adopted)])


def _found(gap: Gap) -> str:
    if not gap.effects:
        return ""
    rows = []
    for effect in gap.effects:
        certain = probability(gap.posterior[f"{effect.family}@{effect.where}"])
        name = effect.family.replace("_", " ")
        head = [f"{name} ({effect.form})" if effect.form else name, effect.where, certain]
        bounds = coefficient_bounds(gap, effect)
        for c in effect.reported:
            ends = bounds.get(c.name)
            scale, unit = readable_unit(c.unit, max(map(abs, ends)) if ends else abs(c.value))
            limits = f"{number(ends[0] * scale)} .. {number(ends[1] * scale)}" if ends else ""
            interval = f"\N{PLUS-MINUS SIGN} {number(_CHANCE * c.standard_error * scale, 2)}"
            rows.append([*head, c.name, number(c.value * scale), interval, limits, unit])
            head = [""] * 3
    header = ["effect", "where", "probability", "coefficient", "value", "95 % interval", "hard bounds", "unit"]
    lines = intervals(gap)
    drawn = lines and picture(
        svg_image(figures.coefficients(lines), "Coefficients with their intervals between their hard bounds"),
        "From one hard bound (black) to the other; light blue is what is plausible beforehand (1 sigma). The dot is "
        "what was found, the line its 95 % interval.",
    )
    names = dict.fromkeys(effect.family for effect in gap.effects)
    return section(
        "What was missing",
        "".join(paragraph(f"{name.replace('_', ' ').capitalize()}: {library()[name].equation}.") for name in names),
        table(header, rows, text_columns=(0, 1, 3, 7)),
        drawn or "",
    )


def _where(gap: Gap) -> str:
    rows = [[d.where, d.variable, chance(d.p)] for d in gap.disagreements]
    found = (
        paragraph("Patterns in what calibrated kinematics leave, beyond chance; corrected for all that was looked at.")
        + table(["where", "depends on", "by chance"], rows, text_columns=(0, 1))
        if rows
        else paragraph("No pattern in what calibrated kinematics leave is beyond chance.")
    )
    content = [
        found,
        "<h3>Over the work volume</h3>",
        picture(
            svg_image(figures.error_maps(gap), "Error over the work volume in plan and side view"),
            "Prism positions in the rig's base frame; the cross is its origin, dark is worse.",
        ),
        "<h3>Joint by joint</h3>",
        picture(
            svg_image(figures.by_joint(gap), "Apparent error of each joint against its reading"),
            "The error each joint would have to make, were it alone to blame, with running medians. A joint to blame "
            "shows a curve; one beside it shows an echo.",
        ),
    ]
    direction = figures.by_direction(gap)
    if direction is not None:
        content += [
            "<h3>By direction of approach</h3>",
            picture(
                svg_image(direction, "Mean apparent error of each joint by the direction of its last motion"),
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
            picture(
                svg_image(figures.against(gap, shown, label), f"Components of the error against {title.lower()}"),
                "Measured minus simulated, in the station's frame, with running medians.",
            ),
        ]
    content += [
        "<h3>By prism and component</h3>",
        picture(svg_image(figures.by_prism(gap), "Error by prism and by component"), "Over all fixes, outliers too."),
    ]
    return section("Where simulation and measurement disagree", *content)


def _candidates(gap: Gap) -> str:
    content = [
        paragraph(
            "Every effect of the library was weighed against all others and against none. Probabilities are of the "
            "family among all families; odds are of the effect against no effect at all."
        )
    ]
    for place, round_ in enumerate(gap.rounds, start=1):
        if not round_.candidates:
            continue
        shown = round_.candidates[:_CANDIDATES_SHOWN]
        rows = [_candidate_row(c, place, gap) for c in shown]
        classes = ["best" if f"{c.family}@{c.where}" in round_.adopted else "" for c in shown]
        title = f"<h3>Round {place}</h3>" if len(gap.rounds) > 1 else ""
        header = ["effect", "probability", "odds against none", "coefficients", "verdict"]
        content.append(title + table(header, rows, text_columns=(0, 3, 4), classes=classes))
    if len(content) == 1:
        return ""
    return section("Candidates, and why they were rejected", *content)


def _candidate_row(candidate: Candidate, place: int, gap: Gap) -> list[str]:
    name = f"{candidate.family}@{candidate.where}"
    pending = any(name == f"{c.family}@{c.where}" for c in gap.indistinguishable)
    verdict = candidate.reason or ("cannot be told apart" if pending else "")
    for number_, round_ in enumerate(gap.rounds, start=1):
        if number_ >= place and name in round_.adopted:
            verdict = "adopted" if number_ == place else f"adopted in round {number_}"
            break
    values = []
    for c in candidate.coefficients:
        scale, unit = readable_unit(c.unit, max(map(abs, candidate.bounds.get(c.name, (c.value,)))))
        values.append(f"{number(c.value * scale)} {unit}".rstrip())
    return [
        place_name(candidate.family, candidate.where),
        probability(candidate.posterior),
        odds(candidate.log_bayes_factor),
        ", ".join(values),
        verdict,
    ]


def _not_shown(gap: Gap) -> str:
    hidden = [f for f in gap.forecasts if not math.isfinite(f.nameable)]
    alike = [f for f in gap.forecasts if math.isfinite(f.nameable) and f.rival and f.separation < _LEAST_SEPARATION]
    content = [
        paragraph(
            "An effect that is not named may be absent, or this data could not show it. Before any was weighed, it was "
            "worked out what each would have looked like in these very poses."
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
        header = ["effect", "where", "share that calibration leaves", "at most, at a plausible size"]
        content += ["<h3>Too small to be named, even at its hard bound</h3>", table(header, rows, text_columns=(0, 1))]
    if alike:
        rows = [
            [
                pair[0].replace("_", " "),
                listed([f.where for f in own]),
                pair[1].replace("_", " "),
                _share_range([f.separation for f in own]),
            ]
            for pair, own in _by(alike, lambda f: (f.family, f.rival.partition("@")[0])).items()
        ]
        header = ["effect", "where", "closest rival", "share that the rival cannot imitate"]
        content += ["<h3>Hard to tell from another</h3>", table(header, rows, text_columns=(0, 1, 2))]
    if gap.disabled:
        content += [
            "<h3>Not looked for</h3>",
            items(f"{family.replace('_', ' ')}: {reason}" for family, reason in sorted(gap.disabled.items())),
        ]
    seen = [f for f in gap.forecasts if math.isfinite(f.nameable)]
    if seen:
        content.append(_details(f"What it could have shown ({len(seen)} effects)", _forecast_table(seen)))
    return section("What this data could not have shown", *content)


def _by(forecasts: Sequence[Forecast], key: Callable[[Forecast], _Key]) -> dict[_Key, list[Forecast]]:
    """Forecasts by what they have in common."""
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
                _family(f),
                f.where,
                f"{number(f.nameable * scale, 2)} {unit}".rstrip(),
                f"{100 * f.visible:.0f} %",
                f.rival.replace("_", " ").replace("@", " at "),
                f"{100 * f.separation:.0f} %" if f.rival else "",
            ]
        )
    header = ["effect", "where", "named from this size on", "visible", "closest rival", "rival cannot imitate"]
    return table(header, rows, text_columns=(0, 1, 4))


def _next(gap: Gap) -> str:
    if not gap.experiments:
        return ""
    poses = [dict(row) for experiment in gap.experiments for row in experiment.poses]
    return section(
        "What to measure next",
        items(experiment.text for experiment in gap.experiments),
        _pose_table(poses) if poses else "",
    )


def _pose_table(poses: Sequence[Mapping[str, object]]) -> str:
    header = list(dict.fromkeys(name for row in poses for name in row))
    rows = [[_cell(row.get(name, "")) for name in header] for row in poses[:_POSES_SHOWN]]
    more = len(poses) - len(rows)
    note = paragraph(f"and {more} more; plan.csv beside this report has all of them", "note") if more else ""
    return table(header, rows, caption="Next poses, as `rigcal plan` writes them") + note


# ---- words -----------------------------------------------------------------------------------------------------------


def _family(forecast: Forecast) -> str:
    return forecast.family.replace("_", " ")


def _cell(value: object) -> str:
    if isinstance(value, float):
        return number(value, 4)
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _details(title: str, content: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{content}</details>"
