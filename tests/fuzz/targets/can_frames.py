"""CAN: what comes over SocketCAN, multicast and slcan, and the decoder of a link with channels of every kind."""

from __future__ import annotations

import contextlib

import msgpack

from daemon.acquisition.channel_files import ChannelFiles
from daemon.acquisition.channels import decoder_factories
from daemon.rig_files import load_rig
from drivers.can.error_frames import BusErrors
from drivers.can.frame import DATA_MAX, EXTENDED_ID_MAX, Frame, SlcanLines, parse_can_frame, parse_multicast
from drivers.can.j1939 import J1939Id
from drivers.can.raw_signal import BitField, SignalChannel, SignalDecoder
from drivers.can_decoder import CanDecoder
from tests.fuzz.streams import frames
from tests.fuzz.target import Run, Target

_IDS = (*(0x080, 0x081, 0x0A0, 0x0A1, 0x100, 0x1A0, 0x1A1, 0x1B0, 0x1BC, 0x201, 0x280, 0x5A0, 0x720, 0x730, 0x73C), 0)
_IDENTIFIERS = tuple(identifier.to_bytes(4, "little") for identifier in (*_IDS, 0x0CFE3021, 0x18FEEE00, 0x1FFFFFFF))
_ENTRY = {
    "timestamp": 1.0,
    "arbitration_id": 0x1A0,
    "is_extended_id": False,
    "is_remote_frame": False,
    "is_error_frame": False,
    "is_fd": False,
    "data": b"\1\2",
}
_PACKED = tuple(msgpack.packb(item) for item in (*_ENTRY, *_ENTRY.values(), {}, [], -1, 2**63, 1e308, float("nan")))


def _check(frame: Frame | None) -> None:
    if frame is not None:
        assert 0 <= frame.arbitration_id <= EXTENDED_ID_MAX
        assert len(frame.data) <= DATA_MAX


def _socketcan() -> Run:
    return lambda data: _check(parse_can_frame(data))


def _multicast() -> Run:
    def run(data: bytes) -> None:
        parsed = parse_multicast(data)
        _check(None if parsed is None else parsed[0])

    return run


def _slcan() -> Run:
    def run(data: bytes) -> None:
        lines = SlcanLines()
        for at in range(0, len(data), 7):
            for frame in lines.feed(data[at : at + 7]):
                _check(frame)

    return run


def _decoder() -> Run:
    source = load_rig("swdt82")
    factories = decoder_factories(source.rig, ChannelFiles.read(source.rig, source.directory), "boom")
    raw = SignalChannel(
        name="raw", unit="x", arbitration_id=0x18FEEE00, is_extended=True, field=BitField(0, 8, "intel")
    )
    real = SignalChannel(name="real", unit="x", arbitration_id=0x333, is_float=True, field=BitField(0, 64, "intel"))

    def run(data: bytes) -> None:
        decoder = CanDecoder("boom", [*(make() for make in factories), SignalDecoder(raw), SignalDecoder(real)])
        stamp = None
        for capture in frames(data):
            stamp = capture.stamp
            decoder.feed(capture)
            decoder.tick(stamp)
        if stamp is not None:
            str(decoder.summary(stamp))

    return run


def _bus_errors() -> Run:
    def run(data: bytes) -> None:
        errors = BusErrors("boom")
        for capture in frames(data):
            errors.feed(capture.stamp, capture.arbitration_id, capture.data)

    return run


def _j1939() -> Run:
    def run(data: bytes) -> None:
        with contextlib.suppress(ValueError):
            str(J1939Id.parse(int.from_bytes(data[:5], "little", signed=True)))

    return run


TARGETS = [
    Target("can-frame", _socketcan),
    Target("can-multicast", _multicast, words=_PACKED),
    Target(
        "can-slcan", _slcan, words=(b"t1A08", b"T0CFE30218", b"r1A00", b"R", b"\r", b"\a", b"z", b"Z", b"00" * 8, b"F")
    ),
    Target("can-decoder", _decoder, words=_IDENTIFIERS, is_slow=True),
    Target("can-errors", _bus_errors),
    Target("j1939", _j1939),
]
