"""What follows from a transaction is done once it is committed, and never where it is not."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.store import Store
from tests.daemon.support.sessions import disk_fails


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = Store(tmp_path / "rigcal.sqlite")
    yield made
    made.close()


def add_link(store: Store, name: str) -> None:
    store.insert("links", {"name": name, "kind": "can"})


def add_two(store: Store, done: list[str]) -> None:
    with store.transaction():
        add_link(store, "can2")
        store.once_committed(lambda: done.append("undone"))
        done.append("asked for")
        add_link(store, "can0")


def test_it_follows_the_outermost_commit_in_its_order(store: Store) -> None:
    done: list[str] = []
    with store.transaction():
        with store.transaction():
            add_link(store, "can0")
            store.once_committed(lambda: done.append("inner"))
        store.once_committed(lambda: done.append("outer"))
        assert done == []
    assert done == ["inner", "outer"]
    store.once_committed(lambda: done.append("outside"))
    assert done == ["inner", "outer", "outside"]


def test_it_is_left_out_with_the_part_that_was_rolled_back(store: Store) -> None:
    done: list[str] = []
    add_link(store, "can0")
    with store.transaction():
        add_link(store, "can1")
        store.once_committed(lambda: done.append("kept"))
        with pytest.raises(sqlite3.IntegrityError):
            add_two(store, done)
    assert done == ["asked for", "kept"]


def test_it_is_not_done_when_the_disk_refuses_the_commit(store: Store) -> None:
    done: list[str] = []
    with disk_fails(), pytest.raises(sqlite3.OperationalError):
        add_two(store, done)
    assert done == ["asked for"]
    add_link(store, "can1")
    assert done == ["asked for"]
    assert [row["name"] for row in store.rows("SELECT name FROM links")] == ["can1"]


def test_no_other_thread_stores_anything_in_between(store: Store) -> None:
    order: list[str] = []
    waits = threading.Event()

    def other() -> None:
        waits.set()
        with store.transaction():
            order.append("the other thread stores")

    thread = threading.Thread(target=other)
    with store.transaction():
        add_link(store, "can0")
        thread.start()
        assert waits.wait(10.0)
        store.once_committed(lambda: thread.join(0.2) or order.append("memory has changed"))
    thread.join()
    assert order == ["memory has changed", "the other thread stores"]
