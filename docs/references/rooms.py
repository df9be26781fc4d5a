"""A picture of the packages and their layers of rooms (folders), from the import contracts in pyproject.toml."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

_PROJECT = Path(__file__).parents[2] / "pyproject.toml"
_SHOWN = {  # package -> heading, in the order of the columns
    "daemon": "the service and the commands",
    "simulators": "rigs with known errors",
    "drivers": "bytes to readings",
    "calibration": "the mathematics",
}
_USED_BY_RIGCAL = ("daemon", "calibration")
_CHARACTER, _LINE, _FLOOR, _EDGE, _COLUMN = 6.4, 15, 10, 14, 236
_TOP, _HEAD = 92, 46
_STYLE = (
    "text{font:12px system-ui,'DejaVu Sans',sans-serif;fill:#1f2933}"
    ".head{font-weight:600;font-size:14px}.sub{fill:#52606d}"
    ".package{fill:#f5f7fa;stroke:#9aa5b1}.floor{fill:#fff;stroke:#cbd2d9}"
    ".arrow{fill:none;stroke:#52606d;stroke-width:1.5}"
)


def picture() -> str:
    """Return the picture as SVG text; equal contracts give equal text."""
    floors = _floors()
    columns = {name: [_wrapped(rooms) for rooms in floors[name]] for name in _SHOWN}
    bottom = max(_TOP + _HEAD + sum(_height(lines) + _FLOOR for lines in column) for column in columns.values()) + _EDGE
    width = _EDGE + len(_SHOWN) * (_COLUMN + _EDGE)
    parts = [
        f'<rect class="package" x="{_EDGE}" y="{_EDGE}" width="{width - 2 * _EDGE}" height="44" rx="6"/>',
        _text(2 * _EDGE, _EDGE + 27, "rigcal", "head"),
        _text(2 * _EDGE + 60, _EDGE + 27, "the public interface: `import rigcal`", "sub"),
    ]
    for number, (name, column) in enumerate(columns.items()):
        parts += _package(name, column, _EDGE + number * (_COLUMN + _EDGE), bottom - _EDGE)
    return "\n".join(
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {bottom}">',
            "<title>Packages and rooms: imports go down in a package, and left to right between packages</title>",
            "<defs><marker id='tip' markerWidth='8' markerHeight='8' refX='6' refY='4' orient='auto'>"
            "<path d='M1,1 L7,4 L1,7 z' fill='#52606d'/></marker>"
            f"<style>{_STYLE}</style></defs>",
            *parts,
            "</svg>\n",
        )
    )


def _package(name: str, floors: Sequence[Sequence[str]], x: float, bottom: float) -> Iterator[str]:
    yield f'<rect class="package" x="{x}" y="{_TOP}" width="{_COLUMN}" height="{bottom - _TOP}" rx="6"/>'
    if name in _USED_BY_RIGCAL:
        yield f'<path class="arrow" marker-end="url(#tip)" d="M{x + _COLUMN / 2},60 V{_TOP - 4}"/>'
    yield _text(x + 10, _TOP + 19, name, "head")
    yield _text(x + 10, _TOP + 36, _SHOWN[name], "sub")
    y = float(_TOP + _HEAD)
    for lines in floors:
        height = _height(lines)
        yield f'<rect class="floor" x="{x + 8}" y="{y}" width="{_COLUMN - 16}" height="{height}" rx="4"/>'
        for number, line in enumerate(lines):
            yield _text(x + 16, y + 16 + number * _LINE, line)
        y += height + _FLOOR


def _floors() -> Mapping[str, Sequence[Sequence[str]]]:
    """Return package -> its layers in the contracts, from the top, each with its rooms."""
    contracts: Sequence[Mapping[str, Any]] = tomllib.loads(_PROJECT.read_text("utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    return {
        name: [[room.strip() for room in floor.split("|")] for floor in contract["layers"]]
        for contract in contracts
        for name in contract.get("containers", ())
    }


def _wrapped(rooms: Sequence[str]) -> list[str]:
    """Return the names of rooms, wrapped to the width of a column."""
    lines: list[str] = []
    for room in rooms:
        longer = f"{lines[-1]}, {room}" if lines else room
        if lines and len(longer) * _CHARACTER <= _COLUMN - 32:
            lines[-1] = longer
        else:
            lines.append(room)
    return lines


def _height(lines: Sequence[str]) -> float:
    return 9 + _LINE * len(lines)


def _text(x: float, y: float, text: str, style: str = "") -> str:
    kind = f' class="{style}"' if style else ""
    return f'<text x="{x:g}" y="{y:g}"{kind}>{escape(text)}</text>'
