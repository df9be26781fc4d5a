"""The one table that flows: fixes with the joint readings at their own instants, as the contract's CSV has it."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
import unicodedata
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError
from calibration.limits import on_one_turn
from calibration.rig import Rig

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]

POSITION_COLUMNS = ("x_mm", "y_mm", "z_mm")
SIGMA_COLUMNS = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm")
LABEL_COLUMNS = ("setup", "session", "pose")
DIRECTIONS = (-1.0, 0.0, 1.0)
CELL_MM = 100.0
_PART = 0.4  # of the spread of all places: no cell is larger
_MOST_DEG = 36_000.0  # a hundred turns
_MOST_TURNS_DEG = 720.0  # more than the limits have, within one file
_MOST_MM = 1e7  # 10 km
_LONGEST = 200  # characters of a label or a number; every row's label takes as much memory as the longest
_LONGEST_ROW = 1 << 20
_MOST_COLUMNS = 1000
_MOST_LABEL_BYTES = 64 << 20
# What an optional column can be, by how its name ends (the first that fits); what is beyond is in another unit, or
# noise that would drown every number it meets.
_POSSIBLE = {
    "dwell_s": (0.0, 1e9),
    "payload_kg": (0.0, 1e5),
    "_degC": (-100.0, 200.0),  # what is warmer is in kelvin
    "_rate": (-1e5, 1e5),
    "_Nm": (-1e9, 1e9),
    "": (-1e12, 1e12),
}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NO_NUMBERS = {"nan", "na", "n/a", "null", "none", "inf", "-inf", "+inf", "infinity", "-"}
_SIGNAL = re.compile(r"[A-Za-z][A-Za-z0-9_]*_(bar|mA)")


@dataclass(frozen=True)
class Observations:
    """n observations of one rig.

    Attributes:
        prism: (n,) prism of each fix.
        joints: joint name -> (n,) readings, deg or mm as the rig's joint says; from a file, angles are on the turn of
            the joint's limits (`limits.on_one_turn`).
        position_mm: (n, 3) in the station's frame; NaN rows only where positions were not required.
        sigma_mm: (n, 3) standard deviation of each coordinate; NaN where not given.
        setup: (n,) station set-up; "" where not given.
        session: (n,) calibration session; "" where not given.
        pose: (n,) standstill; "" where not given. A pose is unique within its session and set-up.
        extra: optional columns by their CSV name (`time_s`, `theta1_dir`, `boom_valve_mA`, ...) -> (n,), NaN where
            not measured.
        ignored_columns: columns of the file that are not part of the contract.
    """

    prism: Strings
    joints: Mapping[str, Floats]
    position_mm: Floats
    sigma_mm: Floats
    setup: Strings
    session: Strings
    pose: Strings
    extra: Mapping[str, Floats] = field(default_factory=dict)
    ignored_columns: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.prism)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """The given rows, by mask or by index."""
        return replace(
            self,
            prism=self.prism[rows],
            joints={k: v[rows] for k, v in self.joints.items()},
            position_mm=self.position_mm[rows],
            sigma_mm=self.sigma_mm[rows],
            setup=self.setup[rows],
            session=self.session[rows],
            pose=self.pose[rows],
            extra={k: v[rows] for k, v in self.extra.items()},
        )

    def groups(self) -> Strings:
        """(n,) labels for grouped splits: sessions or set-ups where there are several, else workspace cells.

        They are of 100 mm, or less where the machine is small (`cell_mm`).
        """
        for labels in (self.session, self.setup):
            if len(np.unique(labels)) > 1:
                return labels
        return self.cells(cell_mm(self.position_mm, self.setup))

    def cells(self, size_mm: float = CELL_MM) -> Strings:
        """(n,) workspace cells: coordinates divided by `size_mm` and rounded to even halves, as `round` does."""
        index = np.rint(self.position_mm / size_mm).astype(int)
        return np.array([f"{x},{y},{z}" for x, y, z in index], dtype=np.str_)


def cell_mm(position_mm: Floats, setup: Strings | NDArray[np.intp]) -> float:
    """Width of the workspace cells that split a machine's fixes: 100 mm, or less where it is small.

    All in one cell, nothing would be left to split. `position_mm` and `setup` as for `spread_mm`.
    """
    return min(CELL_MM, _PART * spread_mm(position_mm, setup)) or CELL_MM


def spread_mm(position_mm: Floats, setup: Strings | NDArray[np.intp]) -> float:
    """Median distance of positions (n, 3) from the median place of their set-up's (n,); 0 where there are none."""
    distance_mm = np.zeros(max(1, len(position_mm)))
    for own in (setup == label for label in np.unique(setup)):
        distance_mm[own] = np.linalg.norm(position_mm[own] - np.median(position_mm[own], axis=0), axis=1)
    return float(np.median(distance_mm))


def optional_columns(rig: Rig) -> set[str]:
    """Numeric columns of the contract that a file may have for `rig`, apart from `<signal>_bar` and `<signal>_mA`."""
    columns = {"time_s", "dwell_s", "temperature_degC", "payload_kg"}
    for joint in rig.joints:
        columns |= {f"{joint.name}_dir", f"{joint.name}_rate", f"{joint.name}_Nm"}
    return columns | {c.column for c in rig.channels if c.name not in rig.joint_names}


def parse_observations(data: bytes, rig: Rig, source: str, *, positions_required: bool = True) -> Observations:
    """Read an observations CSV; a bad file is refused whole.

    Args:
        data: the file's bytes (UTF-8, comma, header; a byte-order mark is tolerated).
        rig: whose joints and prisms the file must have.
        source: file name for messages.
        positions_required: False for prediction, where `x_mm,y_mm,z_mm` may be missing or empty.

    Raises:
        DataError: with file, line, column and reason.
    """
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise DataError(source, "a zero byte, as other encodings have; save the file as UTF-8", line)
    text = _Lines(data)
    reader = csv.reader(text, strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        _check_header(header, rig, source, positions_required)
        table = _Table(source, header, rig)
        for row in reader:
            text.taken = 0
            if row:
                table.append(row, reader.line_num)
    except csv.Error as error:
        raise DataError(source, f"not a CSV file: {error}", text.line) from error
    except UnicodeDecodeError:
        raise _not_utf8(data, source) from None
    if not len(table.lines):
        raise DataError(source, "no observations below the header")
    return _build(table, header, rig, positions_required)


def _not_utf8(data: bytes, source: str) -> DataError:
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        return DataError(source, f"byte {error.start} is not UTF-8; save the file as UTF-8", line)
    raise AssertionError("the text was not UTF-8")


class _Lines:
    """Lines for the CSV reader, which puts a row together from as many as its quotes ask for: not more than a few.

    Attributes:
        taken: characters since it was last set to 0.
        line: number of the last line.
    """

    def __init__(self, data: bytes) -> None:
        self._text = io.TextIOWrapper(io.BytesIO(data), "utf-8-sig", newline="")
        self.taken = 0
        self.line = 0

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._text.readline(_LONGEST_ROW + 1)
        if not line:
            raise StopIteration
        self.line += 1
        self.taken += len(line)
        if self.taken > _LONGEST_ROW:
            raise csv.Error(f"a row of more than {_LONGEST_ROW:,} characters")
        return line


def format_observations(observations: Observations, rig: Rig) -> str:
    """Observations as the contract's CSV, with shortest exact numbers and empty cells for what is not measured.

    Args:
        observations: the table.
        rig: gives the joints' units.
    """
    columns: dict[str, Floats | Strings] = {"prism": observations.prism}
    columns |= {rig.joint(name).column: values for name, values in observations.joints.items()}
    columns |= {name: observations.position_mm[:, i] for i, name in enumerate(POSITION_COLUMNS)}
    for name in LABEL_COLUMNS:
        labels: Strings = getattr(observations, name)
        if np.any(labels != ""):
            columns[name] = labels
    if np.isfinite(observations.sigma_mm).any():
        columns |= {name: observations.sigma_mm[:, i] for i, name in enumerate(SIGMA_COLUMNS)}
    columns |= observations.extra
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    return out.getvalue()


def data_sha256(observations: Observations, rig: Rig) -> str:
    """SHA-256 of the observations in canonical form: the same for a file, a stored session and a replay of it."""
    return hashlib.sha256(format_observations(observations, rig).encode()).hexdigest()


def originals(observations: Observations) -> NDArray[np.intp]:
    """(n,) the first row with the same readings and position in every digit: later ones are copies, no measurements."""
    numbers = np.column_stack([*observations.joints.values(), observations.position_mm]).tolist()
    labels = zip(observations.prism.tolist(), observations.setup.tolist(), strict=True)
    seen: dict[tuple[object, ...], int] = {}
    first = [
        seen.setdefault((*label, *values), row) for row, (label, values) in enumerate(zip(labels, numbers, strict=True))
    ]
    return np.array(first, dtype=np.intp)


def _cells(values: Floats | Strings) -> list[str]:
    return [value if isinstance(value, str) else "" if math.isnan(value) else repr(value) for value in values.tolist()]


class _Numbers:
    """A column of numbers as it is read; what is wrong with it is told when the column is wanted."""

    def __init__(self) -> None:
        self.values = array("d")
        self.empty_line: int | None = None
        self.bad: tuple[int, str] | None = None  # line and cell

    def append(self, cell: str, line: int) -> None:
        if not cell:
            self.values.append(math.nan)
            if self.empty_line is None:
                self.empty_line = line
            return
        value = float(cell) if len(cell) <= _LONGEST and _NUMBER.fullmatch(cell) else math.nan
        self.values.append(value)
        if self.bad is None and not math.isfinite(value):
            self.bad = line, cell


class _Table:
    """The columns of a file that are wanted, row by row; numbers take eight bytes each, whatever was written.

    Attributes:
        source: file name for messages.
        lines: of each row.
    """

    def __init__(self, source: str, header: Sequence[str], rig: Rig) -> None:
        self.source = source
        self.lines = array("q")
        self._width = len(header)
        self._numbers = {name: _Numbers() for name in header if name in _number_columns(header, rig)}
        self._labels: dict[str, list[str]] = {name: [] for name in header if name in ("prism", *LABEL_COLUMNS)}
        self._number_places = [(header.index(name), column) for name, column in self._numbers.items()]
        self._label_places = [(header.index(name), cells) for name, cells in self._labels.items()]
        self._alike: dict[str, str] = {}

    def append(self, row: Sequence[str], line: int) -> None:
        """Take a row; DataError if it has another number of fields than the header."""
        if len(row) != self._width:
            raise DataError(self.source, f"{len(row)} fields where the header has {self._width}", line)
        self.lines.append(line)
        for place, column in self._number_places:
            column.append(row[place].strip(), line)
        for place, cells in self._label_places:
            cell = row[place].strip()
            cells.append(self._alike.setdefault(cell, cell))

    def numbers(self, column: str, *, required: bool) -> Floats:
        found = self._numbers[column]
        first = found.empty_line if required else None
        if found.bad is not None and (first is None or found.bad[0] < first):
            line, cell = found.bad
            raise DataError(self.source, _why_no_number(cell), line, column)
        if first is not None:
            raise DataError(self.source, "empty, but every observation needs it", first, column)
        return np.frombuffer(found.values)

    def labels(self, column: str) -> Strings:
        cells = self._labels.get(column, [""] * len(self.lines))
        alike: dict[str, str] = {}
        longest = 1
        for cell in dict.fromkeys(cells):
            longest = max(longest, len(cell))
            if len(cell) > _LONGEST:
                self.refuse(column, cell, f"a label of {len(cell)} characters; at most {_LONGEST}")
            if 4 * longest * len(cells) > _MOST_LABEL_BYTES:
                self.refuse(column, cell, f"a label of {len(cell)} characters among {len(cells)} rows; shorten it")
            other = alike.setdefault(_plain(cell), cell)
            if other != cell:
                self.refuse(column, cell, f"{cell!a} and {other!a} look the same; write them alike")
        return np.array(cells, dtype=np.str_)

    def refuse(self, column: str, cell: str, reason: str) -> NoReturn:
        """DataError for the first row with this cell."""
        raise DataError(self.source, reason, self.lines[self._labels[column].index(cell)], column)

    def check(self, column: str, values: Floats, bad: NDArray[np.bool_], reason: str) -> None:
        if bad.any():
            i = int(np.argmax(bad))
            raise DataError(self.source, f"{values[i]:g} {reason}", self.lines[i], column)


def _why_no_number(cell: str) -> str:
    if len(cell) > _LONGEST:
        return f"{cell[:20]!r}... of {len(cell)} characters is not a number"
    if _NUMBER.fullmatch(cell):
        return f"{cell!r} is beyond what a number can be"
    what = "not measured is an empty cell" if cell.lower() in _NO_NUMBERS else "write it as 1234.5 or 1e-3"
    return f"{cell!r} is not a finite number; {what}"


def _number_columns(header: Sequence[str], rig: Rig) -> set[str]:
    """Names of the columns of a file that are read as numbers."""
    known = {*(j.column for j in rig.joints), *POSITION_COLUMNS, *SIGMA_COLUMNS, *optional_columns(rig)}
    return {name for name in header if name in known or _SIGNAL.fullmatch(name)}


def _check_header(header: list[str], rig: Rig, source: str, positions_required: bool) -> None:
    if not header or header == [""]:
        raise DataError(source, "the file is empty; a header is needed", 1)
    if len(header) > _MOST_COLUMNS:
        raise DataError(source, f"{len(header)} columns; at most {_MOST_COLUMNS}", 1)
    doubled = sorted({name for name in header if header.count(name) > 1})
    if doubled[:1] == [""]:
        raise DataError(source, f"{header.count('')} columns have no name; name them, or leave them out", 1)
    if doubled:
        raise DataError(source, "column appears twice", 1, doubled[0])
    needed = ["prism", *(j.column for j in rig.joints), *(POSITION_COLUMNS if positions_required else ())]
    missing = [name for name in needed if name not in header]
    if len(header) == 1 and len(missing) == len(needed):
        raise DataError(source, "one column only: separate columns by commas, and write decimals with a point", 1)
    if missing:
        alike = [name for name in header if _plain(name).casefold() == missing[0].casefold()]
        hint = f" (there is {alike[0]!a})" if alike else ""
        raise DataError(
            source, f"column missing{hint} for rig {rig.name!r}; needed: {', '.join(needed)}", 1, missing[0]
        )
    sigmas = [name for name in SIGMA_COLUMNS if name in header]
    if 0 < len(sigmas) < len(SIGMA_COLUMNS):
        raise DataError(source, f"needs the other two of {', '.join(SIGMA_COLUMNS)} beside it", 1, sigmas[0])


def _plain(text: str) -> str:
    """Text as a reader sees it: accents one way, nothing invisible, every space alike."""
    seen = "".join(c for c in unicodedata.normalize("NFC", text) if unicodedata.category(c) != "Cf")
    return " ".join(seen.split())


def _build(table: _Table, header: list[str], rig: Rig, positions_required: bool) -> Observations:
    prism = table.labels("prism")
    for line, name in zip(table.lines, prism, strict=True):
        if name not in rig.prism_names:
            allowed = ", ".join(rig.prism_names)
            raise DataError(
                table.source, f"rig {rig.name!r} has no prism {str(name)!r}; it has {allowed}", line, "prism"
            )

    def triple(columns: tuple[str, ...], *, required: bool) -> Floats:
        out = np.full((len(prism), 3), np.nan)
        for i, name in enumerate(columns):
            if name in header:
                out[:, i] = table.numbers(name, required=required)
        return out

    sigma_mm = triple(SIGMA_COLUMNS, required=False)
    given = np.isfinite(sigma_mm)
    for i, name in enumerate(SIGMA_COLUMNS):
        partly = ~given[:, i] & given.any(axis=1)
        if partly.any():
            reason = "empty beside the row's other sigmas; a fix has all three or none"
            raise DataError(table.source, reason, table.lines[int(np.argmax(partly))], name)
        table.check(name, sigma_mm[:, i], sigma_mm[:, i] <= 0, "is not a standard deviation; it must be positive")
    joints = {j.name: table.numbers(j.column, required=True) for j in rig.joints}
    for joint in rig.joints:
        limit = _MOST_DEG if joint.kind == "revolute" else _MOST_MM
        values = joints[joint.name]
        table.check(
            joint.column, values, np.abs(values) > limit, f"is beyond what a joint can read ({limit:g} {joint.unit})"
        )
        low, high = float(values.min()), float(values.max())
        if joint.kind == "revolute" and high - low > joint.limits[1] - joint.limits[0] + _MOST_TURNS_DEG:
            raise DataError(
                table.source,
                f"readings from {low:.6g} to {high:.6g} deg, turns further than its limits {joint.limits[0]:g} .. "
                f"{joint.limits[1]:g} deg allow; were they converted to degrees twice?",
                column=joint.column,
            )
    position_mm = triple(POSITION_COLUMNS, required=positions_required)
    for i, name in enumerate(POSITION_COLUMNS):
        table.check(
            name,
            position_mm[:, i],
            np.abs(position_mm[:, i]) > _MOST_MM,
            f"is beyond a station's reach ({_MOST_MM:g} mm); of map coordinates, subtract the instrument's",
        )
        table.check(
            SIGMA_COLUMNS[i],
            sigma_mm[:, i],
            sigma_mm[:, i] > _MOST_MM,
            f"is no standard deviation of a fix ({_MOST_MM:g} mm)",
        )
    known = optional_columns(rig)
    extra_names = [c for c in header if c in known or (_SIGNAL.fullmatch(c) and c not in SIGMA_COLUMNS)]
    extra = {name: table.numbers(name, required=False) for name in extra_names}
    for name, values in extra.items():
        if name.endswith("_dir"):
            bad = np.isfinite(values) & ~np.isin(values, DIRECTIONS)
            table.check(name, values, bad, "is not a direction; allowed: -1, 0, 1")
        low, high = next(ends for ending, ends in _POSSIBLE.items() if name.endswith(ending))
        bad = (values < low) | (values > high)
        table.check(name, values, bad, f"is beyond what it can be ({low:g} .. {high:g}); is it in another unit?")
    used = {"prism", *(j.column for j in rig.joints), *POSITION_COLUMNS, *SIGMA_COLUMNS, *LABEL_COLUMNS, *extra_names}
    return Observations(
        prism=prism,
        joints=on_one_turn(rig, joints),
        position_mm=position_mm,
        sigma_mm=sigma_mm,
        setup=table.labels("setup"),
        session=table.labels("session"),
        pose=table.labels("pose"),
        extra=extra,
        ignored_columns=tuple(c for c in header if c not in used),
    )
