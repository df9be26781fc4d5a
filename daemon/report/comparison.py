"""Methods side by side: the second paper's Table 4 as a page, for any rig and data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from calibration.experiments.comparison import NOMINAL, Comparison
from calibration.experiments.residual_comparison import EFFECTS, FIGURES, RESIDUALS, MethodResult
from daemon.report import drawing, markup
from daemon.report.words import number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS: Mapping[str, str] = {  # methods and residuals are drawn in two panels, where colours return
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
_TRAINING = "training_mean_mm"  # the lowest of these is no merit
_BARS = (("mean_mm", "mean"), ("max_mm", "max"), ("std_mm", "standard deviation"))


def comparison_page(comparison: Comparison, sources: Mapping[str, str]) -> str:
    """Return one self-contained HTML document; `sources` is label -> origin of the data."""
    with drawing.styled():
        content = [
            _head(comparison),
            markup.section(
                "Errors",
                markup.table(
                    HEADER,
                    table_rows(comparison),
                    caption=f"Position error in mm on {comparison.held_out} held-out fixes; {LOWEST} the lowest",
                    text_columns=TEXT_COLUMNS,
                    classes=["best" if r.method == "default" else "" for r in comparison.results],
                ),
                markup.items(refused) if (refused := refusals(comparison)) else "",
                drawing.picture(
                    bars(comparison),
                    "Mean, greatest and standard deviation of the error per method",
                    "On the held-out fixes; the axes are logarithmic.",
                ),
                drawing.picture(
                    curves(comparison),
                    "Held-out errors of every method, sorted by size",
                    "Every method's held-out errors, sorted: at 50 % is the median, at 100 % the worst fix.",
                ),
            ),
            markup.sources_section(sources),
        ]
    return markup.page(f"Methods compared: {comparison.rig}", "".join(content))


def label(method: str) -> str:
    """Return a row's name: a method by the name that `calibrate --method` takes, a residual by that of `--residual`."""
    return f"residual {'none' if method == EFFECTS else method}" if method in RESIDUALS else method


def table_rows(comparison: Comparison) -> list[list[str]]:
    """Return cells as in `HEADER`, the lowest of each column of held-out errors marked."""
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


def bars(comparison: Comparison) -> Figure:
    """Draw mean, greatest and standard deviation of the held-out error, a bar for every method."""
    from matplotlib.ticker import LogLocator

    results = _applicable(comparison)
    figure = drawing.new_figure(0.9 + 0.34 * len(results))
    for axes, (key, title) in zip(figure.subplots(1, len(_BARS), sharey=True), _BARS, strict=True):
        values = [value for r in results if isinstance(value := r.as_dict()[key], float)]
        drawn = axes.barh(range(len(values)), values, height=0.62, color=[_COLOURS[r.method] for r in results])
        drawing.plain_log_axis(axes, "x")
        axes.xaxis.set_major_locator(LogLocator(10))
        low, high = max(min(values), 1e-6), max(values)
        span = max(high / low, 2.0)
        axes.set_xlim(low / span**0.25, high * span**0.35)
        axes.bar_label(drawn, labels=[number(value) for value in values], padding=3, fontsize=8.5)
        axes.set_title(title)
        axes.set_xlabel("mm")
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0, labelcolor=drawing.INK)
        axes.set_yticks(range(len(results)), [label(r.method) for r in results])
    figure.axes[0].invert_yaxis()
    return figure


def curves(comparison: Comparison) -> Figure:
    """Draw held-out errors in rising order: of the methods, and of the residuals on the default's kinematics."""
    results = _applicable(comparison)
    panels = {
        "methods": [r for r in results if r.method not in RESIDUALS],
        "residuals on the default's kinematics": [r for r in results if r.method in (*RESIDUALS, "default")],
    }
    drawn = {title: part for title, part in panels.items() if len(part) > 1}
    figure = drawing.new_figure(4.6)
    for axes, (title, part) in zip(
        figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0], drawn.items(), strict=True
    ):
        for result in part:
            assert result.error_mm is not None
            share = 100.0 * (np.arange(len(result.error_mm)) + 1) / len(result.error_mm)
            look = {"color": _COLOURS[result.method], "label": label(result.method)}
            axes.plot(share, np.sort(result.error_mm), linewidth=2.4 if result.method == "default" else 1.4, **look)
        drawing.plain_log_axis(axes)
        axes.set_xlim(0, 100)
        axes.set_title(title)
        axes.set_xlabel("share of the held-out fixes with at most this error, %")
        axes.legend(loc="lower right", fontsize=8.5)
    figure.axes[0].set_ylabel("position error, mm")
    return figure


def _applicable(comparison: Comparison) -> list[MethodResult]:
    return [result for result in comparison.results if result.error_mm is not None]


def headline(comparison: Comparison) -> str:
    """Say the result in one sentence."""
    lowest = comparison.lowest("mean_mm")
    # Residuals that are left out tie with none.
    best = max((r for r in comparison.results if r.method in lowest), key=lambda r: r.method == "default")
    nominal = comparison.results[0]
    assert best.error_mm is not None
    assert nominal.error_mm is not None
    return (
        f"{label(best.method)} has the lowest mean error on {comparison.held_out} held-out fixes: "
        f"{number(float(best.error_mm.mean()))} mm, where the nominal model has "
        f"{number(float(nominal.error_mm.mean()))} mm."
    )


def _head(comparison: Comparison) -> str:
    lead = (
        "Every method was calibrated on the same training fixes and judged on the held-out ones, by its last "
        "stage. Names are those of `calibrate --method` and `--residual`. Rows from \u201cresidual none\u201d to "
        "the default share one identification, and differ in what is learned on top of it; `table` is a table of "
        "corrections and `rbfn-paper` a published network. Seconds are of the whole calibration."
    )
    warnings = comparison.as_dict()["warnings"]  # with the methods' notes
    assert isinstance(warnings, list)
    fixes = f"{comparison.training} training fixes and {comparison.held_out} held-out ones"
    return markup.header(f"Methods compared: {comparison.rig}", fixes, headline(comparison), lead) + markup.notice(
        warnings
    )
