"""Points of an instrument's export as observations: each with its prism, its pose, and the joints of a second file."""

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

from pydantic import ValidationError

from calibration.rig.columns import LABELS, POSITION, names
from calibration.rig.description import Rig
from calibration.rig.toml import parse_toml, quoted
from calibration.rig.toml_errors import place, reason
from drivers.errors import DescriptionError
from drivers.files import read_whole
from drivers.stations.export_format import ColumnMap, ExportedFix, refuse
from drivers.stations.exports import export_formats
from drivers.stations.tables.cells import cells_of, lines_of, number_of

FILE_MAX_BYTES = 128 << 20
REPEATED_MM = 10.0  # a point that is measured again is nearer to itself
MOST_GAP_S = 1.0  # between the joint rows on both sides of a fix
POSE, TIME_S, TIME = "pose", "time_s", "time"


def read_export(path: Path) -> str:
    """Return the text of an export: UTF-8, UTF-16 with its mark, or the Windows code page of western Europe.

    Raises:
        DescriptionError: it cannot be read.
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
    """Read a map that an import has written, or a person.

    Raises:
        DescriptionError: it cannot be read, or a key of it is wrong.
    """
    try:
        found = ColumnMap.model_validate(parse_toml(read_whole(path, 1 << 20).decode("utf-8-sig")))
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise DescriptionError(str(path), f"{'.'.join(map(str, place(first)))}: {reason(first, ColumnMap)}") from error
    except ValueError as error:  # no TOML, no UTF-8
        raise DescriptionError(str(path), f"is not a TOML file: {error}") from error
    if found.format not in export_formats():
        raise DescriptionError(str(path), f"format: {found.format!r} is unknown; known: {', '.join(export_formats())}")
    return found


def map_text(columns: ColumnMap, source: str) -> str:
    """Return a map as TOML."""
    told = columns.model_dump(exclude_defaults=True)
    lines = [f"# How `rigcal import` read {quoted(source)}. Edit it, and give it with --map."]
    lines += [f"{key} = {_toml(value)}" for key, value in told.items() if not isinstance(value, dict)]
    for section in ("columns", "prisms"):
        if told.get(section):
            lines += ["", f"[{section}]", *(f"{quoted(key)} = {_toml(value)}" for key, value in told[section].items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    return quoted(value) if isinstance(value, str) else str(value)


# ---- joints ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JointRows:
    """Rows of a file of joint values.

    Attributes:
        source: name of the file.
        columns: columns that go into the observations.
        by_pose: pose -> values, where the file has poses.
        times_s: of the rows, rising; empty where the file has no times.
        rows: values of each row.
        max_rates: of the columns in deg/s for joints that turn; None for those that slide.
        has_zone: whether the times are of a named time zone; None where they are no dates.
    """

    source: str
    columns: tuple[str, ...]
    by_pose: Mapping[str, Sequence[float]]
    times_s: Sequence[float]
    rows: Sequence[Sequence[float]]
    max_rates: Sequence[float | None]
    has_zone: bool | None = None

    def of(self, fix: ExportedFix, source: str) -> Sequence[float]:
        """Return the joint values of a fix: those of its pose, or between the rows before and after its time.

        Raises:
            DescriptionError: there are none; with the line of the fix.
        """
        if self.by_pose:
            if fix.is_numbered:
                said = f"the point has no name of its own, and {self.source} matches joint values by {POSE!r}"
                refuse(source, f"{said}; call the column of names 'point', or name it in [columns] of a map", fix.line)
            found = self.by_pose.get(_plain(fix.point))
            if found is None:
                refuse(source, f"{self.source} has no pose {fix.point!r}", fix.line)
            return found
        if fix.time_s is None:
            refuse(source, f"the point has no time, and {self.source} no column {POSE!r} to match it by", fix.line)
        if self.has_zone is not None and fix.has_zone is (not self.has_zone):
            zoned, bare = (self.source, source) if self.has_zone else (source, self.source)
            said = f"times of {zoned} have a time zone, and those of {bare} none, so they may differ by hours"
            refuse(source, f"{said}; write both in UTC with a Z at the end (2026-11-24T10:00:00Z)", fix.line)
        place = bisect_left(self.times_s, fix.time_s)
        if place < len(self.times_s) and self.times_s[place] == fix.time_s:
            return self.rows[place]
        if not 0 < place < len(self.times_s) or self.times_s[place] - self.times_s[place - 1] > MOST_GAP_S:
            span = f"{self.times_s[0]:.3f} to {self.times_s[-1]:.3f} s"
            reason = f"{self.source} has no joints within {MOST_GAP_S:g} s on both sides of {fix.time_s:.3f} s ({span})"
            refuse(source, reason, fix.line)
        before, after = self.times_s[place - 1], self.times_s[place]
        share = (fix.time_s - before) / (after - before)
        pairs = zip(self.rows[place - 1], self.rows[place], self.max_rates, strict=True)
        return [a + share * _step(a, b, after - before, rate) for a, b, rate in pairs]


def read_joints(path: Path, rig: Rig) -> JointRows:
    """Read a file of joint values: a column for each joint as in observations, and `pose`, `time_s` or `time` (ISO).

    Raises:
        DescriptionError: a column is missing, a cell is no number, or a pose or a time is there twice; with line
            and column.
    """
    source = path.name
    lines = lines_of(read_export(path))
    header = cells_of(lines[0], ",")
    joints = tuple(joint.column for joint in rig.joints)
    _check_joint_columns(header, joints, rig, source)
    key = next((name for name in (POSE, TIME_S, TIME) if name in header), None)
    if key is None:
        refuse(
            source, f"needs a column {POSE!r} (the point's name or number), {TIME_S!r} or {TIME!r} to match fixes by", 1
        )
    by_pose: dict[str, list[float]] = {}
    timed: dict[float, tuple[int, list[float]]] = {}
    zones: set[bool] = set()
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        cells = cells_of(line, ",")
        if len(cells) != len(header):
            refuse(source, f"{len(cells)} cells where the header has {len(header)}", number)
        row = []
        for column in joints:
            value = number_of(cells[header.index(column)], ".")
            if value is None:
                refuse(source, f"{cells[header.index(column)]!r} is not a number", number, column)
            row.append(value)
        cell = cells[header.index(key)]
        if key == POSE:
            if by_pose.setdefault(_plain(cell), row) is not row:
                refuse(source, f"pose {cell!r} is there twice", number, POSE)
        else:
            time_s, has_zone = _seconds(cell, source, number, key)
            zones |= set() if has_zone is None else {has_zone}
            if len(zones) > 1:
                refuse(source, f"{cell!r}: some times have a time zone, and others none; write all in UTC", number, key)
            before, same = timed.setdefault(time_s, (number, row))
            if same != row:
                refuse(source, f"time {cell!r} is in line {before} with other joint values; leave one", number, key)
    if not by_pose and not timed:
        refuse(source, "no rows below the header")
    times = sorted(timed)
    rates = [joint.max_rate if joint.kind == "revolute" else None for joint in rig.joints]
    return JointRows(source, joints, by_pose, times, [timed[at][1] for at in times], rates, next(iter(zones), None))


def _check_joint_columns(header: Sequence[str], joints: Sequence[str], rig: Rig, source: str) -> None:
    if len(header) == 1:
        refuse(source, "one column only: separate columns by commas, and write decimals with a point", 1)
    for column in joints:
        if header.count(column) != 1:
            problem = (
                "is there twice" if column in header else f"is missing; rig {rig.name!r} needs {', '.join(joints)}"
            )
            refuse(source, f"the column {problem}", 1, column)


def _step(value: float, following: float, seconds: float, max_rate: float | None) -> float:
    """Return how far a joint has moved; one that would have turned too fast is read on another turn, as 359 and 1."""
    step = following - value
    if max_rate is None or abs(step) <= max_rate * seconds:
        return step
    return (step + 180.0) % 360.0 - 180.0


def _seconds(cell: str, source: str, line: int, column: str) -> tuple[float, bool | None]:
    """Return the seconds of a cell, and whether they are of a named time zone; None where it has no date."""
    value = number_of(cell, ".")
    if value is not None:
        return value, None
    try:
        found = datetime.fromisoformat(cell)
    except ValueError:
        refuse(source, f"{cell!r} is neither seconds nor an ISO time", line, column)
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp(), found.tzinfo is not None


def _plain(pose: str) -> str:
    """Return a pose's number without leading zeros, which memories of stations add."""
    return pose.lstrip("0") or "0" if pose.isdigit() else pose


def far_repetitions(fixes: Sequence[ExportedFix], source: str) -> tuple[str, ...]:
    """Return a note on points that are there twice in different places; most likely one of them is another pose."""
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
    return (f"{source} has points twice in different places: {'; '.join(found[:3])}{more}; both are taken",)


def several_constants(fixes: Sequence[ExportedFix], prisms: Sequence[str], source: str) -> tuple[str, ...]:
    """Return a note on each prism that one station measured with several prism constants.

    Args:
        fixes: as the file has them.
        prisms: of the fixes, as the rows have them.
        source: name of the file.
    """
    first: dict[tuple[str, str], dict[float, ExportedFix]] = {}
    for fix, prism in zip(fixes, prisms, strict=True):
        if fix.prism_constant_mm is not None:
            constant_mm = round(fix.prism_constant_mm, 1) + 0.0  # stations have it in steps of 0.1 mm; no -0
            first.setdefault((prism, fix.station), {}).setdefault(constant_mm, fix)
    notes = []
    for (prism, station), constants in first.items():
        if len(constants) > 1:
            at = f" at {station!r}" if station else ""
            said = [f"{mm:g} mm (from point {fix.point!r}, line {fix.line})" for mm, fix in constants.items()]
            notes.append(
                f"{source} has prism {prism!r}{at} measured with prism constants of {' and '.join(said)}, by which its "
                "distances differ: leave out the points with the wrong one, or give each prism a name of its own"
            )
    return tuple(notes)


def setup_names(fixes: Sequence[ExportedFix], setup: str) -> dict[str, str]:
    """Return station of the file -> set-up of its rows; every station has one of its own where the file has several.

    Args:
        fixes: as the file has them.
        setup: as it was named for all rows; "" where it was not.
    """
    stations = list(dict.fromkeys(fix.station for fix in fixes))
    if len(stations) == 1:
        return {stations[0]: setup}
    blanks = ("-".join(["unnamed", *["0"] * zeros]) for zeros in itertools.count())
    blank = next(name for name in blanks if name not in stations)
    return {station: "-".join(filter(None, (setup, station or blank))) for station in stations}


def several_setups(setups: Mapping[str, str], source: str) -> tuple[str, ...]:
    """Return a note on a file of several stations."""
    if len(setups) < 2:
        return ()
    return (
        f"{source} has {len(setups)} set-ups of the instrument, and so have the rows: {', '.join(setups.values())}; "
        "each has a frame of its own",
    )


def repeated_setups(fixes: Sequence[ExportedFix], source: str) -> tuple[str, ...]:
    """Return a note on an instrument that is set up again under the name of a set-up before."""
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
        f"{source} sets the instrument up again under a name it had before: {'; '.join(again[:3])}{more}; its points "
        "are taken as of one set-up: give the file in parts if it stood elsewhere or was turned",
    )


def bare_times(fixes: Sequence[ExportedFix], joints: JointRows | None, source: str) -> tuple[str, ...]:
    """Return a note on dates without a time zone: UTC is taken."""
    bare = [source] * any(fix.has_zone is False for fix in fixes)
    bare += [joints.source] if joints is not None and joints.has_zone is False else []
    return (f"times of {' and '.join(bare)} have no time zone, and are taken for UTC",) if bare else ()


def target_heights(fixes: Sequence[ExportedFix], source: str) -> tuple[str, ...]:
    """Return a note on coordinates of places below the prism."""
    height_mm = fixes[0].target_height_mm  # a table in which they differ is refused
    if not height_mm:
        return ()
    said = (
        f"{source} has target heights of {height_mm:g} mm, so its coordinates may be of places as far below the prism"
    )
    return (f"{said}; they are taken as they are: export with heights of 0 where that matters",)


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
        fixes: as the file has them.
        prisms: of the fixes.
        source: name of the file.
        joints: their joint values; none when None.
        setups: station of the file -> set-up.
        session: of all rows; "" for none.

    Raises:
        DescriptionError: a fix has no joint values; with its line.
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
        fixes: as the file has them.
        columns: its map, which may name prisms.
        source: name of the file.
        rig: whose prisms are measured; any name is taken when None.
        prism: of all fixes; by the file and the map when None.

    Raises:
        DescriptionError: a fix's prism is not known; with its line.
    """
    return [prism or _prism(fix, columns, source, rig) for fix in fixes]


def _prism(fix: ExportedFix, columns: ColumnMap, source: str, rig: Rig | None) -> str:
    """Return a fix's prism: what the map says of its target or point, else the target itself, else the only prism."""
    found = columns.prisms.get(fix.target) or columns.prisms.get(fix.point) or fix.target
    if rig is None:
        return found or "prism"
    if found in rig.prism_names:
        return found
    if len(rig.prism_names) == 1 and not fix.target:
        return rig.prism_names[0]
    said = f"{fix.target!r}" if fix.target else "no code"
    reason = f"point {fix.point!r} has {said}, which is no prism of rig {rig.name!r} ({', '.join(rig.prism_names)}); "
    refuse(source, f"{reason}give --prism, or name it in [prisms] of the map", fix.line)
