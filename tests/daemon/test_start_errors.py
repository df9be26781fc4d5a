"""A daemon that cannot use its disk ends in one sentence that says what to do, at every step of its start."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.commands import REFUSED, CommandError
from daemon.composition import Parts, joiner, require_apart
from daemon.config.config import Config
from daemon.service import Daemon
from daemon.store import Store, StoreError
from drivers.clock import SystemClock
from tests.daemon.support.damage import fill, small_disk
from tests.daemon.support.jobs import SOURCE

CONFIG = """rig = "swdt82"
state_directory = "{state}"

[[can]]
channel = "no-such-can"
"""


def start(directory: Path, state: Path, before: Callable[[], None] | None = None) -> str:
    """What `rigcal run` says when it cannot start: one line."""
    config = directory / "rigcal.toml"
    config.write_text(CONFIG.format(state=state), encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, "-m", "daemon.cli.main", "run", "--config", str(config)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        preexec_fn=before,
        cwd=directory,
    )
    assert ended.returncode == 1, ended.stderr
    assert "Traceback" not in ended.stderr
    (sentence,) = [line for line in ended.stderr.splitlines() if line.startswith("Error: ")]
    return sentence


def test_a_full_disk_is_told_before_there_is_a_store(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 256) as disk:
        fill(disk)
        sentence = start(tmp_path, disk / "state")
    assert "the disk is full" in sentence
    assert "0 MiB free in" in sentence
    assert "delete files" in sentence


@pytest.mark.long
@pytest.mark.parametrize("free_kb", [16, 240])
def test_a_disk_that_becomes_full_while_the_store_is_made_is_told(tmp_path: Path, free_kb: int) -> None:
    with small_disk(tmp_path / "disk", free_kb) as disk:
        sentence = start(tmp_path, disk)
    assert f"{disk / 'rigcal.sqlite'}: cannot be written, the disk is full" in sentence


def test_a_full_disk_is_told_where_the_store_is_there_already(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 2048) as disk:
        Store(disk / "rigcal.sqlite").close()
        fill(disk)
        sentence = start(tmp_path, disk)
    assert f"{disk / 'rigcal.sqlite'}: cannot be written, the disk is full" in sentence
    assert "0 MiB free in" in sentence


def test_a_disk_that_becomes_full_after_the_store_was_opened_is_told(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 2048) as disk:
        config = Config(rig="swdt82", state_directory=disk, socket=tmp_path / "socket")
        Store(config.store_path).close()
        store = Store(config.store_path)
        fill(disk)
        rig = SOURCE.rig
        parts = Parts("live", rig, SOURCE.text, SystemClock(), [], {}, joiner(config, rig))
        with contextlib.closing(store), pytest.raises(StoreError, match="cannot be written, the disk is full"):
            Daemon(config, store, parts)


def test_a_read_only_file_system_is_told(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 2048) as disk:
        Store(disk / "rigcal.sqlite").close()
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        sentence = start(tmp_path, disk)
    assert "is read-only; mount it for writing" in sentence


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_directory_that_may_not_be_written_to_is_told(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir(mode=0o500)
    sentence = start(tmp_path, state)
    assert "must be allowed to write to it" in sentence


def test_a_state_directory_that_is_a_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("no directory", encoding="utf-8")
    assert f"{tmp_path / 'state'}" in start(tmp_path, tmp_path / "state")


@pytest.mark.parametrize("limit_kb", [64])
def test_a_file_that_may_not_grow_is_told(tmp_path: Path, limit_kb: int) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_kb * 1024, limit_kb * 1024))

    sentence = start(tmp_path, tmp_path, limit)
    assert f"{tmp_path / 'rigcal.sqlite'}: cannot be" in sentence
    assert "MiB free in" in sentence


def test_a_simulated_rig_and_a_real_machine_have_no_store_together(tmp_path: Path) -> None:
    with contextlib.closing(Store(tmp_path / "rigcal.sqlite")) as store:
        store.boot_row(SystemClock().now())
    config = tmp_path / "rigcal.toml"
    config.write_text(CONFIG.format(state=tmp_path) + '[[station]]\nserial.path = "/dev/none"\n', encoding="utf-8")
    command = [sys.executable, "-m", "daemon.cli.main", "run", "--sim", "--config", str(config)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == REFUSED, ended.stderr
    assert "holds records of a real machine" in ended.stderr
    require_apart(["boot-a"], tmp_path, is_simulated=True)
    require_apart(["simulated-1"], tmp_path, is_simulated=True)
    with pytest.raises(CommandError, match="records of a simulated rig"):
        require_apart(["simulated-1"], tmp_path, is_simulated=False)
