"""The plots of the gap report; each takes the result of the workflow and returns a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.gap.result import GapResult
from calibration.model.prediction import Predictor
from calibration.observations import Floats
from calibration.pipeline.find_gap import rms
from calibration.rig.description import Joint
from daemon.report import drawing
from daemon.report.calibration.from_model import measured_in_base_mm
from daemon.report.plain_names import joint_words, unit_words
from daemon.report.words import INTERVAL_SIGMAS, PLUS_MINUS, number, signed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND = "#e8f1f7"
_TRACK = "#eef1f3"
_LEAST_LEVER = 0.2  # of a joint's longest lever: a prism nearer to the axis shows little of the joint's error
_LEAST_REACH = 0.02  # of the longest lever of all joints of its kind: fixes show nothing of a shorter one's error
_SIDES = ((-1.0, "\N{DOWNWARDS ARROW}", -0.17), (1.0, "\N{UPWARDS ARROW}", 0.17))  # last change of the reading
_COLUMNS = 3
_VALUES = 0.36  # share of the width for the values in words


@dataclass(frozen=True)
class Stage:
    """A stage of the simulation: its (n, 3) errors in the station's frame, their colour and their label."""

    error_mm: Floats
    colour: str
    label: str


@dataclass(frozen=True)
class Bar:
    """One bar of `steps`: the effect added to the model, and the held-out error in mm."""

    label: str
    rms_mm: float


@dataclass(frozen=True)
class Interval:
    """A coefficient against its hard bounds.

    Attributes:
        label: effect and coefficient.
        value, error: fitted value and its standard error, in `unit`.
        sigma: plausible size (1 sigma).
        lower, upper: hard bounds.
        unit: unit as the reader sees it.
    """

    label: str
    value: float
    error: float
    sigma: float
    lower: float
    upper: float
    unit: str


def stages(gap: GapResult) -> tuple[Stage, ...]:
    """Return the errors of the calibrated kinematics and, if effects were adopted, those with the effects."""
    if not gap.effects:
        return (Stage(gap.error_before_mm, drawing.AFTER, "calibrated kinematics"),)
    return (
        Stage(gap.error_before_mm, drawing.MIDDLE, "before: calibrated kinematics"),
        Stage(gap.error_after_mm, drawing.AFTER, "after: with the effects found"),
    )


def steps(bars: Sequence[Bar], noise_mm: float) -> Figure:
    """Draw the error from calibrated kinematics down towards the noise, one bar per round."""
    figure = drawing.new_figure(0.95 + 0.5 * len(bars))
    axes = figure.add_subplot()
    values = [bar.rms_mm for bar in bars]
    reach = 1.16 * max(*values, noise_mm)
    axes.axvspan(0.0, noise_mm, color=BAND, linewidth=0)
    colours = [drawing.MIDDLE if len(bars) > 1 else drawing.AFTER, *[drawing.AFTER] * (len(bars) - 1)]
    drawn = axes.barh(range(len(bars)), values, height=0.56, color=colours, linewidth=0)
    texts = [f"{number(v)} mm" for v in values]
    for label in axes.bar_label(drawn, labels=texts, padding=4, fontsize=10, fontweight="bold"):
        label.set_bbox({"facecolor": "white", "linewidth": 0, "pad": 1.5})
    axes.axvline(noise_mm, color=drawing.INK, linewidth=1.2, linestyle=(0, (4, 3)))
    axes.annotate(
        f"noise floor {number(noise_mm)} mm",
        (noise_mm, len(bars) - 0.42),
        (5 if noise_mm < 0.55 * reach else -5, -2),
        textcoords="offset points",
        ha="left" if noise_mm < 0.55 * reach else "right",
        va="top",
        color=drawing.INK,
        fontsize=8.5,
    )
    drawing.name_rows(axes, [bar.label for bar in bars], (len(bars) - 0.05, -0.5), size=10)
    axes.set_xlim(0.0, reach)
    axes.set_xlabel("root mean square error, mm")
    return figure


def coefficients(intervals: Sequence[Interval]) -> Figure:
    """Draw every coefficient with its 95 % interval between its hard bounds."""
    figure = drawing.new_figure(0.35 + 0.42 * len(intervals))
    least = min(line.lower / max(abs(line.lower), abs(line.upper)) for line in intervals)
    axes = figure.add_subplot()
    for place, line in enumerate(intervals):
        reach = max(abs(line.lower), abs(line.upper))
        low, high = line.lower / reach, line.upper / reach
        axes.barh(place, high - low, left=low, height=0.5, color=_TRACK, linewidth=0)
        plausible = np.clip([-line.sigma / reach, line.sigma / reach], low, high)
        axes.barh(place, plausible[1] - plausible[0], left=plausible[0], height=0.5, color="#d3e5f1", linewidth=0)
        for bound in (low, high):
            axes.plot([bound, bound], [place - 0.3, place + 0.3], color=drawing.INK, linewidth=1.4)
        half = INTERVAL_SIGMAS * line.error
        beyond = not line.lower <= line.value <= line.upper
        colour = drawing.WARN if beyond else drawing.AFTER
        ends = np.clip([(line.value - half) / reach, (line.value + half) / reach], -1.08, 1.08)
        axes.plot(ends, [place, place], color=colour, linewidth=2.2)
        axes.plot(np.clip(line.value / reach, -1.08, 1.08), place, "o", color=colour, markersize=6)
        text = f"{signed(line.value)} {PLUS_MINUS} {number(half, 2)} {line.unit}"
        axes.annotate(text, (1.13, place), va="center", ha="left", fontsize=9, fontweight="bold", annotation_clip=False)
        for bound, side in ((line.lower, -1), (line.upper, 1)):
            axes.annotate(
                number(bound), (bound / reach, place), (5 * side, 9), textcoords="offset points", fontsize=7.5,
                color=drawing.SOFT, ha="right" if side < 0 else "left", va="bottom",
            )  # fmt: skip
    axes.axvline(0.0, color=drawing.SOFT, linewidth=0.8)
    drawing.name_rows(axes, [line.label for line in intervals], (len(intervals) - 0.4, -0.65))
    axes.set_xlim(least - 0.14, 1.13 + _VALUES / (1.0 - _VALUES) * (1.27 - least))
    axes.set_xticks([])
    axes.grid(False)
    for side_line in axes.spines.values():
        side_line.set_visible(False)
    return figure


def error_maps(gap: GapResult) -> Figure:
    """Draw the error over the work volume before and after, from above and from the side."""
    place_mm = measured_in_base_mm(gap.model, gap.observations)
    sizes = [drawing.sizes_mm(stage.error_mm) for stage in stages(gap)]
    words = ("before", "after") if len(sizes) > 1 else ("",)
    figure = drawing.new_figure(0.4 + 3.6 * len(sizes))
    layers = list(zip(words, sizes, strict=True))
    drawing.map_errors(
        figure, layers, place_mm, drawing.forward_axis(place_mm), size=18, shrink=0.6, label="position error, mm"
    )
    return figure


def by_joint(gap: GapResult) -> Figure:
    """Draw the apparent error of each joint against the joint's own reading."""
    found = apparent(gap)
    joints = [joint for joint in gap.model.rig.joints if joint.name in found]
    lines = -(-len(joints) // _COLUMNS)
    figure = drawing.new_figure(0.55 + 1.75 * lines)
    grid = figure.subplots(lines, _COLUMNS, squeeze=False).ravel()
    for axes, joint in zip(grid, joints, strict=False):
        own = found[joint.name]
        _layers(axes, gap, gap.observations.joints[joint.name][own.rows], own.errors)
        axes.set_title(joint_words(joint))
        axes.set_xlabel(f"reading, {unit_words(joint.unit)}", labelpad=1)
        axes.set_ylabel(_unit(joint), labelpad=1)
    for axes in grid[len(joints) :]:
        axes.set_visible(False)
    _legend(figure, gap)
    return figure


def by_direction(gap: GapResult) -> Figure | None:
    """Draw the mean error of each joint by its direction of approach; None if no joint moved in both directions."""
    found = apparent(gap)
    panels: dict[str, list[tuple[Joint, Apparent, Floats]]] = {}
    for joint in gap.model.rig.joints:
        direction = gap.observations.extra.get(f"{joint.name}_dir")
        if joint.name in found and direction is not None:
            own = found[joint.name]
            sides = direction[own.rows]
            if all((sides == side).sum() > 2 for side, _, _ in _SIDES):
                panels.setdefault(_unit(joint), []).append((joint, own, sides))
    if not panels:
        return None
    figure = drawing.new_figure(2.9)
    grid = figure.subplots(1, len(panels), width_ratios=[len(lines) for lines in panels.values()], squeeze=False)[0]
    for axes, (unit, lines) in zip(grid, panels.items(), strict=True):
        reach = 0.0
        for place, (_, own, sides) in enumerate(lines):
            shifts = np.linspace(-0.06, 0.06, len(own.errors)) if len(own.errors) > 1 else [0.0]
            for errors, stage, shift in zip(own.errors, stages(gap), shifts, strict=True):
                reach = max(reach, _pair(axes, place + float(shift), errors, sides, stage.colour))
        ticks = {place + shift: arrow for place in range(len(lines)) for _, arrow, shift in _SIDES}
        axes.set_xticks(list(ticks), list(ticks.values()))
        for place, (joint, _, _) in enumerate(lines):
            axes.annotate(
                joint.name, (place, 0), (0, -19), xycoords=("data", "axes fraction"), textcoords="offset points",
                ha="center", va="top", color=drawing.INK,
            )  # fmt: skip
        axes.axhline(0, color=drawing.SOFT, linewidth=0.7)
        axes.grid(False, axis="x")
        axes.set_xlim(-0.5, len(lines) - 0.5)
        axes.set_ylim(-1.7 * reach, 1.7 * reach)  # the interval of a joint that moves the prism little may be cut
        axes.set_ylabel(f"mean error, {unit}")
    _legend(figure, gap)
    return figure


def against(gap: GapResult, values: Floats, label: str) -> Figure:
    """Draw the components of the error against (n,) values of a column, NaN where it was not measured."""
    rows = np.flatnonzero(np.isfinite(values))
    figure = drawing.new_figure(2.6)
    grid = figure.subplots(1, 3, sharey=True)
    limit = drawing.robust_reach(gap.error_before_mm)
    for column, (axes, component) in enumerate(zip(grid, "xyz", strict=True)):
        _layers(axes, gap, values[rows], [stage.error_mm[rows, column] for stage in stages(gap)], limit=limit)
        axes.set_title(f"{component} component")
        axes.set_xlabel(label)
    grid[0].set_ylabel("error, mm")
    _legend(figure, gap)
    return figure


def by_prism(gap: GapResult) -> Figure:
    """Draw the root mean square error by prism and by component."""
    masks = {prism: gap.observations.prism == prism for prism in np.unique(gap.observations.prism).tolist()}
    figure = drawing.new_figure(0.85 + 0.42 * max(len(masks), 3))
    left, right = figure.subplots(1, 2)
    labels = [f"{prism} ({int(rows.sum())} fixes)" for prism, rows in masks.items()]
    _bars(left, gap, labels, [[rms(stage.error_mm[rows]) for rows in masks.values()] for stage in stages(gap)])
    left.set_title("By prism")
    components = [np.sqrt((stage.error_mm**2).mean(axis=0)).tolist() for stage in stages(gap)]
    _bars(right, gap, ["x (east)", "y (north)", "z (up)"], components)
    right.set_title("By component, in the station's frame")
    _legend(figure, gap)
    return figure


@dataclass(frozen=True)
class Apparent:
    """The error that a joint alone would need to explain all errors, in rows where it moves the prism enough.

    Attributes:
        rows: indices of these rows.
        errors: (rows,) errors of each stage, mrad or mm.
    """

    rows: NDArray[np.intp]
    errors: tuple[Floats, ...]


def apparent(gap: GapResult) -> Mapping[str, Apparent]:
    """Return each joint's apparent error: least squares of the error along the prism motion that the joint causes."""
    jacobian = Predictor.of(gap.model).linearise(gap.observations).joint_jacobian
    lengths = np.linalg.norm(jacobian, axis=1)  # mm per deg or mm
    kinds = np.array([joint.kind for joint in gap.model.rig.joints])
    found: dict[str, Apparent] = {}
    for index, joint in enumerate(gap.model.rig.joints):
        lever, length = jacobian[:, :, index], lengths[:, index]
        least = max(
            _LEAST_LEVER * float(length.max(initial=0.0)),
            _LEAST_REACH * float(lengths[:, kinds == joint.kind].max(initial=0.0)),
        )
        rows = np.flatnonzero(length > least)
        if len(rows) < 2:
            continue
        scale = 1000.0 * np.pi / 180.0 if joint.kind == "revolute" else 1.0
        along = scale * lever[rows] / length[rows, None] ** 2
        found[joint.name] = Apparent(rows, tuple((s.error_mm[rows] * along).sum(axis=1) for s in stages(gap)))
    return found


def _layers(axes: Axes, gap: GapResult, x: Floats, errors: Sequence[Floats], *, limit: float | None = None) -> None:
    """Draw the errors of each stage against x with running medians."""
    limit = drawing.robust_reach(errors[0][:, None]) if limit is None else limit
    layers = [(values, stage.colour) for values, stage in zip(errors, stages(gap), strict=True)]
    drawing.dots_and_medians(axes, x, layers, limit, size=6, alpha=0.3)


def _pair(axes: Axes, place: float, errors: Floats, sides: Floats, colour: str) -> float:
    """Draw the mean and its 95 % interval by side, joined by a line; return the largest mean."""
    middles = []
    for side, _, shift in _SIDES:
        own = errors[sides == side]
        middles.append(float(np.mean(own)))
        half = INTERVAL_SIGMAS * float(np.std(own, ddof=1)) / np.sqrt(len(own))
        axes.errorbar(place + shift, middles[-1], half, color=colour, marker="o", markersize=4, linewidth=1.4)
    axes.plot([place + shift for _, _, shift in _SIDES], middles, color=colour, linewidth=1.2, alpha=0.6)
    return max(map(abs, middles))


def _bars(axes: Axes, gap: GapResult, labels: Sequence[str], values: Sequence[Sequence[float]]) -> None:
    height = 0.68 / len(values)
    for order, (layer, stage) in enumerate(zip(values, stages(gap), strict=True)):
        places = np.arange(len(labels)) + height * (order - (len(values) - 1) / 2.0)
        drawn = axes.barh(places, layer, height=0.9 * height, color=stage.colour, linewidth=0)
        axes.bar_label(drawn, labels=[number(v) for v in layer], padding=3, fontsize=8)
    drawing.name_rows(axes, labels, (len(labels) - 0.45, -0.55))
    axes.set_xlim(0.0, 1.15 * max(max(layer) for layer in values))
    axes.set_xlabel("root mean square error, mm")


def _legend(figure: Figure, gap: GapResult) -> None:
    figure.legend(
        handles=[drawing.key(stage.colour, stage.label) for stage in stages(gap)], loc="outside upper left", ncols=2
    )


def _unit(joint: Joint) -> str:
    return "milliradians" if joint.kind == "revolute" else "mm"
