"""Real damage for tests: torn pages of a store, a file system that is full or read-only."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.store import Store


def tear(path: Path, *names: str) -> None:
    """Overwrite the first page of tables or indexes of a store that is closed."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        ((size,),) = connection.execute("PRAGMA page_size").fetchall()
        pages = [
            connection.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (name,)).fetchone()[0]
            for name in names
        ]
    with path.open("r+b") as file:
        for page in pages:
            file.seek((page - 1) * size)
            file.write(b"\xa5" * size)


def fill_up(store: Store) -> None:
    """Let a store have no further page, as on a full disk, and none that is free."""
    with contextlib.closing(sqlite3.connect(store.path)) as other:
        other.execute("VACUUM")
    limit_pages(store, store.pragma("page_count"))


def make_room(store: Store) -> None:
    """Let a store that was filled up grow again."""
    limit_pages(store, 1_000_000)


def limit_pages(store: Store, pages: int) -> None:
    """Let the connection that writes have so many pages at most."""
    with store.transaction():
        store.rows(f"PRAGMA max_page_count = {pages}")


@contextlib.contextmanager
def small_disk(place: Path, kilobytes: int) -> Iterator[Path]:
    """A file system of that size; skips the test where none can be mounted."""
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(place)]
    if os.getuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("only root may mount a file system")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def fill(place: Path) -> None:
    """Leave nothing free on a small disk."""
    with contextlib.suppress(OSError), (place / "ballast").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1024))
