"""The store's views, its rig files, and its description in words."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from sqlite_utils import Database

from daemon.store import Reader, Store, StoreError
from daemon.store.describe.table_words import TABLES
from daemon.store.describe.view_words import VIEWS
from daemon.store.migrations import MIGRATIONS
from daemon.store.queries.canned_queries import canned_queries
from daemon.store.queries.observations import ObservationTable
from daemon.store.queries.sessions import SessionTable, session
from daemon.store.views import Channel, channels_of
from docs.references.schema import example
from drivers.readings import Status
from tests.daemon.store_support import at, fix, reading

DOCS = Path(__file__).parents[3] / "docs" / "reference"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store with a session of ten seconds, a second of it at 10 Hz."""
    path = tmp_path / "rigcal.sqlite"
    with contextlib.closing(Store(path)) as store:
        store.declare_channels({"theta1": "deg", "L2": "mm"}, {"oil": "degC", "flow": "l/min"})
        store.insert("links", {"name": "ts1", "kind": "serial"})
        records = [reading("theta1", n / 10, float(n)) for n in range(100)]
        records.append(reading("L2", 4.0, 1500.0, "mm"))
        records.append(reading("theta1", 4.05, None, status=Status.MALFORMED))
        store.insert_records([*records, fix(4.0), fix(90.0)])
        table, observations = SessionTable(store, "swdt82"), ObservationTable(store)
        table.start(at(3.0), "name = 1\n", id="s001-r", prism="r", operator="Ada", kind="static_poses")
        values = {"theta1_deg": 40.0, "theta1_dir": 1.0, "L2_mm": 1500.0, "oil_degC": 61.5, "flow_l_per_min": 12.0}
        place = {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0, "moving": 0}
        row = {"session_id": "s001-r", "prism": "r", "pose": "1", "values_json": values, **place}
        observations.add(1, at(4.0), **row)
        observations.add(None, at(5.0), **{**row, "x_mm": 3.0})
        observations.add(None, at(6.0), **row, excluded="moving")
        table.change("s001-r", state="closed", **store.instant(at(13.0), "ended_"))
    return path


def rows(path: Path, sql: str, **parameters: Any) -> list[dict[str, Any]]:
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.row_factory = sqlite3.Row
        return [dict(row) for row in db.execute(sql, parameters)]


def test_observations_have_iso_times_and_joints_as_columns(path: Path) -> None:
    first, second, excluded = rows(path, "SELECT * FROM v_observations ORDER BY id")
    assert first["time"] == "2023-11-14T22:13:24.000000Z"
    assert (first["theta1_deg"], first["theta1_dir"], first["L2_mm"]) == (40.0, 1.0, 1500.0)
    assert (first["oil_degC"], first["flow_l_per_min"], first["theta1_rate"]) == (61.5, 12.0, None)
    assert (second["excluded"], excluded["excluded"]) == (None, "moving")


def test_readings_have_their_joints_column(path: Path) -> None:
    found = rows(path, "SELECT * FROM v_joints WHERE time >= '2023-11-14T22:13:24.000000Z' ORDER BY id")
    assert [row["theta1_deg"] for row in found[:3]] == [40.0, 41.0, 42.0]
    (length,) = [row for row in found if row["joint"] == "L2"]
    assert (length["L2_mm"], length["theta1_deg"], length["time"]) == (1500.0, None, "2023-11-14T22:13:24.000000Z")
    (bad,) = [row for row in found if row["status"] == "malformed"]
    assert (bad["theta1_deg"], bad["time"]) == (None, "2023-11-14T22:13:24.050000Z")


def test_sessions_count_their_observations(path: Path) -> None:
    (found,) = rows(path, "SELECT * FROM v_sessions")
    assert (found["observations"], found["excluded_observations"], found["duration_s"]) == (2, 1, 10.0)
    assert found["ended"] == "2023-11-14T22:13:33.000000Z"


def test_new_joints_become_columns_and_old_ones_stay(path: Path) -> None:
    with contextlib.closing(Store(path)) as store:
        store.declare_channels({"slew": "deg", 'odd"name': "mm"}, {})
    columns = rows(path, "SELECT * FROM v_observations LIMIT 1")[0]
    assert {"theta1_deg", "slew_deg", "slew_rate", 'odd"name_mm'} <= columns.keys()


def test_every_canned_query_runs_and_is_right(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as db:
        queries = canned_queries(channels_of(Database(db)))
    assert len(queries) == 10
    found = {query.name: rows(path, query.sql, session="s001-r") for query in queries}
    assert found["exclusions_of_session"] == [{"reason": "moving", "observations": 1}]
    (scatter,) = found["standstill_scatter"]
    assert (scatter["fixes"], scatter["x_mm"], scatter["std_x_mm"], scatter["std_y_mm"]) == (2, 2.0, 1.0, 0.0)
    seconds = found["joints_of_session"]  # monotonic seconds 8 to 14: of 3.0 s to 9.9 s into the test
    assert [row["theta1_deg"] for row in seconds] == [34.5, 44.5, 54.5, 64.5, 74.5, 84.5, 94.5]
    assert [row["L2_mm"] for row in seconds][:2] == [None, 1500.0]
    assert [row["slope_distance_m"] for row in found["fixes_of_session"]] == [11.7845]
    assert [(row["joint"], row["value"]) for row in found["newest_joints"]] == [("theta1", 99.0), ("L2", 1500.0)]
    assert len(found["observations_of_session"]) == 3


@pytest.mark.parametrize("name", ["joints_of_session", "fixes_of_session", "newest_joints", "observations_of_session"])
def test_queries_of_large_tables_use_an_index(path: Path, name: str) -> None:
    (query,) = (q for q in canned_queries([Channel("theta1", "deg", is_joint=True)]) if q.name == name)
    plan = [row["detail"] for row in rows(path, f"EXPLAIN QUERY PLAN {query.sql}", session="s001-r")]
    assert not [step for step in plan if re.match(r"SCAN (row|observations|joint_samples|fixes)\b(?!.*INDEX)", step)]
    assert [step for step in plan if "_by_" in step]


# ---- rig files -------------------------------------------------------------------------------------------------------


def test_a_rig_file_is_stored_once(path: Path) -> None:
    with contextlib.closing(Store(path)) as store:
        table = SessionTable(store, "swdt82")
        table.start(at(20.0), "name = 1\n", id="s002-r", prism="r", operator="", kind="static_poses")
        table.change("s002-r", state="aborted")
        table.start(at(30.0), "name = 2\n", id="s003-r", prism="r", operator="", kind="static_poses")
    assert [row["text"] for row in rows(path, "SELECT text FROM rig_files ORDER BY text")] == [
        "name = 1\n",
        "name = 2\n",
    ]
    with Reader(path) as reader:
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


# ---- in words --------------------------------------------------------------------------------------------------------


def test_no_words_are_of_what_the_store_lacks() -> None:
    store = example()
    by_name = {table.name: table for table in store.tables}
    assert by_name.keys() == TABLES.keys() | VIEWS.keys()
    for name, table in by_name.items():
        assert table.words.meanings().keys() <= {column.name for column in table.columns}, name
        assert table.words.label is None or table.words.label in {column.name for column in table.columns}
