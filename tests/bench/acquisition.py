"""Acquisition under a saturated bus: `python -m tests.bench.acquisition [--seconds 60] [--jobs] [--json]`.

A sending process puts 8,000 frames of 8 bytes a second on a bus between processes, and a station speaks 20 times a
second on a pseudo-terminal. Two processes listen, side by side, to the same frames: rigcal's acquisition (links, raw
capture, decoding, store, packing) and python-can's own logger (`Notifier` and `SqliteWriter`). Counted is every single
frame by the number that it carries. With `--jobs` calibrations with their training run beside, one after the other, as
the daemon's jobs do: with low priority and a process for each core. Exit status 1: rigcal has lost a frame.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import can

from daemon.acquisition.acquisition import Acquisition
from daemon.store import Reader, Store
from daemon.store.upkeep.housekeeping import Housekeeping, Keeping
from drivers.can.ports import CanLinkConfig
from drivers.can_decoder import CanDecoder
from drivers.can_link import CanLink
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import SystemClock
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.link import StationLink
from drivers.stations.serial_port import SerialConfig
from tests.bench.traffic import (
    ENCODER_NODES,
    MULTICAST_GROUP,
    STATION_HZ,
    Bus,
    MulticastSender,
    SlcanSender,
    Station,
    Transport,
    multicast_works,
    number_of,
    send_all,
)

BIT_RATE = 1_000_000
START_S = 30.0
JOB_NICE = 10
MEASURED = Path(__file__).parents[1] / "data" / "ur10_random_poses.csv"
SETTLE_S = 1.0  # after the last frame, before the listeners are stopped
POSITION_32_BIT = 0x60040020  # object 6004h.0, mapped first


@dataclass(frozen=True)
class Listening:
    """Where a listener hears the bus: arguments of python-can's bus."""

    interface: Transport
    channel: str
    options: dict[str, Any]


@dataclass(frozen=True)
class Cost:
    """What a listener used, from the first frame until everything was stored.

    Attributes:
        cpu_s: user and system time of its process.
        packing_s: of these, what packing of captures took.
        writer_lag_p99_s: age of the oldest frame of a batch when it was stored; None where it is not known.
    """

    cpu_s: float
    packing_s: float = 0.0
    writer_lag_p99_s: float | None = None


@dataclass(frozen=True)
class Result:
    """How a listener fared.

    Attributes:
        name: which.
        frames: stored, each number once.
        lost, repeated: frames that are not there, or more than once.
        core_share: CPU time by the time that the frames took, without packing.
        packing_share: likewise, of packing.
        us_per_frame: CPU time by frame stored.
        writer_lag_p99_ms: see Cost.
        bytes_per_frame: size of its database by frame.
        fixes, readings: decoded records in its database; None where it does not decode.
    """

    name: str
    frames: int
    lost: int
    repeated: int
    core_share: float
    packing_share: float
    us_per_frame: float
    writer_lag_p99_ms: float | None
    bytes_per_frame: float
    fixes: int | None = None
    readings: int | None = None


# ---- the listening processes -----------------------------------------------------------------------------------------


def cpu_s() -> float:
    """CPU time of this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def thread_cpu_s(name: str) -> float:
    """CPU time so far of a thread of this process (proc(5), schedstat)."""
    (number,) = (thread.native_id for thread in threading.enumerate() if thread.name == name)
    return int(Path(f"/proc/self/task/{number}/schedstat").read_text(encoding="ascii").split()[0]) / 1e9


def run_rigcal(listening: Listening, station_port: str, path: Path, parent: Connection) -> None:
    """Process: rigcal's acquisition."""
    clock = SystemClock()
    can_link = CanLinkConfig(
        name="boom",
        interface=listening.interface,
        channel=listening.channel,
        bitrate=BIT_RATE,
        options=listening.options,
    )
    station = StationConfig(
        name="station", profile="passive", serial=SerialConfig(path=station_port, baud=115_200), max_speed_m_s=5.0
    )
    encoders = [
        EncoderChannel(
            name=f"theta{node}", node=node, pdo=TransmitPdo.usual(node, 1, [POSITION_32_BIT]), max_rate_per_s=20.0
        )
        for node in ENCODER_NODES
    ]
    store = Store(path)
    store.declare_channels({encoder.name: encoder.unit for encoder in encoders}, {})
    store.begin_run(clock.now())
    acquisition = Acquisition(
        [CanLink(can_link, clock), StationLink(station, clock)],
        {
            "boom": lambda: CanDecoder("boom", [EncoderDecoder(encoder) for encoder in encoders]),
            "station": partial(StationDecoder, station),
        },
        store,
        clock,
        on_records=lambda _: None,
    )
    acquisition.start()
    keeping = Keeping(keep_days=None, free_bytes=0, models=path.parent, backup_directory=None, backups=1)
    housekeeping = Housekeeping(store, clock, keeping)
    housekeeping.start()
    deadline = time.monotonic() + START_S
    while not all(link.up for link in acquisition.status().links) and time.monotonic() < deadline:
        time.sleep(0.05)
    parent.send("ready")
    parent.recv()
    before = cpu_s()
    parent.recv()
    lag_s, packing_s = acquisition.status().writer_lag_p99_s, thread_cpu_s("housekeeping")
    acquisition.stop()
    housekeeping.stop()
    store.end_run(clock.now())
    store.close()
    parent.send(Cost(cpu_s() - before, packing_s, lag_s))


def run_python_can(listening: Listening, path: Path, parent: Connection) -> None:
    """Process: python-can's logger."""
    bus = can.Bus(listening.channel, listening.interface, ignore_config=True, **listening.options)
    writer = can.SqliteWriter(path)
    notifier = can.Notifier(bus, [writer])
    parent.send("ready")
    parent.recv()
    before = cpu_s()
    parent.recv()
    notifier.stop()
    bus.shutdown()
    parent.send(Cost(cpu_s() - before))


def run_sender(port: int | None, seconds: float, parent: Connection) -> None:
    """Process: the bus. Tells the listeners' ports, then sends when told to, then how long it took."""
    bus: Bus
    if port is None:
        bus = slcan = SlcanSender(listeners=2)
        parent.send(slcan.paths)
        while not parent.poll():
            slcan.answer()
            time.sleep(0.01)
    else:
        bus = MulticastSender(port)
        parent.send([])
    parent.recv()
    parent.send(send_all(bus, seconds))
    parent.recv()
    bus.close()


class Child:
    """A process of the benchmark and the pipe to it."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        context = mp.get_context("spawn")
        self.pipe, its_end = context.Pipe()
        self.process = context.Process(target=target, args=(*arguments, its_end), daemon=True)
        self.process.start()
        its_end.close()

    def hear(self, timeout_s: float) -> object:
        """What it says next."""
        if not self.pipe.poll(timeout_s):
            raise SystemExit(f"{self.process.name} has said nothing for {timeout_s:g} s; the benchmark ends")
        return self.pipe.recv()

    def tell(self) -> None:
        """Let it go on."""
        self.pipe.send("go on")

    def join(self) -> None:
        """Wait for its end."""
        self.process.join(START_S)


class Jobs:
    """Calibrations with their training, one after the other, in processes of low priority.

    Attributes:
        done: how many have ended well.
    """

    def __init__(self, directory: Path) -> None:
        self.done = 0
        self._data, self._out = directory / "poses.csv", directory / "model"
        header, *rows = MEASURED.read_text(encoding="utf-8").splitlines(keepends=True)
        self._data.write_text(header + "".join(rows[::8]), encoding="utf-8")
        self._stopping = threading.Event()
        self._running: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin with the first."""
        self._thread.start()

    def stop(self) -> None:
        """End, in the midst of one."""
        self._stopping.set()
        if self._running is not None:
            self._running.terminate()
        self._thread.join()

    def _run(self) -> None:
        command = ["nice", "-n", str(JOB_NICE), sys.executable, "-m", "daemon.cli.main", "calibrate", "--rig", "ur10"]
        command += ["--data", str(self._data), "--out", str(self._out)]
        while not self._stopping.is_set():
            self._running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            said = self._running.communicate()[1]
            if self._running.returncode == 0:
                self.done += 1
            elif not self._stopping.is_set():
                raise SystemExit(f"a calibration has failed: {said.decode()}")


# ---- the benchmark ---------------------------------------------------------------------------------------------------


def measure(seconds: float, transport: Transport, directory: Path, *, has_jobs: bool) -> dict[str, object]:
    """Run the benchmark.

    Args:
        seconds: how long frames are sent.
        transport: the bus.
        directory: for all files.
        has_jobs: calibrations run beside.

    Returns:
        what `--json` prints.
    """
    port = 20_000 + os.getpid() % 20_000 if transport == "udp_multicast" else None
    ours, theirs = directory / "rigcal.sqlite", directory / "python-can.db"
    sender = Child(run_sender, port, seconds)
    paths = sender.hear(START_S)
    listening = [_listening(port, paths, i) for i in range(2)]
    station = Station()
    rigcal = Child(run_rigcal, listening[0], station.path, ours)
    python_can = Child(run_python_can, listening[1], theirs)
    listeners = [rigcal, python_can]
    for child in listeners:
        child.hear(START_S)
    jobs = Jobs(directory) if has_jobs else None
    if jobs is not None:
        jobs.start()
    for child in (*listeners, sender):
        child.tell()
    station.start()
    took_s = sender.hear(seconds * 5 + START_S)
    assert isinstance(took_s, float)
    time.sleep(SETTLE_S)
    station.stop()
    if jobs is not None:
        jobs.stop()
    for child in listeners:
        child.tell()
    costs = [child.hear(seconds + START_S) for child in listeners]
    sender.tell()
    for child in (*listeners, sender):
        child.join()
    sent = round(seconds * 1000) * 8
    results = [
        _result("rigcal", _rigcal_numbers(ours), costs[0], sent, took_s, ours),
        _result("python-can SqliteWriter", _python_can_numbers(theirs), costs[1], sent, took_s, theirs),
    ]
    return {
        "transport": transport,
        "seconds": took_s,
        "frames_sent": sent,
        "frames_per_s": sent / took_s,
        "fixes_sent": station.sent,
        "calibrations": 0 if jobs is None else jobs.done,
        "results": [asdict(result) for result in results],
    }


def _listening(port: int | None, paths: object, index: int) -> Listening:
    if port is not None:
        return Listening("udp_multicast", MULTICAST_GROUP, {"port": port, "hop_limit": 0})
    assert isinstance(paths, list)
    return Listening("slcan", paths[index], {"sleep_after_open": 0.0})


def _rigcal_numbers(path: Path) -> tuple[list[int], int, int]:
    """Numbers of the frames in a store, and how many fixes and joint samples it has."""
    with Reader(path) as reader:
        numbers = [number_of(capture.data) for capture in reader.captures("boom")]
        counts = next(
            reader.rows("SELECT (SELECT count(*) FROM fixes) AS f, (SELECT count(*) FROM joint_samples) AS j")
        )
    return numbers, counts["f"], counts["j"]


def _python_can_numbers(path: Path) -> tuple[list[int], None, None]:
    connection = sqlite3.connect(path)
    numbers = [number_of(data) for (data,) in connection.execute("SELECT data FROM messages")]
    connection.close()
    return numbers, None, None


def _result(
    name: str,
    found: tuple[list[int], int | None, int | None],
    cost: object,
    sent: int,
    took_s: float,
    path: Path,
) -> Result:
    assert isinstance(cost, Cost)
    numbers, fixes, readings = found
    frames = len(set(numbers) & set(range(sent)))
    return Result(
        name=name,
        frames=frames,
        lost=sent - frames,
        repeated=len(numbers) - frames,
        core_share=(cost.cpu_s - cost.packing_s) / took_s,
        packing_share=cost.packing_s / took_s,
        us_per_frame=1e6 * cost.cpu_s / max(frames, 1),
        writer_lag_p99_ms=None if cost.writer_lag_p99_s is None else 1000 * cost.writer_lag_p99_s,
        bytes_per_frame=path.stat().st_size / max(frames, 1),
        fixes=fixes,
        readings=readings,
    )


def table(report: dict[str, object]) -> str:
    """The report for people."""
    results = report["results"]
    assert isinstance(results, list)
    rows: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("", lambda r: r["name"]),
        ("frames stored", lambda r: f"{r['frames']:,}"),
        ("frames lost", lambda r: f"{r['lost']:,}"),
        ("share of one core", lambda r: f"{100 * r['core_share']:.1f} %"),
        ("and for packing", lambda r: f"{100 * r['packing_share']:.1f} %"),
        ("CPU per frame", lambda r: f"{r['us_per_frame']:.1f} us"),
        ("database per frame", lambda r: f"{r['bytes_per_frame']:.1f} B"),
        ("writer lag, p99", lambda r: "-" if r["writer_lag_p99_ms"] is None else f"{r['writer_lag_p99_ms']:.0f} ms"),
        ("readings decoded", lambda r: "-" if r["readings"] is None else f"{r['readings']:,}"),
        ("fixes decoded", lambda r: "-" if r["fixes"] is None else f"{r['fixes']:,}"),
    ]
    lines = [
        f"{report['frames_sent']:,} frames in {report['seconds']:.1f} s ({report['frames_per_s']:,.0f}/s) over "
        f"{report['transport']}, {report['fixes_sent']:,} fixes at {STATION_HZ} Hz, "
        f"{report['calibrations']} calibrations beside"
    ]
    lines += [f"{label:20}" + "".join(f"{cell(result):>26}" for result in results) for label, cell in rows]
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long the bus is saturated (60)")
    parser.add_argument(
        "--transport", choices=("udp_multicast", "slcan"), help="the bus; udp_multicast where the host has multicast"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object in place of the table")
    parser.add_argument("--jobs", action="store_true", help="calibrations and training run beside")
    arguments = parser.parse_args()
    transport: Transport = arguments.transport or (
        "udp_multicast" if multicast_works(20_000 + os.getpid() % 20_000) else "slcan"
    )
    with tempfile.TemporaryDirectory(prefix="rigcal-bench-") as directory:
        report = measure(arguments.seconds, transport, Path(directory), has_jobs=arguments.jobs)
    print(json.dumps(report, indent=2) if arguments.json else table(report))
    results = report["results"]
    assert isinstance(results, list)
    sys.exit(1 if results[0]["lost"] else 0)


if __name__ == "__main__":
    main()
