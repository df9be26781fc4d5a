"""The tip's frames: whatever is to be sent, two frames that a receiver can read come of it."""

from __future__ import annotations

import struct

from drivers.can.frame import DATA_MAX
from drivers.can.tip_frames import FRAMES, TipMessage, TipStatus, encode_tip
from tests.fuzz.target import Run, Target

_INPUT = struct.Struct("<BBIddddd")


def _tip() -> Run:
    statuses = tuple(TipStatus)

    def run(data: bytes) -> None:
        chosen, present, counter, x, y, z, sigma, age = _INPUT.unpack(data[: _INPUT.size].ljust(_INPUT.size, b"\0"))
        message = TipMessage(
            statuses[chosen % len(statuses)],
            (x, y, z) if present & 1 else None,
            sigma if present & 2 else None,
            age if present & 4 else None,
        )
        frames = encode_tip(message, 0x680, counter)
        assert len(frames) == FRAMES
        assert all(len(frame.data) <= DATA_MAX for frame in frames)

    return run


TARGETS = [
    Target("tip-frames", _tip, words=tuple(struct.pack("<d", v) for v in (1e308, float("nan"), float("inf"), -1e6)))
]
