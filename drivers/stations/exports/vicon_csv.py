"""Trajectories of Vicon Nexus and Tracker: three columns per marker, one line per frame.

    Trajectories              kind of the block
    100                       frames per second
    ,,rig:tip,,,rig:base      name of each marker above the first of its three columns
    Frame,Sub Frame,X,Y,Z,X,Y,Z
    ,,mm,mm,mm,mm,mm,mm
    1,0,...                   empty cells if a marker was not seen

The separator may be a semicolon. Frame 1 is at 1 / rate seconds. Other kinds of blocks are skipped, and so are empty
lines within this block. A marker has all three coordinates in a frame, or none if it was not seen.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from drivers.stations.export_format import MM_PER, ColumnMap, ExportedFix, ExportFormat, Guess, measured_mm, refuse
from drivers.stations.tables.cells import (
    WHOLE,
    Numbers,
    cells_of,
    decimal_of,
    line_at,
    lines_of,
    number_of,
    why_too_many,
)

_KINDS = {"objects", "devices", "joints", "segments", "model outputs"}


def _recognises(text: str) -> bool:
    return bool(re.search(r"^[ \t]*\"?Trajectories\"?[;,\t ]*\r?$", text, re.MULTILINE))


def _head(text: str, source: str) -> int:
    """Return the index (from 0) of the line with the block's kind."""
    for number, line in enumerate(lines_of(text)):
        if line.strip(' ";,\t').lower() == "trajectories":
            return number
    refuse(source, "the file has no block of trajectories; export trajectories with marker labels")


def _guess(text: str, source: str) -> Guess:
    lines, at = lines_of(text), _head(text, source)
    if len(lines) < at + 5:
        refuse(source, "the block of trajectories ends within its header; export the file again", at + 1)
    separator = next((each for each in (";", "\t", ",") if each in lines[at + 3]), ",")
    rate = number_of(lines[at + 1].strip(' ";,\t'), ",")
    if rate is None or rate <= 0:
        refuse(source, f"{lines[at + 1].strip()!r} is not a number of frames per second", at + 2)
    units = {cell.lower() for cell in cells_of(lines[at + 4], separator) if cell}
    if len(units) != 1 or not units <= MM_PER.keys():
        refuse(source, f"units are {', '.join(sorted(units)) or 'missing'}; export only positions, in mm", at + 5)
    sample = [cell for line in lines[at + 5 : at + 50] for cell in cells_of(line, separator)]
    found = ColumnMap.model_validate(
        {
            "format": FORMAT.name,
            "separator": separator,
            "decimal": decimal_of(sample),
            "header_line": at + 4,
            "first_line": at + 6,
            "length_unit": units.pop(),
            "rate_hz": rate,
        }
    )
    markers = sorted({fix.target for fix in _read(text, found, source)})
    return Guess(found, (f"{rate:g} frames per second of {len(markers)} markers: {', '.join(markers)}",))


def _read(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:
    if columns.rate_hz is None or columns.header_line < 2:
        refuse(source, "the map of trajectories needs rate_hz and header_line; add them")
    lines = lines_of(text)
    header = cells_of(line_at(lines, columns.header_line, source), columns.separator)
    markers = _markers(header, cells_of(lines[columns.header_line - 2], columns.separator), columns, source)
    fixes: list[ExportedFix] = []
    frames: dict[float, int] = {}
    numbers, mm = Numbers(columns.decimal, source), MM_PER[columns.length_unit]
    for number, cells in _rows(lines, columns, source):
        if any(cells[len(header) :]):
            refuse(source, why_too_many(cells, len(header), columns.separator), number)
        frame = number_of(cells[0], ".") if WHOLE.fullmatch(cells[0]) else None
        if frame is None:
            refuse(source, f"{cells[0]!r} is not a frame number", number, header[0])
        if frames.setdefault(frame, number) != number:
            said = f"frame {frame:.0f} is already in line {frames[frame]}"
            refuse(source, f"{said}; export one row per frame, without sub-frames", number, header[0])
        for marker, start in markers.items():
            own = dict(zip("XYZ", [*cells[start : start + 3], "", "", ""], strict=False))
            if not any(own.values()):
                continue
            for axis, cell in own.items():
                if not cell:
                    said = "the cell is empty; a marker must have all three coordinates, or none if it was not seen"
                    refuse(source, said, number, f"{marker} {axis}")
            x, y, z = (mm * numbers.read(cell, number, f"{marker} {axis}") for axis, cell in own.items())
            place = measured_mm((x, y, z), source, number)
            fixes.append(ExportedFix(number, f"{frame:.0f}", marker, place, frame / columns.rate_hz))
    if not fixes:
        refuse(source, "no marker was seen in any frame")
    return fixes


def _markers(header: list[str], names: list[str], columns: ColumnMap, source: str) -> dict[str, int]:
    """Return marker -> index of its first column."""
    axes = "".join(cell.upper() if cell.upper() in ("X", "Y", "Z") else "-" for cell in header)
    markers: dict[str, int] = {}
    for found in re.finditer("XYZ", axes):
        at = found.start()
        marker = (names[at] if at < len(names) else "") or f"unnamed {at + 1}"
        if markers.setdefault(marker, at) != at:
            refuse(source, f"two markers are called {marker!r}; rename one", columns.header_line - 1)
    if not markers:
        refuse(source, "the header has no columns X, Y, Z", columns.header_line)
    return markers


def _rows(lines: list[str], columns: ColumnMap, source: str) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each frame's row, skipping empty lines, until the next block begins."""
    is_after_empty = False
    for number, line in enumerate(lines[columns.first_line - 1 :], columns.first_line):
        cells = cells_of(line, columns.separator)
        if not any(cells):
            is_after_empty = True
            continue
        if cells[0].lower() == "trajectories":
            refuse(source, "a second block of trajectories; save each block as a separate file", number)
        if cells[0].lower() in _KINDS or (is_after_empty and not any(cells[1:]) and number_of(cells[0], ",") is None):
            return
        is_after_empty = False
        yield number, cells


FORMAT = ExportFormat(
    name="vicon_csv", title="Vicon trajectories", rank=25, recognises=_recognises, guess=_guess, read=_read
)
