"""Columns of tables: their roles according to the names in the header, and the choice of columns to read."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from drivers.stations.export_format import Role, refuse
from drivers.stations.tables.named_units import bracket_words, without_unit

_NAMES: Mapping[Role, str] = {
    "point": "point pointname pointid pointnumber pointno ptid ptno pt pid name id label no nr pose punkt punktnr "
    "punktnummer punktname punktnavn punktnamn punktid ptnr pkt pktnr pktname",
    "x": "x east easting e xcoordinate xactual actualx measuredx xmeasured rechtswert rw ost öst øst",
    "y": "y north northing n ycoordinate yactual actualy measuredy ymeasured hochwert hw nord norr",
    "z": "z height elevation elev up orthoheight zcoordinate zactual actualz measuredz zmeasured höhe hoehe h höjd "
    "høyde ellipheight",
    "hz": "hz hzangle horizontalangle hangle azimuth hzcircle",
    "zenith": "v vz zenith zenithangle verticalangle vangle vcircle",
    "distance": "sd slopedistance slopedist distance range d",
    "prism": "prism code target reflector marker",
    "prism_constant": "prismconstant prismconst prismoffset reflectorconstant reflectorconst prismenkonstante "
    "additionskonstante",
    "target_height": "targetheight targetht heightoftarget reflectorheight reflectorht heightofreflector prismheight "
    "prismht rodheight poleheight hr th ht zielhöhe zielhoehe reflektorhöhe reflektorhoehe prismenhöhe prismenhoehe",
    "station": "station stationname stationid stationno stationnr stn setup setupname setupid setupno standpunkt "
    "standpunktnr instrumentstation",
    "date": "date measurementdate",
    "time": "time datetime timestamp dateandtime measurementtime times utc",
}
_SYNONYMS: Mapping[Role, frozenset[str]] = {role: frozenset(words.split()) for role, words in _NAMES.items()}
CARTESIAN: tuple[Role, ...] = ("x", "y", "z")
POLAR: tuple[Role, ...] = ("hz", "zenith", "distance")
_OF_AXES = re.compile(r"[xyz]|[xyz](coordinate|actual|measured)|(actual|measured)[xyz]")  # names without a direction


def roles_of_cells(cells: list[str]) -> dict[Role, list[str]]:
    """Return role -> cells of a header that may have it, by their names and for measured columns also by remarks.

    A remark that is a single letter is ignored if the name gives a direction: `Hochwert (X)` is north.
    """
    roles: dict[Role, list[str]] = {}
    for cell in cells:
        name = without_unit(cell)
        own = _roles_of(name)
        for remark in bracket_words(cell) if set(own) & {*CARTESIAN, *POLAR} else []:
            if len(_plain(remark)) > 1 or remark.lower() not in CARTESIAN or _OF_AXES.fullmatch(_plain(name)):
                own += [role for role in _roles_of(remark.lower()) if role not in own]
        for role in own:
            roles.setdefault(role, []).append(cell)
    return roles


def _plain(name: str) -> str:
    return re.sub(r"(?!^-)[\W_]", "", name.lower())  # -Z points down


def _roles_of(name: str) -> list[Role]:
    plain = _plain(name)
    return [role for role, words in _SYNONYMS.items() if plain in words]


def one_of_each(found: dict[Role, list[str]], header_line: int, source: str, notes: list[str]) -> dict[Role, str]:
    """Return the column of each role, preferring coordinates to angles.

    Args:
        found: role -> columns that may have it.
        header_line: line number of the header.
        source: name of the file, for error messages.
        notes: a note is added for each role with several possible columns.

    Raises:
        DescriptionError: two columns may be the same coordinate, angle or distance, or it is unknown which of X and Y
            is east.
    """
    left_out = POLAR if found.keys() >= set(CARTESIAN) else CARTESIAN
    roles: dict[Role, str] = {}
    for role, cells in found.items():
        if role in left_out:
            continue
        if len(cells) > 1 and role in (*CARTESIAN, *POLAR):
            said = " and ".join(map(repr, cells))
            todo = f"rename one, or write a map with the right one ({role} in [columns]) and pass it with --map"
            refuse(source, f"columns {said} may both be {role}; {todo}", header_line)
        roles[role] = cells[0]
        if len(cells) > 1:
            notes.append(f"{role} is read from {cells[0]!r}, although columns {', '.join(cells)} are possible")
    _check_axes(list(roles), [roles[role] for role in ("x", "y") if role in roles], header_line, source)
    return roles


def _check_axes(order: Sequence[Role], columns: Sequence[str], header_line: int, source: str) -> None:
    """Refuse a column Y before X, the order of grids whose X is north, if no name or remark shows which is east."""
    if "x" not in order or order.index("x") < order.index("y"):
        return
    remarks = [_plain(remark) for column in columns for remark in bracket_words(column)]
    is_said = any(set(_roles_of(remark)) & {"x", "y"} and remark not in ("x", "y") for remark in remarks)
    if not is_said and all(_OF_AXES.fullmatch(_plain(without_unit(column))) for column in columns):
        x, y = columns
        said = f"{y!r} is before {x!r}, as in grids whose X is north, and it is not stated which is east"
        todo = f'write a map that states it in [columns] (x = "{y}", y = "{x}" for such a grid) and pass it with --map'
        refuse(source, f"{said}; rename them to East and North, or {todo}", header_line)
