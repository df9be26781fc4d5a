"""The state of the computer's clock: read from the kernel, from chrony, and through a unit's socket."""

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from daemon.host import time_service
from daemon.host.time_service import ClockState, clock_state, parse_tracking

# As chronyc 4.3 prints it: the clock is 1.5 ms slow.
SLOW = "C0000201,192.0.2.1,3,1795505286.6,0.001500000,0.0001,0.0002,-3.1,0.0,0.1,0.020000000,0.003000000,64.2,Normal"


def test_the_kernel_tells_whether_the_clock_is_kept() -> None:
    state = clock_state()
    assert state.source in ("kernel", "chrony")
    assert state.error == ""
    # The same by another program of the kernel's state, where it is installed.
    if shutil.which("adjtimex") is not None:
        told = subprocess.run(["adjtimex", "--print"], capture_output=True, text=True, check=True).stdout
        status = int(next(line for line in told.splitlines() if "status" in line).split(":")[1])
        assert state.is_synchronized is not bool(status & 0x40)


def test_chrony_tells_the_offset_and_its_bound() -> None:
    state = parse_tracking(SLOW + "\n")
    assert (state.is_synchronized, state.source) == (True, "chrony")
    assert state.offset_s == pytest.approx(-0.0015)  # behind
    assert state.max_error_s == pytest.approx(0.0015 + 0.003 + 0.010)


@pytest.mark.parametrize(
    "line",
    [
        # Before the first answer of a server; and a computer that serves its own time to others.
        "00000000,,0,0.000000000,0.000000000,0.0,0.0,0.000,0.000,0.000,1.000000000,1.000000000,0.0,Not synchronised",
        "7F7F0101,,8,1795505286.607186637,0.000000000,0.0,0.0,0.000,0.000,0.000,0.000000000,0.000000000,0.0,Normal",
    ],
)
def test_a_chrony_without_a_server_keeps_no_clock(line: str) -> None:
    assert parse_tracking(line) == ClockState(False, source="chrony")


@pytest.mark.skipif(shutil.which("chronyd") is None or os.geteuid() != 0, reason="chrony is not installed, or no root")
def test_a_real_chronyd_is_understood(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = tmp_path / "chrony.conf"
    lines = ("port 0", f"cmdport {port}", "bindcmdaddress 127.0.0.1", f"pidfile {tmp_path}/pid", "local stratum 8")
    config.write_text("\n".join(lines) + "\n", encoding="utf-8")
    daemon = subprocess.Popen(  # -x: it leaves the clock alone
        ["chronyd", "-x", "-d", "-f", str(config), "-u", "root"], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    try:
        assert daemon.stderr is not None
        while b"Running" not in (line := daemon.stderr.readline()):
            assert line, "chronyd has ended"
        ask = ["chronyc", "-h", "127.0.0.1", "-p", str(port), "-n", "-c", "tracking"]
        told = subprocess.run(ask, capture_output=True, text=True, check=True).stdout
        assert parse_tracking(told) == ClockState(False, source="chrony")
    finally:
        daemon.terminate()
        daemon.wait()
        assert daemon.stderr is not None
        daemon.stderr.close()


# ---- through a socket ------------------------------------------------------------------------------------------------


class Forbidden:
    """A libc in a sandbox that forbids to read the clock's state."""

    def adjtimex(self, _timex: object) -> int:
        time_service.ctypes.set_errno(1)
        return -1


@pytest.fixture
def forbidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_service.ctypes, "CDLL", lambda *_, **__: Forbidden())


def answering(path: Path, answer: bytes) -> threading.Thread:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen()

    def answer_one() -> None:
        with listener, listener.accept()[0] as connection:
            connection.sendall(answer)

    thread = threading.Thread(target=answer_one)
    thread.start()
    return thread


@pytest.mark.usefixtures("forbidden")
def test_where_a_sandbox_forbids_it_the_program_of_the_unit_is_asked(tmp_path: Path) -> None:
    told = subprocess.run(
        [sys.executable, "-m", time_service.__name__], capture_output=True, check=True, env={**os.environ}
    )
    thread = answering(tmp_path / "clock.sock", told.stdout)
    state = clock_state(str(tmp_path / "clock.sock"))
    thread.join()
    assert state.source in ("kernel", "chrony")
    assert state == ClockState(**json.loads(told.stdout))


@pytest.mark.usefixtures("forbidden")
@pytest.mark.parametrize("answer", [b"", b"[]", b'{"is_synchronized": true, "other": 1}'])
def test_an_answer_that_is_none_is_not_known_and_says_why(tmp_path: Path, answer: bytes) -> None:
    thread = answering(tmp_path / "clock.sock", answer)
    state = clock_state(str(tmp_path / "clock.sock"))
    thread.join()
    assert state.is_synchronized is None
    assert "rigcal-clock@" in state.error


@pytest.mark.usefixtures("forbidden")
def test_a_sandbox_without_the_socket_says_what_is_forbidden(tmp_path: Path) -> None:
    assert clock_state() == ClockState(None, error="adjtimex: Operation not permitted")
    assert "No such file" in clock_state(str(tmp_path / "none.sock")).error
