"""What a command does not know is refused, and so is one without what it needs: nothing is done instead."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.commands import CommandError, reading_socket
from daemon.config.config import Config
from daemon.control.command_table import COMMANDS, READING
from daemon.control.protocol import request
from tests.daemon.control.test_control import talk
from tests.daemon.control.test_rights import OWN_GROUP
from tests.daemon.support.idle_daemon import idle_daemon


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Config]:
    with idle_daemon(tmp_path_factory.mktemp("rig"), read_group=OWN_GROUP) as config:
        for setup in ("S1", "S2"):
            request(config.socket_path, "setup.new", {"id": setup})
        yield config


def refused(path: Path, command: str, **arguments: Any) -> str:
    """Why a command is not carried out; it is wrong use."""
    with pytest.raises(CommandError) as error:
        request(path, command, arguments)
    assert error.value.status == 2
    return str(error.value)


def test_the_table_has_every_command_of_a_daemon(daemon: Config) -> None:
    known = refused(daemon.socket_path, "?").partition("known: ")[2]
    assert set(known.split(", ")) == COMMANDS.keys()


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_argument_is_named_with_those_that_are_known(daemon: Config, command: str) -> None:
    told = refused(daemon.socket_path, command, **COMMANDS[command].needed, setup_id="S1")
    assert told == f"{command}: unknown argument setup_id; known: {', '.join(COMMANDS[command].known) or 'none'}"
    if command in READING:
        assert refused(reading_socket(daemon.socket_path), command, setup_id="S1") == told


@pytest.mark.parametrize(
    ("command", "key"), [(name, key) for name, command in COMMANDS.items() for key in command.needed]
)
def test_an_argument_that_is_missing_is_said_to_be(daemon: Config, command: str, key: str) -> None:
    rest = {other: meaning for other, meaning in COMMANDS[command].needed.items() if other != key}
    assert f"argument {key} is missing" in refused(daemon.socket_path, command, **rest)
    assert f"argument {key} is missing" in refused(daemon.socket_path, command, **rest, **{key: None})


def test_a_session_does_not_start_on_another_setup_than_was_meant(daemon: Config) -> None:
    refused(daemon.socket_path, "session.start", prism="r", setup_id="S1")
    assert request(daemon.socket_path, "session.list") == []
    with_setup = request(daemon.socket_path, "session.start", {"prism": "r", "setup": "S1"})
    assert with_setup["setup"] == "S1"
    request(daemon.socket_path, "session.stop")


@pytest.mark.parametrize("command", sorted(COMMANDS.keys() - READING))
def test_whatever_changes_something_takes_who_is_responsible(daemon: Config, command: str) -> None:
    """The page sends it with all of them."""
    told = refused(daemon.socket_path, command, operator="Ada (page, operate)", setup_id="S1")
    assert "unknown argument setup_id;" in told


def test_a_new_setup_within_a_guide_is_held_to_the_same_names(daemon: Config) -> None:
    told = refused(daemon.socket_path, "guide.start", new_setup={"id": "S3", "instrumnt": "GTS-800A"})
    assert told.startswith("setup.new: unknown argument instrumnt; known: id, instrument,")
    assert "setup.new: argument id is missing" in refused(daemon.socket_path, "guide.start", new_setup={})
    assert [setup["id"] for setup in request(daemon.socket_path, "setup.list")] == ["S1", "S2"]


def test_a_request_has_no_other_members(daemon: Config) -> None:
    answer = talk(daemon.socket_path, b'{"command": "session.start", "args": {"prism": "r", "setup": "S1"}}\n')
    assert (answer["ok"], answer["status"]) == (False, 2)
    assert answer["error"].startswith("unknown key args in the request; a request is {")


def test_a_name_that_cannot_be_printed_is_told_safely(daemon: Config) -> None:
    assert "unknown argument \\x1b[2J;" in refused(daemon.socket_path, "status", **{"\x1b[2J": 1})
    assert len(refused(daemon.socket_path, "status", **{"x" * 100_000: 1})) < 200


def test_an_argument_that_is_null_is_as_if_it_were_not_given(daemon: Config) -> None:
    asked = {"prism": "r", "kind": None, "setup": None, "id": None, "note": None, "operator": None}
    opened = request(daemon.socket_path, "session.start", asked)
    assert opened["kind"] == "static_poses"
    request(daemon.socket_path, "session.abort", {"operator": None})
    described = {"id": "S4", "control_points": None, "note": None}
    guide = request(daemon.socket_path, "guide.start", {"prisms": ["r"], "new_setup": described, "setup": None})[
        "guide"
    ]
    assert guide["setup"] == "S4"
    request(daemon.socket_path, "guide.stop", {"reason": "seen"})
