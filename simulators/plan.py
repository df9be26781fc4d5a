"""Pose plans, as `rigcal plan` writes them, and the stops of a boom that follows one."""

from __future__ import annotations

import contextlib
import csv
import math
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.rig.description import Rig

APPROACH = {"deg": 3.0, "mm": 50.0}  # from how far a joint comes to a pose that says from which side
MOST_ROWS = 100_000
_CONDITIONS = frozenset({"dwell_s", "payload_kg", "temperature_degC"})

Stop = tuple[Mapping[str, float], float]  # joint -> deg or mm; how long to stand there, s


@dataclass(frozen=True)
class PlanRow:
    """A pose of a plan.

    Attributes:
        joints: joint name -> deg or mm.
        conditions: other columns of numbers -> value: `<joint>_dir`, `dwell_s`, `payload_kg`, ...
    """

    joints: Mapping[str, float]
    conditions: Mapping[str, float]


def read_plan(path: Path, rig: Rig, dwell_s: float) -> list[Stop]:
    """Read the stops of a plan (CSV; docs/reference/formats.md).

    Args:
        path: the file.
        rig: whose poses they are.
        dwell_s: how long to stand at each, unless a row says longer.

    Raises:
        ValueError: the file is no plan of this rig; the message names the line.
        OSError: it cannot be read.
    """
    return [stop for row in plan_rows(path, rig) for stop in _stops(rig, row, dwell_s)]


def plan_rows(path: Path, rig: Rig) -> list[PlanRow]:
    """Read the poses of a plan (CSV; docs/reference/formats.md).

    Args:
        path: the file.
        rig: whose poses they are.

    Raises:
        ValueError: the file is no plan of this rig; the message names the line.
        OSError: it cannot be read.
    """
    rows: list[PlanRow] = []
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            for line, row in enumerate(csv.DictReader(file, strict=True), start=2):
                if line > MOST_ROWS:
                    raise ValueError(f"more than {MOST_ROWS} lines; split it")
                try:
                    rows.append(_row(rig, {key: cell for key, cell in row.items() if cell}))
                except ValueError as error:
                    raise ValueError(f"line {line}: {error}") from None
        except (ValueError, csv.Error) as error:  # a file that is no UTF-8 is a ValueError as well
            raise ValueError(f"{path}: {error}") from None
    if not rows:
        raise ValueError(f"{path}: no poses; `rigcal plan --out CSV` writes a plan")
    return rows


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
    return [stop for row in rows for stop in _stops(rig, _row(rig, row), dwell_s)]


def _row(rig: Rig, row: Mapping[str, Any]) -> PlanRow:
    asked = f"a pose has a number for each of {', '.join(j.column for j in rig.joints)}"
    joints = {joint.name: _finite(row.get(joint.column), asked) for joint in rig.joints}
    known = {*row} & {*(f"{joint.name}_dir" for joint in rig.joints), *_CONDITIONS}
    conditions = {
        name: _finite(row[name], f"{asked}, and for its conditions; {name} is {reprlib.repr(row[name])}")
        for name in known
    }
    beyond = next((j for j in rig.joints if not j.limits[0] <= joints[j.name] <= j.limits[1]), None)
    if beyond is not None:
        raise ValueError(f"{beyond.name} = {joints[beyond.name]:g} {beyond.unit} is beyond its limits")
    return PlanRow(joints, conditions)


def _finite(value: Any, asked: str) -> float:
    """Return a finite number; ValueError says what was asked for."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        number = float(value)
        if math.isfinite(number):
            return number
    raise ValueError(asked)


def _stops(rig: Rig, row: PlanRow, dwell_s: float) -> list[Stop]:
    """Return the way to a pose: past it first, where it says from which side to come."""
    sides = {joint.name: row.conditions.get(f"{joint.name}_dir", 0.0) for joint in rig.joints}
    before = {
        joint.name: min(
            max(row.joints[joint.name] - sides[joint.name] * APPROACH[joint.unit], joint.limits[0]), joint.limits[1]
        )
        for joint in rig.joints
    }
    stop: Stop = (row.joints, max(dwell_s, row.conditions.get("dwell_s", 0.0)))
    return [stop] if before == row.joints else [(before, 0.0), stop]
