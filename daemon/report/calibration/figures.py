"""The plots of the calibration report; each takes the report's input and returns a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from daemon.report import drawing
from daemon.report.calibration.inputs import USUAL, ErrorTable, Floats, ReportInput, Stage
from daemon.report.plain_names import constant_words, joint_words, unit_words
from daemon.report.words import INTERVAL_SIGMAS, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_BEFORE_AND_AFTER: tuple[tuple[Stage, str, float], ...] = (
    ("nominal", drawing.BEFORE, -0.2),
    ("hybrid", drawing.AFTER, 0.2),
)


def errors_by_prism(report: ReportInput) -> Figure:
    """Draw the position error per prism before (nominal) and after (hybrid), on a logarithmic axis."""
    figure = drawing.new_figure(3.9)
    axes = figure.add_subplot()
    table = report.judged
    labels: list[str] = []
    for place, prism in enumerate(table.prisms):
        rows = table.prism == prism
        for stage, colour, shift in _BEFORE_AND_AFTER:
            norms = np.maximum(drawing.sizes_mm(table.errors_mm[stage][rows]), drawing.FLOOR_MM)
            _strip(axes, norms, place + shift, colour)
        labels.append(f"{prism}\n{int(rows.sum())} fixes")
    drawing.plain_log_axis(axes)
    axes.axhline(max(report.instrument_mm, drawing.FLOOR_MM), color=drawing.INK, linewidth=1, linestyle=(0, (4, 3)))
    axes.set_xticks(range(len(labels)), labels)
    axes.set_xlim(-0.6, len(labels) - 0.4)
    axes.grid(False, axis="x")
    axes.set_ylabel("position error, mm")
    figure.legend(
        handles=[
            drawing.key(drawing.BEFORE, "before: drawings (nominal)"),
            drawing.key(drawing.AFTER, "after: calibrated (hybrid)"),
            _line_key("root mean square", "-", 1.6),
            _line_key("instrument noise", "--", 1.0),
        ],
        loc="outside upper left",
        ncols=4,
    )
    return figure


def _strip(axes: Axes, norms: Floats, centre: float, colour: str) -> None:
    # Dots lie side by side where the distribution is dense: the width shows their number, without smoothing.
    order = np.argsort(norms, kind="stable")
    logs = np.log10(norms[order])
    counts, edges = np.histogram(logs, bins=np.linspace(logs[0], logs[-1] + 1e-9, 26))
    widths = 0.16 * np.sqrt(counts / counts.max())
    which = np.clip(np.digitize(logs, edges) - 1, 0, len(counts) - 1)
    spread = (np.arange(len(logs)) * 0.618034 + 0.5) % 1.0 * 2.0 - 1.0  # golden-ratio steps: even and reproducible
    drawing.scatter(axes, centre + spread * widths[which], norms[order], colour, size=6, alpha=0.5)
    rms = float(np.sqrt(np.mean(norms**2)))
    axes.plot([centre - 0.18, centre + 0.18], [rms, rms], color=drawing.INK, linewidth=1.6, solid_capstyle="butt")
    at = (centre + 0.2, rms)
    label = axes.annotate(number(rms), at, va="center", ha="left", fontsize=8, fontweight="bold")
    label.set_bbox({"facecolor": axes.get_facecolor(), "edgecolor": "none", "pad": 0.5})


def _line_key(label: str, style: Literal["-", "--"], width: float) -> Line2D:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle=style, color=drawing.INK, linewidth=width, label=label)


def residual_by_joint(report: ReportInput) -> Figure:
    """Draw the remaining error, component by component, against each joint: a trend is physics that the model lacks."""
    table = report.judged
    stages: list[tuple[Stage, str, str]] = [("geometric", drawing.MIDDLE, "geometric")]
    if not np.array_equal(table.errors_mm["geometric"], table.errors_mm["hybrid"]):
        stages.append(("hybrid", drawing.AFTER, "hybrid"))
    limit = max(drawing.robust_reach(table.errors_mm[stage]) for stage, _, _ in stages)
    joints = [joint for joint in report.joints if joint.name in table.joints]
    figure, grid = drawing.even_grid(len(joints), 3, line_in=1.25)
    for line, joint in enumerate(joints):
        values = table.joints[joint.name]
        for column, component in enumerate("xyz"):
            axes = grid[line, column]
            layers = [(table.errors_mm[stage][:, column], colour) for stage, colour, _ in stages]
            drawing.dots_and_medians(axes, values, layers, limit, size=7, alpha=0.35)
            if line == 0:
                axes.set_title(f"{component} component")
            if column == 0:
                axes.set_ylabel("mm")
            axes.set_xlabel(f"{joint_words(joint)}, {unit_words(joint.unit)}", labelpad=1, color=drawing.INK)
    figure.legend(handles=[drawing.key(colour, label) for _, colour, label in stages], loc="upper left", ncols=2)
    return figure


def importance(report: ReportInput, most: int = 10) -> Figure:
    """Draw the features of the learned trees by their share of the split gain (Zhou et al. 2022, Fig. 10)."""
    lines = report.importance[:most]
    figure = drawing.new_figure(0.7 + 0.27 * len(lines))
    axes = figure.add_subplot()
    shares = [100.0 * share for _, share in lines]
    axes.barh(range(len(lines)), shares, height=0.62, color=drawing.AFTER, linewidth=0)
    for place, share in enumerate(shares):
        axes.annotate(f"{number(share, 2)} %", (share, place), (4, 0), textcoords="offset points", va="center")
    drawing.name_rows(axes, [name for name, _ in lines], (len(lines) - 0.4, -0.6))
    axes.set_xlim(0.0, 1.12 * max(shares))
    axes.set_xlabel("share of the gain of all splits, %")
    return figure


def joint_coverage(report: ReportInput) -> Figure:
    """Draw the part of each joint's range that the fixes cover."""
    joints = report.joints
    figure = drawing.new_figure(0.7 + 0.42 * len(joints))
    axes = figure.add_subplot()
    for place, joint in enumerate(joints):
        low, high = joint.limits
        axes.barh(place, 1, height=0.62, color="#eef1f3", linewidth=0)
        for table, colour, shift in _sets(report):
            share = (table.joints[joint.name] - low) / (high - low)
            ticks = np.clip(share, -0.02, 1.02)
            axes.plot(
                ticks, np.full(len(ticks), place + shift), "|", color=colour, markersize=6, alpha=0.5,
                markeredgewidth=0.9, rasterized=len(ticks) > 200,
            )  # fmt: skip
        axes.annotate(f"{low:g}", (-0.03, place), ha="right", va="center", color=drawing.SOFT, fontsize=8)
        axes.annotate(
            f"{high:g} {unit_words(joint.unit)}", (1.035, place), ha="left", va="center", color=drawing.SOFT, fontsize=8
        )
    axes.set_yticks(range(len(joints)), [joint_words(joint) for joint in joints])
    axes.tick_params(axis="y", length=0, labelcolor=drawing.INK, pad=34)
    axes.set_xlim(-0.03, 1.1)
    axes.set_ylim(len(joints) - 0.45, -0.55)
    axes.set_xticks([])
    axes.grid(False)
    for side in axes.spines.values():
        side.set_visible(False)
    figure.legend(handles=_set_keys(report), loc="outside upper left", ncols=2)
    return figure


def _sets(report: ReportInput) -> list[tuple[ErrorTable, str, float]]:
    if report.held_out is None:
        return [(report.training, drawing.AFTER, 0.0)]
    return [(report.training, drawing.AFTER, -0.15), (report.held_out, drawing.MIDDLE, 0.15)]


def _set_keys(report: ReportInput) -> list[Line2D]:
    keys = [drawing.key(drawing.AFTER, f"fitted ({len(report.training)} fixes)")]
    if report.held_out is not None:
        keys.append(drawing.key(drawing.MIDDLE, f"held out ({len(report.held_out)} fixes)"))
    return keys


def workspace(report: ReportInput) -> Figure:
    """Draw the prisms' positions in plan and side view, in the base frame."""
    figure = drawing.new_figure(4.3)
    plan, side = figure.subplots(1, 2)
    forward = drawing.forward_axis(report.training.position_mm)
    for table, colour, _ in reversed(_sets(report)):
        x, y, z = table.position_mm.T / 1000.0
        drawing.scatter(plan, x, y, colour, size=8)
        drawing.scatter(side, (x, y)[forward], z, colour, size=8)
    drawing.views(plan, side, forward)
    figure.legend(handles=_set_keys(report), loc="outside upper left", ncols=2)
    return figure


def error_map(report: ReportInput) -> Figure:
    """Draw the size of the error after calibration, seen from above and from the side."""
    table = report.judged
    figure = drawing.new_figure(4.1)
    forward = drawing.forward_axis(report.training.position_mm)
    errors_mm = drawing.sizes_mm(table.errors_mm["hybrid"])
    drawing.map_errors(
        figure, [("", errors_mm)], table.position_mm, forward, size=16, shrink=0.85, label="remaining error, mm"
    )
    return figure


def corrections(report: ReportInput, most: int = 14) -> Figure:
    """Draw the largest corrections in units of their build tolerance, with 95 % intervals."""
    lines = sorted(report.parameters, key=lambda p: -abs(p.in_tolerances))[:most]
    figure = drawing.new_figure(0.75 + 0.26 * len(lines))
    axes = figure.add_subplot()
    reach = max(3.4, *(abs(p.in_tolerances) + INTERVAL_SIGMAS * p.sigma / p.tolerance for p in lines)) * 1.05
    axes.axvspan(-USUAL, USUAL, color="#eef4f8", linewidth=0)
    axes.axvline(0, color=drawing.SOFT, linewidth=0.8)
    for place, line in enumerate(lines):
        colour = drawing.WARN if line.is_beyond_building else drawing.MIDDLE if line.is_unusual else drawing.AFTER
        half = INTERVAL_SIGMAS * line.sigma / line.tolerance
        axes.plot([line.in_tolerances - half, line.in_tolerances + half], [place, place], color=colour, linewidth=2)
        axes.plot(line.in_tolerances, place, "o" if line.determined else "D", color=colour, markersize=5)
    drawing.name_rows(axes, [constant_words(p.name) for p in lines], (len(lines) - 0.4, -0.6))
    axes.set_xlim(-reach, reach)
    axes.set_xlabel(
        f"correction, in build tolerances (the band of {USUAL:g} tolerances contains 95 % of building errors)"
    )
    return figure
