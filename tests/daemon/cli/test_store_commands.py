"""`rigcal store`: with the daemon running and without, each command says what it did or why it did not."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from daemon.cli import client
from daemon.cli.main import main
from daemon.store import Store
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.support.store import frame

CONFIG = 'rig = "swdt82"\nstate_directory = "."\n[[can]]\nchannel = "can0"\n[store]\nbackup_directory = "backups"\n'


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "rigcal.toml"
    path.write_text(CONFIG, encoding="utf-8")
    store = Store(tmp_path / "rigcal.sqlite")
    store.mark_decoded(store.append_captures([frame(n) for n in range(10)]))
    store.close()
    return path


def say(config: Path, *words: str) -> Result:
    return CliRunner().invoke(main, ["store", *words, "--config", str(config)])


def told(config: Path, *words: str) -> dict[str, Any]:
    result = say(config, *words, "--json")
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_a_store_is_told_checked_backed_up_damaged_and_restored(config: Path) -> None:
    found = told(config, "stats", "--tables")
    assert (found["chunks"], found["small_chunks"], found["undecoded_chunks"]) == (1, 1, 0)
    assert found["tables"]["raw_chunks"] >= 4096
    assert told(config, "check")["is_sound"]
    assert "checked 10 captures in 1 chunk, 0 live models" in say(config, "check").stdout
    backup = told(config, "backup")["backup"]
    assert [b["path"] for b in told(config, "backup", "--list")["backups"]] == [backup]
    assert "no damage found" in say(config, "check", "--backup", backup).stdout
    config.with_name("rigcal.sqlite").write_bytes(b"\0" * 8192)
    broken = say(config, "check")
    assert broken.exit_code == 1
    assert "restore the store from a backup" in broken.output
    restored = told(config, "restore", backup)
    assert (Path(restored["replaced"]) / "rigcal.sqlite").stat().st_size == 8192
    assert told(config, "check")["captures"] == 10
    with contextlib.closing(sqlite3.connect(Path(backup) / "rigcal.sqlite")) as db:
        db.execute("UPDATE raw_chunks SET chunk = CAST(substr(chunk, 1, 40) || x'00' || substr(chunk, 42) AS BLOB)")
        db.commit()
    damaged = say(config, "check", "--backup", backup)
    assert damaged.exit_code == 1
    assert "do not restore this backup; make another one of the store: `rigcal store backup`" in damaged.output
    assert "restore the store from a backup" not in damaged.output


def test_a_store_that_is_a_link_is_not_restored_in_the_place_of_the_link(config: Path, tmp_path: Path) -> None:
    backup = told(config, "backup")["backup"]
    store, elsewhere = config.with_name("rigcal.sqlite"), tmp_path / "elsewhere.sqlite"
    store.rename(elsewhere)
    store.symlink_to(elsewhere)
    refused = say(config, "restore", backup)
    assert refused.exit_code == 1
    assert f"is a link to {elsewhere}" in refused.output
    assert store.is_symlink()
    assert told(config, "check")["captures"] == 10


def test_while_a_daemon_runs_it_is_asked_and_only_a_restore_is_refused(config: Path) -> None:
    with idle_daemon(config.parent):
        assert told(config, "check")["is_sound"]
        backup = told(config, "backup")["backup"]
        assert told(config, "prune", "--days", "30")["deleted_until_utc_ns"] is None  # the last hour always stays
        refused = say(config, "redecode", "--session", "s001-r")
        assert "no captures of session 's001-r'" in refused.stderr
        busy = say(config, "restore", backup)
        assert busy.exit_code == 1
        assert "stop it first" in busy.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["prune"], "give --days"),
        (["redecode"], "give either --session"),
        (["redecode", "--from", "2026-01-01"], "give either --session"),
        (["restore", "/nowhere"], "not a backup of rigcal"),
    ],
)
def test_wrong_use_is_one_sentence_that_says_what_to_do(config: Path, words: list[str], said: str) -> None:
    result = say(config, *words)
    assert result.exit_code != 0
    assert said in result.stderr
    assert "Traceback" not in result.output


def test_without_config_the_installed_daemon_is_meant(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "INSTALLED_CONFIG", config.with_name("none.toml"))
    result = CliRunner().invoke(main, ["store", "stats"])
    assert result.exit_code == 2
    remedy = "give the daemon's configuration with --config"
    assert f"{config.with_name('none.toml')} does not exist; {remedy}" in result.stderr
    monkeypatch.setattr(client, "INSTALLED_CONFIG", config)
    assert str(config.with_name("rigcal.sqlite")) in CliRunner().invoke(main, ["store", "stats"]).stdout


def test_no_command_makes_a_store_where_there_is_none(config: Path) -> None:
    shutil.rmtree(config.with_name("backups"), ignore_errors=True)
    config.with_name("rigcal.sqlite").unlink()
    for words in (["stats"], ["check"], ["backup"], ["prune", "--days", "3"], ["redecode", "--session", "s1"]):
        result = say(config, *words)
        assert result.exit_code != 0
        assert "there is no store" in result.stderr, words
    assert not config.with_name("rigcal.sqlite").exists()
