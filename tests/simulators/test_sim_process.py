"""The simulator as a process of its own: ptys, JSON lines, signals."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
import serial

from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth

DEADLINE_S = 20.0
RATE = 20.0


class Process:
    def __init__(self, folder: Path, *arguments: str) -> None:
        self.can, self.station = folder / "can", folder / "station"
        command = [sys.executable, "-m", "simulators", "--rig", "swdt82", "--seed", "1", "--rate", str(RATE)]
        ports = ["--can-port", str(self.can), "--station-port", str(self.station), "--signal-ms", "100"]
        self.process = subprocess.Popen(
            [*command, *ports, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._lines: queue.Queue[bytes] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def next(self, event: str) -> dict[str, object]:
        """The next event of that name; others are skipped."""
        end = time.monotonic() + DEADLINE_S
        while True:
            got = json.loads(self._lines.get(timeout=max(0.01, end - time.monotonic())))
            if got["event"] in (event, "error"):
                return got

    def do(self, event: str, text: str = "", **command: object) -> dict[str, object]:
        assert self.process.stdin is not None
        self.process.stdin.write((text or json.dumps(command)).encode() + b"\n")
        self.process.stdin.flush()
        return self.next(event)

    def end(self) -> tuple[int, bytes]:
        """Exit status and what it complained of."""
        assert self.process.stdin is not None
        assert self.process.stderr is not None
        if not self.process.stdin.closed:
            self.process.stdin.close()
        status = self.process.wait(DEADLINE_S)
        self._reader.join()
        complaint = b"" if self.process.stderr.closed else self.process.stderr.read()
        self.process.stderr.close()
        if self.process.stdout is not None:
            self.process.stdout.close()
        return status, complaint


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Process]:
    process = Process(tmp_path, "--effects", "backlash@theta4:width_rad=2e-3")
    try:
        yield process
    finally:
        process.end()


def read_until(port: serial.Serial, wanted: bytes) -> bytes:
    got, end = b"", time.monotonic() + DEADLINE_S
    while wanted not in got and time.monotonic() < end:
        got += port.read(max(1, port.in_waiting))
    return got


def test_it_lives_from_ready_to_the_end_of_its_input(rig: Process) -> None:
    ready = rig.next("ready")
    assert (ready["can_port"], ready["station_port"]) == (str(rig.can), str(rig.station))
    assert rig.can.is_symlink()
    assert rig.station.is_symlink()
    assert rig.end() == (0, b"")
    assert not rig.can.is_symlink()
    assert not rig.station.is_symlink()


def test_what_is_put_on_the_links_is_logged(tmp_path: Path) -> None:
    process = Process(tmp_path, "--push-s", "0.5", "--wire-log", str(tmp_path / "wire"))
    process.next("ready")
    process.do("aimed", do="aim", target="r")
    with serial.Serial(str(process.station), 9600, timeout=0.1) as port:
        for _ in range(10):  # the first ones come while it still turns
            read_until(port, b"\n")
    assert process.do("tracked", do="tracked")["target"] == "r"
    process.do("accepted", do="fault", kind="bus_error", state="bus_off")
    process.next("fault")
    assert process.end() == (0, b"")
    lines = [line.split(" ") for line in (tmp_path / "wire").read_text(encoding="ascii").splitlines()]
    frames = [line for line in lines if line[0] == "C"]
    assert ["40", "e", "0000000000000000"] in [line[2:] for line in frames]  # nobody listened on the bus: it is logged
    assert {"80", "200", "201"} <= {line[2] for line in frames}
    station = bytes.fromhex("".join(line[2] for line in lines if line[0] == "S"))
    assert station.count(b"\r\n") >= 1
    measured = [line for line in lines if line[0] == "M"]
    assert {line[2] for line in measured} == {"r"}
    assert set(json.loads(measured[0][6])) == set(shipped_rig("swdt82").joint_names)
    assert [json.loads(" ".join(line[2:]))["kind"] for line in lines if line[0] == "E"] == ["bus_error"]


def test_quit_and_sigterm_end_it_cleanly(tmp_path: Path) -> None:
    process = Process(tmp_path)
    process.next("ready")
    assert process.do("bye", do="quit") == {"event": "bye"}
    assert process.end() == (0, b"")
    process = Process(tmp_path)
    process.next("ready")
    process.process.send_signal(signal.SIGTERM)
    assert process.process.wait(DEADLINE_S) == 0
    assert process.end() == (0, b"")
    assert os.listdir(tmp_path) == []


def test_it_moves_and_its_devices_tell(rig: Process) -> None:
    rig.next("ready")
    assert rig.do("aimed", do="aim", target="r")["target"] == "r"
    (pose,) = rig.do("poses", do="poses", n=1, seed=4)["poses"]
    moving = rig.do("moving", do="move", pose=pose, speed=1.0)
    assert moving["seconds"] > 1.0
    assert rig.next("arrived")["pose"] == pose
    with can.Bus(interface="slcan", channel=str(rig.can), bitrate=500_000, listen_only=True, sleep_after_open=0) as bus:
        counts, end = None, time.monotonic() + DEADLINE_S
        while counts is None and time.monotonic() < end:
            message = bus.recv(0.1)
            if message is not None and message.arbitration_id == 0x180 + 34:
                counts = int.from_bytes(message.data, "little")
    assert counts is not None
    assert (counts - 20000) * 360 / 65536 == pytest.approx(pose["theta4"], abs=0.05)
    with serial.Serial(str(rig.station), 9600, timeout=0.1) as port:
        port.write(b"C11067\x03\r\n")
        assert b"\x06006\x03" in read_until(port, b"r1")[:9]


def test_it_answers_what_the_truth_is(rig: Process) -> None:
    rig.next("ready")
    truth = RigTruth(shipped_rig("swdt82"), 1)
    (pose,) = rig.do("poses", do="poses", n=1)["poses"]
    joints = {k: np.array([v]) for k, v in pose.items()}
    got = rig.do("truth", do="truth", prism="s", pose=pose)
    assert [got[f"{a}_mm"] for a in "xyz"] == pytest.approx(truth.prism_mm("s", joints)[0])
    shifted = rig.do("truth", do="truth", prism="s", pose=pose, columns={"theta4_dir": 1.0})
    assert np.linalg.norm([shifted[f"{a}_mm"] - got[f"{a}_mm"] for a in "xyz"]) > 1.0  # the hidden backlash
    points = rig.do("control_points", do="control_points")["points"]
    assert set(points) == {"cp1", "cp2", "cp3", "cp4"}
    assert rig.do("aimed", do="aim", target="cp1")["event"] == "aimed"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("move it", "Expecting value"),
        ("[1]", "a command must be a JSON object"),
        ('{"do": "dance"}', "unknown command 'dance'; known: aim, move"),
        ('{"do": "aim", "target": "q"}', "no target 'q'"),
        ('{"do": "move"}', "pose names no joint"),
        ('{"do": "move", "pose": 3}', "pose must be an object"),
        ('{"do": "move", "pose": {"theta4": "up"}}', "'up' is not a number"),
        ('{"do": "move", "pose": {"theta4": 1e9}}', "beyond its limits"),
        ('{"do": "fault", "kind": "rust"}', "unknown fault"),
        ('{"do": "fault", "kind": "node_silent", "node": 3}', "no node 3"),
        ('{"do": "truth", "prism": "q"}', "no prism 'q'"),
        ('{"do": "truth", "prism": "r", "pose": {"L2": 1}}', "a pose must have exactly the joints"),
        ('{"do": "poses", "n": 0}', "allowed: 1 to"),
        ('{"do": "poses", "seed": -1}', "must not be negative"),
    ],
)
def test_a_bad_command_is_answered_by_an_error_and_harms_nothing(line: str, words: str, talkative: Process) -> None:
    assert words in talkative.do("error", line)["text"]
    assert talkative.do("control_points", do="control_points")["event"] == "control_points"


@pytest.fixture(scope="module")
def talkative(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    process = Process(tmp_path_factory.mktemp("rig"))
    process.next("ready")
    yield process
    process.end()


def test_an_unplugged_port_comes_back(rig: Process) -> None:
    rig.next("ready")
    before = os.readlink(rig.station)
    assert rig.do("accepted", do="fault", kind="unplug", link="station", seconds=2.0 * RATE)["kind"] == "unplug"
    assert rig.next("fault")["kind"] == "unplug"
    assert not rig.station.is_symlink()
    assert rig.next("plugged")["link"] == "station"
    with serial.Serial(str(rig.station), 9600, timeout=0.1) as port:
        port.write(b"T34083\x03\r\n")
        assert read_until(port, b"\x03") != b""
    rig.do("accepted", do="fault", kind="unplug", link="can", seconds=1.0)
    assert rig.next("plugged")["link"] == "can"
    assert before.startswith("/dev/pts/")


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rig", "nowhere"], b"not a shipped rig"),
        (["--effects", "rust@boom"], b"unknown effect"),
        (["--faults", "node_silent@1:node=99"], b"no node 99"),
        (["--rate", "0"], b"must be positive"),
        (["--push-s", "0"], b"push-s must be positive"),
        (["--latency-ms", "-1"], b"latency-ms must not be negative"),
        (["--random-faults", "-1"], b"random-faults must be positive"),
        (["--origin", "now"], b"is not UTC_NS,MONOTONIC_NS,BOOT_ID"),
        (["--map", "38"], b"is not NODE:WORD+WORD"),
        (["--can-port", "/nowhere/can"], b"No such file"),
    ],
)
def test_wrong_use_ends_with_status_2_and_one_sentence(tmp_path: Path, arguments: list[str], words: bytes) -> None:
    status, complaint = Process(tmp_path, *arguments).end()
    assert status == 2
    assert words in complaint
    assert b"Traceback" not in complaint
    assert os.listdir(tmp_path) == []


def test_faults_by_schedule_and_at_random_are_reported(tmp_path: Path) -> None:
    process = Process(tmp_path, "--faults", "lock_loss@5:seconds=1", "--random-faults", "10")
    process.next("ready")
    assert process.next("fault")["event"] == "fault"
    assert process.next("fault")["event"] == "fault"
    assert process.end() == (0, b"")


def test_a_reader_that_goes_away_ends_it_without_a_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "simulators", "--rig", "ur10"]
    command += ["--can-port", str(tmp_path / "can"), "--station-port", str(tmp_path / "station")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        assert b"ready" in process.stdout.readline()
        process.stdout.close()
        process.stdin.write(b'{"do": "control_points"}\n')
        process.stdin.flush()
        assert process.wait(DEADLINE_S) == 0
        assert process.stderr.read() == b""
    assert os.listdir(tmp_path) == []
