import json
import re
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from daemon.cli.main import main as rigcal
from daemon.commands import CommandError
from daemon.control.protocol import request
from daemon.control.server import ControlServer
from daemon.store.queries.jobs import JobTable
from daemon.store.store import Store
from drivers.clock import SystemClock

release = threading.Event()


def echo(arguments: Mapping[str, Any]) -> Any:
    return dict(arguments)


def refuse(arguments: Mapping[str, Any]) -> Any:
    raise CommandError("not now", 3)


def crash(arguments: Mapping[str, Any]) -> Any:
    raise ZeroDivisionError("a bug")


def wait(arguments: Mapping[str, Any]) -> Any:
    return release.wait(10)


@pytest.fixture
def path(tmp_path: Path) -> Iterator[Path]:
    release.clear()
    server = ControlServer(tmp_path / "s", {"echo": echo, "refuse": refuse, "crash": crash, "wait": wait})
    yield tmp_path / "s"
    release.set()
    server.close()
    assert not (tmp_path / "s").exists()


def talk(path: Path, line: bytes) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(path))
        connection.sendall(line)
        return dict(json.loads(connection.makefile("rb").readline()))


def test_a_command_is_answered(path: Path) -> None:
    assert request(path, "echo", {"a": [1, "ü"]}) == {"a": [1, "ü"]}


def test_a_refusal_carries_its_exit_status(path: Path) -> None:
    with pytest.raises(CommandError, match="not now") as caught:
        request(path, "refuse")
    assert caught.value.status == 3


def test_a_fault_in_one_command_leaves_the_daemon_serving(path: Path) -> None:
    with pytest.raises(CommandError, match="crash failed inside the daemon: a bug") as caught:
        request(path, "crash")
    assert caught.value.status == 1
    assert request(path, "echo", {"still": "here"}) == {"still": "here"}


def test_an_unknown_command_is_told_what_is_known(path: Path) -> None:
    with pytest.raises(CommandError, match="unknown command 'sing'; known: crash, echo"):
        request(path, "sing")


@pytest.mark.parametrize(
    "line", [b"\n", b"{\n", b"[]\n", b"3\n", b'{"command": []}\n', b"\xff\n", b'{"command": "echo", "arguments": 3}\n']
)
def test_malformed_requests_are_refused_in_a_sentence(path: Path, line: bytes) -> None:
    answer = talk(path, line)
    assert answer["ok"] is False
    assert answer["status"] == 2


@pytest.mark.parametrize(
    "value", ["[" * 100_000, "NaN", "1e999, Infinity", '"\\ud800"', "9223372036854775808", "9" * 5000]
)
def test_arguments_that_nothing_can_store_or_show_are_refused_in_a_sentence(path: Path, value: str) -> None:
    answer = talk(path, b'{"command": "echo", "arguments": {"a": [%b]}}\n' % value.encode())
    assert (answer["ok"], answer["status"]) == (False, 2), answer
    assert talk(path, b'{"command": "echo", "arguments": {"a": -9223372036854775808}}\n')["ok"]


def test_a_refusal_does_not_repeat_all_that_was_asked(path: Path) -> None:
    answer = talk(path, json.dumps({"command": "x" * 100_000}).encode() + b"\n")
    assert len(answer["error"]) < 1100


def test_an_endless_line_is_refused(path: Path) -> None:
    assert "longer than" in talk(path, b"x" * (1 << 20) + b"xx\n")["error"]


def test_a_slow_command_stops_no_other(path: Path) -> None:
    slow = threading.Thread(target=request, args=(path, "wait"))
    slow.start()
    assert request(path, "echo") == {}
    release.set()
    slow.join(10)
    assert not slow.is_alive()


def test_no_daemon_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match=r"no daemon is listening at .*start one with `rigcal run`"):
        request(tmp_path / "none", "status")


def test_a_silent_daemon_is_one_sentence(path: Path) -> None:
    with pytest.raises(CommandError, match=r"did not answer within 0\.1 s: it hangs"):
        request(path, "wait", timeout_s=0.1)


def test_the_socket_is_not_open_to_all(path: Path) -> None:
    assert path.stat().st_mode & 0o007 == 0


def test_the_socket_of_a_killed_daemon_is_replaced(tmp_path: Path) -> None:
    stale = socket.socket(socket.AF_UNIX)
    stale.bind(str(tmp_path / "s"))
    stale.close()
    server = ControlServer(tmp_path / "s", {"echo": echo})
    assert request(tmp_path / "s", "echo") == {}
    server.close()


def test_a_file_that_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("keep me", encoding="utf-8")
    with pytest.raises(CommandError, match="cannot be created: Address already in use"):
        ControlServer(precious, {})
    assert precious.read_text(encoding="utf-8") == "keep me"


def test_an_operator_who_asks_for_jobs_before_there_are_any_is_told_when_there_will_be(tmp_path: Path) -> None:
    store = Store(tmp_path / "rigcal.sqlite")
    table = JobTable(store, "swdt82")
    answers = {"jobs.list": lambda _: table.all(SystemClock()), "session.list": lambda _: []}
    server = ControlServer(tmp_path / "s", answers)
    done = CliRunner().invoke(rigcal, ["jobs", "list", "--socket", str(tmp_path / "s")])
    server.close()
    store.close()
    assert done.exit_code == 0
    assert "jobs are queued after a session is closed; `rigcal session start` opens a session" in done.stdout


HOSTILE_JSON = {
    "deep": b"[" * 100_000 + b"\n",
    "deep arguments": b'{"command": "echo", "arguments": {"a": ' + b"[" * 400 + b"]" * 400 + b"}}\n",
    "NaN": b'{"command": "echo", "arguments": {"a": NaN}}\n',
    "infinity": b'{"command": "echo", "arguments": {"a": -Infinity}}\n',
    "a float beyond all": b'{"command": "echo", "arguments": {"a": 1e999}}\n',
    "a whole number without end": b'{"command": "echo", "arguments": {"a": ' + b"9" * 10_000 + b"}}\n",
    "a whole number of 65 bits": b'{"command": "echo", "arguments": {"a": 18446744073709551616}}\n',
    "half a character": b'{"command": "echo", "arguments": {"a": "\\ud800"}}\n',
    "half a character in a key": b'{"command": "echo", "arguments": {"\\udfff": 1}}\n',
    "half a character as command": b'{"command": "\\ud800"}\n',
}


@pytest.mark.long
@pytest.mark.parametrize("line", HOSTILE_JSON.values(), ids=HOSTILE_JSON.keys())
def test_json_that_no_command_can_use_is_one_refusal(path: Path, line: bytes) -> None:
    answer = talk(path, line)
    assert answer["ok"] is False
    assert answer["status"] == 2
    assert re.match("a request|(whole numbers|texts) in a request must ", answer["error"])
    assert len(answer["error"]) < 200
    assert request(path, "echo", {"still": "here"}) == {"still": "here"}


def test_a_refusal_has_an_end_whatever_it_quotes(path: Path) -> None:
    answer = talk(path, b'{"command": "' + b"x" * 500_000 + b'"}\n')
    assert "unknown command" in answer["error"]
    assert len(answer["error"]) < 4000


def test_an_answer_that_is_no_json_is_a_refusal(tmp_path: Path) -> None:
    server = ControlServer(tmp_path / "s", {"odd": lambda _: {1, 2}})
    with pytest.raises(CommandError, match="odd failed inside the daemon"):
        request(tmp_path / "s", "odd")
    server.close()
