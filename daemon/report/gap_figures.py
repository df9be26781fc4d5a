"""The plots of the gap workflow's report; each takes its answer and returns a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.gap.result import Gap
from calibration.gap.workflow import rms
from calibration.observations import Floats
from calibration.rig import Joint
from daemon.plain_text import shown
from daemon.report.drawing import AFTER, INK, LABEL_CHARACTERS, MIDDLE, SOFT, WARN, new_figure
from daemon.report.figures import forward_axis, key, robust_reach, running_median, scatter, sizes_mm, views
from daemon.report.markup import number, signed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND = "#e8f1f7"
_TRACK = "#eef1f3"
_LEAST_LEVER = 0.2  # of a joint's longest: what is nearer its axis says little of it
_LEAST_REACH = 0.02  # of the longest of all joints of its kind: one that hardly moves the prism says nothing
_SIDES = ((-1.0, "\N{DOWNWARDS ARROW}", -0.17), (1.0, "\N{UPWARDS ARROW}", 0.17))  # what the reading did last
_COLUMNS = 3
_VALUES = 0.36  # of the width, for the values in words
_CHANCE = 2.0  # standard errors of an interval


@dataclass(frozen=True)
class Stage:
    """A stage of the simulation: its (n, 3) errors in the station's frame, and how they are drawn."""

    error_mm: Floats
    colour: str
    label: str


@dataclass(frozen=True)
class Bar:
    """One step of the way down to the noise: what the model had by then, and the held-out error in mm."""

    label: str
    rms_mm: float


@dataclass(frozen=True)
class Interval:
    """A coefficient against its hard bounds.

    Attributes:
        label: effect and coefficient.
        value, error: in `unit`, one standard error.
        sigma: plausible size.
        lower, upper: bounds.
        unit: for people.
    """

    label: str
    value: float
    error: float
    sigma: float
    lower: float
    upper: float
    unit: str


def stages(gap: Gap) -> tuple[Stage, ...]:
    """Calibrated kinematics, and where effects were adopted the same with them."""
    if not gap.effects:
        return (Stage(gap.error_before_mm, AFTER, "calibrated kinematics"),)
    return (
        Stage(gap.error_before_mm, MIDDLE, "before: calibrated kinematics"),
        Stage(gap.error_after_mm, AFTER, "after: with the effects found"),
    )


def steps(bars: Sequence[Bar], noise_mm: float) -> Figure:
    """The error from calibrated kinematics down towards the noise, a bar a round."""
    figure = new_figure(0.95 + 0.5 * len(bars))
    axes = figure.add_subplot()
    values = [bar.rms_mm for bar in bars]
    reach = 1.16 * max(*values, noise_mm)
    axes.axvspan(0.0, noise_mm, color=BAND, linewidth=0)
    colours = [MIDDLE if len(bars) > 1 else AFTER, *[AFTER] * (len(bars) - 1)]
    drawn = axes.barh(range(len(bars)), values, height=0.56, color=colours, linewidth=0)
    texts = [f"{number(v)} mm" for v in values]
    for label in axes.bar_label(drawn, labels=texts, padding=4, fontsize=10, fontweight="bold"):
        label.set_bbox({"facecolor": "white", "linewidth": 0, "pad": 1.5})
    axes.axvline(noise_mm, color=INK, linewidth=1.2, linestyle=(0, (4, 3)))
    axes.annotate(
        f"noise floor {number(noise_mm)} mm",
        (noise_mm, len(bars) - 0.42),
        (5 if noise_mm < 0.55 * reach else -5, -2),
        textcoords="offset points",
        ha="left" if noise_mm < 0.55 * reach else "right",
        va="top",
        color=INK,
        fontsize=8.5,
    )
    axes.set_yticks(range(len(bars)), [shown(bar.label, LABEL_CHARACTERS) for bar in bars])
    axes.tick_params(axis="y", length=0, labelcolor=INK, labelsize=10)
    axes.set_ylim(len(bars) - 0.05, -0.5)
    axes.set_xlim(0.0, reach)
    axes.set_xlabel("root mean square error, mm")
    axes.grid(False, axis="y")
    return figure


def coefficients(intervals: Sequence[Interval]) -> Figure:
    """Every coefficient with its 95 % interval, on the way from one hard bound to the other."""
    figure = new_figure(0.35 + 0.42 * len(intervals))
    least = min(line.lower / max(abs(line.lower), abs(line.upper)) for line in intervals)
    axes = figure.add_subplot()
    for place, line in enumerate(intervals):
        reach = max(abs(line.lower), abs(line.upper))
        low, high = line.lower / reach, line.upper / reach
        axes.barh(place, high - low, left=low, height=0.5, color=_TRACK, linewidth=0)
        plausible = np.clip([-line.sigma / reach, line.sigma / reach], low, high)
        axes.barh(place, plausible[1] - plausible[0], left=plausible[0], height=0.5, color="#d3e5f1", linewidth=0)
        for bound in (low, high):
            axes.plot([bound, bound], [place - 0.3, place + 0.3], color=INK, linewidth=1.4)
        half = _CHANCE * line.error
        beyond = not line.lower <= line.value <= line.upper
        colour = WARN if beyond else AFTER
        ends = np.clip([(line.value - half) / reach, (line.value + half) / reach], -1.08, 1.08)
        axes.plot(ends, [place, place], color=colour, linewidth=2.2)
        axes.plot(np.clip(line.value / reach, -1.08, 1.08), place, "o", color=colour, markersize=6)
        text = f"{signed(line.value)} \N{PLUS-MINUS SIGN} {number(half, 2)} {line.unit}"
        axes.annotate(text, (1.13, place), va="center", ha="left", fontsize=9, fontweight="bold", annotation_clip=False)
        for bound, side in ((line.lower, -1), (line.upper, 1)):
            axes.annotate(
                number(bound), (bound / reach, place), (5 * side, 9), textcoords="offset points", fontsize=7.5,
                color=SOFT, ha="right" if side < 0 else "left", va="bottom",
            )  # fmt: skip
    axes.axvline(0.0, color=SOFT, linewidth=0.8)
    axes.set_yticks(range(len(intervals)), [shown(line.label, LABEL_CHARACTERS) for line in intervals])
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.set_ylim(len(intervals) - 0.4, -0.65)
    axes.set_xlim(least - 0.14, 1.13 + _VALUES / (1.0 - _VALUES) * (1.27 - least))
    axes.set_xticks([])
    axes.grid(False)
    for side_line in axes.spines.values():
        side_line.set_visible(False)
    return figure


def error_maps(gap: Gap) -> Figure:
    """Error over the work volume before and after, from above and from the side, on one scale of colours."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    place_m = in_base_mm(gap) / 1000.0
    forward = forward_axis(place_m)
    layers = [sizes_mm(stage.error_mm) for stage in stages(gap)]
    scale = Normalize(0.0, max(min(float(layers[0].max()), 3.0 * float(np.median(layers[0]))), 1e-3))
    figure = new_figure(0.4 + 3.6 * len(layers))
    grid = figure.subplots(len(layers), 2, squeeze=False)
    for line, size in enumerate(layers):
        order = np.argsort(size, kind="stable")  # the largest on top
        x, y, z = place_m[order].T
        plan, side = grid[line]
        for axes, horizontal, vertical in ((plan, x, y), (side, (x, y)[forward], z)):
            axes.scatter(
                horizontal, vertical, c=size[order], s=18, norm=scale, linewidths=0, cmap="viridis_r",
                rasterized=len(order) > 200,
            )  # fmt: skip
        views(plan, side, forward)
        if len(layers) > 1:
            plan.set_title(f"Plan view, {('before', 'after')[line]}")
            side.set_title(f"Side view, {('before', 'after')[line]}")
    bar = figure.colorbar(
        ScalarMappable(scale, "viridis_r"), ax=grid.ravel().tolist(), shrink=0.6, pad=0.01, extend="max"
    )
    bar.set_label("position error, mm")
    bar.outline.set_visible(False)
    return figure


def by_joint(gap: Gap) -> Figure:
    """Error as each joint alone would have to make it, against the joint's own reading."""
    found = apparent(gap)
    joints = [joint for joint in gap.model.rig.joints if joint.name in found]
    lines = -(-len(joints) // _COLUMNS)
    figure = new_figure(0.55 + 1.75 * lines)
    grid = figure.subplots(lines, _COLUMNS, squeeze=False).ravel()
    for axes, joint in zip(grid, joints, strict=False):
        own = found[joint.name]
        _layers(axes, gap, gap.observations.joints[joint.name][own.rows], own.errors)
        axes.set_title(joint.name)
        axes.set_xlabel(f"reading, {joint.unit}", labelpad=1)
        axes.set_ylabel(_unit(joint), labelpad=1)
    for axes in grid[len(joints) :]:
        axes.set_visible(False)
    _legend(figure, gap)
    return figure


def by_direction(gap: Gap) -> Figure | None:
    """Mean error of each joint by the side from which it came; None where no joint came from both."""
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
    figure = new_figure(2.9)
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
                ha="center", va="top", color=INK,
            )  # fmt: skip
        axes.axhline(0, color=SOFT, linewidth=0.7)
        axes.grid(False, axis="x")
        axes.set_xlim(-0.5, len(lines) - 0.5)
        axes.set_ylim(-1.7 * reach, 1.7 * reach)  # the interval of a joint that moves the prism little may be cut
        axes.set_ylabel(f"mean error, {unit}")
    _legend(figure, gap)
    return figure


def against(gap: Gap, values: Floats, label: str) -> Figure:
    """The components of the error against (n,) values of a column, NaN where it was not measured."""
    rows = np.flatnonzero(np.isfinite(values))
    figure = new_figure(2.6)
    grid = figure.subplots(1, 3, sharey=True)
    limit = robust_reach(gap.error_before_mm)
    for column, (axes, component) in enumerate(zip(grid, "xyz", strict=True)):
        _layers(axes, gap, values[rows], [stage.error_mm[rows, column] for stage in stages(gap)], limit=limit)
        axes.set_title(f"{component} component")
        axes.set_xlabel(label)
    grid[0].set_ylabel("error, mm")
    _legend(figure, gap)
    return figure


def by_prism(gap: Gap) -> Figure:
    """Root mean square error by prism and by component."""
    masks = {prism: gap.observations.prism == prism for prism in np.unique(gap.observations.prism).tolist()}
    figure = new_figure(0.85 + 0.42 * max(len(masks), 3))
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
    """What a joint would have to err by to make the errors seen, in rows where the prism is far from its axis.

    Attributes:
        rows: index of them.
        errors: of each stage, (rows,) mrad or mm.
    """

    rows: NDArray[np.intp]
    errors: tuple[Floats, ...]


def apparent(gap: Gap) -> Mapping[str, Apparent]:
    """The apparent error of every joint that moves a prism: the least-squares share of the error along its motion."""
    jacobian = gap.model.linearise(gap.observations)[0].joint_jacobian
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


def in_base_mm(gap: Gap) -> Floats:
    """(n, 3) measured positions in the rig's base frame."""
    chain, model, observations = gap.model.chain, gap.model, gap.observations
    origin = np.array([chain.base(model.values, s).translation_mm for s in range(len(chain.setups))])
    return model.to_base(observations, observations.position_mm - origin[chain.bind(observations).setup])


def _layers(axes: Axes, gap: Gap, x: Floats, errors: Sequence[Floats], *, limit: float | None = None) -> None:
    """Dots and running medians of each stage's errors; what is beyond the axis is drawn at its edge."""
    limit = robust_reach(errors[0][:, None]) if limit is None else limit
    drawn = list(zip(errors, stages(gap), strict=True))
    for values, stage in drawn:
        scatter(axes, x, np.clip(values, -limit, limit), stage.colour, size=6, alpha=0.3)
    for values, stage in drawn:
        line = running_median(x, values)
        axes.plot(*line, color="white", linewidth=3.2)
        axes.plot(*line, color=stage.colour, linewidth=1.6)
    axes.axhline(0, color=SOFT, linewidth=0.7)
    axes.set_ylim(-1.05 * limit, 1.05 * limit)


def _pair(axes: Axes, place: float, errors: Floats, sides: Floats, colour: str) -> float:
    """Mean and its 95 % interval by side, joined by a line; the largest mean."""
    middles = []
    for side, _, shift in _SIDES:
        own = errors[sides == side]
        middles.append(float(np.mean(own)))
        half = _CHANCE * float(np.std(own, ddof=1)) / np.sqrt(len(own))
        axes.errorbar(place + shift, middles[-1], half, color=colour, marker="o", markersize=4, linewidth=1.4)
    axes.plot([place + shift for _, _, shift in _SIDES], middles, color=colour, linewidth=1.2, alpha=0.6)
    return max(map(abs, middles))


def _bars(axes: Axes, gap: Gap, labels: Sequence[str], values: Sequence[Sequence[float]]) -> None:
    height = 0.68 / len(values)
    for order, (layer, stage) in enumerate(zip(values, stages(gap), strict=True)):
        places = np.arange(len(labels)) + height * (order - (len(values) - 1) / 2.0)
        drawn = axes.barh(places, layer, height=0.9 * height, color=stage.colour, linewidth=0)
        axes.bar_label(drawn, labels=[number(v) for v in layer], padding=3, fontsize=8)
    axes.set_yticks(range(len(labels)), list(labels))
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.set_ylim(len(labels) - 0.45, -0.55)
    axes.set_xlim(0.0, 1.15 * max(max(layer) for layer in values))
    axes.set_xlabel("root mean square error, mm")
    axes.grid(False, axis="y")


def _legend(figure: Figure, gap: Gap) -> None:
    figure.legend(handles=[key(stage.colour, stage.label) for stage in stages(gap)], loc="outside upper left", ncols=2)


def _unit(joint: Joint) -> str:
    return "mrad" if joint.kind == "revolute" else "mm"
