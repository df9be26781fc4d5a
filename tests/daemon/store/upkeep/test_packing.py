"""Small chunks become large ones in the background; no capture is lost, and none can be read twice."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path

import pytest

from daemon.store import Reader, Store
from daemon.store.reader import CHUNKS
from daemon.store.upkeep.packing import Packing
from drivers.readings import Capture
from tests.daemon.support.store import at, frame, serial_bytes, table


def append(store: Store, captures: list[Capture], *, decoded: bool = True) -> None:
    ids = store.append_captures(captures)
    if decoded:
        store.mark_decoded(ids)


def fill(store: Store, seconds: int, boot_id: str = "boot-a") -> list[Capture]:
    """Two chunks a second: of ten frames, and of what a station said."""
    kept: list[Capture] = []
    for second in range(seconds):
        now: list[Capture] = [frame(n, second + n / 10, boot_id=boot_id) for n in range(10)]
        now += [serial_bytes(b"%%*PQ 1.23\r\n", second + 0.95, boot_id=boot_id)]
        append(store, now)
        kept += now
    return kept


def pack(store: Store) -> int:
    packing = Packing(store)
    return sum(1 for _ in iter(packing.pack_next, False))


def read(path: Path, link: str | None = None) -> list[Capture]:
    with Reader(path) as reader:
        return list(reader.captures(link))


def of_link(captures: list[Capture], link: str) -> list[Capture]:
    return [capture for capture in captures if capture.link == link]


def test_all_captures_are_there_in_few_chunks_and_their_order(path: Path, store: Store) -> None:
    kept = fill(store, 200)
    assert pack(store) > 0
    for link in ("boom", "station"):
        assert read(path, link) == of_link(kept, link)
    with Reader(path) as reader:
        seen = list(reader.captures("boom", at(61.5), at(64.25)))
    assert seen == [
        c for c in of_link(kept, "boom") if at(61.5).monotonic_ns <= c.stamp.monotonic_ns <= at(64.25).monotonic_ns
    ]
    assert len(table(path, "raw_chunks")) < 2 * 200 / 3  # the last minute lies in small ones


def test_what_is_not_decoded_yet_stays_as_it_is(path: Path, store: Store) -> None:
    append(store, [frame(0, 0.0)])
    append(store, [frame(1, 1.0)], decoded=False)
    fill(store, 150)
    pack(store)
    assert store.undecoded_chunks() != []
    assert len(table(path, "raw_chunks")) == 302


def test_each_boot_and_a_link_that_fell_silent_are_packed_to_their_ends(path: Path, store: Store) -> None:
    kept = fill(store, 20, "boot-a")
    for second in range(200):
        append(store, [serial_bytes(b"x", float(second), boot_id="boot-b")])
    pack(store)
    assert read(path, "boom") == of_link(kept, "boom")
    assert [row["captures"] for row in table(path, "raw_chunks")][:2] == [200, 20]


def test_a_damaged_chunk_stays_and_what_lies_about_it_is_still_packed(path: Path, store: Store) -> None:
    fill(store, 30)
    store.update("raw_chunks", {"id": 5}, {"chunk": b"RCAP and nonsense"})
    kept = fill(store, 200, "boot-b")
    pack(store)
    (damaged,) = [row for row in table(path, "raw_chunks") if row["id"] == 5]
    assert damaged["chunk"] == b"RCAP and nonsense"
    with Reader(path) as reader:
        newest = list(reader.captures("boom", at(0.0, boot_id="boot-b")))
    assert newest == of_link(kept, "boom")


def test_a_disk_that_refuses_leaves_all_as_it_was(path: Path, store: Store) -> None:
    kept = fill(store, 100)
    with sqlite3.connect(path) as other:
        other.execute("BEGIN IMMEDIATE")
        store.rows("PRAGMA busy_timeout = 10")
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            Packing(store).pack_next()
        other.rollback()
    other.close()
    assert read(path, "boom") == of_link(kept, "boom")
    assert len(table(path, "raw_chunks")) == 200
    assert pack(store) > 0


def test_captures_of_a_time_are_found_by_an_index_and_no_other_chunk_is_read(path: Path, store: Store) -> None:
    fill(store, 3)
    with contextlib.closing(sqlite3.connect(path)) as db:
        plan = str(db.execute(f"EXPLAIN QUERY PLAN {CHUNKS}", (1, 5, 1, 9, "boom")).fetchall())
    assert "SEARCH raw_chunks USING COVERING INDEX raw_chunks_by_end" in plan
    assert "SEARCH raw_chunks USING INTEGER PRIMARY KEY" in plan
    assert "SCAN raw_chunks" not in plan
    assert "TEMP B-TREE" not in plan
