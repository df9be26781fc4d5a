"""Draws a rig's chain as lines of text, from the side and from above, for terminals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calibration.design.visibility import Bodies
from calibration.observations import Floats

_WIDTH, _HEIGHT = 66, 18  # characters
_ASPECT = 2.0  # a character is twice as high as wide


def sketch(bodies: Bodies, across: Sequence[int]) -> list[str]:
    """Draw a rig's pose on a grid of characters.

    Links are dots, frames at the end of a link with a length are the last digit of their row number, prisms are `*`,
    and the base is `#`.

    Args:
        bodies: the rig in one pose.
        across: axes of the base frame that point to the right and up, such as (0, 2).
    """
    u, v = across
    points = bodies.everything_mm[0][:, (u, v)]
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, 1.0)
    mm = max(float(span[0]) / (_WIDTH - 1), float(span[1]) / ((_HEIGHT - 1) * _ASPECT))
    columns, lines = round(float(span[0]) / mm) + 1, round(float(span[1]) / mm / _ASPECT) + 1
    cells = [[" "] * columns for _ in range(lines)]

    def put(place_mm: Floats, mark: str) -> None:
        x, y = (place_mm[[u, v]] - low) / mm
        cells[lines - 1 - min(lines - 1, round(float(y) / _ASPECT))][min(columns - 1, round(float(x)))] = mark

    for number in bodies.links:
        start, end = bodies.link_mm(number)
        for place in _between(start[0], end[0], mm):
            put(place, ".")
    for number in bodies.links:
        put(bodies.frames_mm[0, number], str(number % 10))
    put(np.zeros(3), "#")
    for place in bodies.prisms_mm[0]:
        put(place, "*")
    return ["".join(line).rstrip() for line in cells]


def _between(start: Floats, end: Floats, step_mm: float) -> Iterator[Floats]:
    steps = max(1, int(np.linalg.norm(end - start) / step_mm * 2.0))
    for share in np.linspace(0.0, 1.0, steps + 1):
        yield start + share * (end - start)
