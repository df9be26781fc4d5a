"""The store's views, and its description in words."""

from __future__ import annotations

import contextlib
from pathlib import Path

from daemon.store import Store
from daemon.store.describe.table_words import TABLES
from daemon.store.describe.view_words import VIEWS
from docs.references.schema import example
from tests.daemon.support.store import rows


def test_observations_have_iso_times_and_joints_as_columns(session_path: Path) -> None:
    first, second, excluded = rows(session_path, "SELECT * FROM v_observations ORDER BY id")
    assert first["time"] == "2023-11-14T22:13:24.000000Z"
    assert (first["theta1_deg"], first["theta1_dir"], first["L2_mm"]) == (40.0, 1.0, 1500.0)
    assert (first["oil_degC"], first["flow_l_per_min"], first["theta1_rate"]) == (61.5, 12.0, None)
    assert (second["excluded"], excluded["excluded"]) == (None, "moving")


def test_readings_have_their_joints_column(session_path: Path) -> None:
    found = rows(session_path, "SELECT * FROM v_joints WHERE time >= '2023-11-14T22:13:24.000000Z' ORDER BY id")
    assert [row["theta1_deg"] for row in found[:3]] == [40.0, 41.0, 42.0]
    (length,) = [row for row in found if row["joint"] == "L2"]
    assert (length["L2_mm"], length["theta1_deg"], length["time"]) == (1500.0, None, "2023-11-14T22:13:24.000000Z")
    (bad,) = [row for row in found if row["status"] == "malformed"]
    assert (bad["theta1_deg"], bad["time"]) == (None, "2023-11-14T22:13:24.050000Z")


def test_sessions_count_their_observations(session_path: Path) -> None:
    (found,) = rows(session_path, "SELECT * FROM v_sessions")
    assert (found["observations"], found["excluded_observations"], found["duration_s"]) == (2, 1, 10.0)
    assert found["ended"] == "2023-11-14T22:13:33.000000Z"


def test_new_joints_become_columns_and_old_ones_stay(session_path: Path) -> None:
    with contextlib.closing(Store(session_path)) as store:
        store.declare_channels({"slew": "deg", 'odd"name': "mm"}, {})
    columns = rows(session_path, "SELECT * FROM v_observations LIMIT 1")[0]
    assert {"theta1_deg", "slew_deg", "slew_rate", 'odd"name_mm'} <= columns.keys()


def test_no_words_are_of_what_the_store_lacks() -> None:
    store = example()
    by_name = {table.name: table for table in store.tables}
    assert by_name.keys() == TABLES.keys() | VIEWS.keys()
    for name, table in by_name.items():
        assert table.words.meanings().keys() <= {column.name for column in table.columns}, name
        assert table.words.label is None or table.words.label in {column.name for column in table.columns}
