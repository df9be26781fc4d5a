"""`rigcal init`: the files it writes, and that it only listens."""

from __future__ import annotations

import json
import os
import select
import threading
from pathlib import Path

import can
import pytest
from click.testing import CliRunner, Result

from daemon.cli.listening import hear_bus, hear_station
from daemon.cli.main import main
from daemon.config.config import read_config
from drivers.can.ports import CanLinkConfig
from drivers.clock import SystemClock
from drivers.stations.profiles import station_profiles
from drivers.stations.topcon.codec import CODEC
from tests.drivers.serial_support import framed

RECORD = framed(b"U+00006148-00023344-00029912m+2515656d")


def init(*options: str) -> Result:
    return CliRunner().invoke(main, ["init", "--no-questions", *options])


def test_the_files_pass_the_check_and_are_never_overwritten(tmp_path: Path) -> None:
    joints = ("--joint", "theta1:revolute:-15:60:32", "--joint", "L2:prismatic:0:2168")
    made = init("--out", str(tmp_path), *joints, "--prism", "tip", "--station", "/dev/ttyUSB7", "--baud", "1200")
    assert made.exit_code == 0, made.output
    assert "FILL IN" in made.stdout
    checked = CliRunner().invoke(main, ["config", "check", str(tmp_path / "rigcal.toml"), "--json"])
    told = json.loads(checked.stdout)
    assert (told["rig"], told["links"]) == ("my_rig", ["boom", "station"])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    again = init("--out", str(tmp_path))
    assert again.exit_code == 2
    assert "is not overwritten" in again.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert b"allow_transmit = true" not in [line for file in before.values() for line in file.splitlines()]


def test_checks_list_the_lines_that_are_still_to_be_filled_in(tmp_path: Path) -> None:
    made = init("--out", str(tmp_path), "--joint", "theta1:revolute:-15:60:32", "--prism", "tip", "--station", "none")
    rig = next(path for path in tmp_path.iterdir() if path.name != "rigcal.toml")
    lines = rig.read_text(encoding="utf-8").splitlines()
    marked = [n for n, line in enumerate(lines, 1) if "FILL IN" in line and not line.startswith("#")]
    assert len(marked) == 3
    assert "at the 3 places marked FILL IN" in made.stdout
    note = f"lines {', '.join(map(str, marked))}: still to be filled in from the drawings"
    for command in (["config", "check", str(tmp_path / "rigcal.toml")], ["rig", "check", str(rig)]):
        checked = CliRunner().invoke(main, command)
        assert checked.exit_code == 0
        assert note in " ".join(checked.stdout.split())
        assert json.loads(CliRunner().invoke(main, [*command, "--json"]).stdout)["fill_in"] == marked
    rig.write_text("\n".join(lines).replace("FILL IN", "from the drawings"), encoding="utf-8")
    checked = CliRunner().invoke(main, ["config", "check", str(tmp_path / "rigcal.toml")])
    assert "filled in" not in checked.stdout


def test_a_shipped_rig_needs_no_rig_file(tmp_path: Path) -> None:
    assert init("--out", str(tmp_path), "--rig", "swdt82", "--station", "none").exit_code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["rigcal.toml"]
    assert init("--out", str(tmp_path / "b"), "--rig", "swdt28").exit_code == 2
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("profile", station_profiles())
def test_every_profile_of_the_configuration_can_be_chosen(tmp_path: Path, profile: str) -> None:
    made = init("--out", str(tmp_path), "--rig", "swdt82", "--station", "/dev/ttyUSB7", "--profile", profile)
    assert made.exit_code == 0, made.output
    assert read_config(tmp_path / "rigcal.toml").station[0].profile == profile


def test_a_port_is_no_channel_of_socketcan(tmp_path: Path) -> None:
    refused = init("--out", str(tmp_path), "--rig", "swdt82", "--station", "none", "--channel", "/dev/ttyACM0")
    assert refused.exit_code == 2
    assert "interface slcan" in refused.stderr
    assert not any(tmp_path.iterdir())


def test_an_slcan_adapter_is_at_a_serial_port(tmp_path: Path) -> None:
    made = init("--out", str(tmp_path), "--rig", "swdt82", "--station", "none", "--interface", "slcan")
    assert made.exit_code == 0, made.output
    assert read_config(tmp_path / "rigcal.toml").can[0].channel == "/dev/ttyACM0"
    refused = init(
        *("--out", str(tmp_path / "b"), "--rig", "swdt82", "--station", "none"),
        *("--interface", "slcan", "--channel", "can0"),
    )
    assert refused.exit_code == 2
    assert "use the interface socketcan" in refused.stderr


@pytest.mark.parametrize("joint", ["theta1", "theta1:round:0:1", "theta1:revolute:a:b", "t:revolute:0:1:2:3"])
def test_a_joint_that_cannot_be_read_is_refused_with_an_example(tmp_path: Path, joint: str) -> None:
    refused = init("--out", str(tmp_path), "--joint", joint)
    assert refused.exit_code == 2
    assert "theta1:revolute:-15:60:32" in refused.stderr
    assert not any(tmp_path.iterdir())


def test_nodes_are_heard_on_a_bus_and_nothing_is_sent() -> None:
    with can.Bus("rigcal-init", "virtual") as bus:
        sent = threading.Event()

        def talk() -> None:
            while not sent.wait(0.02):
                for identifier in (0x720, 0x1A1, 0x80, 0x221):
                    bus.send(can.Message(arbitration_id=identifier, data=[5], is_extended_id=False))

        talking = threading.Thread(target=talk)
        talking.start()
        link = CanLinkConfig(name="boom", interface="virtual", channel="rigcal-init")
        heard = hear_bus(link, 0.3, SystemClock())
        sent.set()
        talking.join()
        assert heard.nodes == (32, 33)  # by its heartbeat, by its TPDO; what is sent to a node is no node
        assert set(heard.identifiers) == {0x720, 0x1A1, 0x80, 0x221}
        assert bus.recv(0) is None
        with pytest.raises(ValueError, match="must not allow transmission"):
            hear_bus(CanLinkConfig(name="b", interface="virtual", channel="x", allow_transmit=True), 0.1, SystemClock())


def test_the_records_of_a_station_are_heard_and_nothing_is_sent() -> None:
    master, slave = os.openpty()
    sent = threading.Event()

    def talk() -> None:
        while not sent.wait(0.02):
            os.write(master, RECORD)

    talking = threading.Thread(target=talk)
    talking.start()
    try:
        heard = hear_station(os.ttyname(slave), 0.3, SystemClock(), bauds=(9600,))
    finally:
        sent.set()
        talking.join()
    assert heard is not None
    assert (heard.family, heard.serial.baud) == (CODEC.family, 9600)
    assert not select.select([master], [], [], 0)[0], "the listener has written"
    os.close(master)
    os.close(slave)


def test_a_silent_port_is_no_station() -> None:
    master, slave = os.openpty()
    assert hear_station(os.ttyname(slave), 0.05, SystemClock(), bauds=(9600, 1200)) is None
    os.close(master)
    os.close(slave)
