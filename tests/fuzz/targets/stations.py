"""Total stations: framers with parsers, the whole decoder, and the pollers."""

from __future__ import annotations

import contextlib
import random
import re
from itertools import cycle

from drivers.clock import Stamp
from drivers.readings import SerialCapture
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.link import start_poller
from drivers.stations.profile import Codec
from drivers.stations.replies import ACK, NAK, Frame
from drivers.stations.serial_port import SerialConfig
from drivers.stations.sokkia.codec import CODEC as SOKKIA
from drivers.stations.sokkia.codec import checksum
from drivers.stations.survey import RecordError
from drivers.stations.topcon.codec import CODEC as TOPCON
from drivers.stations.topcon.framing import block_check
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


def _framed(codec: Codec, data: bytes) -> None:
    framer, parser = codec.framer(), codec.parser("station", _CONFIGS[0])
    sizes = cycle((1, 3, 17, 64))
    at = 0
    while at < len(data):
        size = next(sizes)
        for found in framer.feed(data[at : at + size]):
            if isinstance(found, Frame) and found.data not in (ACK, NAK):
                with contextlib.suppress(RecordError):
                    parser.parse(found.data, START, START)
        assert framer.pending <= 256
        at += size
    framer.flush("end")


def _topcon() -> Run:
    return lambda data: _framed(TOPCON, data)


def _sokkia() -> Run:
    return lambda data: _framed(SOKKIA, data)


def _decoder() -> Run:
    def run(data: bytes) -> None:
        decoder = StationDecoder(_CONFIGS[data[0] % len(_CONFIGS)] if data else _CONFIGS[0])
        stamp = START
        for pause_ns, is_sent, piece in pieces(data[1:]):
            stamp = stamp.shifted(pause_ns)
            decoder.feed(SerialCapture("station", stamp, piece, is_transmitted=is_sent))
        decoder.tick(stamp.shifted(60_000_000_000))

    return run


def _poller() -> Run:
    def run(data: bytes) -> None:
        poller = start_poller(_CONFIGS[data[0] % 5] if data else _CONFIGS[0])
        assert poller is not None
        now_ns = 1_000_000_000
        for pause_ns, _, piece in pieces(data[1:]):
            now_ns += pause_ns
            poller.feed(SerialCapture("station", Stamp(0, now_ns, "fuzz"), piece))
            steps = 0
            while poller.step(now_ns) is not None:
                steps += 1
                assert steps < _MOST_STEPS, "it would send for ever"
            poller.wake_ns(now_ns)
            poller.take_notices()
        poller.closing()

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
    Target("conversation", _poller, words=_TOPCON + _SOKKIA, repair=_bcc_or_sum),
]
