"""Values at a fixed position in a CAN frame, for machines that are described signal by signal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from calibration.rig.channels import RawSignal
from simulators.devices.can.bus import Frame


def pack(channel: RawSignal, value: float) -> bytes:
    """Return eight bytes with the value, clipped to the field's range, in the channel's field and zeros elsewhere."""
    counts = round((value - channel.offset) / channel.scale)
    low, high = (-(1 << channel.length_bits - 1), (1 << channel.length_bits - 1) - 1)
    if not channel.is_signed:
        low, high = 0, (1 << channel.length_bits) - 1
    counts = max(low, min(high, counts)) & ((1 << channel.length_bits) - 1)
    if channel.byte_order == "intel":
        return (counts << channel.start_bit & (1 << 64) - 1).to_bytes(8, "little")
    # Motorola: the start bit is the most significant one; bit 7 of byte 0 is the first on the wire
    first = channel.start_bit // 8 * 8 + 7 - channel.start_bit % 8
    return (counts << 64 - first - channel.length_bits & (1 << 64) - 1).to_bytes(8, "big")


_PERIOD_S = 0.02


class RawSignals:
    """Sends the frames of all channels, each at the same period.

    Args:
        channels: the signals; signals with the same identifier share one frame.
        sources: channel name -> function that returns value and rate at an instant in simulated seconds.
    """

    def __init__(
        self,
        channels: Sequence[RawSignal],
        sources: Mapping[str, Callable[[float], tuple[float, float]]],
    ) -> None:
        self._frames: dict[tuple[int, bool], list[RawSignal]] = {}
        for channel in channels:
            self._frames.setdefault((channel.arbitration_id, channel.is_extended), []).append(channel)
        self._sources, self._next_s = sources, 0.0

    def poll(self, now_s: float) -> list[Frame]:
        """Return the frames that are due."""
        if now_s < self._next_s:
            return []
        self._next_s = now_s + _PERIOD_S
        frames = []
        for (identifier, is_extended), channels in self._frames.items():
            total = 0
            for channel in channels:
                total |= int.from_bytes(pack(channel, self._sources[channel.name](now_s)[0]), "big")
            frames.append(Frame(identifier, total.to_bytes(8, "big"), is_extended=is_extended))
        return frames

    def next_deadline(self) -> float:
        """Return the instant at which the next frames are due."""
        return self._next_s
