"""Style and shared parts of all plots, and figures as SVG, drawn without a display."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from daemon.host.safe_output import shown
from daemon.report.markup import escape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Okabe and Ito's palette: distinguishable with any colour vision, and in grey as well.
BEFORE = "#8c8c8c"
MIDDLE = "#d55e00"
AFTER = "#0072b2"
WARN = "#b3261e"
INK = "#1d2733"
SOFT = "#5b6670"
GRID = "#e3e7ea"

_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#b8c0c6",
    "axes.labelcolor": SOFT,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign in a name is plain text
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "svg.hashsalt": "rigcal",  # the same report gives the same bytes
    "image.cmap": "viridis",
}
# On a dark screen a drawing inverts its neutral colours: paper, ink, lines. A printed page stays light.
_TURNED = {
    "#ffffff": "#14191f",
    "white": "#14191f",
    INK: "#e8ecef",
    "#000000": "#e8ecef",
    SOFT: "#a9b4bd",
    GRID: "#2b343d",
    "#b8c0c6": "#55606b",
    "#eef1f3": "#242c34",
    "#eef4f8": "#1c2731",
    "#e8f1f7": "#1f3040",
    AFTER: "#56b4e9",
    BEFORE: "#9aa3aa",
    WARN: "#ff8a7d",
}
_TURNED_RULES = "".join(
    f'[style*="{kind}: {old}"]{{{kind}:{new} !important}}'
    for old, new in _TURNED.items()
    for kind in ("fill", "stroke")
)
_DARK = f"@media screen and (prefers-color-scheme: dark) {{{_TURNED_RULES}}}"
RASTER_DPI = 150
WIDTH_IN = 9.6
LABEL_CHARACTERS = 60  # maximum length of a name next to an axis
_DOTS_MAX = 4000  # in a map
_ABOVE_IN, _BELOW_IN, _BESIDE_IN = 0.6, 0.5, 0.6  # legend and title; ticks and label of an x axis; of a y axis
FLOOR_MM = 1e-3  # smaller errors are drawn at this value on a logarithmic axis


def styled() -> AbstractContextManager[None]:
    """Return a context in which figures have the report's style.

    The settings are global to the process: only one thread may draw.
    """
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def new_figure(height_in: float) -> Figure:
    """Return an empty figure without a window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def even_grid(lines: int, columns: int, *, line_in: float) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure with room for a legend at the top, and its (lines, columns) axes, which share y.

    The margins are fixed: to compute them for many axes, matplotlib would draw everything a second time.
    """
    from matplotlib.figure import Figure

    height_in = _ABOVE_IN + line_in * lines
    figure = Figure(figsize=(WIDTH_IN, height_in))
    grid = figure.subplots(lines, columns, sharey=True, squeeze=False)
    figure.subplots_adjust(
        left=_BESIDE_IN / WIDTH_IN,
        right=1.0 - 0.1 / WIDTH_IN,
        top=1.0 - _ABOVE_IN / height_in,
        bottom=_BELOW_IN / height_in,
        wspace=0.06,
        hspace=_BELOW_IN / (line_in - _BELOW_IN),
    )
    return figure, grid


def picture(figure: Figure, description: str, caption: str) -> str:
    """Return the HTML of a figure with the drawing embedded, and its caption.

    Args:
        figure: the drawing.
        description: its content in words, for screen readers.
        caption: the text below the drawing.
    """
    out = io.BytesIO()
    figure.savefig(out, format="svg", dpi=RASTER_DPI, metadata={"Date": None, "Creator": None})
    drawn = out.getvalue().replace(b"</style>", _DARK.encode() + b"</style>", 1)
    data = base64.b64encode(drawn).decode("ascii")
    image = f'<img alt="{html.escape(description, quote=True)}" src="data:image/svg+xml;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def plain_log_axis(axes: Axes, which: str = "y") -> None:
    """Set a logarithmic scale with ticks written as plain numbers (0.5, 1, 2, 5, 10, ...)."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axes.yaxis if which == "y" else axes.xaxis
    if which == "y":
        axes.set_yscale("log")
    else:
        axes.set_xscale("log")
    axis.set_major_locator(LogLocator(10, subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def sizes_mm(errors_mm: Floats) -> Floats:
    """Return the (n,) lengths of (n, 3) errors."""
    return np.asarray(np.linalg.norm(errors_mm, axis=1))


def scatter(axes: Axes, x: Floats, y: Floats, colour: str, *, size: float = 7.0, alpha: float = 0.55) -> None:
    """Draw dots without edges."""
    # Many dots are rasterised inside the SVG; a few are drawn as shapes.
    axes.scatter(x, y, s=size, c=colour, alpha=alpha, linewidths=0, rasterized=len(x) > 200)


def key(colour: str, label: str) -> Line2D:
    """Return a legend entry with a dot."""
    from matplotlib.lines import Line2D

    return Line2D([], [], marker="o", linestyle="", color=colour, markersize=5, label=label)


def robust_reach(errors_mm: Floats) -> float:
    """Return the limit of an axis of errors, mm."""
    # Five standard deviations of the bulk: a few gross errors must not flatten everything else.
    reach = 5 * 1.4826 * float(np.median(np.abs(errors_mm)))
    return max(min(reach, 1.05 * float(np.max(np.abs(errors_mm)))), FLOOR_MM)


def running_median(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return increasing positions along (n,) x and the median of (n,) y around each."""
    # Medians of groups with equally many fixes; a joint that did not move has one group.
    order = np.argsort(x, kind="stable")
    groups = np.array_split(order, max(1, min(40, len(x) // 12)))
    middles = np.array([np.median(x[group]) for group in groups])
    keep = np.append(True, np.diff(middles) > 0)
    medians = np.array([np.median(y[group]) for group in groups])
    return middles[keep], medians[keep]


def forward_axis(position_mm: Floats) -> int:
    """Return the axis, x (0) or y (1), along which the machine reaches forward.

    The side view shows this axis horizontally.

    Args:
        position_mm: (n, 3) prism positions in the base frame.
    """
    x, y, _ = np.abs(np.median(position_mm, axis=0))
    return int(y > x)


def views(plan: Axes, side: Axes, forward: int) -> None:
    """Label a plan and a side view in metres, and mark the base's origin."""
    for axes, title, horizontal, vertical in ((plan, "Plan view", "x", "y"), (side, "Side view", "xy"[forward], "z")):
        axes.set_title(title)
        axes.set_xlabel(f"{horizontal}, m")
        axes.set_ylabel(f"{vertical}, m")
        axes.plot(0, 0, marker="+", color=INK, markersize=9)
        axes.set_aspect("equal", adjustable="datalim")


def name_rows(axes: Axes, names: Sequence[str], ends: tuple[float, float], *, size: float | None = None) -> None:
    """Label horizontal bars with names.

    Args:
        axes: axes with bars at 0, 1, 2, ... from the top.
        names: names of the bars; long ones are shortened.
        ends: lower and upper end of the axis.
        size: font size of the names in points; the style's size by default.
    """
    axes.set_yticks(range(len(names)), [shown(name, LABEL_CHARACTERS) for name in names])
    axes.tick_params(axis="y", length=0, labelcolor=INK, labelsize=size)
    axes.set_ylim(*ends)
    axes.grid(False, axis="y")


def dots_and_medians(
    axes: Axes, x: Floats, layers: Sequence[tuple[Floats, str]], limit: float, *, size: float, alpha: float
) -> None:
    """Draw layers of values against x with running medians; outliers appear at the edge.

    Args:
        axes: axes to draw on.
        x: (n,) positions.
        layers: (n,) values and colour of each layer.
        limit: end of the axis of values.
        size: size of a dot.
        alpha: opacity of a dot.
    """
    for values, colour in layers:
        scatter(axes, x, np.clip(values, -limit, limit), colour, size=size, alpha=alpha)
    for values, colour in layers:
        line = running_median(x, values)
        axes.plot(*line, color="white", linewidth=3.2)
        axes.plot(*line, color=colour, linewidth=1.6)
    axes.axhline(0, color=SOFT, linewidth=0.7)
    axes.set_ylim(-limit * 1.05, limit * 1.05)


def map_errors(
    figure: Figure,
    layers: Sequence[tuple[str, Floats]],
    place_mm: Floats,
    forward: int,
    *,
    size: float,
    shrink: float,
    label: str,
) -> None:
    """Draw errors over the work volume from above and from the side, with one colour scale.

    Args:
        figure: an empty figure.
        layers: for each row of views, a word for its titles and the (n,) sizes of the errors in mm.
        place_mm: (n, 3) positions in the base frame.
        forward: horizontal axis of the side view, as `forward_axis` returns it.
        size: size of a dot.
        shrink: length of the colour scale as a share of the figure.
        label: label of the colour scale.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    first = layers[0][1]
    top = min(float(first.max()), 3.0 * float(np.median(first)))  # gross errors must not flatten the rest
    scale = Normalize(0.0, max(top, FLOOR_MM))
    grid = figure.subplots(len(layers), 2, squeeze=False)
    for (word, errors_mm), (plan, side) in zip(layers, grid, strict=True):
        order = np.argsort(errors_mm, kind="stable")[-_DOTS_MAX:]  # the largest on top
        x, y, z = place_mm[order].T / 1000.0
        for axes, horizontal, vertical in ((plan, x, y), (side, (x, y)[forward], z)):
            axes.scatter(
                horizontal, vertical, c=errors_mm[order], s=size, norm=scale, linewidths=0, cmap="viridis_r",
                rasterized=len(order) > 200,
            )  # fmt: skip
        views(plan, side, forward)
        if word:
            plan.set_title(f"Plan view, {word}")
            side.set_title(f"Side view, {word}")
    bar = figure.colorbar(
        ScalarMappable(scale, "viridis_r"), ax=grid.ravel().tolist(), shrink=shrink, pad=0.01, extend="max"
    )
    bar.set_label(label)
    bar.outline.set_visible(False)
