"""Reading pose plans written by `rigcal plan`, and the stops of a boom that follows a plan."""

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

APPROACH = {"deg": 3.0, "mm": 50.0}  # length of the approach to a pose with a prescribed direction
MOST_ROWS = 100_000
_CONDITIONS = frozenset({"dwell_s", "payload_kg", "temperature_degC"})

Stop = tuple[Mapping[str, float], float]  # (joint -> deg or mm, standing time in s)


@dataclass(frozen=True)
class PlanRow:
    """A pose of a plan.

    Attributes:
        joints: joint name -> deg or mm.
        conditions: name of another numeric column -> value: `<joint>_dir`, `dwell_s`, `payload_kg`, ...
    """

    joints: Mapping[str, float]
    conditions: Mapping[str, float]


def read_plan(path: Path, rig: Rig, dwell_s: float) -> list[Stop]:
    """Read the stops of a plan (CSV; docs/reference/formats.md).

    Args:
        path: the file.
        rig: the rig of the plan.
        dwell_s: minimum standing time at each pose; a row may set a longer one.

    Raises:
        ValueError: the file is not a plan for this rig; the message names the line.
        OSError: the file cannot be read.
    """
    return [stop for row in plan_rows(path, rig) for stop in _stops(rig, row, dwell_s)]


def plan_rows(path: Path, rig: Rig) -> list[PlanRow]:
    """Read the poses of a plan (CSV; docs/reference/formats.md).

    Args:
        path: the file.
        rig: the rig of the plan.

    Raises:
        ValueError: the file is not a plan for this rig; the message names the line.
        OSError: the file cannot be read.
    """
    rows: list[PlanRow] = []
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            for line, row in enumerate(csv.DictReader(file, strict=True), start=2):
                if line > MOST_ROWS:
                    raise ValueError(f"more than {MOST_ROWS} lines; split the file")
                try:
                    rows.append(_row(rig, {key: cell for key, cell in row.items() if cell}))
                except ValueError as error:
                    raise ValueError(f"line {line}: {error}") from None
        except (ValueError, csv.Error) as error:  # a file that is not UTF-8 also raises ValueError
            raise ValueError(f"{path}: {error}") from None
    if not rows:
        raise ValueError(f"{path}: no poses; `rigcal plan --out CSV` writes a plan")
    return rows


def stops_of(rig: Rig, rows: Iterable[Mapping[str, Any]], dwell_s: float) -> list[Stop]:
    """Return the stops for the rows of a pose plan.

    If a row prescribes the direction of a joint, the boom first goes past the pose to the right side without stopping.
    Other conditions except the dwell are ignored, as driving cannot influence them.

    Args:
        rig: the rig of the plan.
        rows: rows of a plan by `rigcal plan`.
        dwell_s: minimum standing time at each pose; a row may set a longer one.

    Raises:
        ValueError: a row lacks a number for a joint, or a number is beyond the joint's limits.
    """
    return [stop for row in rows for stop in _stops(rig, _row(rig, row), dwell_s)]


def _row(rig: Rig, row: Mapping[str, Any]) -> PlanRow:
    asked = f"a pose needs a number for each of {', '.join(j.column for j in rig.joints)}"
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
    """Return a finite number; ValueError with text `asked` if the value is not one."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        number = float(value)
        if math.isfinite(number):
            return number
    raise ValueError(asked)


def _stops(rig: Rig, row: PlanRow, dwell_s: float) -> list[Stop]:
    """Return the stops for a pose, with an approach before it if the row prescribes a direction."""
    sides = {joint.name: row.conditions.get(f"{joint.name}_dir", 0.0) for joint in rig.joints}
    before = {
        joint.name: min(
            max(row.joints[joint.name] - sides[joint.name] * APPROACH[joint.unit], joint.limits[0]), joint.limits[1]
        )
        for joint in rig.joints
    }
    stop: Stop = (row.joints, max(dwell_s, row.conditions.get("dwell_s", 0.0)))
    return [stop] if before == row.joints else [(before, 0.0), stop]
