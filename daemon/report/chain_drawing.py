"""A rig's chain from above and from the side, as SVG: links with their radii, frames, prisms, base and floor."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from calibration.design.visibility import Bodies, Site
from daemon.report.drawing import AFTER, BEFORE, INK, MIDDLE, SOFT, forward_axis, key, new_figure, styled, views

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POINTS_PER_IN = 72.0
_HEIGHT_IN = 5.2


def chain_svg(poses: Mapping[str, Bodies], at: Site, title: str) -> bytes:
    """Draw a rig in one or two poses.

    Args:
        poses: name of a pose, e.g. `zero pose` -> the machine in that pose.
        at: site with the radii of the links and the floor.
        title: text above the drawing.

    Returns:
        SVG.
    """
    with styled():
        figure = new_figure(_HEIGHT_IN)
        figure.suptitle(title, fontsize=10, fontweight="bold", x=0.01, ha="left")
        plan, side = figure.subplots(1, 2)
        shown = list(poses.values())
        forward = forward_axis(shown[-1].prisms_mm[0])
        for axes, across in ((plan, (0, 1)), (side, (forward, 2))):
            for bodies, colour in zip(shown, (BEFORE, AFTER), strict=False):
                _draw(axes, bodies, across, colour, named=bodies is shown[-1])
        views(plan, side, forward)
        side.axhline(at.floor_mm / 1e3, color=SOFT, linewidth=0.8, linestyle="--")
        handles = [key(colour, name) for name, colour in zip(poses, (BEFORE, AFTER), strict=False)]
        figure.legend(handles=[*handles, key(MIDDLE, "prism")], loc="outside lower right", ncols=len(handles) + 1)
        figure.canvas.draw()
        _thicken(plan, at)
        _thicken(side, at)
        out = io.BytesIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return out.getvalue()


def _draw(axes: Axes, bodies: Bodies, across: Sequence[int], colour: str, *, named: bool) -> None:
    u, v = across
    for number in bodies.links:
        start, end = (ends[0] / 1e3 for ends in bodies.link_mm(number))
        for gid in ("radius", "line"):
            axes.plot(
                (start[u], end[u]), (start[v], end[v]), color=colour, linewidth=1.2,
                alpha=0.18 if gid == "radius" else 1.0, solid_capstyle="round", gid=f"{gid}{number}",
            )  # fmt: skip
    frames, prisms = bodies.frames_mm[0] / 1e3, bodies.prisms_mm[0] / 1e3
    axes.plot(frames[1:, u], frames[1:, v], linestyle="", marker="o", color=colour, markersize=3.5)
    axes.plot(prisms[:, u], prisms[:, v], linestyle="", marker="D", color=MIDDLE, markersize=4.5)
    if named:
        _name(axes, dict(zip(bodies.rig.prism_names, prisms, strict=True)), u, v, MIDDLE)
        _name(axes, {str(n): frames[n] for n in bodies.links}, u, v, INK)


def _name(axes: Axes, places: Mapping[str, Sequence[float]], u: int, v: int, colour: str) -> None:
    """Write names next to places; places with several names get one label."""
    at: dict[tuple[float, float], list[str]] = {}
    for name, place in places.items():
        at.setdefault((round(float(place[u]), 2), round(float(place[v]), 2)), []).append(name)
    for (x, y), names in at.items():
        offset = (5, -9) if colour == MIDDLE else (4, 4)
        axes.annotate(
            ", ".join(names), (x, y), xytext=offset, textcoords="offset points", fontsize=7, color=colour,
            annotation_clip=False,
        )  # fmt: skip


def _thicken(axes: Axes, at: Site) -> None:
    """Set line widths to the radii of the links, once the scale of the axes is final."""
    (left, _), (right, _) = (axes.transData.transform((x, 0.0)) for x in axes.get_xlim())
    low, high = axes.get_xlim()
    points_per_m = (right - left) / (high - low) * _POINTS_PER_IN / axes.figure.dpi
    for line in axes.get_lines():
        gid = line.get_gid() or ""
        if gid.startswith("radius"):
            line.set_linewidth(max(1.2, 2.0 * at.radius_mm(int(gid.removeprefix("radius"))) / 1e3 * points_per_m))
