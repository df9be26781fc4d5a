"""The comparison of methods as a page: Table 4 of the second paper, for any rig and data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from calibration.experiments.comparison import NOMINAL, Comparison
from calibration.experiments.residual_comparison import EFFECTS, FIGURES, RESIDUALS, MethodResult
from daemon.report import drawing, markup
from daemon.report.front import Accuracy, Facts, front, judge, signatures
from daemon.report.plain_names import in_words, method_words, residual_words
from daemon.report.words import listed, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS: Mapping[str, str] = {  # methods and residuals are drawn in two panels, which reuse colours
    NOMINAL: drawing.BEFORE,
    "km": "#e69f00",
    "skcm": "#009e73",
    "rbf-tcm": "#cc79a7",
    "effects": drawing.INK,
    "table": drawing.BEFORE,
    "rbfn-paper": drawing.MIDDLE,
    "rbfn": "#e69f00",
    "lightgbm": "#009e73",
    "chain": "#cc79a7",
    "gp": "#56b4e9",
    "default": drawing.AFTER,
    "pde-paper": drawing.MIDDLE,
}
HEADER = ("method", "mean", "max", "std", "rms", "mean, training", "seconds", "on top of the kinematics")
LOWEST = "*"
TEXT_COLUMNS = (0, len(HEADER) - 1)
_TRAINING = "training_mean_mm"  # not marked: the lowest training error is no merit
_FIGURES = (("mean_mm", "mean"), ("max_mm", "worst fix"), ("std_mm", "standard deviation"))
_PAGE_HEADER = ("method", "mean", "worst", "standard deviation", "root mean square", "mean where fitted", "seconds")


def comparison_page(comparison: Comparison, sources: Mapping[str, str], facts: Facts | None = None) -> str:
    """Return one self-contained HTML document.

    Args:
        comparison: results of the methods.
        sources: label -> origin of the data.
        facts: the first lines of the page; by default the rig's name alone.
    """
    with drawing.styled():
        content = [
            _head(comparison, facts or Facts(comparison.rig)),
            markup.section(
                "Errors",
                markup.table(
                    [*_PAGE_HEADER, HEADER[-1]],
                    [
                        _in_words(row, result)
                        for row, result in zip(table_rows(comparison), comparison.results, strict=True)
                    ],
                    caption=f"Position error in mm on {comparison.held_out} held-out fixes; {LOWEST} marks the lowest",
                    text_columns=TEXT_COLUMNS,
                    classes=["best" if r.method == "default" else "" for r in comparison.results],
                ),
                markup.items(in_words(text) for text in refused) if (refused := _refusals(comparison)) else "",
                drawing.picture(
                    dots(comparison),
                    "Mean, maximum and standard deviation of the error per method, and the noise floor",
                    "On the held-out fixes; the axes are logarithmic. The dashed line is the instruments' noise, "
                    "root mean square.",
                ),
                drawing.picture(
                    curves(comparison),
                    "Held-out errors of every method, sorted by size",
                    "Every method's held-out errors, sorted: 50 % is the median, 100 % the worst fix. The dashed line "
                    "is the instruments' noise.",
                ),
            ),
            markup.sources_section(sources),
            signatures(),
        ]
    return markup.page(f"Methods compared: {comparison.rig}", "".join(content))


def label(method: str) -> str:
    """Return a row's name, as `calibrate --method` or `--residual` takes it."""
    return f"residual {'none' if method == EFFECTS else method}" if method in RESIDUALS else method


def table_rows(comparison: Comparison) -> list[list[str]]:
    """Return cells in the order of `HEADER`, with the lowest of each column of held-out errors marked."""
    lowest = {figure: comparison.lowest(figure) for figure in FIGURES if figure != _TRAINING}
    rows = []
    for result in comparison.results:
        row = result.as_dict()
        cells = [label(result.method)]
        if result.reason is not None:
            rows.append([*cells, "not applicable", *[""] * (len(HEADER) - 2)])
            continue
        for figure in FIGURES:
            mark = f" {LOWEST}" if result.method in lowest.get(figure, ()) else ""
            value = row[figure]
            assert isinstance(value, float)
            cells.append(number(value) + mark)
        cells.append("" if result.seconds is None else number(result.seconds))
        cells.append(", ".join(part.replace("_", " ") for part in result.adds))
        rows.append(cells)
    return rows


def refusals(comparison: Comparison) -> list[str]:
    """Return a sentence for every method that does not apply."""
    return [f"{label(r.method)}: not applicable: {r.reason}" for r in comparison.results if r.reason is not None]


def dots(comparison: Comparison) -> Figure:
    """Draw mean, maximum and standard deviation of the held-out error, a dot per method, and the noise floor."""
    results = _applicable(comparison)
    figure = drawing.new_figure(1.2 + 0.34 * len(results))
    for axes, (key, title) in zip(figure.subplots(1, len(_FIGURES), sharey=True), _FIGURES, strict=True):
        values = [value for r in results if isinstance(value := r.as_dict()[key], float)]
        floor = comparison.noise_mm if key == "mean_mm" else None
        for place, (result, value) in enumerate(zip(results, values, strict=True)):
            axes.axhline(place, color=drawing.GRID, linewidth=0.8, zorder=0)
            axes.plot(max(value, drawing.FLOOR_MM), place, "o", color=_COLOURS[result.method], markersize=7)
            axes.annotate(number(value), (max(value, drawing.FLOOR_MM), place), (7, 0), textcoords="offset points",
                va="center", fontsize=8.5)  # fmt: skip
        drawing.plain_log_axis(axes, "x")
        known = [max(value, drawing.FLOOR_MM) for value in (*values, *([floor] if floor else []))]
        span = max(max(known) / min(known), 2.0)
        axes.set_xlim(min(known) / span**0.15, max(known) * span**0.4)
        if floor:
            axes.axvline(floor, color=drawing.INK, linewidth=1.2, linestyle=(0, (4, 3)))
        axes.set_title(title)
        axes.set_xlabel("mm")
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0, labelcolor=drawing.INK)
        axes.set_yticks(range(len(results)), [method_words(r.method) for r in results])
    figure.axes[0].set_ylim(len(results) - 0.5, -0.5)
    return figure


def curves(comparison: Comparison) -> Figure:
    """Draw sorted held-out errors of the methods, and of the residuals on the kinematics of the default method."""
    results = _applicable(comparison)
    panels = {
        "methods": [r for r in results if r.method not in RESIDUALS],
        "learned residuals on rigcal's kinematics": [r for r in results if r.method in (*RESIDUALS, "default")],
    }
    drawn = {title: part for title, part in panels.items() if len(part) > 1}
    figure = drawing.new_figure(4.6)
    for axes, (title, part) in zip(
        figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0], drawn.items(), strict=True
    ):
        for result in part:
            assert result.error_mm is not None
            share = 100.0 * (np.arange(len(result.error_mm)) + 1) / len(result.error_mm)
            look = {"color": _COLOURS[result.method], "label": method_words(result.method)}
            axes.plot(share, np.sort(result.error_mm), linewidth=2.4 if result.method == "default" else 1.4, **look)
        drawing.plain_log_axis(axes)
        if comparison.noise_mm:
            axes.axhline(comparison.noise_mm, color=drawing.INK, linewidth=1.2, linestyle=(0, (4, 3)))
        axes.set_xlim(0, 100)
        axes.set_title(title)
        axes.set_xlabel("share of the held-out fixes with at most this error, %")
        axes.legend(loc="lower right", fontsize=8.5)
    figure.axes[0].set_ylabel("position error, mm")
    return figure


def _applicable(comparison: Comparison) -> list[MethodResult]:
    return [result for result in comparison.results if result.error_mm is not None]


def headline(comparison: Comparison) -> str:
    """Return the result in one sentence."""
    lowest = comparison.lowest("mean_mm")
    # A residual that was not adopted ties with the row without a residual.
    best = max((r for r in comparison.results if r.method in lowest), key=lambda r: r.method == "default")
    nominal = comparison.results[0]
    assert best.error_mm is not None
    assert nominal.error_mm is not None
    name = _sentence_start(method_words(best.method))
    return (
        f"{name} has the lowest mean error on {comparison.held_out} held-out fixes: "
        f"{number(float(best.error_mm.mean()))} mm, compared with "
        f"{number(float(nominal.error_mm.mean()))} mm of the nominal model."
    )


def _head(comparison: Comparison, facts: Facts) -> str:
    lead = (
        f"Every method was calibrated on the same {comparison.training} training fixes. The result of its last stage "
        "was judged on the held-out fixes. Learned residuals share rigcal's own identification and differ only in the "
        "learner on top of it. Seconds are the time of the whole calibration."
    )
    own = next((r for r in comparison.results if r.method == "default"), comparison.results[-1])
    rows = f"on {comparison.held_out} held-out fixes"
    verdict, accuracy = None, f"Accuracy: {method_words(own.method)} does not apply to these data."
    if own.error_mm is not None:
        rms_mm = float(np.sqrt(np.mean(own.error_mm**2)))
        verdict = judge(facts.tolerance_mm, rms_mm, is_held_out=True, rows=f"{rows} by {method_words(own.method)}")
        noise = "" if comparison.noise_mm is None else f"; the instruments' noise is {number(comparison.noise_mm)} mm"
        accuracy = f"Accuracy by {method_words(own.method)}: {number(rms_mm)} mm root mean square {rows}{noise}."
    first = front(facts, verdict, Accuracy(accuracy))
    title = f"Methods compared: {comparison.rig}"
    return markup.header(title, first, headline(comparison), lead) + markup.notice(notices(comparison))


def notices(comparison: Comparison) -> list[str]:
    """Return all warnings and notes, each sentence once, with the methods that it concerns."""
    about: dict[str, list[str]] = {}
    for result in comparison.results:
        for note in result.notes:
            about.setdefault(note, []).append(method_words(result.method))
    own = [f"{_sentence_start(listed(names))}: {note}" for note, names in about.items()]
    return [in_words(note) for note in dict.fromkeys([*comparison.warnings, *own])]


def _refusals(comparison: Comparison) -> list[str]:
    """Return a sentence for every reason why methods do not apply, with these methods."""
    about: dict[str, list[str]] = {}
    for result in comparison.results:
        if result.reason is not None:
            about.setdefault(result.reason, []).append(method_words(result.method))
    return [f"{_sentence_start(listed(names))}: not applicable: {reason}" for reason, names in about.items()]


def _in_words(cells: list[str], result: MethodResult) -> list[str]:
    """Return a row of the table with its method and what it adds in words."""
    adds = ", ".join(residual_words(part) if part in RESIDUALS else part.replace("_", " ") for part in result.adds)
    return [method_words(result.method), *cells[1:-1], adds]


def _sentence_start(text: str) -> str:
    return text if text.startswith("rigcal") else text[:1].upper() + text[1:]
