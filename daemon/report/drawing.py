"""How every plot of a report looks, and how a figure becomes bytes; drawn on Agg and SVG canvases, with no display."""

from __future__ import annotations

import base64
import html
import io
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart by readers with any colour vision, and apart in grey as well.
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
    "text.parse_math": False,  # a dollar sign in a name is a dollar sign
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
RASTER_DPI = 150
WIDTH_IN = 9.6
LABEL_CHARACTERS = 60  # of a name beside an axis
MINUS = "\N{MINUS SIGN}"


def styled() -> AbstractContextManager[None]:
    """A context in which figures have the report's look; settings are the process's, so one thread draws."""
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure that belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def svg_image(figure: Figure, description: str) -> str:
    """An `<img>` element that holds the figure itself; `description` is read out to those who cannot see it."""
    out = io.BytesIO()
    figure.savefig(out, format="svg", dpi=RASTER_DPI, metadata={"Date": None, "Creator": None})
    data = base64.b64encode(out.getvalue()).decode("ascii")
    return f'<img alt="{html.escape(description, quote=True)}" src="data:image/svg+xml;base64,{data}">'


def png_bytes(figure: Figure, dpi: int = 150) -> bytes:
    """The figure as a PNG file."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, metadata={"Software": None})
    return out.getvalue()


def plain_log_axis(axes: Axes, which: str = "y") -> None:
    """Logarithmic scale with ticks written as plain numbers (0.5, 1, 2, 5, 10, ...)."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axes.yaxis if which == "y" else axes.xaxis
    if which == "y":
        axes.set_yscale("log")
    else:
        axes.set_xscale("log")
    axis.set_major_locator(LogLocator(10, subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
