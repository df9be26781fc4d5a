"""The queries that are offered with the store run, are right, and read large tables by an index."""

from __future__ import annotations

import contextlib
import re
import sqlite3
from pathlib import Path

import pytest
from sqlite_utils import Database

from daemon.store.queries.canned_queries import canned_queries
from daemon.store.views import Channel, channels_of
from tests.daemon.support.store import rows


def test_every_canned_query_runs_and_is_right(session_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(session_path)) as db:
        queries = canned_queries(channels_of(Database(db)))
    assert len(queries) == 10
    found = {query.name: rows(session_path, query.sql, session="s001-r") for query in queries}
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
def test_queries_of_large_tables_use_an_index(session_path: Path, name: str) -> None:
    (query,) = (q for q in canned_queries([Channel("theta1", "deg", is_joint=True)]) if q.name == name)
    plan = [row["detail"] for row in rows(session_path, f"EXPLAIN QUERY PLAN {query.sql}", session="s001-r")]
    assert not [step for step in plan if re.match(r"SCAN (row|observations|joint_samples|fixes)\b(?!.*INDEX)", step)]
    assert [step for step in plan if "_by_" in step]
