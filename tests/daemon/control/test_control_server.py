"""The control socket goes on: without descriptors, with clients that only wait, and when its file is taken away."""

import contextlib
import grp
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from daemon.commands import REFUSED, CommandError, is_cancelled, reading_socket
from daemon.control.protocol import request
from daemon.control.server import ControlServer, Limits
from daemon.host.systemd import Notifier
from tests.daemon.support.idle_daemon import idle_daemon

DEADLINE_S = 60.0


def echo(arguments: Mapping[str, Any]) -> Any:
    return dict(arguments)


@contextlib.contextmanager
def serving(path: Path, handlers: Mapping[str, Any] | None = None, **limits: float) -> Iterator[ControlServer]:
    server = ControlServer(path, handlers or {"echo": echo}, limits=Limits(**limits))  # type: ignore[arg-type]
    try:
        yield server
    finally:
        server.close()


def connected(path: Path, said: bytes = b"") -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(DEADLINE_S)
    connection.connect(str(path))
    if said:
        connection.sendall(said)
    return connection


def wait(what: str, done: Callable[[], object]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not done():
        assert time.monotonic() < deadline, f"waited for {what}"
        time.sleep(0.01)


def answers(path: Path) -> bool:
    try:
        return bool(request(path, "echo", {"a": 1}) == {"a": 1})
    except CommandError:
        return False


# ---- descriptors -----------------------------------------------------------------------------------------------------

# Serves with no descriptor left, says so, and gives them back when it is told to.
STARVED = """
import logging, os, resource, sys
from pathlib import Path
from daemon.control.server import ControlServer
logging.basicConfig(level=logging.INFO)
server = ControlServer(Path(sys.argv[1]), {"echo": dict})
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
taken = []
try:
    while True:
        taken.append(os.open("/dev/null", os.O_RDONLY))
except OSError:
    os.write(1, b"starved\\n")
os.read(0, 1)
for descriptor in taken:
    os.close(descriptor)
os.write(1, b"fed\\n")
os.read(0, 1)
server.close()
"""


def test_a_daemon_without_descriptors_answers_again_when_it_has_some(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w") as log:
        command = [sys.executable, "-c", STARVED, str(tmp_path / "s")]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == b"starved\n"
            with connected(tmp_path / "s", b'{"command": "echo", "arguments": {"a": 1}}\n') as waiting:
                wait("a complaint", lambda: "Too many open files" in (tmp_path / "log").read_text())
                time.sleep(0.5)  # several attempts
                process.stdin.write(b"x")
                process.stdin.flush()
                assert process.stdout.readline() == b"fed\n"
                assert json.loads(waiting.makefile("rb").readline())["result"] == {"a": 1}
            process.stdin.write(b"x")
            process.stdin.flush()
            assert process.wait(DEADLINE_S) == 0
        finally:
            process.kill()
    assert (tmp_path / "log").read_text().count("Too many open files") == 1


# ---- clients ---------------------------------------------------------------------------------------------------------


def test_more_clients_than_there_are_places_for_are_told_so(tmp_path: Path) -> None:
    release = threading.Event()
    with (
        serving(tmp_path / "s", {"wait": lambda _: release.wait(DEADLINE_S), "echo": echo}, clients=2),
        contextlib.ExitStack() as stack,
    ):
        busy = [stack.enter_context(connected(tmp_path / "s", b'{"command": "wait"}\n')) for _ in range(2)]
        with pytest.raises(CommandError, match="already serves 2 clients; try again") as refused:
            request(tmp_path / "s", "echo")
        assert refused.value.status == 1
        release.set()
        for connection in busy:
            assert json.loads(connection.makefile("rb").readline())["ok"] is True


def test_clients_that_only_wait_do_not_lock_the_operator_out(tmp_path: Path) -> None:
    with serving(tmp_path / "s", give_way_s=0.0), contextlib.ExitStack() as stack:
        for n in range(100):
            stack.enter_context(connected(tmp_path / "s", b'{"comm' if n % 2 else b""))
        assert answers(tmp_path / "s")


def test_clients_that_read_no_answer_do_not_lock_the_operator_out(tmp_path: Path) -> None:
    said = json.dumps({"command": "echo", "args": {"a": "x" * 50_000}}).encode() + b"\n"
    with serving(tmp_path / "s", give_way_s=0.1, send_s=DEADLINE_S), contextlib.ExitStack() as stack:
        for _ in range(32):
            client = stack.enter_context(connected(tmp_path / "s"))
            client.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while client.send(said):  # until the answers that nobody reads keep the server from reading on
                    pass
        wait("a place", lambda: answers(tmp_path / "s"))


def test_a_client_that_goes_on_reading_a_long_answer_gets_the_whole_of_it(tmp_path: Path) -> None:
    long = "x" * 5_000_000
    with serving(tmp_path / "s", {"echo": echo, "long": lambda _: long}, clients=1, give_way_s=0.2):
        with connected(tmp_path / "s", b'{"command": "long"}\n') as client:
            answer = bytearray()
            others = 0
            while not answer.endswith(b"\n"):
                answer += client.recv(200_000)
                if len(answer) // 1_000_000 > others:  # another client asks for a place every while
                    others += 1
                    assert not answers(tmp_path / "s")
            assert json.loads(answer)["result"] == long
        wait("a place", lambda: answers(tmp_path / "s"))


def test_an_idle_client_is_closed(tmp_path: Path) -> None:
    with serving(tmp_path / "s", idle_s=0.2), connected(tmp_path / "s") as idle:
        assert idle.recv(1) == b""


def test_a_request_that_is_never_finished_is_refused_and_closed(tmp_path: Path) -> None:
    with serving(tmp_path / "s", line_s=0.2), connected(tmp_path / "s", b'{"command": "ec') as slow:
        with slow.makefile("rb") as stream:
            answer, end = json.loads(stream.readline()), stream.read()
        assert "not finished within 0.2 s" in answer["error"]
        assert end == b""


def test_a_request_that_comes_in_drops_is_refused_all_the_same(tmp_path: Path) -> None:
    with serving(tmp_path / "s", line_s=0.5), connected(tmp_path / "s") as slow:
        with contextlib.suppress(OSError):
            for _ in range(int(DEADLINE_S / 0.05)):
                slow.sendall(b" ")
                time.sleep(0.05)
        with contextlib.suppress(ConnectionResetError):
            assert b"not finished" in slow.recv(1000)


def test_a_client_that_does_not_read_its_answers_is_closed(tmp_path: Path) -> None:
    sent = threading.Event()

    def much(_arguments: Mapping[str, Any]) -> str:
        sent.set()
        return "x" * (16 << 20)

    with (
        serving(tmp_path / "s", {"much": much, "echo": echo}, clients=1, send_s=0.2, give_way_s=DEADLINE_S),
        connected(tmp_path / "s", b'{"command": "much"}\n'),
    ):
        assert sent.wait(DEADLINE_S)
        wait("its place", lambda: answers(tmp_path / "s"))


def test_a_command_may_take_longer_than_a_client_may_wait(tmp_path: Path) -> None:
    def shoot(_arguments: Mapping[str, Any]) -> str:
        time.sleep(0.5)
        return "shot"

    with serving(tmp_path / "s", {"shoot": shoot}, idle_s=0.1, line_s=0.1, send_s=0.1):
        assert request(tmp_path / "s", "shoot") == "shot"


def test_a_command_knows_when_nobody_waits_for_its_answer_any_more(tmp_path: Path) -> None:
    began, ended = threading.Event(), threading.Event()

    def shoot(_arguments: Mapping[str, Any]) -> str:
        began.set()
        wait("the client to leave", is_cancelled)
        ended.set()
        return "shot"

    with serving(tmp_path / "s", {"shoot": shoot}):
        with connected(tmp_path / "s", b'{"command": "shoot"}\n'):
            assert began.wait(DEADLINE_S)
        assert ended.wait(DEADLINE_S)


def test_a_client_that_has_no_more_to_say_still_waits_for_its_answer(tmp_path: Path) -> None:
    with (
        serving(tmp_path / "s", {"shoot": lambda _: is_cancelled()}),
        connected(tmp_path / "s", b'{"command": "shoot"}\n') as client,
        client.makefile("rb") as stream,
    ):
        client.shutdown(socket.SHUT_WR)
        assert json.loads(stream.readline())["result"] is False


def test_requests_that_come_together_are_answered_in_order(tmp_path: Path) -> None:
    lines = b"".join(b'{"command": "echo", "arguments": {"n": %d}}\n' % n for n in range(3))
    with serving(tmp_path / "s"), connected(tmp_path / "s", lines) as client, client.makefile("rb") as stream:
        assert [json.loads(stream.readline())["result"]["n"] for _ in range(3)] == [0, 1, 2]


# ---- the socket's file -----------------------------------------------------------------------------------------------


def test_a_socket_file_that_was_removed_is_made_anew(tmp_path: Path) -> None:
    with serving(tmp_path / "s"):
        (tmp_path / "s").unlink()
        wait("a new socket", lambda: answers(tmp_path / "s"))


def test_a_socket_file_that_a_dead_process_left_in_its_place_is_replaced(tmp_path: Path) -> None:
    with serving(tmp_path / "s"):
        (tmp_path / "s").unlink()
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(tmp_path / "s"))
        wait("a new socket", lambda: answers(tmp_path / "s"))


def test_two_daemons_do_not_steal_each_others_socket(tmp_path: Path) -> None:
    with serving(tmp_path / "s"):
        with pytest.raises(CommandError, match="another process listens at"):
            ControlServer(tmp_path / "s", {"echo": echo})
        assert answers(tmp_path / "s")


def took(stack: contextlib.ExitStack, path: Path) -> bool:
    """Try to serve in the place of a server, which makes a new socket as soon as it sees that its own is gone."""
    path.unlink()
    try:
        stack.enter_context(serving(path, {"other": lambda _: "other"}))
    except CommandError:
        return False
    return True


def test_a_daemon_whose_socket_was_taken_says_so_and_leaves_it_to_the_other(tmp_path: Path) -> None:
    with serving(tmp_path / "s") as first:
        assert first.trouble() is None
        with contextlib.ExitStack() as stack:
            wait("its place", lambda: took(stack, tmp_path / "s"))
            wait("trouble", first.trouble)
            assert "another process listens" in str(first.trouble())
            assert request(tmp_path / "s", "other") == "other"
        wait("its own socket", lambda: answers(tmp_path / "s"))
        wait("no trouble", lambda: first.trouble() is None)


def test_a_file_that_is_put_in_the_sockets_place_is_left_alone(tmp_path: Path) -> None:
    with serving(tmp_path / "s") as server:
        (tmp_path / "s").unlink()
        (tmp_path / "s").write_text("precious", encoding="utf-8")
        wait("trouble", server.trouble)
    assert (tmp_path / "s").read_text(encoding="utf-8") == "precious"


# ---- the watchdog ----------------------------------------------------------------------------------------------------


def break_listener(path: Path) -> None:
    """Put another file in the place of the descriptor that listens at `path`, as a fault elsewhere might do."""
    with open(os.devnull, "rb") as nothing:
        for name in os.listdir("/proc/self/fd"):
            if Path(f"/proc/self/fd/{name}").is_socket():
                found = socket.socket(fileno=int(name))
                is_it = found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) == 1
                is_it = is_it and found.getsockname() == str(path)
                found.detach()
                if is_it:
                    os.dup2(nothing.fileno(), int(name))
                    return
    raise AssertionError(f"nothing listens at {path}")


@pytest.mark.long
def test_the_watchdog_hears_nothing_of_a_daemon_that_takes_no_commands(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(DEADLINE_S)
        environ = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1500000"}
        with idle_daemon(tmp_path, Notifier(environ)) as config:
            while manager.recv(1000) != b"WATCHDOG=1":
                pass
            break_listener(config.socket_path)
            manager.settimeout(3.0)  # a beat comes every 0.75 s, the last one 1.5 s after the thread's last round
            with contextlib.suppress(TimeoutError):
                for _ in range(20):
                    heard = manager.recv(1000)
                raise AssertionError(f"still {heard!r}")


def test_a_control_socket_that_was_taken_is_an_alarm_until_it_is_back(tmp_path: Path) -> None:
    def alarms(path: Path) -> list[tuple[str, str]]:
        return [(a["kind"], a["subject"]) for a in request(path, "alarms.list")["active"]]

    with idle_daemon(tmp_path, read_group=grp.getgrgid(os.getegid()).gr_name) as config:
        reading = reading_socket(config.socket_path)
        config.socket_path.unlink()
        config.socket_path.write_text("not a socket", encoding="utf-8")
        wait("the alarm", lambda: ("control_dead", "control.sock") in alarms(reading))
        config.socket_path.unlink()
        wait("its end", lambda: ("control_dead", "control.sock") not in alarms(reading))
        assert request(config.socket_path, "setup.list") == []


def test_a_server_that_accepts_is_alive(tmp_path: Path) -> None:
    with serving(tmp_path / "s") as server:
        assert server.alive(within_s=DEADLINE_S)
        break_listener(tmp_path / "s")
        wait("its end", lambda: not server.alive(within_s=1.0))


def test_a_rig_that_is_not_simulated_is_moved_by_nobodys_command(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        for command, arguments in (("simulation.visit", {"poses": []}), ("simulation.aim", {"target": "r"})):
            with pytest.raises(CommandError, match="--by-hand") as refused:
                request(config.socket_path, command, arguments)
            assert refused.value.status == REFUSED
