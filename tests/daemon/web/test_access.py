"""Tokens are kept hashed, roles rise, and wrong tokens are limited."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.commands import CommandError
from daemon.web.access import AttemptLimit, Person, Role, TokenFile, role_refusal
from daemon.web.commands import COMMANDS
from daemon.web.settings import WebSettings
from drivers.clock import ManualClock


def test_a_token_is_found_again_and_nowhere_written_down(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    token = file.add("Ada", Role.OPERATE, 1)
    assert len(token) > 40
    assert TokenFile(file.path).find(token) == Person("Ada", Role.OPERATE)
    assert file.find(token + "x") is None
    assert token not in file.path.read_text()
    assert file.path.stat().st_mode & 0o777 == 0o640


def test_a_token_that_is_removed_counts_no_more_in_another_process_either(tmp_path: Path) -> None:
    file, other = TokenFile(tmp_path / "tokens.json"), TokenFile(tmp_path / "tokens.json")
    ada, bo = other.add("Ada", Role.READ, 1), other.add("Bo", Role.APPROVE, 2)
    assert file.find(ada) is not None
    other.remove("Ada")
    assert file.find(ada) is None
    assert file.find(bo) == Person("Bo", Role.APPROVE)
    with pytest.raises(CommandError, match="there are: Bo"):
        other.remove("Ada")


@pytest.mark.parametrize("name", ["", " ", "a" * 61, "two\nlines"])
def test_a_token_has_a_printable_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(CommandError, match="a token's name is"):
        TokenFile(tmp_path / "tokens.json").add(name, Role.READ, 1)


def test_two_tokens_never_have_one_name(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    file.add("Ada", Role.READ, 1)
    with pytest.raises(CommandError, match="has a token already"):
        file.add("Ada", Role.APPROVE, 1)


# Says that it is ready; at a word it adds names of its own, and others that another process adds as well.
ADDING = """
import sys
from pathlib import Path
from daemon.commands import CommandError
from daemon.web.access import Role, TokenFile
file, me = TokenFile(Path(sys.argv[1])), sys.argv[2]
print("ready", flush=True)
input()
for n in range(40):
    file.add(f"{me}{n}", Role.READ, 1)
    try:
        file.add(f"both{n}", Role.READ, 1)
        print(n)
    except CommandError as error:
        assert "has a token already" in str(error)
"""


def test_processes_that_add_tokens_at_once_lose_none_and_share_no_name(tmp_path: Path) -> None:
    path = tmp_path / "tokens.json"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    people = [subprocess.Popen([sys.executable, "-c", ADDING, str(path), name], **pipes) for name in ("a", "b")]
    for person in people:
        assert person.stdout is not None
        assert person.stdout.readline() == "ready\n"
    for person in people:
        assert person.stdin is not None
        person.stdin.write("go\n")
        person.stdin.flush()
    told = [person.communicate(timeout=60)[0].split() for person in people]
    assert [person.returncode for person in people] == [0, 0]
    assert sorted(int(n) for numbers in told for n in numbers) == list(range(40)), "each name was given once"
    names = {entry.name for entry in TokenFile(path).entries()}
    assert names == {f"{who}{n}" for who in ("a", "b", "both") for n in range(40)}


@pytest.mark.parametrize(
    "text", ["", "[]", "{", json.dumps({"tokens": [{"name": "a", "role": "king", "sha256": "", "created_utc_ns": 1}]})]
)
def test_a_damaged_file_lets_nobody_in(tmp_path: Path, text: str) -> None:
    path = tmp_path / "tokens.json"
    path.write_text(text)
    with pytest.raises(CommandError, match=r"tokens\.json"):
        TokenFile(path).find("rigcal_x")


def test_wrong_tokens_are_limited_for_each_address_and_in_all() -> None:
    clock = ManualClock()
    limit = AttemptLimit(clock)
    for number in range(10):
        assert limit.wait_s("10.0.0.1") == 0
        limit.note("10.0.0.1", f"guess {number}")
    assert limit.wait_s("10.0.0.1") == 60
    assert limit.wait_s("10.0.0.2") == 0
    clock.advance(61)
    assert limit.wait_s("10.0.0.1") == 0
    for number in range(100):
        limit.note(f"10.1.0.{number}", f"another guess {number}")
    assert limit.wait_s("10.2.0.1") > 0


def test_a_browser_that_keeps_a_removed_token_shuts_nobody_out() -> None:
    limit = AttemptLimit(ManualClock())
    limit.note("10.0.0.1", "removed")
    assert limit.is_known("removed")
    assert not limit.is_known("another")


def test_what_writes_needs_more_than_reading_and_what_goes_live_needs_approval() -> None:
    from daemon.control.command_table import READING

    assert {name for name, role in COMMANDS.items() if role is Role.READ} == READING
    assert COMMANDS["model.accept"] is COMMANDS["model.rollback"] is COMMANDS["model.reject"] is Role.APPROVE
    assert not {"devices.configure", "store.prune", "store.redecode", "simulation.visit"} & COMMANDS.keys()
    assert "role approve" in role_refusal(Person("Ada", Role.OPERATE), Role.APPROVE)


@pytest.mark.parametrize(
    ("host", "name", "is_own"),
    [
        ("127.0.0.1", "localhost", True),
        ("127.0.0.1", "[::1]", True),
        ("127.0.0.1", "192.168.1.7", False),
        ("127.0.0.1", "evil.example", False),
        ("0.0.0.0", "192.168.1.7", True),
        ("0.0.0.0", "rig7.mine.example", True),
        ("0.0.0.0", "evil.example", False),
        ("0.0.0.0", "", False),
    ],
)
def test_a_computer_knows_its_own_names(host: str, name: str, is_own: bool) -> None:
    settings = WebSettings(Path("control.sock"), Path("tokens.json"), host=host, names=("rig7.mine.example",))
    assert settings.is_own_host(name) is is_own


def test_another_address_needs_tls(tmp_path: Path) -> None:
    socket, tokens = tmp_path / "control.sock", tmp_path / "tokens.json"
    with pytest.raises(CommandError, match="use TLS"):
        WebSettings(socket, tokens, host="0.0.0.0").check()
    with pytest.raises(CommandError, match="cannot be read"):
        WebSettings(socket, tokens, certificate=tmp_path / "none.pem", key=tmp_path / "none.pem").check()
    assert WebSettings(socket, tokens, host="0.0.0.0").role_without_token() is None
    assert WebSettings(socket, tokens, loopback_role=Role.READ).role_without_token() is Role.READ
