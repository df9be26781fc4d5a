"""Sessions keep their rig file, which is stored once."""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path

import pytest
from sqlite_utils import Database

from daemon.store import Reader, Store, StoreError
from daemon.store.migrations import MIGRATIONS
from daemon.store.queries.sessions import SessionTable, session
from tests.daemon.support.store import at, rows


def test_a_rig_file_is_stored_once(session_path: Path) -> None:
    with contextlib.closing(Store(session_path)) as store:
        table = SessionTable(store, "swdt82")
        table.start(at(20.0), "name = 1\n", id="s002-r", prism="r", operator="", kind="static_poses")
        table.change("s002-r", state="aborted")
        table.start(at(30.0), "name = 2\n", id="s003-r", prism="r", operator="", kind="static_poses")
    assert [row["text"] for row in rows(session_path, "SELECT text FROM rig_files ORDER BY text")] == [
        "name = 1\n",
        "name = 2\n",
    ]
    with Reader(session_path) as reader:
        third = session(reader, "s003-r")
    assert third is not None
    assert third["rig_text"] == "name = 2\n"
    assert third["rig_sha256"] == hashlib.sha256(b"name = 2\n").hexdigest()


def older_store(path: Path) -> None:
    """A store as it was before rig files had a table: two sessions of one file, one of another, and a model."""
    db = Database(path)
    MIGRATIONS.apply(db, stop_before="m030_rig_files")
    db["boots"].insert({"id": 1, "kernel_boot_id": "a", "booted_utc_ns": 0})
    for n, text in enumerate(["one", "one", "two"]):
        row = {"id": f"s{n}", "rig": "swdt82", "rig_sha256": "wrong", "rig_text": text, "prism": "r", "operator": ""}
        row |= {"kind": "static_poses", "state": "closed", "started_utc_ns": n, "started_monotonic_ns": n}
        db["calibration_sessions"].insert({**row, "started_boot_id": 1})
    instant = {"created_utc_ns": 9, "created_monotonic_ns": 9, "created_boot_id": 1}
    result = json.dumps({"sessions": ["s0", "s1"]})
    db["jobs"].insert({"id": 1, "kind": "gap", "state": "done", "result_json": result, **instant})
    model = {"id": 1, "rig": "swdt82", "path": "00001-gap", "manifest_sha256": "", "stage": "effects"}
    db["models"].insert({**model, "state": "candidate", "job_id": 1, **instant})
    db.close()


def test_no_session_of_an_older_store_is_rejected_and_what_was_accepted_stays_accepted(tmp_path: Path) -> None:
    path = tmp_path / "rigcal.sqlite"
    db = Database(path)
    MIGRATIONS.apply(db, stop_before="m032_rejected_sessions")
    db["boots"].insert({"id": 1, "kernel_boot_id": "a", "booted_utc_ns": 0})
    db["rig_files"].insert({"sha256": "a", "rig": "swdt82", "text": "one"})
    row = {"id": "s1", "rig": "swdt82", "rig_sha256": "a", "prism": "r", "operator": "", "kind": "static_poses"}
    row |= {"state": "closed", "started_utc_ns": 1, "started_monotonic_ns": 1, "started_boot_id": 1}
    db["calibration_sessions"].insert({**row, "accepted_despite": "it stood", "accepted_by": "Ada"})
    db.close()
    with contextlib.closing(Store(path)) as store:
        summary = SessionTable(store, "swdt82").summary("s1")
    assert (summary["rejected"], summary["not_used"]) == (None, None)
    assert summary["accepted"]["by"] == "Ada"


def test_rig_files_of_an_older_store_are_moved(tmp_path: Path) -> None:
    path = tmp_path / "rigcal.sqlite"
    older_store(path)
    with Reader(path) as reader, pytest.raises(StoreError, match="older rigcal"):
        session(reader, "s0")
    Store(path).close()
    with Reader(path) as reader:
        texts = [found["rig_text"] for name in ("s0", "s1", "s2") if (found := session(reader, name))]
        assert texts == ["one", "one", "two"]
        assert reader.count("rig_files") == 2
    (model,) = rows(path, "SELECT rig_sha256 FROM models")
    assert model["rig_sha256"] == hashlib.sha256(b"one").hexdigest()
    assert rows(path, "PRAGMA foreign_key_check") == []
