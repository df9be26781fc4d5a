"""CANopen: SDO answers, the set-up of nodes that answer as they please, supervision of a node."""

from __future__ import annotations

import contextlib
import struct

from daemon.acquisition.channel_files import ChannelFiles
from daemon.acquisition.channels import decoder_factories, node_setups
from daemon.rig_files import load_rig
from drivers.can.frame import Frame
from drivers.canopen.cia301 import classify
from drivers.canopen.node_setup import SetupRunner
from drivers.canopen.pdo_channel import PdoChannelDecoder
from drivers.canopen.sdo import Download, SdoExchange, Upload, decode_response
from drivers.canopen.supervision import NodeSupervision
from drivers.errors import DeviceError
from tests.fuzz.streams import START, frames
from tests.fuzz.target import Run, Target

_COMMANDS = tuple(bytes([c]) for c in (0x00, 0x01, 0x10, 0x42, 0x43, 0x47, 0x4B, 0x4F, 0x41, 0x60, 0x80, 0xC1))


def _sdo() -> Run:
    def run(data: bytes) -> None:
        transfer = Upload(0x1018, 1) if data[:1] < b"\x80" else Download(0x1017, 0, b"\1\2")
        exchange = SdoExchange("node 32", transfer)
        for at in range(1, len(data), 8):
            answer = data[at : at + 8]
            with contextlib.suppress(ValueError):
                decode_response(answer)
            try:
                exchange.feed(answer)
            except DeviceError:
                return

    return run


def _setup() -> Run:
    source = load_rig("swdt82")
    files = ChannelFiles.read(source.rig, source.directory)
    setups = [s for s in node_setups(source.rig, files, "boom") if s.node in (32, 48, 60)]

    def run(data: bytes) -> None:
        conversation = SetupRunner()
        for setup in setups:
            conversation.add(setup)
        now, asked = START, b"\x40\0\0\0\0\0\0\0"
        at = 0
        while at < len(data) and (conversation.is_active or at == 0):
            now = now.shifted(1_000_000_000 if data[at] & 0x80 else 1_000_000)
            conversation.advance(now)
            sent = conversation.take_frames()
            asked = next((f.data for f in reversed(sent) if f.arbitration_id >= 0x600), asked)
            node = next((f.arbitration_id - 0x600 for f in reversed(sent) if f.arbitration_id >= 0x600), 32)
            answer, used = _answer(data, at, asked)
            conversation.feed(Frame(0x580 + node, answer), now)
            conversation.take_events()
            at += used
        conversation.abort(now, "the end")
        conversation.take_events()

    return run


def _answer(data: bytes, at: int, asked: bytes) -> tuple[bytes, int]:  # noqa: PLR0911 - one answer a case
    """What a node says to a request: right in form and of any content, or anything; bytes of `data` used up."""
    content, place = data[at + 1 : at + 5].ljust(4, b"\0"), asked[1:4]
    match data[at] & 7:
        case 0 | 1:
            return b"\x43" + place + content, 5
        case 2:
            return b"\x41" + place + content, 5
        case 3:
            return bytes([data[at] & 0x1F]) + content + b"\0\0\0", 5
        case 4:
            return b"\x60" + place + b"\0\0\0\0", 1
        case 5:
            return b"\x80" + place + content, 5
        case 6:
            return b"\x80" + place + struct.pack("<I", 0x06020000), 1
        case _:
            return data[at + 1 : at + 9], 9


def _supervision() -> Run:
    source = load_rig("swdt82")
    files = ChannelFiles.read(source.rig, source.directory)
    factories = decoder_factories(source.rig, files, "boom")
    (setup,) = [one for one in node_setups(source.rig, files, "boom") if one.node == 32]

    def run(data: bytes) -> None:
        made = (make() for make in factories)
        channels = [c for c in made if isinstance(c, PdoChannelDecoder) and c.node == 32]
        node = NodeSupervision(32, channels, setup)
        handlers = list(node.handlers.values())
        for capture in frames(data):
            classify(capture.arbitration_id & 0x7FF)
            node.tick(capture.stamp)
            handlers[capture.arbitration_id % len(handlers)](capture.stamp, capture.data)

    return run


TARGETS = [
    Target("sdo", _sdo, words=_COMMANDS),
    Target("node-setup", _setup, words=_COMMANDS, is_slow=True),
    Target("node-supervision", _supervision, words=_COMMANDS, is_slow=True),
]
