"""Poses of a session before, between and after its shots of control points.

The queries read the observations of a range of time by their index, and end early, because a session may contain
hundreds of thousands of observations and acquisition waits while it is closed.
"""

from __future__ import annotations

import math
from itertools import pairwise

from daemon.store.rows import RowSource

Place = tuple[int, int]  # row of a boot, and ns of its monotonic clock; places sort in order of time

_FIRST: Place = (0, -(2**63))
_LAST: Place = (2**63 - 1, 2**63 - 1)
_ALL = -1  # as a limit of rows
_SHOTS = "SELECT name, phase, boot_id, monotonic_ns FROM control_shots WHERE session_id = ?"
# While the boom moves, each observation counts as one pose.
POSES = """SELECT DISTINCT coalesce(pose, id) AS pose FROM observations WHERE session_id = ? AND excluded IS NULL
    AND (boot_id, monotonic_ns) >= (?, ?) AND (boot_id, monotonic_ns) < (?, ?) LIMIT ?"""


def has_poses(source: RowSource, session_id: str) -> bool:
    """Return True if a session has a pose that can be used."""
    return bool(_poses(source, session_id, (_FIRST, _LAST), 1))


def has_poses_before_enclosed(source: RowSource, session_id: str) -> bool:
    """Return True if a pose follows the first shot but precedes all shots of points shot again at the end."""
    first = min(_shots(source, session_id, "start").values())
    enclosed = _enclosed(source, session_id)
    return bool(enclosed) and bool(_poses(source, session_id, (_after(first), enclosed[0][0]), 1))


def is_enclosed(source: RowSource, session_id: str, least: float) -> bool:
    """Return True if enough of a session's poses lie between two shots of a control point.

    Args:
        source: the store.
        session_id: the session.
        least: smallest share of the poses, less than 1.
    """
    spans = _enclosed(source, session_id)
    edges = [_FIRST, *(edge for span in spans for edge in span), _LAST]
    outside: set[str | int] = set()
    for span in [*pairwise(edges)][::2]:
        outside |= _poses(source, session_id, span, _ALL)
    odds = least / (1 - least)
    wanted = math.ceil(odds * len(outside))  # so many are enough in any case
    enclosed: set[str | int] = set()
    for span in spans:
        enclosed |= _poses(source, session_id, span, wanted)
    return len(enclosed) >= wanted or len(enclosed) >= odds * len(outside - enclosed)


def _poses(source: RowSource, session_id: str, span: tuple[Place, Place], most: int) -> set[str | int]:
    """Return at most so many poses in a span of time, its end excluded."""
    begin, end = span
    return {row["pose"] for row in source.rows(POSES, (session_id, *begin, *end, most))}


def _enclosed(source: RowSource, session_id: str) -> list[tuple[Place, Place]]:
    """Return the spans between the first shot of a point at the start and its last at the end, merged, in order."""
    starts, ends = _shots(source, session_id, "start"), _shots(source, session_id, "end")
    spans: list[tuple[Place, Place]] = []
    for begin, end in sorted((_after(starts[name]), ends[name]) for name in starts.keys() & ends.keys()):
        if spans and begin <= spans[-1][1]:
            spans[-1] = spans[-1][0], max(spans[-1][1], end)
        elif begin < end:
            spans.append((begin, end))
    return spans


def _shots(source: RowSource, session_id: str, phase: str) -> dict[str, Place]:
    """Return the control points of a phase -> their first shot of the start, or their last shot of the end."""
    found: dict[str, Place] = {}
    nearest = min if phase == "start" else max
    for row in source.rows(_SHOTS, (session_id,)):
        if row["phase"] == phase:
            place = row["boot_id"], row["monotonic_ns"]
            found[row["name"]] = nearest(place, found.get(row["name"], place))
    return found


def _after(place: Place) -> Place:
    return place[0], place[1] + 1
