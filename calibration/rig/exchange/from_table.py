"""A rig from a Denavit-Hartenberg table: a CSV file with one row of constants for each joint.

Columns, in any order:

* the constants of a row of a rig file, in either unit: `alpha_deg` or `alpha_rad`, `a_mm` or `a_m`, likewise `d`,
  `theta`, `beta` and `b`;
* `joint` names a joint, with `kind` (`revolute` by default), `lower` and `upper` in deg or mm, and `max_rate`;
* `theta_drive`, `d_drive` and `a_drive` hold a sum such as `0.5*q1 - q2`, for rows that several joints drive or whose
  `a` is driven. In a table with such a column, a line with only cells of a joint is not a row: it describes the joint;
* `after`, `x_mm` ... `rx_deg` and `identify` are as in a rig file;
* `prism` makes the line a prism instead of a row, on the frame `frame` (by default that of the last row), at
  `prism_x_mm` and so on.

A comment `# convention: NAME` gives the convention of the constants.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping
from typing import get_args

from calibration.errors import RigError
from calibration.rig.description import Convention
from calibration.rig.exchange.draft import LIMITS_ASSUMED, SIGMA, Draft, free_name
from calibration.rig.exchange.frames import tidy

CONSTANTS = {"alpha": "deg", "a": "mm", "d": "mm", "theta": "deg", "beta": "deg", "b": "mm"}
_OF_EVERY_TABLE = ("alpha", "a", "d", "theta")
BEFORE = ("x_mm", "y_mm", "z_mm", "rz_deg", "ry_deg", "rx_deg")
DRIVES = ("theta", "d", "a")
PRISM = ("prism", "frame", "prism_x_mm", "prism_y_mm", "prism_z_mm")
JOINT = ("joint", "kind", "lower", "upper", "max_rate")
_SCALES = {"deg": 1.0, "rad": math.degrees(1.0), "mm": 1.0, "m": 1e3}
_OTHER = {"deg": "rad", "mm": "m"}
_KNOWN = frozenset(
    (
        *(f"{name}_{unit}" for name, own in CONSTANTS.items() for unit in (own, _OTHER[own])),
        *(f"{driven}_drive" for driven in DRIVES),
        *BEFORE,
        *PRISM,
        *JOINT,
        "row",
        "after",
        "identify",
    )
)
_CONVENTION = re.compile(r"#\s*convention:\s*(\w+)\s*")
_TERM = re.compile(r"\s*([+-]?)\s*(?:((?:\d++\.?\d*+|\.\d++)(?:[eE][+-]?\d++)?)\s*\*\s*)?([A-Za-z]\w*)", re.ASCII)
_ASSUMED_LIMITS = {"revolute": (-180.0, 180.0), "prismatic": (0.0, 1000.0)}
_MOST_LINES = 1000


def draft_of_table(text: str, source: str, convention: Convention | None = None) -> Draft:
    """Make a rig file from a Denavit-Hartenberg table.

    Args:
        text: CSV.
        source: name of its file.
        convention: convention of the constants; by default that of a comment in the file, or else standard (`dh`).

    Raises:
        RigError: unknown columns, cells that are not numbers, no row with a joint; with the line.
    """
    return _Table(text, source, convention).draft()


class _Table:
    def __init__(self, text: str, source: str, convention: Convention | None) -> None:
        self._source = source
        lines = text.removeprefix("\ufeff").splitlines()
        if len(lines) > _MOST_LINES:
            raise RigError(source, "", f"{len(lines)} lines; the maximum is {_MOST_LINES}")
        stated = next((m[1] for m in map(_CONVENTION.fullmatch, lines) if m), None)
        if stated is not None and stated not in get_args(Convention):
            reason = f"{stated!r} is unknown; give one of {', '.join(get_args(Convention))}"
            raise RigError(source, "convention", reason)
        known: Mapping[str, Convention] = {name: name for name in get_args(Convention)}
        self._convention = convention or known[stated or "dh"]
        self._draft = Draft(source.rpartition(".")[0] or source, self._convention, source)
        self._lines = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and line[:1] != "#"]
        self._kinds: dict[str, str] = {}
        self._has_drives = False
        self._constants: set[str] = set()

    def draft(self) -> Draft:
        draft, rows = self._draft, list(self._rows())
        if not rows:
            raise RigError(self._source, "", "no rows below the header")
        continued = set()
        for line, cells in rows:
            if "prism" in cells:
                self._add_prism(line, cells)
            elif self._has_drives and cells and set(cells) <= set(JOINT):
                self._add_joint(line, cells, self._kind(line, cells))
            else:
                self._add_row(line, cells)
                row = len(draft.sections["row"])
                continued.add(int(self._number(line, cells, "after", row - 1)))
        if not draft.sections["joint"]:
            raise RigError(self._source, "", "no row names a joint; add a column `joint` or `theta_drive`")
        if not draft.sections["prism"]:
            for end in sorted(set(range(1, len(draft.sections["row"]) + 1)) - continued):
                name = "tool" if not draft.sections["prism"] else f"tool_{end}"
                keys = {"name": free_name(name, self._kinds), "frame": end, "offset_mm": [0.0, 0.0, 0.0]}
                draft.add("prism", keys | {"offset_known": False}, "the position of the reflector is not known")
        missing = [f"{name}_{CONSTANTS[name]} = 0" for name in _OF_EVERY_TABLE if name not in self._constants]
        if missing:
            said = " and ".join(filter(None, (", ".join(missing[:-1]), missing[-1])))
            columns = "columns" if len(missing) > 1 else "column"
            draft.values_assumed.append(f"{said} for all rows: the table has no such {columns}")
        draft.notes += [
            f"Convention: {self._convention}.",
            draft.assumed,
        ]
        return draft

    def _rows(self) -> Iterator[tuple[int, dict[str, str]]]:
        if not self._lines:
            raise RigError(self._source, "", "the file is empty")
        (first, header), *lines = self._lines
        names = [name.strip() for name in next(csv.reader([header]))]
        unknown = [name for name in names if name not in _KNOWN]
        if unknown or len(set(names)) < len(names):
            what = f"unknown column {unknown[0]!r}" if unknown else "two columns have the same name"
            if len(names) == 1 and any(mark in header for mark in ";\t"):
                raise RigError(
                    self._source, "header", "separate columns by commas, and use a point for decimals", first
                )
            raise RigError(self._source, "header", f"{what}; possible columns: {', '.join(sorted(_KNOWN))}", first)
        self._constants = {name.rpartition("_")[0] for name in names}
        self._has_drives = any(f"{driven}_drive" in names for driven in DRIVES)
        for number, line in lines:
            cells = [cell.strip() for cell in next(csv.reader(io.StringIO(line)))]
            if len(cells) != len(names):
                raise RigError(self._source, "", f"{len(cells)} cells, but the header has {len(names)}", number)
            yield number, {name: cell for name, cell in zip(names, cells, strict=True) if cell}

    def _add_row(self, line: int, cells: Mapping[str, str]) -> None:
        keys: dict[str, object] = {}
        after = int(self._number(line, cells, "after", len(self._draft.sections["row"])))
        if after != len(self._draft.sections["row"]):
            keys["after"] = after
        before = {name: self._number(line, cells, name, 0.0) for name in BEFORE if name in cells}
        if any(before.values()):
            keys["before"] = {name: value for name, value in before.items() if value}
        for name, unit in CONSTANTS.items():
            for column in (f"{name}_{unit}", f"{name}_{_OTHER[unit]}"):
                if column in cells:
                    scale = _SCALES[column.rpartition("_")[2]]
                    keys[f"{name}_{unit}"] = tidy(self._number(line, cells, column, 0.0) * scale)
        drive = {name: self._terms(line, cells[f"{name}_drive"]) for name in DRIVES if f"{name}_drive" in cells}
        if "joint" in cells:
            kind = self._kind(line, cells)
            driven = "theta" if kind == "revolute" else "d"
            drive = drive or {driven: {cells["joint"]: 1.0}}
            self._add_joint(line, cells, kind)
        for name in dict.fromkeys(name for terms in drive.values() for name in terms):
            if name not in self._kinds:
                kind = "revolute" if name in drive.get("theta", {}) else "prismatic"
                self._add_joint(line, {"joint": name}, kind)
        if drive:
            keys["drive"] = drive
        if "identify" in cells:
            keys["identify"] = [] if cells["identify"] == "-" else cells["identify"].split()
        self._draft.add("row", keys)

    def _add_prism(self, line: int, cells: Mapping[str, str]) -> None:
        frame = int(self._number(line, cells, "frame", len(self._draft.sections["row"])))
        offset = [self._number(line, cells, name, 0.0) for name in PRISM[2:]]
        self._draft.add("prism", {"name": cells["prism"], "frame": frame, "offset_mm": offset})

    def _kind(self, line: int, cells: Mapping[str, str]) -> str:
        kind = cells.get("kind", "revolute")
        if kind not in SIGMA:
            raise RigError(self._source, "kind", f"{kind!r} is neither revolute nor prismatic", line)
        return kind

    def _add_joint(self, line: int, cells: Mapping[str, str], kind: str) -> None:
        name = cells.get("joint", "")
        if not name:
            raise RigError(self._source, "joint", "empty; name the joint that the cells of this line describe", line)
        if name in self._kinds:
            given = next(t.keys["limits"] for t in self._draft.sections["joint"] if t.keys["name"] == name)
            assert isinstance(given, list)
            for column, limit in zip(("lower", "upper"), given, strict=True):
                if column in cells and self._number(line, cells, column, 0.0) != limit:
                    reason = f"joint {name!r} has {limit:g} on an earlier line; give the same limits, or give them once"
                    raise RigError(self._source, column, reason, line)
            return
        self._kinds[name] = kind
        low, high = _ASSUMED_LIMITS[kind]
        limits = [self._number(line, cells, "lower", low), self._number(line, cells, "upper", high)]
        keys: dict[str, object] = {"name": name, "kind": kind, "limits": limits, "sigma": SIGMA[kind]}
        if "max_rate" in cells:
            keys["max_rate"] = self._number(line, cells, "max_rate", 0.0)
        self._draft.add("joint", keys, "" if {"lower", "upper"} <= set(cells) else LIMITS_ASSUMED)

    def _terms(self, line: int, text: str) -> dict[str, float]:
        """Return joint -> coefficient of a sum such as `0.5*q1 - q2`."""
        terms, at = dict[str, float](), 0
        while at < len(text):
            found = _TERM.match(text, at)
            if found is None or (terms and not found[1]):
                raise RigError(self._source, "drive", f"{text!r} is not a sum such as 0.5*q1 - q2", line)
            size = float(found[2]) if found[2] else 1.0
            terms[found[3]] = terms.get(found[3], 0.0) + (-size if found[1] == "-" else size)
            at = found.end()
        return terms

    def _number(self, line: int, cells: Mapping[str, str], column: str, default: float) -> float:
        try:
            number = float(cells.get(column, default))
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise RigError(self._source, column, f"{cells[column]!r} is not a number", line)
        return number
