"""Captured logs, DBC and EDS files, as files on a disk."""

from __future__ import annotations

import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from drivers.can.dbc import DbcFile
from drivers.can.raw_signal import SignalDecoder
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.logs.can_log import read_can_log
from drivers.logs.serial_log import read_serial_log
from tests.fuzz.mutate import change
from tests.fuzz.target import Run, Target, check_refusal, scratch_directory

_BLF_HEADER = 144
_OBJECT = struct.Struct("<4sHHLL")
_CONTAINER = struct.Struct("<H6xL4x")
_MESSAGE = re.compile(rb"BO_\s+\d+\s+(\w+)")
_SIGNAL = re.compile(rb"SG_\s+(\w+)")
_STAMP = Stamp(0, 0, "boot")


def on_file(suffix: str, read: Callable[[Path], None]) -> Run:
    """A target that reads a file with this ending; it may refuse with DescriptionError."""
    path = scratch_directory() / f"input{suffix}"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        try:
            read(path)
        except DescriptionError as error:
            check_refusal(error, str(path))

    return run


def _can_log(path: Path) -> None:
    for capture in read_can_log(path):
        assert len(capture.data) <= 8


def _serial_log(path: Path) -> None:
    for _ in read_serial_log(path):
        pass


def _dbc(path: Path) -> None:
    file, text = DbcFile(path), path.read_bytes()
    messages, signals = _MESSAGE.findall(text)[:3], _SIGNAL.findall(text)[:20]
    for message in messages:
        for signal in signals:
            try:
                channel = file.channel("channel", "unit", message.decode("cp1252"), signal.decode("cp1252"))
                decoder = SignalDecoder(channel)
            except (DescriptionError, UnicodeDecodeError):
                continue
            for data in (b"", bytes(8), b"\xff" * 8, b"\x01\x80\x7f\xfe\x00\x10\x20\x30"):
                decoder.decode(_STAMP, data)


def _eds(path: Path) -> None:
    for number in (1, 2):
        TransmitPdo.from_eds(path, 32, number)


def _changed_blf(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    """Change the header, an object, or what a container holds, which is packed again."""
    if len(data) < _BLF_HEADER + _OBJECT.size or rng.random() < 0.3:
        return change(rng, "bytes", data, corpus)
    head, body = bytearray(data[:_BLF_HEADER]), data[_BLF_HEADER:]
    struct.pack_into("<Q", head, 16, 0 if rng.random() < 0.5 else len(data))
    struct.pack_into("<L", head, 32, rng.choice((0, 0, 3, 2**31)))
    _, header_size, version, size, kind = _OBJECT.unpack_from(body)
    if kind != 10 or size > len(body):
        return bytes(head) + change(rng, "bytes", body, corpus)
    method, _ = _CONTAINER.unpack_from(body, _OBJECT.size)
    inside = body[_OBJECT.size + _CONTAINER.size : size]
    if method == 2:
        try:
            inside = zlib.decompressobj().decompress(inside, 1 << 20)
        except zlib.error:
            return change(rng, "bytes", data, corpus)
    objects = inside.split(b"LOBJ")
    at = rng.randrange(len(objects))
    objects[at] = change(rng, "bytes", objects[at], objects)
    inside = b"LOBJ".join(objects) * rng.choice((1, 1, 1, 1, 40))
    packed = zlib.compress(inside) if method == 2 else inside
    content = _CONTAINER.pack(method, len(inside)) + packed
    container = _OBJECT.pack(b"LOBJ", header_size, version, _OBJECT.size + len(content), kind) + content
    rest = body[size + size % 4 :]
    return bytes(head) + container + bytes(len(container) % 4) + (container if rng.random() < 0.2 else rest)


_DBC_WORDS = (
    *(b"BO_ 512 X: 8 A\n", b' SG_ S : 0|8@1+ (1,0) [0|0] "" A\n', b' SG_ M M : 0|8@1+ (1,0) [0|0] "" A\n'),
    *(
        b" m0 ",
        b" m1M ",
        b" M ",
        b"SG_MUL_VAL_ 512 S M 0-255, 4-4294967295;\n",
        b"SIG_VALTYPE_ 512 S : 1;\n",
        b"@0-",
        b"@1+",
    ),
    *(
        b'VAL_ 512 S 255 "SNA" 0 "a" ;\n',
        b'BA_DEF_ "x" INT 0 1;\n',
        b'BA_ "x" 1e9;\n',
        b'CM_ "',
        b"BU_: A B\n",
        b"EV_ ",
    ),
    *(b"VECTOR__INDEPENDENT_SIG_MSG", b"3221225472", b"BO_TX_BU_ 512 : A;\n", b"SIG_GROUP_ 512 g 1 : S;\n", b"16000"),
)
_EDS_WORDS = (
    b" " * 20_000,
    *(
        b"$NODEID+0x180",
        b"[1800sub1]\n",
        b"[1A00]\n",
        b"[1A00sub0]\n",
        b"[1A00Name]\n",
        b"NrOfEntries=255\n",
        b"[Comments]\n",
    ),
    *(
        b"CompactSubObj=255\n",
        b"Lines=99999999\n",
        b"ObjectType=0x8\n",
        b"ObjectType=0x9\n",
        b"DataType=0x1B\n",
        b"1=a\n",
    ),
    *(
        b"DefaultValue=0x60040020\n",
        b"ParameterValue=",
        b"DataType=0xFF\n",
        b"[DummyUsage]\n",
        b"LowLimit=-1\n",
        b"%(a)s",
    ),
)
_LOG_WORDS = (b"##", b"#R8", b"R", b"T", b"20000080#0000000000000000", b"1FFFFFFF#", b"(4294967295.999999)", b"can0")
_ASC_WORDS = (
    *(b"date Sat Sep 30 15:06:13.191 2017\n", b"base dec timestamps absolute\n", b"Begin Triggerblock ", b"ErrorFrame"),
    *(
        b"CANFD",
        b" Rx d 8 ",
        b" Tx r ",
        b"x Rx",
        b"0.1 1 1A0 Rx d 2 01 02\n",
        b"// ",
        b"internal events logged\n",
        b"Start of",
    ),
)

TARGETS = [
    Target("log-candump", lambda: on_file(".log", _can_log), "text", _LOG_WORDS, is_slow=True),
    Target("log-asc", lambda: on_file(".asc", _can_log), "text", _ASC_WORDS, is_slow=True),
    Target("log-blf", lambda: on_file(".blf", _can_log), change=_changed_blf, is_slow=True),
    Target(
        "log-serial", lambda: on_file(".serial", _serial_log), "text", (b"boot b", b" rx ", b" tx ", b"#"), is_slow=True
    ),
    Target("dbc", lambda: on_file(".dbc", _dbc), "text", _DBC_WORDS, is_slow=True),
    Target("eds", lambda: on_file(".eds", _eds), "text", _EDS_WORDS, is_slow=True),
]
