"""A daemon that cannot use its disk ends in one sentence that says what to do, at every step of its start."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from daemon.commands import REFUSED, CommandError
from daemon.composition import Parts, joiner, require_apart, simulated, simulated_machine
from daemon.config.config import Config, read_config
from daemon.rig_files import load_rig
from daemon.service import Daemon
from daemon.store import Store, StoreError
from drivers.clock import NS_PER_S, SystemClock
from tests.daemon.support.acquisition import wait_until
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
    machine = simulated_machine("swdt82", 1, (), has_secret=False)
    require_apart(["boot-a"], tmp_path, machine)
    require_apart(["simulated-1", f"simulated-{uuid.uuid4()}", f"{machine}{uuid.uuid4()}"], tmp_path, machine)
    with pytest.raises(CommandError, match="records of a simulated rig"):
        require_apart(["simulated-1"], tmp_path, None)


def test_a_store_of_another_simulated_machine_is_refused() -> None:
    machine = ("swdt82", 1, ["backlash@theta4"], False)
    others = [("ur10", *machine[1:]), ("swdt82", 2, *machine[2:]), ("swdt82", 1, [], False), (*machine[:3], True)]
    name, *rest = (simulated_machine(*m[:3], has_secret=m[3]) for m in (machine, *others))
    for other in rest:
        with pytest.raises(CommandError, match="was measured on a different simulated machine; start that one again"):
            require_apart([f"{other}{uuid.uuid4()}"], Path("rigcal.sqlite"), name)
    require_apart([f"{name}{uuid.uuid4()}"], Path("rigcal.sqlite"), name)


def test_a_store_of_another_simulated_machine_is_refused_with_the_options_of_its_own(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.write_text(CONFIG.format(state=tmp_path) + '[[station]]\nserial.path = "/dev/none"\n', encoding="utf-8")
    command = [sys.executable, "-m", "daemon.cli.main", "run", "--sim", "--config", str(config)]
    first = subprocess.Popen([*command, "--effect", "backlash@theta4"], stderr=subprocess.DEVNULL)
    try:
        wait_until((tmp_path / "control.sock").exists)
    finally:
        first.terminate()
        assert first.wait(60) == 0
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == REFUSED
    assert "start that one again with --rig swdt82 --seed 1 --effect=backlash@theta4, or move" in ended.stderr


def test_simulated_time_that_ran_fast_does_not_run_backwards_at_the_next_start(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.write_text(CONFIG.format(state=tmp_path) + '[[station]]\nserial.path = "/dev/none"\n', encoding="utf-8")
    parsed, source = read_config(config), load_rig("swdt82")
    ahead_ns = SystemClock().now().utc_ns + 3600 * NS_PER_S
    settings: dict[str, Any] = {"rate": 20.0, "seed": 1, "effects": (), "dwell_s": 4.0}
    with simulated(parsed, source, **settings, after_utc_ns=ahead_ns) as parts:
        now = parts.clock.now()
        assert now.utc_ns > ahead_ns
    path = tmp_path / "rigcal.sqlite"
    with contextlib.closing(Store(path)) as store:
        assert store.last_utc_ns() == 0
        store.begin_run(now)
        store.note_alive(now.shifted(NS_PER_S))
        assert store.last_utc_ns() == now.utc_ns + NS_PER_S
