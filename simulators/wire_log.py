"""A log of everything that a simulated rig put on its links, to be compared with what a host has stored.

Lines of text, fields apart by one blank, each with the instant in nanoseconds on the monotonic clock that the rig
shares with its host:

    C NS IDENTIFIER FLAGS DATA     a frame on the bus, whether or not anybody listened, hexadecimal; flags: - or some of
                                   x (29 bit), r (remote), e (error frame)
    S NS DATA                      bytes that left the station, hexadecimal
    M NS TARGET X Y Z POSE         a distance that the station measured: to which target, its true place in the
                                   instrument's frame (mm), the joints' true values (JSON)
    E NS EVENT                     what happened to the rig (JSON): faults as they began, ports that came back
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType

from simulators.devices.can.bus import Frame
from simulators.devices.machine import Floats


class WireLog:
    """Writes the log; a context manager.

    Args:
        path: the file; lines are appended.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="ascii")

    def __enter__(self) -> WireLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def frames(self, at_ns: int, frames: Iterable[Frame]) -> None:
        """Log frames that appeared on the bus."""
        for frame in frames:
            flags = "x" * frame.is_extended + "r" * frame.is_remote + "e" * frame.is_error or "-"
            self._file.write(f"C {at_ns} {frame.arbitration_id:X} {flags} {frame.data.hex()}\n")

    def station(self, at_ns: int, data: bytes) -> None:
        """Log bytes that left the station."""
        if data:
            self._file.write(f"S {at_ns} {data.hex()}\n")

    def measured(self, at_ns: int, target: str, place_mm: Floats, pose: Mapping[str, float]) -> None:
        """Log a distance that the station measured."""
        x, y, z = place_mm
        rounded = json.dumps({name: round(value, 5) for name, value in pose.items()}, separators=(",", ":"))
        self._file.write(f"M {at_ns} {target} {x:.3f} {y:.3f} {z:.3f} {rounded}\n")

    def event(self, at_ns: int, event: Mapping[str, object]) -> None:
        """Log an event of the rig; it is written to the disk with all before it."""
        self._file.write(f"E {at_ns} {json.dumps(event)}\n")
        self._file.flush()
