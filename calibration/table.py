"""Reading of observation tables, CSV files or data frames from any source, with a check of every cell."""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
from array import array
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError
from calibration.rig.columns import CONDITIONS, LABELS, OF_JOINT, POSITION, PRISM, SIGMA, WRITTEN, names, names_of_joint
from calibration.rig.description import Rig
from calibration.rig.signals import is_read_anyway

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]

Place = Literal["line", "row", "pose"]
"""How messages number rows: by the line of the file, from 1, or by the row of the data frame, from 0."""

POSITION_COLUMNS = names(POSITION)
SIGMA_COLUMNS = names(SIGMA)
LABEL_COLUMNS = names(LABELS)

_LONGEST = 200  # characters of a label or a number; the label of every row takes as much memory as the longest one
_LONGEST_ROW = 1 << 20
_MOST_COLUMNS = 1000
_MOST_COLUMNS_NAMED = 8  # in a message
_LONGEST_NAME_TOLD = 40  # characters of a column's name in a message
_MOST_LABEL_BYTES = 64 << 20
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NO_NUMBERS = {"nan", "na", "n/a", "null", "none", "inf", "-inf", "+inf", "infinity", "-"}
_NOT_MEASURED = {"nan", "None", "<NA>", "NaT"}  # cells of data frames, as text


class DataFrame(Protocol):
    """A table with named columns, such as a data frame of pandas or polars."""

    @property
    def columns(self) -> Iterable[Any]:
        """Names of the columns."""

    def __getitem__(self, column: Any, /) -> Any:
        """Return a column by its name; it has a method `to_numpy`."""


class Table:
    """The columns of a table that rigcal uses, filled row by row; each number takes eight bytes.

    Args:
        source: name of the table for messages.
        header: names of its columns.
        rig: the rig whose joints, prisms, channels and signals determine the columns to read.
        positions_required: False if the position columns may be missing.
        place: how messages number rows.

    Attributes:
        header: names of its columns.
        place: how messages number rows.

    Raises:
        DataError: a column is missing, appears twice or has no name.
    """

    def __init__(
        self,
        source: str,
        header: Sequence[str],
        rig: Rig,
        *,
        positions_required: bool,
        place: Place = "line",
    ) -> None:
        self.header, self.place = header, place
        self._source = source
        self._check_header(rig, positions_required)
        self._lines = array("q")
        self._numbers = {name: _Numbers() for name in header if name in _number_columns(header, rig)}
        self._labels: dict[str, list[str]] = {name: [] for name in header if name in (PRISM.name, *LABEL_COLUMNS)}
        self._ignored = {name: _Ignored() for name in header if name not in self.wanted}
        self._number_places = [(header.index(name), column) for name, column in self._numbers.items()]
        self._label_places = [(header.index(name), cells) for name, cells in self._labels.items()]
        self._ignored_places = [(header.index(name), column) for name, column in self._ignored.items()]
        self._alike: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._lines)

    @property
    def wanted(self) -> set[str]:
        """Names of the columns that are read; all others are ignored."""
        return {*self._numbers, *self._labels}

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of the columns that are ignored."""
        return tuple(self._ignored)

    @property
    def ignored_numbers(self) -> tuple[str, ...]:
        """Names of the ignored columns that hold numbers, not all equal, and that rigcal did not write itself."""
        own = names(WRITTEN)
        return tuple(name for name, column in self._ignored.items() if column.varies and name not in own)

    @property
    def row_numbers(self) -> NDArray[np.intp]:
        """(n,) number of each row, as in messages."""
        return np.array(self._lines, dtype=np.intp)

    def append(self, row: Sequence[str], line: int) -> None:
        """Append a row.

        Args:
            row: its cells, in the order of the header.
            line: its number, as in messages.

        Raises:
            DataError: the row has more or fewer fields than the header.
        """
        if len(row) != len(self.header):
            raise DataError(self._source, f"{len(row)} fields, but the header has {len(self.header)}", line)
        self._lines.append(line)
        for place, column in self._number_places:
            column.append(row[place].strip(), line)
        for place, cells in self._label_places:
            cell = row[place].strip()
            cells.append(self._alike.setdefault(cell, cell))
        for place, ignored in self._ignored_places:
            ignored.append(row[place].strip())

    def numbers(self, column: str, *, required: bool) -> Floats:
        """Return a column (n,) of numbers, NaN where a cell is empty.

        Raises:
            DataError: a cell is not a finite number, or is empty although `required`.
        """
        found = self._numbers[column]
        first = found.empty_line if required else None
        if found.bad is not None and (first is None or found.bad[0] < first):
            line, cell = found.bad
            self._refuse_line(line, column, _why_no_number(cell))
        if first is not None:
            self._refuse_line(first, column, "empty, but every observation needs it")
        return np.frombuffer(found.values)

    def triple(self, columns: tuple[str, ...], *, required: bool) -> Floats:
        """Return three columns (n, 3) of numbers; a column that the table lacks is NaN."""
        out = np.full((len(self), 3), np.nan)
        for i, name in enumerate(columns):
            if name in self.header:
                out[:, i] = self.numbers(name, required=required)
        return out

    def labels(self, column: str) -> Strings:
        """Return a column (n,) of labels, all "" if the table has no such column.

        Raises:
            DataError: a label is too long, or two different labels look the same.
        """
        cells = self._labels.get(column, [""] * len(self))
        alike: dict[str, str] = {}
        longest = 1
        for cell in dict.fromkeys(cells):
            longest = max(longest, len(cell))
            if len(cell) > _LONGEST:
                reason = f"the label has {len(cell)} characters; the maximum is {_LONGEST}"
                self.refuse(cells.index(cell), column, reason)
            if 4 * longest * len(cells) > _MOST_LABEL_BYTES:
                reason = f"the label has {len(cell)} characters, too many in a table of {len(cells)} rows; shorten it"
                self.refuse(cells.index(cell), column, reason)
            other = alike.setdefault(_plain(cell), cell)
            if other != cell:
                reason = f"{cell!a} and {other!a} look the same but differ; write them with the same characters"
                self.refuse(cells.index(cell), column, reason)
        return np.array(cells, dtype=np.str_)

    def refuse(self, row: int, column: str, reason: str) -> NoReturn:
        """Raise DataError for a cell of row `row`, counted from 0."""
        self._refuse_line(self._lines[row], column, reason)

    def refuse_where(self, bad: NDArray[np.bool_], column: str, values: Floats, reason: str) -> None:
        """Raise DataError for the first row of the (n,) mask `bad`, if any; the message begins with its value."""
        if bad.any():
            row = int(np.argmax(bad))
            self.refuse(row, column, f"{values[row]:g} {reason}")

    def refuse_column(self, column: str, reason: str) -> NoReturn:
        """Raise DataError for a whole column."""
        raise DataError(self._source, reason, column=column)

    def _refuse_line(self, line: int, column: str, reason: str) -> NoReturn:
        if self.place == "row":
            raise DataError(f"{self._source}, row {line} (from 0)", reason, column=column)
        raise DataError(self._source, reason, line, column)

    def _refuse_header(self, reason: str, column: str | None = None) -> NoReturn:
        raise DataError(self._source, reason, 1 if self.place == "line" else None, column)

    def _check_header(self, rig: Rig, positions_required: bool) -> None:
        header = self.header
        if not header or header == [""]:
            self._refuse_header("the file is empty; it needs a header" if self.place == "line" else "no columns")
        if len(header) > _MOST_COLUMNS:
            self._refuse_header(f"{len(header)} columns; the maximum is {_MOST_COLUMNS}")
        doubled = sorted({name for name in header if header.count(name) > 1})
        if doubled[:1] == [""]:
            self._refuse_header(f"{header.count('')} columns have no name; name or remove them")
        if doubled:
            self._refuse_header("column appears more than once; rename or remove the others", doubled[0])
        needed = [PRISM.name, *(j.column for j in rig.joints), *(POSITION_COLUMNS if positions_required else ())]
        missing = [name for name in needed if name not in header]
        if len(header) == 1 and len(missing) == len(needed):
            self._refuse_header("only one column; separate columns by commas, and use a point for decimals")
        if missing:
            alike = [name for name in header if _plain(name).casefold() == missing[0].casefold()]
            hint = f" (but there is {alike[0]!a})" if alike else ""
            others = [ascii(name[:_LONGEST_NAME_TOLD]) for name in header if name not in needed][:_MOST_COLUMNS_NAMED]
            found = f"; other columns found: {', '.join(others)}" if others else ""
            self._refuse_header(
                f"column missing for rig {rig.name!r}{hint}; required: {', '.join(needed)}{found}", missing[0]
            )
        sigmas = [name for name in SIGMA_COLUMNS if name in header]
        if 0 < len(sigmas) < len(SIGMA_COLUMNS):
            reason = f"other sigma columns missing; give all of {', '.join(SIGMA_COLUMNS)}, or none"
            self._refuse_header(reason, sigmas[0])


def read_csv(data: bytes, rig: Rig, source: str, *, positions_required: bool) -> Table:
    """Read a CSV file.

    Args:
        data: UTF-8, comma, header; a byte-order mark is tolerated.
        rig: the rig whose columns are read.
        source: file name for messages.
        positions_required: as for `Table`.

    Raises:
        DataError: the file is malformed; names file, line, column and reason.
    """
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise DataError(source, "contains a zero byte, so it is not UTF-8 text; save the file as UTF-8", line)
    text = _Lines(data)
    reader = csv.reader(text, strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        table = Table(source, header, rig, positions_required=positions_required)
        for row in reader:
            text.taken = 0
            if row:
                table.append(row, reader.line_num)
    except csv.Error as error:
        raise DataError(source, f"not a CSV file: {error}", text.line) from error
    except UnicodeDecodeError:
        raise _not_utf8(data, source) from None
    if not len(table):
        raise DataError(source, "no observations below the header")
    return table


def read_frame(frame: DataFrame, rig: Rig, source: str, *, positions_required: bool) -> Table:
    """Read a data frame.

    Args:
        frame: a data frame of pandas, polars or a similar library; None and NaN mean "not measured".
        rig: the rig whose columns are read.
        source: name for messages.
        positions_required: as for `Table`.

    Raises:
        DataError: the frame is malformed; names row, column and reason.
    """
    keys = list(frame.columns)
    header = [str(key) for key in keys]
    table = Table(source, header, rig, positions_required=positions_required, place="row")
    columns = {name: [_cell(v) for v in frame[key].to_numpy().tolist()] for name, key in zip(header, keys, strict=True)}
    rows = len(columns[PRISM.name])
    if not rows:
        raise DataError(source, "no observations")
    for name, cells in columns.items():
        if len(cells) != rows:
            table.refuse_column(name, f"{len(cells)} cells, but column prism has {rows}")
    for number, row in enumerate(zip(*columns.values(), strict=True)):
        table.append(row, number)
    return table


def optional_columns(rig: Rig) -> set[str]:
    """Return the names of all optional columns of numbers, except pressures and currents.

    Pressures and currents are read without an entry in the rig file (`is_read_anyway`).
    """
    of_joints = {name for joint in rig.joint_names for name in names_of_joint(OF_JOINT, joint)}
    of_channels = {c.column for c in rig.channels if c.name not in rig.joint_names}
    return {*names(CONDITIONS), *of_joints, *of_channels, *(signal.column for signal in rig.signals)}


def extra_columns(header: Sequence[str], rig: Rig) -> list[str]:
    """Return the optional columns of numbers among a table's columns, in the order of the header."""
    known = optional_columns(rig)
    return [name for name in header if name in known or is_read_anyway(name)]


def _number_columns(header: Sequence[str], rig: Rig) -> set[str]:
    """Return the names of the columns that are read as numbers if the table has them."""
    return {*(j.column for j in rig.joints), *POSITION_COLUMNS, *SIGMA_COLUMNS, *extra_columns(header, rig)}


class _Numbers:
    """A column of numbers as it is read; its first faults are kept, and raised when the column is requested."""

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


class _Ignored:
    """A column that is ignored."""

    def __init__(self) -> None:
        self._numbers: set[float] | None = set()  # two at most; None as soon as a cell is not a number

    @property
    def varies(self) -> bool:
        """True if it holds only numbers, and not all of them are equal."""
        return self._numbers is not None and len(self._numbers) > 1

    def append(self, cell: str) -> None:
        if not cell or self._numbers is None:
            return
        if len(cell) > _LONGEST or not _NUMBER.fullmatch(cell):
            self._numbers = None
        elif len(self._numbers) < 2:
            self._numbers.add(float(cell))


class _Lines:
    """Lines for the CSV reader, with a limit on the length of a row, which quotes can extend over many lines.

    Attributes:
        taken: characters read since the caller last set it to 0.
        line: number of the line that was read last, from 1.
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
            raise csv.Error(f"a row has more than {_LONGEST_ROW:,} characters; is a quote left open?")
        return line


def _not_utf8(data: bytes, source: str) -> DataError:
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        return DataError(source, f"byte {error.start} is not UTF-8; save the file as UTF-8", line)
    raise AssertionError("the text was not UTF-8")


def _cell(value: object) -> str:
    """Return a cell of a data frame as CSV text; whole numbers have no decimal point, so that they can be labels."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    text = str(value)
    return "" if text in _NOT_MEASURED else text


def _why_no_number(cell: str) -> str:
    if len(cell) > _LONGEST:
        return f"{cell[:20]!r}... of {len(cell)} characters is not a number"
    if _NUMBER.fullmatch(cell):
        return f"{cell!r} is too large for a number"
    advice = "leave cells without a value empty" if cell.lower() in _NO_NUMBERS else "write it as 1234.5 or 1e-3"
    return f"{cell!r} is not a finite number; {advice}"


def _plain(text: str) -> str:
    """Return text as it looks on screen: accents composed, invisible characters removed, white space normalised."""
    seen = "".join(c for c in unicodedata.normalize("NFC", text) if unicodedata.category(c) != "Cf")
    return " ".join(seen.split())
