"""Converts points of an instrument's export to observations, with prism, pose, and joint values of a second file."""

from __future__ import annotations

import csv
import io
import itertools
import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import click
from pydantic import ValidationError

from calibration.rig.columns import LABELS, POSITION, names
from calibration.rig.description import Rig
from calibration.rig.toml import parse_toml, quoted
from calibration.rig.toml_errors import place, reason
from daemon.host.safe_output import write_file
from drivers.errors import DescriptionError
from drivers.files import read_whole
from drivers.stations.export_format import ColumnMap, ExportedFix, refuse
from drivers.stations.exports import export_formats
from drivers.stations.tables.cells import cells_of, lines_of, number_of

FILE_MAX_BYTES = 128 << 20
REPEATED_MM = 10.0  # repeated measurements of one point are closer to each other
MOST_GAP_S = 1.0  # between the joint rows before and after a fix
POSE, TIME_S, TIME = "pose", "time_s", "time"


def read_export(path: Path) -> str:
    """Return the text of an export: UTF-8, UTF-16 with a byte order mark, or Windows code page 1252.

    Raises:
        DescriptionError: the file cannot be read.
    """
    try:
        data = read_whole(path, FILE_MAX_BYTES)
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def read_map(path: Path) -> ColumnMap:
    """Read a map that an import or a person has written.

    Raises:
        DescriptionError: the file cannot be read, or one of its keys is wrong.
    """
    try:
        found = ColumnMap.model_validate(parse_toml(read_whole(path, 1 << 20).decode("utf-8-sig")))
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise DescriptionError(str(path), f"{'.'.join(map(str, place(first)))}: {reason(first, ColumnMap)}") from error
    except ValueError as error:  # not TOML or not UTF-8
        raise DescriptionError(str(path), f"is not a TOML file: {error}") from error
    if found.format not in export_formats():
        raise DescriptionError(str(path), f"format: {found.format!r} is unknown; known: {', '.join(export_formats())}")
    return found


def map_text(columns: ColumnMap, source: str) -> str:
    """Return a map as TOML.

    Args:
        columns: the map.
        source: name of the file that it was made for.
    """
    told = columns.model_dump(exclude_defaults=True)
    lines = [f"# How `rigcal import` read {quoted(source)}. Edit this file, then use it with --map."]
    lines += [f"{key} = {_toml(value)}" for key, value in told.items() if not isinstance(value, dict)]
    for section in ("columns", "prisms"):
        if told.get(section):
            lines += ["", f"[{section}]", *(f"{quoted(key)} = {_toml(value)}" for key, value in told[section].items())]
    return "\n".join(lines) + "\n"


def keep_map(path: Path, columns: ColumnMap, source: str) -> None:
    """Write a map, unless it is there already.

    Args:
        path: where it is kept.
        columns: the map.
        source: name of the file that it was made for.

    Raises:
        click.UsageError: a different map is there, which may have been edited.
        DescriptionError: what is there is no map.
    """
    if not path.is_file():
        write_file(path, map_text(columns, source).encode())
    elif read_map(path) != columns:
        raise click.UsageError(f"{path} describes other columns, perhaps edited: give it with --map, or move it away")


def _toml(value: object) -> str:
    return quoted(value) if isinstance(value, str) else str(value)


# ---- joints ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JointRows:
    """Rows of a file of joint values.

    Attributes:
        source: name of the file.
        columns: columns to add to the observations.
        by_pose: pose -> joint values; empty if the file has no poses.
        times_s: ascending times of the rows, in seconds; empty if the file has no times.
        rows: joint values of each row, in the order of `times_s`.
        max_rates: for each column the largest rate of a revolute joint, deg/s; None for a prismatic joint.
        has_zone: whether the times have a time zone; None if they are not dates.
    """

    source: str
    columns: tuple[str, ...]
    by_pose: Mapping[str, Sequence[float]]
    times_s: Sequence[float]
    rows: Sequence[Sequence[float]]
    max_rates: Sequence[float | None]
    has_zone: bool | None = None

    def of(self, fix: ExportedFix, source: str) -> Sequence[float]:
        """Return the joint values of a fix: those of its pose, or interpolated to its time.

        Args:
            fix: the fix.
            source: name of its file, for error messages.

        Raises:
            DescriptionError: there are no joint values; the error has the line of the fix.
        """
        if self.by_pose:
            if fix.is_numbered:
                said = f"the point has no name, but {self.source} has joint values by {POSE!r}"
                refuse(source, f"{said}; name the column of names 'point', or give it in [columns] of a map", fix.line)
            found = self.by_pose.get(_plain(fix.point))
            if found is None:
                refuse(source, f"{self.source} has no pose {fix.point!r}", fix.line)
            return found
        if fix.time_s is None:
            refuse(source, f"the point has no time, and {self.source} has no column {POSE!r} to match it by", fix.line)
        if self.has_zone is not None and fix.has_zone is (not self.has_zone):
            zoned, bare = (self.source, source) if self.has_zone else (source, self.source)
            said = f"times of {zoned} have a time zone but times of {bare} do not, so they may differ by hours"
            refuse(source, f"{said}; write both in UTC with a Z at the end (2026-11-24T10:00:00Z)", fix.line)
        place = bisect_left(self.times_s, fix.time_s)
        if place < len(self.times_s) and self.times_s[place] == fix.time_s:
            return self.rows[place]
        if not 0 < place < len(self.times_s) or self.times_s[place] - self.times_s[place - 1] > MOST_GAP_S:
            span = f"{self.times_s[0]:.3f} to {self.times_s[-1]:.3f} s"
            reason = f"{self.source} has no rows at most {MOST_GAP_S:g} s apart around {fix.time_s:.3f} s ({span})"
            refuse(source, reason, fix.line)
        before, after = self.times_s[place - 1], self.times_s[place]
        share = (fix.time_s - before) / (after - before)
        pairs = zip(self.rows[place - 1], self.rows[place], self.max_rates, strict=True)
        return [a + share * _step(a, b, after - before, rate) for a, b, rate in pairs]


def read_joints(path: Path, rig: Rig) -> JointRows:
    """Read a file of joint values: a column for each joint as in observations, and `pose`, `time_s` or `time` (ISO).

    Raises:
        DescriptionError: a column is missing, a cell is not a number, or a pose or a time is repeated; the error has
            line and column.
    """
    source = path.name
    lines = lines_of(read_export(path))
    header = cells_of(lines[0], ",")
    joints = tuple(joint.column for joint in rig.joints)
    _check_joint_columns(header, joints, rig, source)
    key = next((name for name in (POSE, TIME_S, TIME) if name in header), None)
    if key is None:
        refuse(
            source, f"needs a column {POSE!r} (name or number of the point), {TIME_S!r} or {TIME!r} to match fixes", 1
        )
    by_pose: dict[str, list[float]] = {}
    timed: dict[float, tuple[int, list[float]]] = {}
    zones: set[bool] = set()
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        cells = cells_of(line, ",")
        if len(cells) != len(header):
            refuse(source, f"has {len(cells)} cells, but the header has {len(header)}", number)
        row = []
        for column in joints:
            value = number_of(cells[header.index(column)], ".")
            if value is None:
                refuse(source, f"{cells[header.index(column)]!r} is not a number", number, column)
            row.append(value)
        cell = cells[header.index(key)]
        if key == POSE:
            if by_pose.setdefault(_plain(cell), row) is not row:
                refuse(source, f"pose {cell!r} is repeated", number, POSE)
        else:
            time_s, has_zone = _seconds(cell, source, number, key)
            zones |= set() if has_zone is None else {has_zone}
            if len(zones) > 1:
                refuse(source, f"{cell!r}: some times have a time zone and some do not; write all in UTC", number, key)
            before, same = timed.setdefault(time_s, (number, row))
            if same != row:
                refuse(source, f"time {cell!r} is in line {before} with different joint values; keep one", number, key)
    if not by_pose and not timed:
        refuse(source, "has no rows below the header")
    times = sorted(timed)
    rates = [joint.max_rate if joint.kind == "revolute" else None for joint in rig.joints]
    return JointRows(source, joints, by_pose, times, [timed[at][1] for at in times], rates, next(iter(zones), None))


def _check_joint_columns(header: Sequence[str], joints: Sequence[str], rig: Rig, source: str) -> None:
    if len(header) == 1:
        refuse(source, "has only one column: separate columns with commas, and use a decimal point", 1)
    for column in joints:
        if header.count(column) != 1:
            problem = "is repeated" if column in header else f"is missing; rig {rig.name!r} needs {', '.join(joints)}"
            refuse(source, f"the column {problem}", 1, column)


def _step(value: float, following: float, seconds: float, max_rate: float | None) -> float:
    """Return a joint's motion between two rows; if its rate is too high, assume a wrap by 360 deg, as from 359 to 1."""
    step = following - value
    if max_rate is None or abs(step) <= max_rate * seconds:
        return step
    return (step + 180.0) % 360.0 - 180.0


def _seconds(cell: str, source: str, line: int, column: str) -> tuple[float, bool | None]:
    """Return the time in a cell in seconds, and whether it has a time zone; None if it is not a date."""
    value = number_of(cell, ".")
    if value is not None:
        return value, None
    try:
        found = datetime.fromisoformat(cell)
    except ValueError:
        refuse(source, f"{cell!r} is neither seconds nor an ISO time", line, column)
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp(), found.tzinfo is not None


def _plain(pose: str) -> str:
    """Return a pose's number without leading zeros, which stations add in their memory."""
    return pose.lstrip("0") or "0" if pose.isdigit() else pose


def far_repetitions(fixes: Sequence[ExportedFix], source: str) -> tuple[str, ...]:
    """Return a note on repeated points at different positions; probably they were measured in different poses."""
    first: dict[tuple[str, str, str], ExportedFix] = {}
    found = []
    for fix in fixes:
        other = first.setdefault((fix.station, fix.target, _plain(fix.point)), fix)
        apart_mm = math.dist(fix.position_mm, other.position_mm)
        if apart_mm > REPEATED_MM:
            found.append(f"{fix.point!r} in lines {other.line} and {fix.line}, {apart_mm:.0f} mm apart")
    if not found:
        return ()
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    return (f"{source} has repeated points at different positions: {'; '.join(found[:3])}{more}; all are used",)


def several_constants(fixes: Sequence[ExportedFix], prisms: Sequence[str], source: str) -> tuple[str, ...]:
    """Return a note on each prism that one station measured with several prism constants.

    Args:
        fixes: in the order of the file.
        prisms: prism of each fix.
        source: name of the file.
    """
    first: dict[tuple[str, str], dict[float, ExportedFix]] = {}
    for fix, prism in zip(fixes, prisms, strict=True):
        if fix.prism_constant_mm is not None:
            constant_mm = round(fix.prism_constant_mm, 1) + 0.0  # stations resolve 0.1 mm; + 0.0 avoids -0
            first.setdefault((prism, fix.station), {}).setdefault(constant_mm, fix)
    notes = []
    for (prism, station), constants in first.items():
        if len(constants) > 1:
            at = f" at {station!r}" if station else ""
            said = [f"{mm:g} mm (from point {fix.point!r}, line {fix.line})" for mm, fix in constants.items()]
            notes.append(
                f"{source} has prism {prism!r}{at} measured with prism constants of {' and '.join(said)}, so its "
                "distances are inconsistent: remove the points with the wrong constant, or name the prisms differently"
            )
    return tuple(notes)


def setup_names(fixes: Sequence[ExportedFix], setup: str) -> dict[str, str]:
    """Return station of the file -> set-up of its rows; if the file has several stations, each has its own set-up.

    Args:
        fixes: in the order of the file.
        setup: name given for all rows; "" if none was given.
    """
    stations = list(dict.fromkeys(fix.station for fix in fixes))
    if len(stations) == 1:
        return {stations[0]: setup}
    blanks = ("-".join(["unnamed", *["0"] * zeros]) for zeros in itertools.count())
    blank = next(name for name in blanks if name not in stations)
    return {station: "-".join(filter(None, (setup, station or blank))) for station in stations}


def several_setups(setups: Mapping[str, str], source: str) -> tuple[str, ...]:
    """Return a note on a file with several stations."""
    if len(setups) < 2:
        return ()
    return (
        f"{source} has {len(setups)} set-ups of the instrument, which the rows have too: "
        f"{', '.join(setups.values())}; each has its own frame",
    )


def repeated_setups(fixes: Sequence[ExportedFix], source: str) -> tuple[str, ...]:
    """Return a note on an instrument that is set up again under the name of an earlier set-up."""
    first: dict[str, int] = {}
    lines: dict[int, tuple[int, str]] = {}
    for fix in fixes:
        if first.setdefault(fix.station, fix.times_set_up) != fix.times_set_up:
            lines.setdefault(fix.times_set_up, (fix.line, fix.station))
    if not lines:
        return ()
    again = [f"before line {line} as {station or 'unnamed'!r}" for line, station in lines.values()]
    more = f" and {len(again) - 3} times more" if len(again) > 3 else ""
    return (
        f"{source} sets the instrument up again under an earlier name: {'; '.join(again[:3])}{more}; all its points "
        "are assigned to one set-up: split the file if the instrument was moved or turned",
    )


def bare_times(fixes: Sequence[ExportedFix], joints: JointRows | None, source: str) -> tuple[str, ...]:
    """Return a note on dates without a time zone, which are taken as UTC."""
    bare = [source] * any(fix.has_zone is False for fix in fixes)
    bare += [joints.source] if joints is not None and joints.has_zone is False else []
    return (f"times of {' and '.join(bare)} have no time zone and are taken as UTC",) if bare else ()


def target_heights(fixes: Sequence[ExportedFix], source: str) -> tuple[str, ...]:
    """Return a note on coordinates that may refer to points below the prism."""
    height_mm = fixes[0].target_height_mm  # a table with different heights is refused
    if not height_mm:
        return ()
    said = (
        f"{source} has target heights of {height_mm:g} mm, so its coordinates may be of points that far below the prism"
    )
    return (f"{said}; they are used unchanged: if that is wrong, export with target heights of 0",)


# ---- observations ----------------------------------------------------------------------------------------------------


def observations_csv(
    fixes: Sequence[ExportedFix],
    prisms: Sequence[str],
    source: str,
    joints: JointRows | None,
    setups: Mapping[str, str],
    session: str,
) -> str:
    """Return the observations CSV of an export's fixes.

    Args:
        fixes: in the order of the file.
        prisms: prism of each fix.
        source: name of the file.
        joints: rows of joint values; None to write no joint columns.
        setups: station of the file -> set-up.
        session: name for all rows; "" for none.

    Raises:
        DescriptionError: a fix has no joint values; the error has its line.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    has_time = any(fix.time_s is not None for fix in fixes)
    has = {"setup": any(setups.values()), "session": session}
    given = [name for name in names(LABELS) if has.get(name)]
    joint_columns = joints.columns if joints is not None else ()
    writer.writerow(["prism", *joint_columns, *names(POSITION), *given, POSE, *([TIME_S] if has_time else [])])
    for fix, prism in zip(fixes, prisms, strict=True):
        values = [] if joints is None else joints.of(fix, source)
        cells = [prism, *map(repr, map(float, values))]
        labels = {"setup": setups[fix.station], "session": session}
        cells += [f"{value:.4f}" for value in fix.position_mm] + [labels[name] for name in given] + [fix.point]
        writer.writerow([*cells, *(["" if fix.time_s is None else repr(fix.time_s)] if has_time else [])])
    return out.getvalue()


def prisms_of(
    fixes: Sequence[ExportedFix], columns: ColumnMap, source: str, rig: Rig | None, prism: str | None
) -> list[str]:
    """Return the prism of each fix.

    Args:
        fixes: in the order of the file.
        columns: map of the file, which may name prisms.
        source: name of the file.
        rig: the rig whose prisms are measured; None to accept any name.
        prism: the prism of all fixes; None to use the file and the map.

    Raises:
        DescriptionError: a fix's prism is unknown; the error has its line.
    """
    return [prism or _prism(fix, columns, source, rig) for fix in fixes]


def _prism(fix: ExportedFix, columns: ColumnMap, source: str, rig: Rig | None) -> str:
    """Return a fix's prism: from the map by its target or point, else its target, else the rig's only prism."""
    found = columns.prisms.get(fix.target) or columns.prisms.get(fix.point) or fix.target
    if rig is None:
        return found or "prism"
    if found in rig.prism_names:
        return found
    if len(rig.prism_names) == 1 and not fix.target:
        return rig.prism_names[0]
    said = f"{fix.target!r}" if fix.target else "no code"
    reason = f"point {fix.point!r} has {said}, which is not a prism of rig {rig.name!r} ({', '.join(rig.prism_names)})"
    refuse(source, f"{reason}; give --prism, or assign it in [prisms] of the map", fix.line)
