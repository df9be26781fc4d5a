"""The plots of a report; each takes tables and returns a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from calibration.rig import Joint
from daemon.plain_text import shown
from daemon.report.drawing import (
    AFTER,
    BEFORE,
    INK,
    LABEL_CHARACTERS,
    MIDDLE,
    SOFT,
    WARN,
    WIDTH_IN,
    new_figure,
    plain_log_axis,
)
from daemon.report.inputs import USUAL, ErrorTable, Floats, ReportInput, Stage
from daemon.report.markup import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.lines import Line2D

_FLOOR_MM = 1e-3  # below this an error has no place on a logarithmic axis
_DOTS_MAX = 4000
_BEFORE_AND_AFTER: tuple[tuple[Stage, str, float], ...] = (("nominal", BEFORE, -0.2), ("hybrid", AFTER, 0.2))


def sizes_mm(errors_mm: Floats) -> Floats:
    """(n,) lengths of (n, 3) errors."""
    return np.asarray(np.linalg.norm(errors_mm, axis=1))


def scatter(axes: Axes, x: Floats, y: Floats, colour: str, *, size: float = 7.0, alpha: float = 0.55) -> None:
    """Dots without edges."""
    # Many dots are drawn as a picture inside the SVG, a few as shapes.
    axes.scatter(x, y, s=size, c=colour, alpha=alpha, linewidths=0, rasterized=len(x) > 200)


def draw_errors_by_prism(axes: Axes, report: ReportInput) -> None:
    """Distribution of the position error per prism, before (nominal) and after (hybrid), on a logarithmic axis."""
    table = report.judged
    labels: list[str] = []
    for place, prism in enumerate(table.prisms):
        rows = table.prism == prism
        for stage, colour, shift in _BEFORE_AND_AFTER:
            norms = np.maximum(sizes_mm(table.errors_mm[stage][rows]), _FLOOR_MM)
            _strip(axes, norms, place + shift, colour)
        labels.append(f"{prism}\n{int(rows.sum())} fixes")
    plain_log_axis(axes)
    axes.axhline(max(report.instrument_mm, _FLOOR_MM), color=INK, linewidth=1, linestyle=(0, (4, 3)))
    axes.set_xticks(range(len(labels)), labels)
    axes.set_xlim(-0.6, len(labels) - 0.4)
    axes.grid(False, axis="x")
    axes.set_ylabel("position error, mm")


def _strip(axes: Axes, norms: Floats, centre: float, colour: str) -> None:
    # Dots beside each other where the distribution is dense: the width says how many, nothing is smoothed away.
    order = np.argsort(norms, kind="stable")
    logs = np.log10(norms[order])
    counts, edges = np.histogram(logs, bins=np.linspace(logs[0], logs[-1] + 1e-9, 26))
    widths = 0.16 * np.sqrt(counts / counts.max())
    which = np.clip(np.digitize(logs, edges) - 1, 0, len(counts) - 1)
    spread = (
        np.arange(len(logs)) * 0.618034 + 0.5
    ) % 1.0 * 2.0 - 1.0  # golden-ratio steps: even, and the same on every run
    scatter(axes, centre + spread * widths[which], norms[order], colour, size=6, alpha=0.5)
    rms = float(np.sqrt(np.mean(norms**2)))
    axes.plot([centre - 0.18, centre + 0.18], [rms, rms], color=INK, linewidth=1.6, solid_capstyle="butt")
    at = (centre + 0.2, rms)
    label = axes.annotate(number(rms), at, va="center", ha="left", fontsize=8, fontweight="bold")
    label.set_bbox({"facecolor": axes.get_facecolor(), "edgecolor": "none", "pad": 0.5})


def errors_by_prism(report: ReportInput) -> Figure:
    """Before and after, per prism."""
    figure = new_figure(3.9)
    axes = figure.add_subplot()
    draw_errors_by_prism(axes, report)
    figure.legend(
        handles=[
            key(BEFORE, "before: drawings (nominal)"),
            key(AFTER, "after: calibrated (hybrid)"),
            _line_key("root mean square", "-", 1.6),
            _line_key("instrument noise", "--", 1.0),
        ],
        loc="outside upper left",
        ncols=4,
    )
    return figure


def key(colour: str, label: str) -> Line2D:
    """A dot for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], marker="o", linestyle="", color=colour, markersize=5, label=label)


def _line_key(label: str, style: Literal["-", "--"], width: float) -> Line2D:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle=style, color=INK, linewidth=width, label=label)


def residual_by_joint(report: ReportInput) -> Figure:
    """What is left, component by component, against each joint: a trend is physics that the model lacks."""
    table = report.judged
    stages: list[tuple[Stage, str, str]] = [("geometric", MIDDLE, "geometric")]
    if not np.array_equal(table.errors_mm["geometric"], table.errors_mm["hybrid"]):
        stages.append(("hybrid", AFTER, "hybrid"))
    limit = max(robust_reach(table.errors_mm[stage]) for stage, _, _ in stages)
    joints = [joint for joint in report.joints if joint.name in table.joints]
    figure = new_figure(0.75 + 1.25 * len(joints))
    grid = figure.subplots(len(joints), 3, sharey=True, squeeze=False)
    for line, joint in enumerate(joints):
        values = table.joints[joint.name]
        for column, component in enumerate("xyz"):
            axes = grid[line, column]
            for stage, colour, _ in stages:
                errors = table.errors_mm[stage][:, column]
                scatter(axes, values, np.clip(errors, -limit, limit), colour, size=7, alpha=0.35)
            for stage, colour, _ in stages:
                line_xy = running_median(values, table.errors_mm[stage][:, column])
                axes.plot(*line_xy, color="white", linewidth=3.2)
                axes.plot(*line_xy, color=colour, linewidth=1.6)
            axes.axhline(0, color=SOFT, linewidth=0.7)
            axes.set_ylim(-limit * 1.05, limit * 1.05)
            if line == 0:
                axes.set_title(f"{component} component")
            if column == 0:
                axes.set_ylabel("mm")
            axes.set_xlabel(f"{joint.name}, {joint.unit}", labelpad=1, color=INK)
    figure.legend(handles=[key(colour, label) for _, colour, label in stages], loc="outside upper left", ncols=2)
    return figure


def robust_reach(errors_mm: Floats) -> float:
    """How far an axis of errors goes."""
    # Five standard deviations of the bulk: a few gross errors must not flatten everything else.
    reach = 5 * 1.4826 * float(np.median(np.abs(errors_mm)))
    return max(min(reach, 1.05 * float(np.max(np.abs(errors_mm)))), _FLOOR_MM)


def running_median(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Places along x, rising, and the median of y about each."""
    # Medians of groups with equally many fixes; a joint that did not move has one.
    order = np.argsort(x, kind="stable")
    groups = np.array_split(order, max(1, min(40, len(x) // 12)))
    middles = np.array([np.median(x[group]) for group in groups])
    keep = np.append(True, np.diff(middles) > 0)
    medians = np.array([np.median(y[group]) for group in groups])
    return middles[keep], medians[keep]


def importance(report: ReportInput, most: int = 10) -> Figure:
    """Features of the learned trees by their share of what the splits gained (Zhou et al. 2022, Fig. 10)."""
    lines = report.importance[:most]
    figure = new_figure(0.7 + 0.27 * len(lines))
    axes = figure.add_subplot()
    shares = [100.0 * share for _, share in lines]
    axes.barh(range(len(lines)), shares, height=0.62, color=AFTER, linewidth=0)
    for place, share in enumerate(shares):
        axes.annotate(f"{number(share, 2)} %", (share, place), (4, 0), textcoords="offset points", va="center")
    axes.set_yticks(range(len(lines)), [shown(name, LABEL_CHARACTERS) for name, _ in lines])
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.set_ylim(len(lines) - 0.4, -0.6)
    axes.set_xlim(0.0, 1.12 * max(shares))
    axes.set_xlabel("share of what the splits gained, %")
    axes.grid(False, axis="y")
    return figure


def joint_coverage(report: ReportInput) -> Figure:
    """Which part of each joint's range the fixes cover."""
    joints: Sequence[Joint] = report.joints
    figure = new_figure(0.7 + 0.42 * len(joints))
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
        axes.annotate(f"{low:g}", (-0.03, place), ha="right", va="center", color=SOFT, fontsize=8)
        axes.annotate(f"{high:g} {joint.unit}", (1.035, place), ha="left", va="center", color=SOFT, fontsize=8)
    axes.set_yticks(range(len(joints)), [joint.name for joint in joints])
    axes.tick_params(axis="y", length=0, labelcolor=INK, pad=34)
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
        return [(report.training, AFTER, 0.0)]
    return [(report.training, AFTER, -0.15), (report.held_out, MIDDLE, 0.15)]


def _set_keys(report: ReportInput) -> list[Line2D]:
    keys = [key(AFTER, f"fitted ({len(report.training)} fixes)")]
    if report.held_out is not None:
        keys.append(key(MIDDLE, f"held out ({len(report.held_out)} fixes)"))
    return keys


def workspace(report: ReportInput) -> Figure:
    """Where the prisms were: plan and side view, in the base frame."""
    figure = new_figure(4.3)
    plan, side = figure.subplots(1, 2)
    forward = forward_axis(report.training.position_mm)
    for table, colour, _ in reversed(_sets(report)):
        x, y, z = table.position_mm.T / 1000.0
        scatter(plan, x, y, colour, size=8)
        scatter(side, (x, y)[forward], z, colour, size=8)
    views(plan, side, forward)
    figure.legend(handles=_set_keys(report), loc="outside upper left", ncols=2)
    return figure


def forward_axis(position_mm: Floats) -> int:
    """Whether a machine with its prisms at (n, 3), base frame, reaches forward along x (0) or y (1).

    Seen from the side that direction runs across the page.
    """
    x, y, _ = np.abs(np.median(position_mm, axis=0))
    return int(y > x)


def views(plan: Axes, side: Axes, forward: int) -> None:
    """Titles, labels and the base of a plan and a side view, m."""
    for axes, title, horizontal, vertical in ((plan, "Plan view", "x", "y"), (side, "Side view", "xy"[forward], "z")):
        axes.set_title(title)
        axes.set_xlabel(f"{horizontal}, m")
        axes.set_ylabel(f"{vertical}, m")
        axes.plot(0, 0, marker="+", color=INK, markersize=9)
        axes.set_aspect("equal", adjustable="datalim")


def draw_error_map(figure: Figure | SubFigure, report: ReportInput) -> None:
    """What is left after calibration, from above and from the side: colour is the size of the error."""
    from matplotlib.colors import Normalize

    table = report.judged
    norms = sizes_mm(table.errors_mm["hybrid"])
    order = np.argsort(norms, kind="stable")[-_DOTS_MAX:]  # the largest on top
    top = min(float(norms.max()), 3 * float(np.median(norms)))  # gross errors must not flatten the rest
    scale = Normalize(0.0, max(top, _FLOOR_MM))
    x, y, z = table.position_mm[order].T / 1000.0
    plan, side = figure.subplots(1, 2)

    forward = forward_axis(report.training.position_mm)

    def dots(axes: Axes, horizontal: Floats, vertical: Floats) -> PathCollection:
        return axes.scatter(
            horizontal,
            vertical,
            c=norms[order],
            s=16,
            norm=scale,
            linewidths=0,
            rasterized=len(order) > 200,
            cmap="viridis_r",
        )

    dots(plan, x, y)
    bar = figure.colorbar(dots(side, (x, y)[forward], z), ax=[plan, side], shrink=0.85, pad=0.01, extend="max")
    bar.set_label("error left, mm")
    bar.outline.set_visible(False)
    views(plan, side, forward)


def error_map(report: ReportInput) -> Figure:
    """The error left after calibration, seen from above and from the side."""
    figure = new_figure(4.1)
    draw_error_map(figure, report)
    return figure


def corrections(report: ReportInput, most: int = 14) -> Figure:
    """The largest corrections in units of their build tolerance, with their 95 % intervals."""
    lines = sorted(report.parameters, key=lambda p: -abs(p.in_tolerances))[:most]
    figure = new_figure(0.75 + 0.26 * len(lines), WIDTH_IN)
    axes = figure.add_subplot()
    reach = max(3.4, *(abs(p.in_tolerances) + 2 * p.sigma / p.tolerance for p in lines)) * 1.05
    axes.axvspan(-USUAL, USUAL, color="#eef4f8", linewidth=0)
    axes.axvline(0, color=SOFT, linewidth=0.8)
    for place, line in enumerate(lines):
        colour = WARN if line.is_beyond_building else MIDDLE if line.is_unusual else AFTER
        half = 2 * line.sigma / line.tolerance
        axes.plot([line.in_tolerances - half, line.in_tolerances + half], [place, place], color=colour, linewidth=2)
        axes.plot(line.in_tolerances, place, "o" if line.determined else "D", color=colour, markersize=5)
    axes.set_yticks(range(len(lines)), [shown(p.name, LABEL_CHARACTERS) for p in lines])
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.set_ylim(len(lines) - 0.4, -0.6)
    axes.set_xlim(-reach, reach)
    axes.set_xlabel(
        f"correction, in build tolerances (the band, {USUAL:g} tolerances, holds 95 % of what building does)"
    )
    axes.grid(False, axis="y")
    return figure
