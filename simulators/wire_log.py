"""A log of everything that a simulated rig sent on its links, for comparison with the data that a host stored.

Each line has fields separated by one blank, including the time in nanoseconds on the monotonic clock that the rig
shares with its host:

    C NS IDENTIFIER FLAGS DATA     a frame on the bus, even without a listener, hexadecimal; flags: - or some of
                                   x (29 bit), r (remote), e (error frame)
    S NS DATA                      bytes sent by the station, hexadecimal
    M NS TARGET X Y Z POSE         a distance measured by the station: target, its true position in the instrument's
                                   frame (mm), the joints' true values (JSON)
    E NS EVENT                     an event of the rig (JSON): the start of a fault, the return of a port
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
        """Log bytes sent by the station."""
        if data:
            self._file.write(f"S {at_ns} {data.hex()}\n")

    def measured(self, at_ns: int, target: str, place_mm: Floats, pose: Mapping[str, float]) -> None:
        """Log a distance that the station measured.

        Args:
            at_ns: time on the monotonic clock.
            target: name of the measured prism or control point.
            place_mm: (3,) its true position in the instrument's frame.
            pose: joint name -> true value, deg or mm.
        """
        x, y, z = place_mm
        rounded = json.dumps({name: round(value, 5) for name, value in pose.items()}, separators=(",", ":"))
        self._file.write(f"M {at_ns} {target} {x:.3f} {y:.3f} {z:.3f} {rounded}\n")

    def event(self, at_ns: int, event: Mapping[str, object]) -> None:
        """Log an event of the rig and flush the log to the file."""
        self._file.write(f"E {at_ns} {json.dumps(event)}\n")
        self._file.flush()
