from __future__ import annotations

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers.errors import LinkError
from drivers.stations.serial_port import SerialConfig, SerialPort, forbid_other_openers, is_pseudo_terminal
from tests.drivers.serial_support import DEADLINE_S, plugged_in

TIOCGEXCL = 0x80045440


def opened(path: Path, **settings: object) -> SerialPort:
    return SerialPort(SerialConfig.model_validate({"path": str(path), **settings}), "station", 1.0)


def test_a_read_returns_what_is_there_and_an_empty_read_means_nothing_came(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        assert port.read(0.0) == b""
        instrument.send(b"hello")
        assert port.read(DEADLINE_S) == b"hello"
        port.close()


def test_a_read_ends_as_soon_as_the_first_byte_comes(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        timer = threading.Timer(0.05, instrument.send, [b"x"])
        timer.start()
        began = time.monotonic()
        assert port.read(30.0) == b"x"
        assert time.monotonic() - began < 10.0
        timer.join()
        port.close()


def test_a_write_is_complete(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        port.write(b"C067\x03\r\n")
        instrument.expect(b"C067\x03\r\n")
        port.close()


def test_a_device_that_takes_no_bytes_is_a_link_error_not_a_hang(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = SerialPort(SerialConfig(path=str(instrument.path)), "station", 0.05)
        with pytest.raises(LinkError, match="writing failed"):
            port.write(bytes(1_000_000))
        port.close()


@pytest.mark.parametrize("doing", ["read", "write"])
def test_unplugging_is_a_link_error_that_names_link_and_path(tmp_path: Path, doing: str) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        instrument.unplug()
        with pytest.raises(LinkError, match=r"station \(.*/tty\).*plugged in"):
            port.read(DEADLINE_S) if doing == "read" else port.write(b"x")
        port.close()


def test_a_closed_port_gives_link_errors_and_may_be_closed_again(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        port.close()
        port.close()
        with pytest.raises(LinkError, match="reading failed"):
            port.read(0.0)
        with pytest.raises(LinkError, match="writing failed"):
            port.write(b"x")


def test_a_missing_port_says_to_plug_it_in(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="no such port: plug in the adapter"):
        opened(tmp_path / "absent")


def test_what_is_no_serial_port_says_so_with_the_settings(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(
        LinkError, match="not a serial port, or 1200 baud, 7 data bits, parity even, 1 stop bits not supported"
    ):
        opened(tmp_path / "file", baud=1200, bytesize=7, parity="even")
    with pytest.raises(LinkError, match="not a serial port"):
        opened(tmp_path)
    with pytest.raises(LinkError, match="not a serial port"):  # pyserial raises ValueError
        opened(Path("a\0b"))


def test_a_port_in_use_names_the_process_that_has_it(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        program = (
            "import serial, sys; port = serial.Serial(sys.argv[1], exclusive=True);"
            "print('open', flush=True); sys.stdin.read()"
        )
        with subprocess.Popen(
            [sys.executable, "-c", program, str(instrument.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == b"open\n"
            with pytest.raises(LinkError, match="in use by process"):
                opened(instrument.path)
            assert other.stdin is not None
            other.stdin.close()
        opened(instrument.path).close()  # free again


def test_a_busy_port_whose_holder_is_hidden_is_still_reported_as_in_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        # Another user's process, whose descriptors cannot be read. As root nothing is hidden: look where nothing is.
        monkeypatch.setattr("drivers.stations.serial_port.glob.iglob", lambda _: iter(["/proc/0/fd/0"]))
        with pytest.raises(LinkError, match="in use by another program"):
            opened(instrument.path)
        port.close()


@pytest.mark.skipif(os.getuid() != 0, reason="changes user to one without rights")
def test_a_port_without_permission_names_the_group_dialout(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        path = Path(os.path.realpath(instrument.path))
        path.chmod(0o600)
        os.seteuid(65534)
        try:
            with pytest.raises(LinkError, match="add this user to group dialout"):
                opened(path)
        finally:
            os.seteuid(0)


def test_seven_bits_and_parity_are_passed_over_on_a_pseudo_terminal(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        assert is_pseudo_terminal(str(instrument.path))
        port = opened(instrument.path, baud=1200, bytesize=7, parity="even", stopbits=2)
        instrument.send(b"Q")
        assert port.read(DEADLINE_S) == b"Q"
        port.close()


def test_other_programs_are_kept_from_opening_the_terminal() -> None:
    master, slave = pty.openpty()
    try:
        forbid_other_openers(slave)
        assert struct.unpack("i", fcntl.ioctl(slave, TIOCGEXCL, b"\0" * 4))[0] == 1
    finally:
        os.close(slave)
        os.close(master)


def test_a_pseudo_terminal_is_not_left_locked_for_a_program_that_follows_a_killed_one(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        port = opened(instrument.path)
        descriptor = os.open(instrument.path, os.O_RDWR | os.O_NOCTTY)
        assert struct.unpack("i", fcntl.ioctl(descriptor, TIOCGEXCL, b"\0" * 4))[0] == 0
        os.close(descriptor)
        port.close()


def test_a_real_terminal_is_locked_on_opening(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        # The only terminals without hardware are pseudo-terminals; take this one for a real one.
        monkeypatch.setattr("drivers.stations.serial_port.is_pseudo_terminal", lambda _: False)
        port = opened(instrument.path)
        descriptor = os.open(instrument.path, os.O_RDWR | os.O_NOCTTY) if os.getuid() == 0 else None
        if descriptor is not None:
            assert struct.unpack("i", fcntl.ioctl(descriptor, TIOCGEXCL, b"\0" * 4))[0] == 1
            os.close(descriptor)
        port.close()
        with pytest.raises(LinkError, match="not supported"):  # Linux answers EINVAL
            opened(instrument.path, bytesize=7, parity="even")


def test_settings_that_no_port_has_are_refused_by_name() -> None:
    for wrong in ({"path": ""}, {"path": "x", "baud": 0}, {"path": "x", "parity": "mark"}, {"path": "x", "speed": 1}):
        with pytest.raises(ValidationError):
            SerialConfig.model_validate(wrong)


def test_termios_errors_are_not_os_errors_and_still_become_link_errors(tmp_path: Path) -> None:
    assert not issubclass(termios.error, OSError)
    with pytest.raises(LinkError):
        opened(Path("/dev/null"))
