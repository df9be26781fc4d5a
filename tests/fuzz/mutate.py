"""New inputs from old ones: small changes of bytes, lines and JSON, the same for the same seed."""

from __future__ import annotations

import json
import random
import re
import struct
from typing import Any

from tests.fuzz.target import Target

SIZE_MAX = 1 << 18
_MOST_CHANGES = 6
_NUMBERS = (
    *(0, 1, 2, 7, 8, 9, 63, 64, 65, 127, 128, 254, 255, 256, 511, 512, 1785, 4095, 4096, 16000, 32767, 32768, 65535),
    *(65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63, 2**64, 10**18, 10**30, 10**400),
)
_WORDS = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"1e-999", b"-0", b"0x", b"+", b"--1", b"1e5", b"9" * 400, b"9" * 5000, b"."),
    *(
        b"\0",
        b"\r",
        b"\n",
        b"\r\n",
        b"\t",
        b" ",
        b"\x1b[2J",
        b"\xff",
        b"\xef\xbb\xbf",
        "ü€😀".encode(),
        b"\xed\xa0\x80",
    ),
    *(
        b'"',
        b"'",
        b"\\",
        b"{",
        b"}",
        b"[",
        b"]",
        b"(",
        b")",
        b"<",
        b">",
        b"=",
        b":",
        b";",
        b",",
        b"#",
        b"%s",
        b"$NODEID",
    ),
)
_DIGITS = re.compile(rb"[+-]?\d+(?:\.\d+)?")
_TEXTS = (
    *("", "a", "\0", "\n", "\x1b[31m", "ü€😀", "\ud800", "../../etc/passwd", "x" * 300, "x" * 70_000, "<b>", "'; DROP"),
    *("S1", "r", "cp1", "nan", "1e999", "-1", "0", "true", "null"),
)


def mutate(rng: random.Random, target: Target, corpus: list[bytes]) -> bytes:
    """An input for a target, made from its corpus."""
    data = rng.choice(corpus) if corpus else b""
    if target.change is not None and rng.random() < 0.9:
        data = target.change(rng, data, corpus)
    else:
        data = change(rng, target.kind, data, corpus, target.words)
    if target.repair is not None and rng.random() < 0.8:
        data = target.repair(rng, data)
    return data[:SIZE_MAX]


def change(rng: random.Random, kind: str, data: bytes, corpus: list[bytes], words: tuple[bytes, ...] = ()) -> bytes:
    """`data` with a few changes; most often one."""
    for _ in range(min(_MOST_CHANGES, 1 + int(rng.expovariate(1.0)))):
        if kind == "json" and rng.random() < 0.8:
            data = _changed_json(rng, data)
        elif kind != "bytes" and rng.random() < 0.4:
            data = _changed_lines(rng, data, corpus)
        elif kind != "bytes" and rng.random() < 0.3:
            data = _changed_number(rng, data)
        else:
            data = _changed_bytes(rng, data, corpus, words)
    return data[:SIZE_MAX]


def _place(rng: random.Random, data: bytes) -> int:
    return rng.randrange(len(data) + 1)


def _run(rng: random.Random, data: bytes) -> tuple[int, int]:
    start = _place(rng, data)
    return start, min(len(data), start + int(rng.expovariate(0.1)) + 1)


def _changed_bytes(  # noqa: PLR0911 - one change a case
    rng: random.Random, data: bytes, corpus: list[bytes], words: tuple[bytes, ...]
) -> bytes:
    start, end = _run(rng, data)
    match rng.randrange(10):
        case 0:
            at = min(start, max(0, len(data) - 1))
            return data[:at] + bytes(b ^ 1 << rng.randrange(8) for b in data[at : at + 1]) + data[at + 1 :]
        case 1:
            return data[:start] + rng.randbytes(end - start) + data[end:]
        case 2:
            return data[:start] + data[end:]
        case 3:
            return data[:start] + rng.randbytes(rng.randrange(1, 9)) + data[start:]
        case 4:
            return data[:end] + data[start:end] * rng.choice((1, 2, 10, 300)) + data[end:]
        case 5:
            return data[:start] + rng.choice(words or _WORDS) + data[start if rng.random() < 0.5 else end :]
        case 6:
            return data[:start] + rng.choice(_WORDS) + data[end:]
        case 7:
            other = rng.choice(corpus) if corpus else b""
            first, last = _run(rng, other)
            return data[:start] + other[first : rng.choice((last, len(other)))] + data[end:]
        case 8:
            code = rng.choice(("<B", "<H", ">H", "<I", ">I", "<Q", ">Q"))
            size = struct.calcsize(code)
            number = rng.choice(_NUMBERS) - rng.randrange(2)
            return data[:start] + struct.pack(code, number % (1 << 8 * size)) + data[start + size :]
        case _:
            return data[:start]


def _changed_number(rng: random.Random, data: bytes) -> bytes:
    found = [m.span() for m in _DIGITS.finditer(data[:SIZE_MAX])]
    if not found:
        return data
    start, end = rng.choice(found)
    number = str(rng.choice(_NUMBERS))
    new = rng.choice(
        (number, f"-{number}", f"{number}.5", f"0x{int(number):X}", f"{rng.random():.3f}", "1e308", "nan", "")
    )
    return data[:start] + new.encode() + data[end:]


def _changed_lines(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    lines = data.splitlines(keepends=True) or [b""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(6):
        case 0:
            del lines[at]
        case 1:
            lines[at:at] = [lines[other]] * rng.choice((1, 2, 20))
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            more = (rng.choice(corpus) if corpus else b"").splitlines(keepends=True) or [b""]
            lines.insert(at, rng.choice(more))
        case 4:
            words = lines[at].split(b" ")
            rng.shuffle(words)
            lines[at] = b" ".join(words)
        case _:
            lines[at] = lines[at] * rng.choice((2, 50))
    return b"".join(lines)


def value(rng: random.Random, depth: int = 0) -> Any:  # noqa: PLR0911 - one kind a case
    """Any JSON value."""
    match rng.randrange(8 if depth < 3 else 6):
        case 0:
            return None
        case 1:
            return rng.random() < 0.5
        case 2:
            return rng.choice((1, -1)) * rng.choice(_NUMBERS)
        case 3:
            return rng.choice((0.0, -0.0, 0.5, 1e308, 1e-320, -1e300, float("nan"), float("inf"), rng.gauss(0, 1e3)))
        case 4 | 5:
            return rng.choice(_TEXTS)
        case 6:
            return [value(rng, depth + 1) for _ in range(rng.choice((0, 1, 2, 3, 30)))]
        case _:
            return {rng.choice(_TEXTS): value(rng, depth + 1) for _ in range(rng.randrange(4))}


def _changed_json(rng: random.Random, data: bytes) -> bytes:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return _changed_number(rng, data)
    holders: list[Any] = []
    waiting = [document]
    while waiting:
        item = waiting.pop()
        if isinstance(item, dict | list) and item:
            holders.append(item)
            waiting += item.values() if isinstance(item, dict) else item
    if not holders or rng.random() < 0.03:
        document = value(rng)
    else:
        _change_one(rng, rng.choice(holders), SIZE_MAX // (len(data) + 1) + 1)
    if rng.random() < 0.02:
        return b"[" * rng.choice((100, 5000, 100_000)) + data
    try:
        return json.dumps(document).encode()
    except RecursionError:
        return data


def _change_one(rng: random.Random, holder: Any, most: int) -> None:
    """Change one value; none is there more than `most` times afterwards."""
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    key, other = rng.choice(keys), rng.choice(keys)
    match rng.randrange(7):
        case 0:
            del holder[key]
        case 1:
            holder[key] = holder[other]
        case 2 if isinstance(holder, list):
            holder += holder[:1000] * min(most, rng.choice((1, 2, 50, 10_000)))
        case 3:
            for _ in range(rng.choice((1, 3, 900))):
                holder[key] = [holder[key]]
        case 4 if isinstance(holder, dict):
            holder[rng.choice(_TEXTS)] = holder[key]
        case _:
            holder[key] = value(rng)
