"""Downloads of the memory of Topcon GTS-200 series stations (docs/reference/protocols.md): records in checked blocks.

    file   = { STX, 128 characters, block number 0 to 9, three digits of block check, ETX, line end }, EOT
    check  = XOR of the characters and the number
    fields = _' job   _( instrument   _) its height   _+ point   _<blank> record   _* code   _, height of the target

A record is the same `?` record that the instrument sends on its serial line, with its own block check.
"""

from __future__ import annotations

import re
from dataclasses import replace

from drivers.clock import Stamp
from drivers.stations.export_format import ColumnMap, ExportedFix, ExportFormat, Guess, refuse
from drivers.stations.survey import RANGE_MAX_M, RecordError, position_mm, range_checked
from drivers.stations.topcon.framing import block_check, decode_frame
from drivers.stations.topcon.records import parse_record

_STX, _ETX, _EOT = "\x02", "\x03", "\x04"
_BLOCK = re.compile(r"\x02?(?P<data>[ -~]{128})(?P<number>\d)(?P<check>\d{3})\x03?")
_FIELD = re.compile(r"_(?P<kind>['()+ *,])(?P<value>[^_]*)")
_NEVER = Stamp(0, 0, "")  # the file has no times


def _recognises(text: str) -> bool:
    return text.lstrip("\r\n").startswith((f"{_STX}_'", "_'"))


def _guess(text: str, source: str) -> Guess:
    fixes = _read(text, ColumnMap(format=FORMAT.name), source)
    codes = sorted({fix.target for fix in fixes if fix.target})
    told = f"codes {', '.join(codes)}" if codes else "no codes"
    notes = (f"{len(fixes)} records of points, with {told}; positions are computed from slope distance and angles",)
    return Guess(ColumnMap(format=FORMAT.name), notes)


def _read(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:  # noqa: ARG001 - the format has no columns
    joined, lines = _blocks(text, source)
    joined = joined.rstrip(" ")  # the last block is padded
    if not joined.endswith("_"):
        refuse(
            source,
            "the download ends within a field, so blocks are missing; download the file again",
            lines[-1] if lines else None,
        )
    joined = joined[:-1]
    fixes: list[ExportedFix] = []
    point, target, stood = "", "", {"'": "", "(": "", ")": ""}
    times_set_up, has_measured = 0, True  # since it was set up
    end = 0
    for match in _FIELD.finditer(joined):
        line = lines[match.start() // 128]
        if match.start() != end:
            refuse(source, f"{joined[end : match.start()][:20]!r} does not belong to any field", line)
        end = match.end()
        value = match["value"]
        match match["kind"]:
            case "'" | "(" | ")" as kind:
                stood[kind] = value.strip()
                if has_measured:
                    times_set_up, has_measured = times_set_up + 1, False
            case "+":
                point, target = value.strip(), ""
            case " ":
                station = "/".join(filter(None, stood.values()))
                fixes.append(replace(_fix(value, point, line, source), station=station, times_set_up=times_set_up))
                has_measured = True
            case "*":
                target = value.strip()
                if target and fixes and fixes[-1].point == point:
                    fixes[-1] = replace(fixes[-1], target=target)
    if joined[end:].strip():
        refuse(source, f"{joined[end:].strip()[:20]!r} does not belong to any field", lines[-1])
    if not fixes:
        refuse(source, "the download has no point records")
    return fixes


def _fix(record: str, point: str, line: int, source: str) -> ExportedFix:
    if not point:
        refuse(source, f"record without a point: {record!r}", line)
    data = decode_frame(record.strip().encode("latin-1"))
    if data is None:
        refuse(source, f"the block check of the record of point {point} is wrong: {record!r}", line)
    try:
        found = parse_record(data, source, _NEVER, _NEVER)
    except RecordError as error:
        refuse(source, f"point {point}: {error}", line)
    found = range_checked(found, RANGE_MAX_M)
    place = position_mm(found)
    if place is None:
        refuse(source, f"point {point}: {found.reason or 'the record has no position'}; remove it from the file", line)
    return ExportedFix(line, point, "", place, prism_constant_mm=found.prism_constant_mm)


def _blocks(text: str, source: str) -> tuple[str, list[int]]:
    """Return the joined data of all blocks and the line number of each block."""
    data: list[str] = []
    lines: list[int] = []
    has_ended = False
    for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1):
        block = line.removesuffix(_ETX)
        if not line.strip(" \x00"):
            continue
        if line.startswith(_EOT):
            has_ended = True
            continue
        if has_ended:
            refuse(source, "a block follows the end of the transmission; save each download as a separate file", number)
        match = _BLOCK.fullmatch(block)
        if match is None:
            refuse(source, f"{len(block)} characters; a block has 128, its number and three digits", number)
        if block_check((match["data"] + match["number"]).encode()) != match["check"].encode():
            refuse(source, f"the block check is wrong: {match['check']}; download the file again", number)
        if int(match["number"]) != len(data) % 10:
            refuse(
                source,
                f"found block {match['number']}, expected block {len(data) % 10}: a block is missing; "
                "download the file again",
                number,
            )
        data.append(match["data"])
        lines.append(number)
    return "".join(data), lines


FORMAT = ExportFormat(
    name="topcon_gts",
    title="Topcon GTS memory download",
    rank=10,
    recognises=_recognises,
    guess=_guess,
    read=_read,
)
