"""Pose plans, as `rigcal plan` writes them, and the stops of a boom that follows one."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from calibration.rig.description import Rig

APPROACH = {"deg": 3.0, "mm": 50.0}  # from how far a joint comes to a pose that says from which side
MOST_ROWS = 100_000

Stop = tuple[Mapping[str, float], float]  # joint -> deg or mm; how long to stand there, s


def read_plan(path: Path, rig: Rig, dwell_s: float) -> list[Stop]:
    """Read the stops of a plan (CSV; docs/formats.md).

    Args:
        path: the file.
        rig: whose poses they are.
        dwell_s: how long to stand at each, unless a row says longer.

    Raises:
        ValueError: the file is no plan of this rig; the message names the line.
        OSError: it cannot be read.
    """
    stops: list[Stop] = []
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            for line, row in enumerate(csv.DictReader(file, strict=True), start=2):
                if line > MOST_ROWS:
                    raise ValueError(f"more than {MOST_ROWS} lines; split it")
                try:
                    stops += stops_of(rig, [{key: cell for key, cell in row.items() if cell}], dwell_s)
                except ValueError as error:
                    raise ValueError(f"line {line}: {error}") from None
        except (ValueError, csv.Error) as error:  # a file that is no UTF-8 is a ValueError as well
            raise ValueError(f"{path}: {error}") from None
    if not stops:
        raise ValueError(f"{path}: no poses; `rigcal plan --out CSV` writes a plan")
    return stops


def stops_of(rig: Rig, rows: Iterable[Mapping[str, Any]], dwell_s: float) -> list[Stop]:
    """Return the stops for the rows of a pose plan.

    Where a row says from which side a joint comes, the boom first goes to that side of the pose, without a stop. Other
    conditions than that and the dwell are nothing that driving could bring about.

    Args:
        rig: whose poses they are.
        rows: as `rigcal plan` has them.
        dwell_s: how long to stand at each, unless a row says longer.

    Raises:
        ValueError: a row without a number for each joint, or with one beyond its limits.
    """
    stops: list[Stop] = []
    for row in rows:
        try:
            pose = {joint.name: float(row[joint.column]) for joint in rig.joints}
            sides = {joint.name: float(row.get(f"{joint.name}_dir", 0.0)) for joint in rig.joints}
            stand_s = max(dwell_s, float(row.get("dwell_s", 0.0)))
            if not all(map(math.isfinite, (*pose.values(), *sides.values(), stand_s))):
                raise ValueError("not finite")
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"a pose has a number for each of {', '.join(j.column for j in rig.joints)}"
            ) from error
        before = {
            joint.name: min(
                max(pose[joint.name] - sides[joint.name] * APPROACH[joint.unit], joint.limits[0]), joint.limits[1]
            )
            for joint in rig.joints
        }
        beyond = next((j for j in rig.joints if not j.limits[0] <= pose[j.name] <= j.limits[1]), None)
        if beyond is not None:
            raise ValueError(f"{beyond.name} = {pose[beyond.name]:g} {beyond.unit} is beyond its limits")
        if before != pose:
            stops.append((before, 0.0))
        stops.append((pose, stand_s))
    return stops
