"""A simulated rig on a real interface and a real device drives a plan; a daemon reads it as an installed one does."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from calibration.rig.description import shipped_rig
from daemon.composition import live
from daemon.config.config import parse_config
from daemon.control.protocol import request
from daemon.rig_files import load_rig
from daemon.service import Daemon
from daemon.store import Store
from drivers.can.frame import Frame
from drivers.errors import LinkError
from simulators.__main__ import main
from simulators.link_ends import BusEnd, SerialEnd
from simulators.plan import read_plan
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import running as run_daemon
from tests.drivers.multicast import GROUP, multicast_bus, unused_port

RIG = shipped_rig("swdt82")
MIDDLE = {joint.name: sum(joint.limits) / 2 for joint in RIG.joints}
VCAN = Path("/sys/class/net/vcan0")


class NullModem:
    """Two serial devices, each at the other's end of the line."""

    def __init__(self) -> None:
        self._ends = [pty.openpty(), pty.openpty()]
        self.devices = [os.ttyname(slave) for _, slave in self._ends]
        for master, slave in self._ends:
            tty.setraw(slave)
            os.set_blocking(master, False)
        self._stop, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _carry(self) -> None:
        (one, _), (other, _) = self._ends
        while True:
            ready, _, _ = select.select([one, other, self._stop], [], [])
            if self._stop in ready:
                return
            for source in ready:
                with contextlib.suppress(BlockingIOError):  # nobody reads there: the bytes are lost
                    os.write(other if source == one else one, os.read(source, 4096))

    def close(self) -> None:
        os.write(self._wake, b"x")
        self._thread.join()
        for descriptor in (*self._ends[0], *self._ends[1], self._stop, self._wake):
            os.close(descriptor)


@pytest.fixture
def line() -> Iterator[NullModem]:
    modem = NullModem()
    try:
        yield modem
    finally:
        modem.close()


def plan(path: Path, *poses: dict[str, float], **columns: str) -> Path:
    names = [joint.column for joint in RIG.joints]
    rows = [
        ",".join([*(f"{(MIDDLE | pose)[joint.name]}" for joint in RIG.joints), *columns.values()]) for pose in poses
    ]
    path.write_text("\n".join([",".join([*names, *columns]), *rows]) + "\n", encoding="utf-8")
    return path


def command(*options: str) -> list[str]:
    return [sys.executable, "-m", "simulators", "--rig", "swdt82", "--seed", "1", *options]


@contextlib.contextmanager
def installed(directory: Path, port: int, device: str) -> Iterator[Path]:
    """A daemon that only listens, on links that its configuration names; its control socket."""
    text = f"""rig = "swdt82"
state_directory = "."
[[can]]
interface = "udp_multicast"
channel = "{GROUP}"
options = {{ port = {port}, hop_limit = 0 }}
[[station]]
serial.path = "{device}"
[jobs]
enabled = false
"""
    config = parse_config(text, directory / "rigcal.toml")
    store = Store(config.store_path)
    daemon = Daemon(config, store, live(config, load_rig("swdt82")))
    with run_daemon(daemon, store):
        yield config.socket_path


def channels(socket: Path) -> dict[str, Any]:
    return {one["name"]: one["value"] for one in request(socket, "status")["acquisition"]["channels"]}


def test_a_daemon_reads_a_rig_that_drives_a_plan_on_real_links_until_it_is_told_to_end(
    tmp_path: Path, line: NullModem
) -> None:
    port = unused_port()
    poses = plan(tmp_path / "plan.csv", {"theta4": 20.0}, {"theta4": 22.0})
    options = ["--can", f"udp_multicast:{GROUP}", "--can-option", f"port={port}", "--can-option", "hop_limit=0"]
    options += ["--station-device", line.devices[0], "--aim", "r", "--drive", str(poses), "--dwell-s", "0.3", "--loop"]
    rig = subprocess.Popen(command(*options), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
    try:
        with installed(tmp_path, port, line.devices[1]) as socket:
            assert rig.stdout is not None
            ready = json.loads(rig.stdout.readline())
            assert ready == {"event": "ready", "can_port": f"udp_multicast:{GROUP}", "station_port": line.devices[0]}
            seen: set[int] = set()

            def is_seen_at_both() -> bool:
                seen.add(round(channels(socket).get("theta4") or 0.0))
                return {20, 22} <= seen

            wait_until(is_seen_at_both)
            wait_until(lambda: request(socket, "status")["acquisition"]["stations"][0]["lock"] == "locked")
            assert channels(socket)["theta1"] == pytest.approx(MIDDLE["theta1"], abs=0.1)
            assert request(socket, "status")["mode"] == "live"
        rig.send_signal(signal.SIGTERM)
        assert rig.wait(10.0) == 0
    finally:
        rig.kill()
        rig.communicate()


def test_a_plan_that_is_driven_once_ends_the_rig(tmp_path: Path) -> None:
    poses = plan(tmp_path / "plan.csv", {}, {"theta1": 20.0})
    options = ["--can-port", str(tmp_path / "can"), "--station-port", str(tmp_path / "station"), "--drive", str(poses)]
    run = command(*options, "--rate", "50")
    done = subprocess.run(run, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    events = [json.loads(text) for text in done.stdout.splitlines()]
    assert [event["event"] for event in events] == ["ready", "arrived", "arrived", "driven"]
    assert [event["pose"]["theta1"] for event in events[1:3]] == [MIDDLE["theta1"], 20.0]
    assert not (tmp_path / "can").is_symlink()


@pytest.fixture
def _handlers() -> Iterator[None]:
    """The process's own signal handlers, after a test that has replaced them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("_handlers")
def test_links_and_plans_that_do_not_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ports = ["--can-port", str(tmp_path / "can"), "--station-port", str(tmp_path / "station")]
    beyond, empty = plan(tmp_path / "beyond.csv", {}, {"theta1": 500.0}), plan(tmp_path / "empty.csv")
    for options, complaint in (
        (["--can", "can0", *ports[2:]], "'can0' is not INTERFACE:CHANNEL"),
        (["--can", "socketcan:no-such0", *ports[2:]], "cannot open socketcan 'no-such0'"),
        ([*ports[:2], "--station-device", "/dev/no-such"], "no such port"),
        ([*ports, "--drive", str(beyond)], "beyond.csv: line 3: theta1 = 500 deg is beyond its limits"),
        ([*ports, "--drive", str(empty)], "empty.csv: no poses"),
        ([*ports, "--loop"], "--loop needs a plan"),
        ([*ports, "--aim", "nowhere"], "no target 'nowhere'"),
    ):
        with pytest.raises(SystemExit, match="2"):
            sys.exit(main([*command(*options)[3:]]))
        assert complaint in capsys.readouterr().err
    assert not (tmp_path / "can").is_symlink()


def test_a_plan_says_how_long_to_stand_and_from_which_side(tmp_path: Path) -> None:
    stops = read_plan(plan(tmp_path / "plan.csv", {}, {}, dwell_s="8", theta4_dir="1"), RIG, 5.0)
    assert [stand_s for _, stand_s in stops] == [0.0, 8.0, 0.0, 8.0]
    assert stops[0][0]["theta4"] == pytest.approx(MIDDLE["theta4"] - 3.0)
    (tmp_path / "broken.csv").write_bytes(b"theta1_deg\n\xff\n")
    with pytest.raises(ValueError, match=r"broken\.csv: .*utf-8"):
        read_plan(tmp_path / "broken.csv", RIG, 5.0)


def test_a_plan_with_a_number_of_thousands_of_digits_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"line 2: .*dwell_s is '9{12}\.\.\.9{13}'$"):
        read_plan(plan(tmp_path / "plan.csv", {}, dwell_s="9" * 5000), RIG, 5.0)


def test_the_end_of_a_bus_hears_others_and_not_itself_and_sends_no_error_frames() -> None:
    port = unused_port()
    end = BusEnd("udp_multicast", GROUP, {"port": port, "hop_limit": 0})
    with multicast_bus(port) as host:
        end.send([end_frame := Frame(0x181, b"\x01"), Frame(0x004, bytes(8), is_error=True)])
        message = host.recv(5.0)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (end_frame.arbitration_id, end_frame.data)
        assert host.recv(0.05) is None
        host.send(message)
        select.select([end.fileno()], [], [], 5.0)
        assert [frame.arbitration_id for frame in end.receive()] == [0x181]
        end.unplug()
        assert (end.plugged, end.receive()) == (False, [])
        end.plug()
        assert end.plugged
        end.unplug()


def test_a_device_that_goes_away_is_an_error_and_one_that_is_not_read_blocks_nobody(line: NullModem) -> None:
    end = SerialEnd(line.devices[0], 9600)
    for _ in range(50):
        end.write(bytes(4096))
    end.unplug()
    master, slave = pty.openpty()
    end = SerialEnd(os.ttyname(slave), 9600)
    os.close(slave)
    os.close(master)
    with pytest.raises(LinkError):
        end.write(b"x")
    end.unplug()


@pytest.mark.skipif(not VCAN.exists(), reason="this kernel has no vcan0")
def test_the_end_of_a_socketcan_bus() -> None:
    one, other = BusEnd("socketcan", "vcan0", {}), BusEnd("socketcan", "vcan0", {})
    one.send([Frame(0x181, b"\x01")])
    select.select([other.fileno()], [], [], 5.0)
    assert [frame.arbitration_id for frame in other.receive()] == [0x181]
    one.unplug()
    other.unplug()
