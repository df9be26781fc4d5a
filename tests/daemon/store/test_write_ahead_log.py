"""Another program that keeps reading the store is found, and told as an alarm once its log has grown."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from daemon.store import Store, health
from daemon.store.write_ahead_log import log_bytes, reader_of
from tests.daemon.support.store import frame, table
from tests.daemon.support.watch import watched

# Reads one row and leaves its transaction open until it is told to end.
READER = """
import sqlite3, sys
store = sqlite3.connect(sys.argv[1], isolation_level=None)
store.execute("BEGIN")
store.execute("SELECT count(*) FROM raw_chunks").fetchall()
print(flush=True)
sys.stdin.read()
"""


@contextmanager
def reading(path: Path) -> Iterator[int]:
    """A process that has the store open; its process id."""
    command = [sys.executable, "-c", READER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process.pid
        process.communicate()


def store_some(store: Store) -> None:
    for n in range(50):
        store.append_captures([frame(n)])


def test_a_process_that_leaves_a_transaction_open_is_found_until_it_ends(path: Path) -> None:
    with watched(path) as (store, _):
        store_some(store)
        assert reader_of(path) is None
        with reading(path) as pid:
            assert f"process {pid} (python" in str(reader_of(path))
            assert len(table(path, "raw_chunks")) == 50, "what this process reads itself is not meant"
        assert reader_of(path) is None


def test_a_log_that_grows_behind_a_reader_is_told_with_the_process(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with watched(path) as (store, watch):
        monkeypatch.setattr(health, "LONG_LOG_BYTES", log_bytes(path) + 100_000)
        with reading(path) as pid:
            watch.look()
            assert watch.health.log_fault == ""
            while log_bytes(path) <= health.LONG_LOG_BYTES:
                store_some(store)
            watch.look()
            assert f"process {pid} " in watch.health.log_fault
            assert not watch.health.is_log_stuck
            monkeypatch.setattr(health, "_space", lambda _: (log_bytes(path) - 1, True))
            watch.look()
            assert watch.health.is_log_stuck
        watch.look()
        assert watch.health.log_fault.startswith("that may need"), "the log is still long"


def test_a_store_without_a_log_has_neither_size_nor_reader(path: Path) -> None:
    assert log_bytes(path) == 0
    assert reader_of(path) is None
