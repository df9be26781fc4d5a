"""Frames and their stamps on a starved computer: `python -m tests.bench.socketcan [--seconds 60] [--json]`.

A sending process puts 8,000 frames of 8 bytes a second on a bus that the kernel stamps on arrival: `vcan0` where there
is one, else UDP on this host, whose datagrams have true receive stamps as SocketCAN's frames have (a socket pair's are
stamped only when they are read). Two processes per core spin beside it. Side by side listen rigcal's link
(`drivers.can_link.CanLink`) and python-can's own logger (`Notifier` with its candump writer). Each frame carries its
number, and the sender notes when it sent it. A bus does not wait for the computer, so the sender runs with real-time
priority where it may; the rate that it reached is told. Exit status 1: rigcal lost a frame that it had received, or its
stamps go back.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import sys
import tempfile
import threading
import time
from array import array
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import can
import numpy as np

from drivers.can.port import OVERFLOW
from drivers.can.ports import CanLinkConfig
from drivers.can_link import CanLink
from drivers.clock import SystemClock
from drivers.logs.can_log import read_can_log
from drivers.readings import CanCapture, DeviceEvent, EventKind, LinkItem
from simulators.devices.can.bus import Frame
from tests.bench.acquisition import SETTLE_S, START_S, Child, cpu_s
from tests.bench.traffic import FRAMES_PER_MS, MULTICAST_GROUP, Bus, MulticastSender, frame_at, number_of, send_all

SPINNERS_PER_CORE = 2
VCAN = "vcan0"


@dataclass(frozen=True)
class Transport:
    """The bus: what python-can calls its kind and its name, and further arguments."""

    interface: Any
    channel: str
    options: dict[str, Any]


@dataclass(frozen=True)
class Heard:
    """What a listener received, in its order.

    Attributes:
        numbers, utc_ns: of the frames.
        monotonic_ns: of the frames; None where the listener does not know it.
        doubtful: how many frames are marked.
        overflowed: frames that the kernel dropped because they were not fetched; None where the listener cannot tell.
        cpu_s: that its process used while it listened.
        events: what else the listener told.
    """

    numbers: array[int]
    utc_ns: array[int]
    monotonic_ns: array[int] | None
    doubtful: int | None
    overflowed: int | None
    cpu_s: float
    events: list[str]


@dataclass(frozen=True)
class Sent:
    """When each frame was sent, by its number."""

    monotonic_ns: array[int]
    utc_ns: array[int]
    seconds: float
    is_real_time: bool


@dataclass(frozen=True)
class Result:
    """How a listener fared.

    Attributes:
        name: which.
        received: frames, each number once.
        repeated: frames more than once.
        lost_in_kernel: that found the socket's buffer full; None: not known.
        dropped: lost otherwise, after the kernel had them; for a listener that cannot tell, all that are lost.
        doubtful: frames stored with a mark; None: it knows no such thing.
        steps_back: frames whose stamp is before that of the frame before.
        late_p50_ms, late_p99_ms, late_max_ms: stamp less the instant of sending.
        early_max_ms: the same, the other way round: a stamp before its frame was sent.
        us_per_frame: CPU time by frame received.
    """

    name: str
    received: int
    repeated: int
    lost_in_kernel: int | None
    dropped: int
    doubtful: int | None
    steps_back: int
    late_p50_ms: float
    late_p99_ms: float
    late_max_ms: float
    early_max_ms: float
    us_per_frame: float


# ---- processes -------------------------------------------------------------------------------------------------------


def run_rigcal(transport: Transport, parent: Connection) -> None:
    """Process: rigcal's link."""
    numbers, utc_ns, monotonic_ns = array("q"), array("q"), array("q")
    doubtful, overflowed, events = 0, 0, list[str]()
    is_up = threading.Event()

    def emit(item: LinkItem) -> None:
        nonlocal doubtful, overflowed
        if isinstance(item, CanCapture):
            numbers.append(number_of(item.data))
            utc_ns.append(item.stamp.utc_ns)
            monotonic_ns.append(item.stamp.monotonic_ns)
            doubtful += item.stamp.is_doubtful
        elif not isinstance(item, DeviceEvent):
            return
        elif item.kind is EventKind.LINK_UP:
            is_up.set()
        elif item.kind is EventKind.FRAMES_DROPPED and OVERFLOW in item.text:
            overflowed += item.code or 0
        else:
            events.append(item.text)

    config = CanLinkConfig(
        name="boom", interface=transport.interface, channel=transport.channel, options=transport.options
    )
    stop = threading.Event()
    loop = threading.Thread(target=CanLink(config, SystemClock()).run, args=(emit, stop))
    loop.start()
    is_up.wait(START_S)
    before_s = cpu_s()
    parent.send("ready")
    parent.recv()
    stop.set()
    loop.join()
    parent.send(Heard(numbers, utc_ns, monotonic_ns, doubtful, overflowed, cpu_s() - before_s, events))


def run_python_can(transport: Transport, path: Path, parent: Connection) -> None:
    """Process: python-can's logger."""
    bus = can.Bus(transport.channel, transport.interface, ignore_config=True, **transport.options)
    notifier = can.Notifier(bus, [can.CanutilsLogWriter(path)])
    before_s = cpu_s()
    parent.send("ready")
    parent.recv()
    notifier.stop()
    bus.shutdown()
    used_s = cpu_s() - before_s
    numbers, utc_ns = array("q"), array("q")
    for capture in read_can_log(path):
        numbers.append(number_of(capture.data))
        utc_ns.append(capture.stamp.utc_ns)
    parent.send(Heard(numbers, utc_ns, None, None, None, used_s, []))


class NotedBus:
    """Notes when each frame was handed to a bus."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._clock = SystemClock()
        self.monotonic_ns, self.utc_ns = array("q"), array("q")

    def send(self, frame: Frame) -> None:
        now = self._clock.now()
        self.monotonic_ns.append(now.monotonic_ns)
        self.utc_ns.append(now.utc_ns)
        self._bus.send(frame)

    def close(self) -> None:
        self._bus.close()


class VcanSender:
    """Frames go to a virtual CAN interface."""

    def __init__(self, channel: str) -> None:
        self._bus = can.Bus(channel, "socketcan", ignore_config=True)

    def send(self, frame: Frame) -> None:
        self._bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False))

    def close(self) -> None:
        self._bus.shutdown()


def run_sender(transport: Transport, seconds: float, parent: Connection) -> None:
    """Process: the bus."""
    is_real_time = False
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
        is_real_time = True
    sender: Bus = (
        VcanSender(transport.channel)
        if transport.interface == "socketcan"
        else MulticastSender(transport.options["port"])
    )
    bus = NotedBus(sender)
    parent.send("ready")
    parent.recv()
    took_s = send_all(bus, seconds)
    parent.send("sent")
    parent.recv()
    bus.send(frame_at(len(bus.utc_ns)))  # the kernel tells of frames that it lost with the next one alone
    bus.close()
    parent.send(Sent(bus.monotonic_ns, bus.utc_ns, took_s, is_real_time))


def spin() -> None:
    """Process: what else the computer has to do."""
    while True:
        pass


# ---- the benchmark ---------------------------------------------------------------------------------------------------


def the_transport() -> Transport:
    """A virtual CAN interface where there is one, else UDP on this host."""
    if Path("/sys/class/net", VCAN).exists():
        return Transport("socketcan", VCAN, {})
    return Transport("udp_multicast", MULTICAST_GROUP, {"port": 20_000 + os.getpid() % 20_000, "hop_limit": 0})


def measure(seconds: float, spinners_per_core: int, directory: Path) -> dict[str, object]:
    """Run the benchmark.

    Returns:
        what `--json` prints.
    """
    transport = the_transport()
    sender = Child(run_sender, transport, seconds)
    rigcal = Child(run_rigcal, transport)
    python_can = Child(run_python_can, transport, directory / "python-can.log")
    for child in (sender, rigcal, python_can):
        child.hear(START_S)
    cores = len(os.sched_getaffinity(0))
    spinners = [mp.get_context("spawn").Process(target=spin, daemon=True) for _ in range(spinners_per_core * cores)]
    for spinner in spinners:
        spinner.start()
    try:
        time.sleep(SETTLE_S)
        sender.tell()
        sender.hear(seconds * 5 + START_S)
        time.sleep(SETTLE_S)
    finally:
        for spinner in spinners:
            spinner.kill()
    sender.tell()
    sent = sender.hear(START_S)
    assert isinstance(sent, Sent)
    time.sleep(SETTLE_S)
    found = []
    for child in (rigcal, python_can):
        child.tell()
        heard = child.hear(seconds + START_S)
        assert isinstance(heard, Heard)
        found.append(heard)
    for child in (sender, rigcal, python_can):
        child.join()
    return {
        "transport": transport.interface,
        "seconds": sent.seconds,
        "sent": len(sent.monotonic_ns),
        "frames_per_s": len(sent.monotonic_ns) / sent.seconds,
        "sender_is_real_time": sent.is_real_time,
        "cores": cores,
        "spinners": len(spinners),
        "results": [asdict(_result("rigcal", found[0], sent)), asdict(_result("python-can", found[1], sent))],
        "events": found[0].events,
    }


def _result(name: str, heard: Heard, sent: Sent) -> Result:
    numbers = np.asarray(heard.numbers)
    count = len(sent.monotonic_ns)
    received = len(np.unique(numbers))
    stamps, origin = (
        (heard.utc_ns, sent.utc_ns) if heard.monotonic_ns is None else (heard.monotonic_ns, sent.monotonic_ns)
    )
    late_ms = (np.asarray(stamps) - np.asarray(origin)[numbers]) / 1e6 if received else np.zeros(1)
    return Result(
        name=name,
        received=received,
        repeated=len(numbers) - received,
        lost_in_kernel=heard.overflowed,
        dropped=count - received - (heard.overflowed or 0),
        doubtful=heard.doubtful,
        steps_back=int(np.count_nonzero(np.diff(np.asarray(stamps)) < 0)),
        late_p50_ms=float(np.percentile(late_ms, 50)),
        late_p99_ms=float(np.percentile(late_ms, 99)),
        late_max_ms=float(late_ms.max()),
        early_max_ms=max(0.0, -float(late_ms.min())),
        us_per_frame=1e6 * heard.cpu_s / max(received, 1),
    )


def table(report: dict[str, object]) -> str:
    """The report for people."""
    results = report["results"]
    events = report["events"]
    assert isinstance(results, list)
    assert isinstance(events, Sequence)

    def known(value: object) -> str:
        return "not known" if value is None else f"{value:,}"

    rows: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("", lambda r: r["name"]),
        ("frames received", lambda r: f"{r['received']:,}"),
        ("lost in the kernel", lambda r: known(r["lost_in_kernel"])),
        ("dropped", lambda r: f"{r['dropped']:,}"),
        ("of doubtful time", lambda r: known(r["doubtful"])),
        ("stamps that go back", lambda r: f"{r['steps_back']:,}"),
        ("stamp late by, p50", lambda r: f"{r['late_p50_ms']:.3f} ms"),
        ("p99", lambda r: f"{r['late_p99_ms']:.3f} ms"),
        ("max", lambda r: f"{r['late_max_ms']:.3f} ms"),
        ("stamp early by, max", lambda r: f"{r['early_max_ms']:.3f} ms"),
        ("CPU per frame", lambda r: f"{r['us_per_frame']:.1f} us"),
    ]
    lines = [
        f"{report['sent']:,} frames in {report['seconds']:.1f} s ({report['frames_per_s']:,.0f}/s of "
        f"{1000 * FRAMES_PER_MS:,}) over {report['transport']}, sender "
        f"{'with' if report['sender_is_real_time'] else 'without'} real-time priority, "
        f"{report['spinners']} spinning processes on {report['cores']} cores"
    ]
    lines += [f"{label:20}" + "".join(f"{cell(result):>16}" for result in results) for label, cell in rows]
    return "\n".join([*lines, *events])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long frames are sent (60)")
    parser.add_argument(
        "--spinners", type=int, default=SPINNERS_PER_CORE, help=f"spinning processes per core ({SPINNERS_PER_CORE})"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object in place of the table")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rigcal-bench-") as directory:
        report = measure(arguments.seconds, arguments.spinners, Path(directory))
    print(json.dumps(report, indent=2) if arguments.json else table(report))
    results = report["results"]
    assert isinstance(results, list)
    sys.exit(1 if results[0]["dropped"] or results[0]["steps_back"] else 0)


if __name__ == "__main__":
    main()
