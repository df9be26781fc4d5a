"""Observations: fixes with the joint readings at the same instants, the input table of all methods."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError, check_type, wrong_type
from calibration.rig.columns import LEAST_SIGMA_MM
from calibration.rig.description import Rig, check_rig
from calibration.rig.limits import on_one_turn
from calibration.rig.words import counted
from calibration.table import (
    LABEL_COLUMNS,
    POSITION_COLUMNS,
    SIGMA_COLUMNS,
    DataFrame,
    Place,
    Table,
    extra_columns,
    read_csv,
    read_frame,
)

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]

ROW = "row"  # an optional column that is never in a file: the row's number, from 0, added where no time is known
DIRECTIONS = (-1.0, 0.0, 1.0)
DIGEST = 10  # hexadecimal digits of a row's digest; any false match between two tables of 6,000 rows: 1 in 30,000
CELL_MM = 100.0
_CELL_SHARE = 0.4  # of the spread of all positions: the largest width of a cell
_MOST_DEG = 36_000.0  # a hundred turns
_MOST_TURNS_DEG = 720.0  # readings of one file may span this much more than the joint's limits
_MOST_MM = 1e7  # 10 km
# Possible values of an optional column, by the end of its name (the first match counts). Values outside are in a
# different unit, or are garbage that would swamp the computation.
_POSSIBLE = {
    "dwell_s": (0.0, 1e9),
    "payload_kg": (0.0, 1e5),
    "_degC": (-100.0, 200.0),  # warmer is kelvin
    "_rate": (-1e5, 1e5),
    "_Nm": (-1e9, 1e9),
    "": (-1e12, 1e12),
}


@dataclass(frozen=True)
class Observations:
    """Fixes of prisms with the joint readings at their instants: n rows of one rig.

    `Observations.from_csv` reads a file, `Observations.from_frame` a data frame of pandas or polars.

    Attributes:
        prism: (n,) prism of each fix.
        joints: joint name -> (n,) readings in the unit of the joint, deg or mm; from a file, angles are on the turn of
            the joint's limits (`limits.on_one_turn`).
        position_mm: (n, 3) in the station's frame; rows can be NaN only if positions were not required.
        sigma_mm: (n, 3) standard deviation of each coordinate; NaN if not given.
        setup: (n,) station set-up; "" if not given.
        session: (n,) calibration session; "" if not given.
        pose: (n,) standstill; "" if not given. A pose is unique within its session and set-up.
        extra: optional columns by their CSV name (`time_s`, `theta1_dir`, `boom_valve_mA`, ...) -> (n,), NaN where
            not measured.
        ignored_columns: columns of the file that docs/reference/rig-keys.md does not name.
        ignored_numbers: the ignored columns that hold numbers, which a signal of the rig file could use.
        row_numbers: (n,) number of the line or row that each row was read from (`row_name`); None for rows that were
            made in a program.
        place: how rows are named: by `row_numbers`, as lines of a file, whose header is line 1, or as rows of a data
            frame, from 0; or by pose and session, for data of a daemon.
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
    ignored_numbers: tuple[str, ...] = ()
    row_numbers: NDArray[np.intp] | None = None
    place: Place = "row"

    @classmethod
    def from_csv(cls, path_or_text: str | Path, rig: Rig, *, positions_required: bool = True) -> Observations:
        """Read observations from a CSV file or its text; one bad cell rejects the whole file.

        Columns: `prism`; every joint as `<joint>_deg` or `<joint>_mm`; `x_mm`, `y_mm`, `z_mm` of the fix in the
        station's frame; optionally `setup`, `session`, `pose`, `sigma_x_mm` and so on, `time_s`, signals.

        Args:
            path_or_text: path of the file, or its text: a string of more than one line.
            rig: the machine that was measured.
            positions_required: False for prediction, where positions may be missing or empty.

        Raises:
            DataError: the file is malformed or does not fit the rig; names file, line, column and reason.
            TypeError: an argument has a wrong type.
        """
        check_rig(rig)
        frames = "rigcal.Observations.from_frame reads a data frame"
        check_type("path_or_text", path_or_text, (str, os.PathLike), f"the path of a CSV file, or its text; {frames}")
        if isinstance(path_or_text, str) and "\n" in path_or_text:
            return parse_observations(path_or_text.encode(), rig, "text", positions_required=positions_required)
        path = Path(path_or_text)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DataError(str(path), f"cannot be read: {error.strerror}") from error
        return parse_observations(data, rig, path.name, positions_required=positions_required)

    @classmethod
    def from_frame(cls, frame: DataFrame, rig: Rig, *, positions_required: bool = True) -> Observations:
        """Read observations from a data frame of pandas or polars, or any object with such columns.

        Args:
            frame: the columns of `from_csv`; None and NaN mean "not measured".
            rig: the machine that was measured.
            positions_required: False for prediction, where positions may be missing or NaN.

        Raises:
            DataError: the frame is malformed or does not fit the rig; names row (from 0), column and reason.
            TypeError: an argument has a wrong type.
        """
        check_rig(rig)
        if not hasattr(frame, "columns"):
            files = "rigcal.Observations.from_csv reads a file"
            raise wrong_type("frame", frame, f"a data frame of pandas or polars, as pd.DataFrame(columns); {files}")
        return _build(
            read_frame(frame, rig, "data frame", positions_required=positions_required), rig, positions_required
        )

    def __len__(self) -> int:
        return len(self.prism)

    def __repr__(self) -> str:
        poses = {pose for pose in zip(self.session, self.setup, self.pose, strict=True) if pose[-1]}
        counts = ((len(poses), "pose"), (len({name for name in self.session if name}), "session"))
        more = "".join(f", {counted(count, noun)}" for count, noun in counts if count)
        return f"Observations({counted(len(self), 'fix', 'fixes')} of {counted(len(set(self.prism)), 'prism')}{more})"

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Return the given rows, by mask or by index."""
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
            row_numbers=None if self.row_numbers is None else self.row_numbers[rows],
        )

    def numbered(self) -> Observations:
        """Return the observations, with the row numbers as a further column `ROW` if no row has a time."""
        if ROW in self.extra or np.isfinite(self.extra.get("time_s", np.full(1, np.nan))).any():
            return self
        return replace(self, extra={**self.extra, ROW: np.arange(len(self), dtype=np.float64)})

    def row_number(self, row: int) -> int:
        """Return the number of the line or row that row `row` (from 0) was read from."""
        return row if self.row_numbers is None else int(self.row_numbers[row])

    def row_name(self, *rows: int) -> str:
        """Return the name of rows, given from 0, for messages: `line 17`, `lines 17, 43`, `row 16 (from 0)`.

        Fixes of a daemon have no file that people know: `pose 1.17 of session s001-r`.
        """
        if self.place == "pose":
            return self._pose_names(rows)
        numbers = ", ".join(str(self.row_number(row)) for row in rows)
        return f"{self.place}{'s' if len(rows) > 1 else ''} {numbers}{' (from 0)' if self.place == 'row' else ''}"

    def _pose_names(self, rows: Sequence[int]) -> str:
        poses: dict[str, dict[str, None]] = {}
        for row in rows:
            poses.setdefault(str(self.session[row]), {})[str(self.pose[row]) or "(unnamed)"] = None
        return ", ".join(
            f"pose{'s' if len(names) > 1 else ''} {', '.join(names)} of session {session}"
            for session, names in poses.items()
        )

    def groups(self) -> Strings:
        """Return (n,) labels for grouped splits: sessions if there are several, else set-ups, else workspace cells.

        Cells are 100 mm wide, or less for a small machine (`cell_mm`).
        """
        for labels in (self.session, self.setup):
            if len(np.unique(labels)) > 1:
                return labels
        return self.cells(cell_mm(self.position_mm, self.setup))

    def cells(self, size_mm: float = CELL_MM) -> Strings:
        """Return (n,) workspace cells: coordinates divided by `size_mm` and rounded, halves to even."""
        index = np.rint(self.position_mm / size_mm).astype(int)
        return np.array([f"{x},{y},{z}" for x, y, z in index], dtype=np.str_)


def check_observations(name: str, value: object) -> None:
    """Check that an argument is Observations, and not a data frame or a path.

    Args:
        name: name of the argument.
        value: its value.

    Raises:
        TypeError: it is not.
    """
    made = "rigcal.Observations.from_csv('fixes.csv', rig) or rigcal.Observations.from_frame(frame, rig)"
    check_type(name, value, Observations, f"Observations, as from {made}")


def cell_mm(position_mm: Floats, setup: Strings | NDArray[np.intp]) -> float:
    """Return the width of the workspace cells that split a machine's fixes: 100 mm, or less for a small machine.

    With cells of 100 mm, all fixes of a small machine could be in one cell and could not be split.

    Args:
        position_mm: (n, 3) mm.
        setup: (n,) labels.
    """
    return min(CELL_MM, _CELL_SHARE * spread_mm(position_mm, setup)) or CELL_MM


def spread_mm(position_mm: Floats, setup: Strings | NDArray[np.intp]) -> float:
    """Return the median distance, mm, of positions from the median position of their set-up; 0 without positions.

    Args:
        position_mm: (n, 3) mm.
        setup: (n,) labels.
    """
    distance_mm = np.zeros(max(1, len(position_mm)))
    for own in (setup == label for label in np.unique(setup)):
        distance_mm[own] = np.linalg.norm(position_mm[own] - np.median(position_mm[own], axis=0), axis=1)
    return float(np.median(distance_mm))


def parse_observations(data: bytes, rig: Rig, source: str, *, positions_required: bool = True) -> Observations:
    """Read an observations CSV; one bad cell rejects the whole file.

    Args:
        data: the file's bytes (UTF-8, comma, header; a byte-order mark is tolerated).
        rig: the machine that was measured; the file must have its joints and prisms.
        source: file name for messages.
        positions_required: False for prediction, where `x_mm,y_mm,z_mm` may be missing or empty.

    Raises:
        DataError: the file is malformed or does not fit the rig; names file, line, column and reason.
    """
    return _build(read_csv(data, rig, source, positions_required=positions_required), rig, positions_required)


def format_observations(observations: Observations, rig: Rig) -> str:
    """Format observations as CSV: shortest exact numbers, and empty cells where nothing was measured.

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
    columns |= {name: values for name, values in observations.extra.items() if name != ROW}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    return out.getvalue()


def data_sha256(observations: Observations, rig: Rig) -> str:
    """Return the SHA-256 of the observations' CSV: the same for a file, a stored session and a replay of it."""
    return hashlib.sha256(format_observations(observations, rig).encode()).hexdigest()


def row_digests(observations: Observations) -> list[str]:
    """Return a digest of each row, `DIGEST` hexadecimal digits that recognise the same fix in a different file.

    The digest depends on the prism, the readings rounded to nine digits and the position rounded to a micrometre; other
    columns do not matter.
    """
    columns = [observations.prism.tolist()]
    columns += [[f"{value:.9g}" for value in readings.tolist()] for readings in observations.joints.values()]
    columns += [[f"{value:.3f}" for value in axis.tolist()] for axis in observations.position_mm.T]
    texts = ("\x1f".join(row).encode() for row in zip(*columns, strict=True))
    return [hashlib.blake2b(text, digest_size=DIGEST // 2).hexdigest() for text in texts]


def are_among(observations: Observations, digests: Collection[str]) -> NDArray[np.bool_]:
    """Return an (n,) mask, True for rows whose digest (`row_digests`) is in `digests`."""
    return np.isin(row_digests(observations), list(digests))


def originals(observations: Observations) -> NDArray[np.intp]:
    """Return (n,) the index of the first row with exactly the same prism, set-up, readings and position.

    Rows whose index differs from their own are copies.
    """
    numbers = np.column_stack([*observations.joints.values(), observations.position_mm]).tolist()
    labels = zip(observations.prism.tolist(), observations.setup.tolist(), strict=True)
    seen: dict[tuple[object, ...], int] = {}
    first = [
        seen.setdefault((*label, *values), row) for row, (label, values) in enumerate(zip(labels, numbers, strict=True))
    ]
    return np.array(first, dtype=np.intp)


def is_original(observations: Observations) -> NDArray[np.bool_]:
    """Return an (n,) mask, False for copies of an earlier row, which are not independent measurements."""
    return np.asarray(originals(observations) == np.arange(len(observations)))


def _cells(values: Floats | Strings) -> list[str]:
    return [value if isinstance(value, str) else "" if math.isnan(value) else repr(value) for value in values.tolist()]


def _build(table: Table, rig: Rig, positions_required: bool) -> Observations:
    """Build observations from the columns of a table; raise DataError for values that no measurement can have."""
    prism = table.labels("prism")
    for row, name in enumerate(prism.tolist()):
        if name not in rig.prism_names:
            allowed = ", ".join(rig.prism_names)
            table.refuse(row, "prism", f"rig {rig.name!r} has no prism {name!r}; it has {allowed}")
    sigma_mm = table.triple(SIGMA_COLUMNS, required=False)
    given = np.isfinite(sigma_mm)
    for i, name in enumerate(SIGMA_COLUMNS):
        partly = ~given[:, i] & given.any(axis=1)
        if partly.any():
            reason = "empty, but the row has other sigmas; give all three or none"
            table.refuse(int(np.argmax(partly)), name, reason)
        own = sigma_mm[:, i]
        table.refuse_where(own <= 0, name, own, "is not a standard deviation; it must be positive")
        reason = f"is smaller than any instrument's standard deviation (at least {LEAST_SIGMA_MM:g} mm); check the unit"
        table.refuse_where(own < LEAST_SIGMA_MM, name, own, reason)
    joints = {j.name: table.numbers(j.column, required=True) for j in rig.joints}
    for joint in rig.joints:
        limit = _MOST_DEG if joint.kind == "revolute" else _MOST_MM
        values = joints[joint.name]
        reason = f"is beyond what a joint can read (at most {limit:g} {joint.unit}); check the unit"
        table.refuse_where(np.abs(values) > limit, joint.column, values, reason)
        low, high = float(values.min()), float(values.max())
        if joint.kind == "revolute" and high - low > joint.limits[1] - joint.limits[0] + _MOST_TURNS_DEG:
            table.refuse_column(
                joint.column,
                f"readings from {low:.6g} to {high:.6g} deg span more turns than the joint's limits, "
                f"{joint.limits[0]:g} .. {joint.limits[1]:g} deg, allow; were they converted to degrees twice?",
            )
    position_mm = table.triple(POSITION_COLUMNS, required=positions_required)
    for name, values in zip(POSITION_COLUMNS, position_mm.T, strict=True):
        reason = (
            f"is beyond the range of a total station (at most {_MOST_MM:g} mm); subtract the instrument's coordinates "
            f"from map coordinates"
        )
        table.refuse_where(np.abs(values) > _MOST_MM, name, values, reason)
    for name, values in zip(SIGMA_COLUMNS, sigma_mm.T, strict=True):
        reason = f"is too large for the standard deviation of a fix (at most {_MOST_MM:g} mm); check the unit"
        table.refuse_where(values > _MOST_MM, name, values, reason)
    extra_names = extra_columns(table.header, rig)
    extra = {name: table.numbers(name, required=False) for name in extra_names}
    directions = {f"{name}_dir" for name in rig.joint_names}
    for name, values in extra.items():
        if name in directions:
            bad = np.isfinite(values) & ~np.isin(values, DIRECTIONS)
            table.refuse_where(bad, name, values, "is not a direction; allowed: -1, 0, 1")
        low, high = next(ends for ending, ends in _POSSIBLE.items() if name.endswith(ending))
        reason = f"is outside the possible range ({low:g} .. {high:g}); check the unit"
        table.refuse_where((values < low) | (values > high), name, values, reason)
    return Observations(
        prism=prism,
        joints=on_one_turn(rig, joints),
        position_mm=position_mm,
        sigma_mm=sigma_mm,
        setup=table.labels("setup"),
        session=table.labels("session"),
        pose=table.labels("pose"),
        extra=extra,
        ignored_columns=table.ignored,
        ignored_numbers=table.ignored_numbers,
        row_numbers=table.row_numbers,
        place=table.place,
    )
