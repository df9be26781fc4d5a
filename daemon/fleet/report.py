"""The report on a fleet: an HTML page with the rigs, their common deviations, and what each would gain from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daemon.fleet.comparison import Fleet, Group, Quantity, gains
from daemon.report import drawing, markup
from daemon.report.words import PLUS_MINUS, number, signed

_MOST_QUANTITIES = 20
_MOST_RIGS = 200  # rows in a table; the Parquet file has all rigs
_HEIGHT_IN = 3.4


def fleet_report(fleet: Fleet, made: str, files: Sequence[str]) -> str:
    """Return the report as an HTML page.

    Args:
        fleet: the comparison.
        made: time of the report, for people.
        files: names of the other files of the result.
    """
    rigs = sum(len(group.answers) for group in fleet.groups)
    sections = [_header(fleet, rigs, made)]
    for group in fleet.groups:
        sections += [_overview(group), _common(group), _outliers(group), _drift(group), _gains(group)]
    if fleet.failed:
        rows = [[answer["name"], answer["error"]] for answer in fleet.failed[:_MOST_RIGS]]
        table = markup.table(("rig", "reason"), rows, text_columns=(0, 1))
        sections.append(markup.section("Rigs that could not be assessed", table))
    sections.append(markup.section("Files", markup.items(files)))
    return markup.page("Fleet", "".join(sections))


def _header(fleet: Fleet, rigs: int, made: str) -> str:
    common = sum(len(group.common) for group in fleet.groups)
    outlying = sum(bool(group.outlying(n)) for group in fleet.groups for n in range(len(group.answers)))
    changed = sum(_has_changed(answer) for group in fleet.groups for answer in group.answers)
    lead = (
        f"Constants that deviate from the drawing in the same way on all rigs: {common}. Rigs that differ from the "
        f"others more than is usual: {outlying}. Rigs that have changed since they were last measured: {changed}."
    )
    before = np.median([a["stages"]["nominal"] for g in fleet.groups for a in g.answers]) if rigs else float("nan")
    after = np.median([a["stages"]["effects"] for g in fleet.groups for a in g.answers]) if rigs else float("nan")
    tiles = [
        markup.Tile("Rigs", str(rigs), ""),
        markup.Tile("Could not be assessed", str(len(fleet.failed)), ""),
        markup.Tile("Median error by the drawings", number(float(before))),
        markup.Tile("Median error calibrated", number(float(after)), kind="after"),
    ]
    return markup.header("Fleet", made, f"Comparison of {rigs} rigs", lead, tiles)


def _has_changed(answer: object) -> bool:
    assert isinstance(answer, dict)
    drift = answer["drift"]
    return drift is not None and drift["alarm"] == "worse"


def _overview(group: Group) -> str:
    names = [f"{place} in {count}" for place, count in list(group.effects.items())[:_MOST_QUANTITIES]]
    effects = f"Named effects: {', '.join(names)} of {len(group.answers)} rigs." if names else ""
    return markup.section(
        f"Rigs of type {group.rig}",
        _errors_picture(group),
        markup.paragraph(effects) if effects else "",
    )


def _errors_picture(group: Group) -> str:
    before = np.sort([answer["stages"]["nominal"] for answer in group.answers])
    after = np.sort([answer["stages"]["effects"] for answer in group.answers])
    noise = np.median([answer["noise_mm"] for answer in group.answers])
    share = (np.arange(len(before)) + 0.5) / len(before) * 100.0
    with drawing.styled():
        figure = drawing.new_figure(_HEIGHT_IN)
        axes = figure.subplots()
        axes.plot(
            np.maximum(before, drawing.FLOOR_MM), share, color=drawing.BEFORE, linewidth=2, label="by the drawings"
        )
        axes.plot(np.maximum(after, drawing.FLOOR_MM), share, color=drawing.AFTER, linewidth=2, label="calibrated")
        axes.axvline(noise, color=drawing.SOFT, linewidth=0.9, linestyle="--", label="scatter of a fix, median")
        drawing.plain_log_axis(axes, "x")
        axes.set_xlabel("RMS error of a rig on its own fixes, mm")
        axes.set_ylabel("rigs with a smaller error, %")
        axes.set_ylim(0, 100)
        axes.legend(loc="lower right")
        return drawing.picture(
            figure,
            "Cumulative distribution of the rigs' errors before and after calibration",
            "Share of rigs with an error below a given value, by the drawings and calibrated, on each rig's own fixes.",
        )


def _common(group: Group) -> str:
    shared = group.common
    text = (
        "A constant that deviates from the drawing in the same way on all rigs is an error in the drawing or the rig "
        "file: correct it there, and every rig starts closer to the truth. The spread is the variation between rigs "
        "beyond measurement errors: the actual build tolerance."
    )
    if not shared:
        return markup.section(
            "In common", markup.paragraph("No constant deviates from the drawings in the same way on all rigs.")
        )
    rows = [
        [
            quantity.name,
            quantity.unit,
            f"{signed(quantity.fleet.mean)} {PLUS_MINUS} {number(quantity.fleet.mean_sigma, 2)}",
            number(quantity.fleet.spread),
            str(quantity.fleet.rigs),
        ]
        for quantity in shared[:_MOST_QUANTITIES]
    ]
    table = markup.table(("constant", "unit", "mean deviation", "spread", "rigs"), rows, text_columns=(0, 1))
    return markup.section("In common", markup.paragraph(text), table, _forest(shared[0]))


def _forest(quantity: Quantity) -> str:
    """Draw one quantity for all rigs: estimated from their own data, and given the fleet."""
    there = np.flatnonzero(np.isfinite(quantity.own))
    order = there[np.argsort(quantity.own[there])]
    place = np.arange(len(order), dtype=np.float64)
    with drawing.styled():
        figure = drawing.new_figure(_HEIGHT_IN)
        axes = figure.subplots()
        own, sigma = quantity.own[order], quantity.own_sigma[order]
        axes.vlines(place, own - 2 * sigma, own + 2 * sigma, color=drawing.BEFORE, linewidth=0.8)
        drawing.scatter(axes, place, own, drawing.BEFORE, size=9)
        drawing.scatter(axes, place, quantity.fleet.estimate[order], drawing.AFTER, size=7, alpha=0.9)
        outside = quantity.outliers[order]
        drawing.scatter(axes, place[outside], own[outside], drawing.WARN, size=22, alpha=1.0)
        axes.axhline(quantity.fleet.mean, color=drawing.AFTER, linewidth=1.2)
        axes.axhline(0, color=drawing.SOFT, linewidth=0.7)
        axes.set_xlabel("rigs, in the order of their own estimate")
        axes.set_ylabel(f"{quantity.name}, {quantity.unit}")
        handles = [
            drawing.key(drawing.BEFORE, "own data, 95 %"),
            drawing.key(drawing.AFTER, "given the fleet"),
            drawing.key(drawing.WARN, "outlier"),
        ]
        axes.legend(handles=handles, loc="upper left")
        return drawing.picture(
            figure,
            f"{quantity.name} of every rig with its interval, and the mean of the fleet",
            f"{quantity.name}: the estimate from each rig's own data, and the best estimate given all other rigs.",
        )


def _outliers(group: Group) -> str:
    rows = []
    found = [
        (quantity, n, answer["name"]) for n, answer in enumerate(group.answers) for quantity in group.outlying(n)[:3]
    ]
    for quantity, n, name in sorted(found, key=lambda each: -abs(each[0].fleet.deviation[each[1]])):
        own, mean = signed(float(quantity.own[n])), signed(quantity.fleet.mean)
        deviation = signed(float(quantity.fleet.deviation[n]), 2)
        rows.append([name, quantity.name, f"{own} {quantity.unit}", f"{mean} {quantity.unit}", deviation])
    if not rows:
        return markup.section("Outliers", markup.paragraph("No rig differs from the others more than is usual."))
    heads = ("rig", "constant", "its value", "fleet", "standard deviations")
    text = "Possible reasons: a part was exchanged, bent or assembled differently, or the data are of another machine."
    return markup.section(
        "Outliers", markup.paragraph(text), markup.table(heads, rows[:_MOST_RIGS], text_columns=(0, 1))
    )


def _drift(group: Group) -> str:
    known = [answer for answer in group.answers if answer["drift"] is not None and answer["drift"]["ratio"] is not None]
    if not known:
        text = "No rig has a check session or more than one session, so it is unknown whether any has changed."
        return markup.section("Drift", markup.paragraph(text))
    changed = sorted((a for a in known if _has_changed(a)), key=lambda answer: -answer["drift"]["ratio"])
    text = (
        f"{len(changed)} of {len(known)} rigs have changed, judged by their newest session and a model that has not "
        "seen it."
    )
    rows = [[a["name"], a["drift"]["session"], number(a["drift"]["ratio"])] for a in changed[:_MOST_RIGS]]
    heads = ("rig", "session", "error / expected error")
    table = markup.table(heads, rows, text_columns=(0, 1)) if rows else ""
    return markup.section("Drift", markup.paragraph(text), table)


def _gains(group: Group) -> str:
    rows = _gain_rows(group)
    text = "What would help each rig most: urgent actions first, then by the expected decrease of its error in mm."
    heads = ("rig", "calibrated RMS, mm", "scatter of a fix, mm", "gain, mm", "what to do")
    table = markup.table(heads, rows[:_MOST_RIGS], text_columns=(4,))
    more = f"{len(rows) - _MOST_RIGS} more rigs are in the table file." if len(rows) > _MOST_RIGS else ""
    return markup.section(
        "What each rig would gain from", markup.paragraph(text), table, markup.paragraph(more) if more else ""
    )


def _gain_rows(group: Group) -> list[list[str]]:
    """Return a row for each rig, the most urgent first."""
    rows = []
    for n, answer in enumerate(group.answers):
        offered = gains(group, n)
        first = offered[0].gain_mm if offered else 0.0
        texts = [gain.text + (f" ({number(gain.gain_mm)} mm)" if np.isfinite(gain.gain_mm) else "") for gain in offered]
        told = "; ".join(texts) or "nothing: its error is at the noise level"
        row = [answer["name"], number(answer["stages"]["effects"]), number(answer["noise_mm"]), number(first), told]
        rows.append((np.inf if np.isnan(first) else first, row))
    return [row for _, row in sorted(rows, key=lambda each: -each[0])]
