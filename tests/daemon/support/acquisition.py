"""Links, decoders and a whole acquiring process for tests of acquisition."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from daemon.acquisition.acquisition import Acquisition
from daemon.store import Reader, Store
from drivers.can.ports import CanLinkConfig
from drivers.can_link import CanLink
from drivers.clock import Stamp, SystemClock
from drivers.readings import (
    CanCapture,
    Capture,
    Gap,
    GapReason,
    LinkItem,
    LinkLoop,
    Reading,
    Record,
    SerialCapture,
    Status,
)
from tests.daemon.support.store import fix, table
from tests.drivers.multicast import GROUP

DEADLINE_S = 20.0

Make = Callable[..., Acquisition]


def raw(path: Path) -> list[Capture]:
    """The captures that are stored, in order."""
    with Reader(path) as reader:
        return [*reader.captures()]


def values(path: Path) -> list[float]:
    """The samples of joints that are stored, in order."""
    return [row["value"] for row in table(path, "joint_samples")]


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for `condition`; fail the test when it does not come true."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true in time"
        time.sleep(0.005)


class ListLink:
    """Emits what it is given, then waits for `stop`.

    Args:
        name: of the link.
        items: what to emit.
        gate: emits only once it is set.
    """

    read_until: Stamp | None = None

    def __init__(self, name: str, items: Iterable[LinkItem], gate: threading.Event | None = None) -> None:
        self.name = name
        self.done = threading.Event()
        self._items, self._gate = items, gate

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        while self._gate is not None and not self._gate.wait(0.01) and not stop.is_set():
            pass
        for item in self._items:
            emit(item)
        self.done.set()
        stop.wait()


class NumberDecoder:
    """Frames carry a number: its reading. Serial bytes are fixes. Remembers what it was given.

    Args:
        kill_at: the process dies when the frame with this number is decoded.
        fail_at: raises at this number.
    """

    def __init__(self, kill_at: int = -1, fail_at: int = -1) -> None:
        self.fed: list[Capture] = []
        self.ticks: list[Stamp] = []
        self._kill_at, self._fail_at = kill_at, fail_at

    def feed(self, capture: Capture) -> Sequence[Record]:
        self.fed.append(capture)
        if isinstance(capture, SerialCapture):
            seconds = (capture.stamp.monotonic_ns - 5_000_000_000) / 1e9
            return [fix(seconds)]
        number = int.from_bytes(capture.data, "little")
        if number == self._kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        if number == self._fail_at:
            raise ZeroDivisionError("a defect")
        return [Reading("theta1", capture.stamp, float(number), "deg", Status.OK, number)]

    def tick(self, now: Stamp) -> Sequence[Record]:
        self.ticks.append(now)
        return []


class SilenceDecoder(NumberDecoder):
    """Reports a gap at the first tick after 0.5 s without a frame."""

    def tick(self, now: Stamp) -> Sequence[Record]:
        super().tick(now)
        if self.fed and now.monotonic_ns - self.fed[-1].stamp.monotonic_ns > 500_000_000:
            return [Gap("theta1", GapReason.SILENT, self.fed[-1].stamp)]
        return []


class NumberSource:
    """A link that emits numbered frames, fast, until it is stopped."""

    name = "boom"
    read_until: Stamp | None = None

    def __init__(self, clock: SystemClock) -> None:
        self._clock = clock

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        number = 0
        while not stop.wait(0.001):
            for _ in range(8):
                emit(CanCapture("boom", self._clock.now(), 0x181, number.to_bytes(8, "little")))
                number += 1


def main() -> None:
    """A process that acquires numbered frames into the store `argv[1]` until it is killed (itself at `argv[2]`).

    They are its own, or come over the bus between processes with the port `argv[3]`.
    """
    clock = SystemClock()
    store = Store(Path(sys.argv[1]))
    store.declare_channels({"theta1": "deg"}, {})
    store.begin_run(clock.now())
    kill_at = int(sys.argv[2])
    link: LinkLoop = NumberSource(clock)
    if len(sys.argv) > 3:
        options = {"port": int(sys.argv[3]), "hop_limit": 0}
        link = CanLink(CanLinkConfig(name="boom", interface="udp_multicast", channel=GROUP, options=options), clock)
    acquisition = Acquisition(
        [link],
        {"boom": lambda: NumberDecoder(kill_at)},
        store,
        clock,
        batch_seconds=0.01,
        on_records=lambda _: None,
    )
    acquisition.start()
    print("acquiring", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
