"""Whether what is stored fits together, and fits the truth that the simulator knows."""

from __future__ import annotations

import json
import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from calibration.rig.description import Rig
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S
from tests.soak.losses import Measured, Wire

PLACE_MM = 15.0  # six times the noise of circles, distance and target
JOINT = {"deg": 1.5, "mm": 25.0}  # what zeros and build errors of a machine come to; other poses differ by far more
BEFORE_NS, AFTER_NS = 3 * NS_PER_S, NS_PER_S // 2  # a fix's stamp lies this close to its measurement
JUMP_EDGE_NS = 2 * NS_PER_S
LATE_S = 0.25  # real: what a port's bytes and frames may be read late by, unmarked, where no kernel stamps them


def inconsistencies(reader: Reader) -> list[str]:
    """What does not fit together in a store whose daemon has ended in order."""
    found = [f"integrity_check: {row}" for row in _column(reader, "PRAGMA integrity_check") if row != "ok"]
    found += [f"foreign_key_check: {row}" for row in reader.rows("PRAGMA foreign_key_check")]
    opened = _column(reader, "SELECT id FROM calibration_sessions WHERE state = 'open'")
    if len(opened) > 1:
        found.append(f"{len(opened)} sessions are open: {', '.join(opened)}")
    found += [f"session {row['id']} begins before the one before has ended" for row in reader.rows(_OVERLAPPING)]
    found += [f"{row['n']} observations of session {row['id']}: {row['what']}" for row in reader.rows(_STRAY)]
    undecoded = _column(reader, "SELECT count(*) FROM undecoded_chunks")[0]
    if undecoded:
        found.append(f"{undecoded} chunks are not decoded")
    if _column(reader, "SELECT clean FROM daemon_runs ORDER BY id DESC LIMIT 1") != [1]:
        found.append("the last run has not ended in order")
    return found


def _column(reader: Reader, sql: str) -> list[Any]:
    return [next(iter(row.values())) for row in reader.rows(sql)]


_OVERLAPPING = """SELECT later.id FROM calibration_sessions AS later JOIN calibration_sessions AS earlier
    ON earlier.rowid = later.rowid - 1
    WHERE earlier.ended_monotonic_ns IS NULL OR later.started_monotonic_ns < earlier.ended_monotonic_ns"""
_STRAY = """SELECT s.id, count(*) AS n,
        CASE WHEN o.prism != s.prism THEN 'of prism ' || o.prism ELSE 'outside its time' END AS what
    FROM observations AS o JOIN calibration_sessions AS s ON s.id = o.session_id
    WHERE o.prism != s.prism OR o.monotonic_ns < s.started_monotonic_ns OR o.monotonic_ns >= s.ended_monotonic_ns
    GROUP BY s.id, what"""


def untruths(reader: Reader, rig: Rig, wire: Wire, rate: float) -> tuple[Counter[str], list[str]]:
    """Observations that calibration may use, beside the truth.

    Args:
        reader, rig: of the store.
        wire: what the rig sent and measured.
        rate: simulated seconds per real second: joints that move may be off by what they move while they are read late.

    Returns:
        Fault -> how many observations have it, with their number as `observations`; and some of them in words.
    """
    counts: Counter[str] = Counter()
    examples: list[str] = []
    measured_ns = [m.at_ns for m in wire.measured]
    jumps = _jumps(rig, wire)
    for row in reader.rows("SELECT * FROM observations WHERE excluded IS NULL ORDER BY id"):
        counts["observations"] += 1
        at_ns, place = row["monotonic_ns"], (row["x_mm"], row["y_mm"], row["z_mm"])
        near = wire.measured[bisect_left(measured_ns, at_ns - BEFORE_NS) : bisect_left(measured_ns, at_ns + AFTER_NS)]
        fault = _untruth(
            row["prism"], place, near, json.loads(row["values_json"]), rig, _jumped(jumps, at_ns), LATE_S * rate
        )
        if fault:
            kind, text = fault
            counts[kind] += 1
            if counts[kind] <= 5:
                session = row["session_id"]
                examples.append(f"observation {row['id']} of {session} at {at_ns / NS_PER_S:.2f} s: {text}")
    return counts, examples


def _untruth(
    prism: str,
    place: tuple[float, float, float],
    near: Sequence[Measured],
    values: Mapping[str, float],
    rig: Rig,
    jumped: set[str],
    late_s: float,
) -> tuple[str, str] | None:
    if not near:
        return "never measured", "the station measured nothing near its instant"
    fitting = [m for m in near if math.dist(m.place_mm, place) <= PLACE_MM]
    if not fitting:
        nearest = min(near, key=lambda m: math.dist(m.place_mm, place))
        off_mm = math.dist(nearest.place_mm, place)
        return "wrong place", f"{off_mm:.0f} mm from the nearest place that was measured then ({nearest.target})"
    fitting = [m for m in fitting if m.target == prism]
    if not fitting:
        return "wrong name", f"stored as prism {prism}, the station did not measure that prism then"
    # A prism may stand still while joints beyond it move: any of the instants at which it was there may be the fix's.
    for joint in rig.joints:
        value = values.get(f"{joint.name}_{joint.unit}")
        if value is None or joint.name in jumped:
            continue
        nearest = min(fitting, key=lambda m: abs(m.pose[joint.name] - value))
        off = abs(nearest.pose[joint.name] - value)
        if off > JOINT[joint.unit] + late_s * abs(values.get(f"{joint.name}_rate", 0.0)):
            return (
                "wrong pose",
                f"{joint.name} stored as {value:.2f} {joint.unit}, it stood at {nearest.pose[joint.name]:.2f}",
            )
    return None


def _jumps(rig: Rig, wire: Wire) -> list[tuple[int, str, int]]:
    """When which joint's encoder was shifted, and by how much in all since."""
    names = {channel.node: channel.name for channel in rig.channels if hasattr(channel, "node")}
    totals: Counter[str] = Counter()
    jumps = []
    for at_ns, event in wire.events:
        if event.get("kind") == "preset_jump":
            name = names[int(float(str(event["node"])))]
            totals[name] += int(float(str(event["counts"])))
        elif event.get("kind") == "node_reboot":  # a preset that was not stored is lost
            name = names[int(float(str(event["node"])))]
            totals[name] = 0
        else:
            continue
        jumps.append((at_ns, name, totals[name]))
    return jumps


def _jumped(jumps: Sequence[tuple[int, str, int]], at_ns: int) -> set[str]:
    """Joints whose encoder did not count from its own zero then."""
    totals = {name: total for ns, name, total in jumps if ns <= at_ns}
    edges = {name for ns, name, _ in jumps if abs(ns - at_ns) < JUMP_EDGE_NS}
    return edges | {name for name, total in totals.items() if total}
