"""Commands are found in their folder, and start without what they do not use."""

from __future__ import annotations

import ast
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from daemon.cli import commands
from daemon.cli.client import socket_of
from daemon.cli.commands import tip
from daemon.cli.main import main
from daemon.commands import INSTALLED_SOCKET
from tests.daemon.support.idle_daemon import idle_daemon

HEAVY = ("numpy", "scipy", "pydantic", "rich", "matplotlib", "numba", "lightgbm")
NEW = '''
import click


@click.command()
def hello() -> None:
    """Greet."""
    click.echo("hello there")
'''


def heavy_modules(*arguments: str) -> list[str]:
    """Names of heavy packages that are loaded when a command has ended well."""
    code = (
        "import sys\n"
        "from daemon.cli.main import main\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert not end.code\n"
        f"print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    found: list[str] = ast.literal_eval(done.stderr.splitlines()[-1])
    return found


def test_a_new_file_in_the_folder_is_a_new_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hello.py").write_text(NEW, encoding="utf-8")
    monkeypatch.setattr(commands, "__path__", [*commands.__path__, str(tmp_path)])
    assert re.search(r"hello +Greet\.", CliRunner().invoke(main, ["--help"]).stdout)
    assert CliRunner().invoke(main, ["hello"]).stdout == "hello there\n"


@pytest.mark.parametrize(
    ("typed", "meant"), [(["statsu"], "Did you mean 'status'?"), (["session", "strat"], "Did you mean 'start'?")]
)
def test_a_mistyped_command_is_told_which_one_may_be_meant(typed: list[str], meant: str) -> None:
    refused = CliRunner().invoke(main, typed)
    assert refused.exit_code == 2
    assert f"No such command {typed[-1]!r}. {meant}" in refused.stderr


def test_a_word_that_resembles_no_command_suggests_none() -> None:
    refused = CliRunner().invoke(main, ["xyzzy"])
    assert "No such command 'xyzzy'.\n" in refused.stderr


def test_an_empty_variable_is_as_if_it_were_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RIGCAL_SOCKET", "")
    assert socket_of(None, None) == INSTALLED_SOCKET
    monkeypatch.setenv("RIGCAL_SOCKET", "rigcal-sim/control.sock")
    assert socket_of(None, None) == Path("rigcal-sim/control.sock")


@pytest.mark.parametrize(
    ("typed", "named"),
    [
        (["session", "guide", "--prisms", ""], "--prisms"),
        (["run", "--sim", "--effect="], "--effect"),
        (["init", "--out", ""], "--out"),
        (["config", "check", ""], "an argument"),
    ],
)
def test_an_empty_argument_is_refused_by_name(
    typed: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(main, typed)
    assert refused.exit_code == 2
    assert f"Error: {named} is empty; give it a value or omit it" in refused.stderr
    assert not list(tmp_path.iterdir())


def test_no_command_uses_another_commands_module() -> None:
    for path in Path(commands.__path__[0]).glob("*.py"):
        assert "daemon.cli.commands" not in path.read_text(encoding="utf-8"), path


def test_a_reader_that_has_ended_is_no_error(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.write_text('rig = "swdt82"\n[[can]]\nchannel = "can0"\n', encoding="utf-8")
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "daemon.cli.main", "config", "check", str(config)]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert done.returncode == 1
    assert done.stderr == ""


@pytest.mark.parametrize("options", [[], ["--follow"]])
def test_a_tip_waits_for_a_daemon_that_hangs_no_longer_than_the_status_does(
    options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tip, "STATUS_TIMEOUT_S", 0.1)
    with socket.socket(socket.AF_UNIX) as hangs:
        hangs.bind(str(tmp_path / "control.sock"))
        hangs.listen()
        failed = CliRunner().invoke(main, ["tip", *options, "--socket", str(tmp_path / "control.sock")])
    assert failed.exit_code == 1
    assert "did not answer within 0.1 s: it hangs" in failed.stderr


def test_help_loads_nothing_heavy() -> None:
    assert heavy_modules("--help") == []


def test_the_state_of_a_running_daemon_is_shown_with_nothing_heavy_loaded(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        for command in (["status", "--frames"], ["alarms"], ["session", "list"]):
            assert heavy_modules(*command, "--socket", str(config.socket_path)) == []


def test_a_configuration_given_as_a_file_is_answered_with_the_option(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.touch()
    told = CliRunner().invoke(main, ["run", str(config)])
    assert told.exit_code == 2
    assert f"--config {config}" in told.stderr


def test_an_option_without_its_value_is_answered_with_what_to_give() -> None:
    told = CliRunner().invoke(main, ["session", "guide", "--stop"])
    assert told.exit_code == 2
    assert "Option --stop needs a value: --stop REASON" in told.stderr
