"""Total stations: framers with interpreters, the whole decoder, and the conversations."""

from __future__ import annotations

import contextlib
import random
import re
from itertools import cycle

from drivers.bytestream import Frame, Framer
from drivers.readings import SerialCapture
from drivers.serialport import SerialConfig
from drivers.sokkia.interpreter import SetInterpreter
from drivers.sokkia.set import SetFramer, checksum
from drivers.station import Interpreter, StationConfig, StationDecoder, start_conversation
from drivers.survey import RecordError
from drivers.topcon.codec import GtsFramer, block_check
from drivers.topcon.interpreter import GtsInterpreter
from drivers.topcon.records import CorrectionScales
from tests.fuzz.streams import START, pieces
from tests.fuzz.target import Run, Target

_LINE = SerialConfig(path="/dev/none")
_CONFIGS = tuple(
    StationConfig(serial=_LINE, **options)
    for options in (
        {"profile": "topcon_gts8"},
        {"profile": "topcon_classic"},
        {"profile": "topcon_classic", "measure": "coordinates", "crlf": False},
        {"profile": "sokkia_set", "init": ("Xe",)},
        {"profile": "sokkia_set", "init": ("A",)},
        {"profile": "passive", "listen_to": "topcon"},
        {"profile": "passive", "listen_to": "sokkia"},
    )
)
_MOST_STEPS = 100
_TOPCON = (
    b"\x06006\x03",
    b"\x15021\x03",
    b"?",
    b"(",
    b"<",
    b"U",
    b"/",
    b"Q",
    b"E",
    b"\x03",
    b"\r\n",
    b"m",
    b"d",
    b"+",
    b"-",
)
_SOKKIA = (b"\x06", b"\x15", b"\r\n", b"E200", b"E321", b"0000000", b"9999999", b"A ", b",", b" ")
_RECORD = re.compile(rb"[?(<U/QE][ -~]*?\d{3}\x03")
_REPLY = re.compile(rb"[^\r\n]* [0-9A-F]{2}\r")


def _framed(framer: Framer, interpreter: Interpreter, data: bytes) -> None:
    sizes = cycle((1, 3, 17, 64))
    at = 0
    while at < len(data):
        size = next(sizes)
        for found in framer.feed(data[at : at + size]):
            if isinstance(found, Frame):
                with contextlib.suppress(RecordError):
                    interpreter.interpret(found.data, START, START)
        assert framer.pending <= 256
        at += size
    framer.flush("end")


def _topcon() -> Run:
    return lambda data: _framed(GtsFramer(), GtsInterpreter("station", CorrectionScales(0.1, 0.1)), data)


def _sokkia() -> Run:
    return lambda data: _framed(SetFramer(), SetInterpreter("station"), data)


def _decoder() -> Run:
    def run(data: bytes) -> None:
        decoder = StationDecoder(_CONFIGS[data[0] % len(_CONFIGS)] if data else _CONFIGS[0])
        stamp = START
        for pause_ns, is_sent, piece in pieces(data[1:]):
            stamp = stamp.shifted(pause_ns)
            decoder.feed(SerialCapture("station", stamp, piece, is_transmitted=is_sent))
        decoder.tick(stamp.shifted(60_000_000_000))

    return run


def _conversation() -> Run:
    def run(data: bytes) -> None:
        conversation = start_conversation(_CONFIGS[data[0] % 5] if data else _CONFIGS[0])
        assert conversation is not None
        now_ns = 1_000_000_000
        for pause_ns, _, piece in pieces(data[1:]):
            now_ns += pause_ns
            conversation.feed(piece, now_ns)
            steps = 0
            while conversation.step(now_ns) is not None:
                steps += 1
                assert steps < _MOST_STEPS, "it would send for ever"
            conversation.wake_ns(now_ns)
            conversation.take_notices()
        conversation.closing()

    return run


def _bcc(rng: random.Random, data: bytes) -> bytes:
    return _RECORD.sub(lambda m: m[0][:-4] + block_check(m[0][:-4]) + b"\x03", data)


def _sum(rng: random.Random, data: bytes) -> bytes:
    return _REPLY.sub(lambda m: m[0][:-3] + checksum(m[0][:-3]) + b"\r", data)


def _bcc_or_sum(rng: random.Random, data: bytes) -> bytes:
    return _bcc(rng, _sum(rng, data))


TARGETS = [
    Target("topcon", _topcon, words=_TOPCON, repair=_bcc),
    Target("sokkia", _sokkia, words=_SOKKIA, repair=_sum),
    Target("station-decoder", _decoder, words=_TOPCON + _SOKKIA, repair=_bcc_or_sum),
    Target("conversation", _conversation, words=_TOPCON + _SOKKIA, repair=_bcc_or_sum),
]
