"""Who may look and who may change, and whom the kernel knows behind the name that a client says."""

import grp
import json
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from sqlite_utils import Database

from daemon.cli.main import main
from daemon.commands import Caller, CommandError, reading_socket
from daemon.config.config import Config, ConfigError, parse_config
from daemon.control.command_table import READING
from daemon.control.protocol import how_to_be_let_in, request
from daemon.store.reader import Reader
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.support.models import ModelRig

OWN_GROUP = grp.getgrgid(os.getegid()).gr_name
OWN_USER = pwd.getpwuid(os.geteuid()).pw_name
HOW = "use sudo" if os.getegid() == 0 else f"join the group {OWN_GROUP} "
STRANGER = 65534
AS_STRANGER = """
import os, sys
from daemon.cli import main
from daemon.cli.commands import alarms, jobs, model, session, setup, status, tip
os.setgroups([int(gid) for gid in sys.argv[1].split(",") if gid])
os.setgid(65534)
os.setuid(65534)
main.main(sys.argv[2:])
"""


@pytest.fixture
def reachable() -> Iterator[Path]:
    """A directory that other users may enter, as they do not pytest's."""
    directory = Path(tempfile.mkdtemp(prefix="rigcal-"))
    directory.chmod(0o755)
    yield directory
    shutil.rmtree(directory)


def rows(config: Config, sql: str) -> list[dict[str, Any]]:
    with Reader(config.store_path) as reader:
        return list(reader.rows(sql))


# ---- who gives a command ---------------------------------------------------------------------------------------------


def test_a_session_is_kept_with_the_user_behind_the_name_that_is_said(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        request(config.socket_path, "setup.new", {"id": "S1"})
        request(config.socket_path, "session.start", {"prism": "r", "operator": "the King"})
        (row,) = rows(config, "SELECT operator, caller_user, caller_uid, caller_pid FROM calibration_sessions")
        assert row == {
            "operator": "the King",
            "caller_user": OWN_USER,
            "caller_uid": os.geteuid(),
            "caller_pid": os.getpid(),
        }
        assert request(config.socket_path, "session.list")[0]["user"] == OWN_USER
        listed = CliRunner(env={"COLUMNS": "200"}).invoke(
            main, ["session", "list", "--socket", str(config.socket_path)]
        )
        assert f"the King (user {OWN_USER})" in listed.stdout


def test_words_about_a_session_are_kept_with_the_user_who_gave_them(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        request(config.socket_path, "setup.new", {"id": "S1"})
        name = request(config.socket_path, "session.start", {"prism": "r"})["id"]
        request(config.socket_path, "session.confirm-prism", {"operator": "the King"})
        request(config.socket_path, "session.stop")
        accepted = request(config.socket_path, "session.accept", {"id": name, "operator": "the King"})["accepted"]
        assert (accepted["by"], accepted["user"]) == ("the King", OWN_USER)
        (word,) = rows(config, "SELECT operator, caller_uid FROM prism_confirmations")
        assert word == {"operator": "the King", "caller_uid": os.geteuid()}


def test_a_change_of_the_live_model_is_kept_with_the_user_who_made_it(tmp_path: Path) -> None:
    made = ModelRig(tmp_path)
    made.accepted()
    made.close()
    with idle_daemon(tmp_path, socket=tmp_path / "s") as config:
        request(config.socket_path, "model.zeros-checked", {"operator": "the King"})
        found = rows(config, "SELECT operator, caller_user, caller_uid FROM model_states ORDER BY id")
        assert found[-1] == {"operator": "the King", "caller_user": OWN_USER, "caller_uid": os.geteuid()}
        assert found[0]["caller_user"] is None
        assert request(config.socket_path, "model.show")["history"][-1]["user"] == OWN_USER


def test_every_command_that_changes_something_is_logged_with_its_user(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO"), idle_daemon(tmp_path) as config:
        request(config.socket_path, "status")
        request(config.socket_path, "setup.new", {"id": "S1"})
    said = [r.getMessage() for r in caplog.records if r.name == "daemon.control.server"]
    assert said == [f"setup.new, requested by {Caller(OWN_USER, os.geteuid(), os.getpid())}"]


@pytest.mark.parametrize("forged", ["caller_user", "caller_uid", "caller", "uid"])
def test_a_client_cannot_say_who_it_is(tmp_path: Path, forged: str) -> None:
    with idle_daemon(tmp_path) as config:
        request(config.socket_path, "setup.new", {"id": "S1"})
        with pytest.raises(CommandError, match=f"unknown argument {forged};"):
            request(config.socket_path, "session.start", {"prism": "r", forged: 0})
        request(config.socket_path, "session.start", {"prism": "r"})
        (row,) = rows(config, "SELECT caller_uid, caller_pid FROM calibration_sessions")
        assert row == {"caller_uid": os.geteuid(), "caller_pid": os.getpid()}


# ---- looking and changing --------------------------------------------------------------------------------------------


def test_every_command_either_reads_or_changes() -> None:
    with tempfile.TemporaryDirectory() as directory, idle_daemon(Path(directory), read_group=OWN_GROUP) as config:
        with pytest.raises(CommandError) as unknown:
            request(config.socket_path, "?")
        commands = set(str(unknown.value).partition("known: ")[2].split(", "))
        assert commands > READING
        for command in sorted(commands - READING):
            with pytest.raises(CommandError, match=f"{command} does; {HOW}") as refused:
                request(reading_socket(config.socket_path), command)
            assert refused.value.status == 3
        for command in ("status", "setup.list", "session.list", "jobs.list", "model.list"):
            request(reading_socket(config.socket_path), command)


def test_the_reading_socket_is_its_groups_alone(tmp_path: Path) -> None:
    with idle_daemon(tmp_path, read_group=OWN_GROUP) as config:
        found = reading_socket(config.socket_path).stat()
        assert (found.st_mode & 0o777, found.st_gid) == (0o660, os.getegid())


def test_without_the_group_the_daemon_runs_and_an_alarm_says_that_no_one_may_look(tmp_path: Path) -> None:
    with idle_daemon(tmp_path, read_group="no-such-group") as config:
        assert request(config.socket_path, "setup.list") == []
        assert not reading_socket(config.socket_path).exists()
        wait_until(lambda: request(config.socket_path, "status")["alarms"]["active"])
        (alarm,) = request(config.socket_path, "status")["alarms"]["active"]
        assert (alarm["kind"], alarm["subject"]) == ("control_dead", "status.sock")
        assert "there is no group 'no-such-group'" in alarm["text"]


def test_a_reading_socket_in_the_control_sockets_place_is_refused(tmp_path: Path) -> None:
    text = 'rig = "swdt82"\nread_group = "adm"\nsocket = "status.sock"\n'
    with pytest.raises(ConfigError, match="read_group"):
        parse_config(text, tmp_path / "rigcal.toml")


def test_nobody_is_told_to_join_the_group_of_root() -> None:
    of_root = Path("/")
    assert of_root.stat().st_gid == 0
    assert how_to_be_let_in(of_root) == "use sudo: its group is root, which nobody should join"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_who_may_only_look_is_told_how_to_be_let_in(reachable: Path) -> None:
    group = next(g for g in grp.getgrall() if g.gr_gid not in {0, STRANGER})

    def as_stranger(*command: str, groups: str = "") -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", AS_STRANGER, groups, *command, "--socket", str(reachable / "control.sock")],
            capture_output=True,
            text=True,
            check=False,
        )

    with idle_daemon(reachable, read_group=group.gr_name) as config:
        shown = as_stranger("status", "--json", groups=str(group.gr_gid))
        assert shown.returncode == 0, shown.stderr
        assert json.loads(shown.stdout)["rig"] == "swdt82"
        refused = as_stranger("setup", "new", "S1", groups=str(group.gr_gid))
        assert refused.returncode == 3
        assert HOW in refused.stderr
        nobody = as_stranger("status")
        assert nobody.returncode == 3
        assert f"permission denied; {HOW}" in nobody.stderr
        assert rows(config, "SELECT * FROM station_setups") == []


# ---- stores of before ------------------------------------------------------------------------------------------------


def test_a_store_from_before_has_rows_that_no_user_is_known_for(tmp_path: Path) -> None:
    made = ModelRig(tmp_path)
    made.accepted()
    made.close()
    database = Database(tmp_path / "rigcal.sqlite")
    columns = {column.name for column in database["model_states"].columns}
    assert {"caller_user", "caller_uid", "caller_pid"} <= columns
    assert all(row["caller_user"] is None for row in database["model_states"].rows)
    database.close()
