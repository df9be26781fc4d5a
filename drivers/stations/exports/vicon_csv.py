"""Trajectories of Vicon Nexus and Tracker: a marker takes three columns, a frame a line.

    Trajectories              the kind of the block
    100                       frames a second
    ,,rig:tip,,,rig:base      a marker above the first of its three columns
    Frame,Sub Frame,X,Y,Z,X,Y,Z
    ,,mm,mm,mm,mm,mm,mm
    1,0,...                   empty where a marker was not seen

The separator may be a semicolon. Frame 1 is at 1 / rate seconds. Other kinds of blocks are passed over.
"""

from __future__ import annotations

import re

from drivers.stations.delimited import cells_of, decimal_of, line_at, lines_of, number_of, why_no_number
from drivers.stations.export_format import MM_PER, ColumnMap, ExportedFix, ExportFormat, Guess, refuse

_KINDS = {"trajectories", "objects", "devices", "joints", "segments", "model outputs"}


def _recognises(text: str) -> bool:
    return bool(re.search(r"^[ \t]*\"?Trajectories\"?[;,\t ]*\r?$", text, re.MULTILINE))


def _head(text: str, source: str) -> int:
    """Return the line of the block's kind, from 0."""
    for number, line in enumerate(lines_of(text)):
        if line.strip(' ";,\t').lower() == "trajectories":
            return number
    refuse(source, "the file has no block of trajectories; export them with the labels of the markers")


def _guess(text: str, source: str) -> Guess:
    lines, at = lines_of(text), _head(text, source)
    if len(lines) < at + 5:
        refuse(source, "the block of trajectories ends within its header", at + 1)
    separator = next((each for each in (";", "\t", ",") if each in lines[at + 3]), ",")
    rate = number_of(lines[at + 1].strip(' ";,\t'), ",")
    if rate is None or rate <= 0:
        refuse(source, f"{lines[at + 1].strip()!r} is not a number of frames a second", at + 2)
    units = {cell.lower() for cell in cells_of(lines[at + 4], separator) if cell}
    if len(units) != 1 or not units <= MM_PER.keys():
        refuse(source, f"units are {', '.join(sorted(units)) or 'missing'}; export positions alone, in mm", at + 5)
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
    return Guess(found, (f"{rate:g} frames a second of {len(markers)} markers: {', '.join(markers)}",))


def _read(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:
    if columns.rate_hz is None or columns.header_line < 2:
        refuse(source, "the map of trajectories needs rate_hz and header_line")
    lines = lines_of(text)
    header = cells_of(line_at(lines, columns.header_line, source), columns.separator)
    names = cells_of(lines[columns.header_line - 2], columns.separator)
    axes = "".join(cell.upper() if cell.upper() in ("X", "Y", "Z") else "-" for cell in header)
    starts = [found.start() for found in re.finditer("XYZ", axes)]
    if not starts:
        refuse(source, "the header has no columns X, Y, Z", columns.header_line)
    fixes: list[ExportedFix] = []
    mm = MM_PER[columns.length_unit]
    for number, line in enumerate(lines[columns.first_line - 1 :], columns.first_line):
        cells = cells_of(line, columns.separator)
        if not any(cells) or cells[0].lower() in _KINDS:
            break  # the next block
        frame = number_of(cells[0], columns.decimal)
        if frame is None:
            refuse(source, f"{cells[0]!r} is not the number of a frame", number, header[0])
        for start in starts:
            own = cells[start : start + 3]
            if len(own) < 3 or not any(own):
                continue
            values = [number_of(cell, columns.decimal) for cell in own]
            marker = names[start] if start < len(names) and names[start] else f"unnamed {start + 1}"
            for axis, value, cell in zip("XYZ", values, own, strict=True):
                if value is None:
                    refuse(source, why_no_number(cell), number, f"{marker} {axis}")
            x, y, z = (mm * value for value in values if value is not None)
            fixes.append(ExportedFix(number, f"{frame:g}", marker, (x, y, z), frame / columns.rate_hz))
    if not fixes:
        refuse(source, "no marker was seen in any frame")
    return fixes


FORMAT = ExportFormat(
    name="vicon_csv", title="Vicon trajectories", rank=25, recognises=_recognises, guess=_guess, read=_read
)
