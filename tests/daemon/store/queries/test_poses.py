"""What is read of a session while it is closed, and for each status: never all of a long one."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from daemon.store import Store
from daemon.store.queries import observations, poses, sessions
from daemon.store.queries.observations import ObservationTable, tally_of
from daemon.store.queries.poses import has_poses_before_enclosed, is_enclosed
from daemon.store.queries.sessions import SessionTable
from tests.daemon.support.store import at

ID = "s001-r"
PLACE = {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0, "prism": "r", "moving": False, "values_json": {}}
PER_POSE = 20


class Counting:
    """A source of rows that counts them."""

    def __init__(self, store: Store) -> None:
        self.store, self.read = store, 0

    def rows(self, sql: str, parameters: Sequence[object] = ()) -> list[dict[str, Any]]:
        found = self.store.rows(sql, parameters)
        self.read += len(found)
        return found


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    with contextlib.closing(Store(path)) as store:
        setup = {"id": "S1", "instrument": "", "serial": "", "state": "ok"}
        store.insert("station_setups", setup | store.instant(at(0.0), "created_"))
        SessionTable(store, "swdt82").start(at(0.0), "", id=ID, prism="r", operator="", kind="static_poses")
        yield store


def shoot(store: Store, point: str, phase: str, second: float) -> None:
    place = {"setup_id": "S1", "name": point, "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0}
    if not store.rows("SELECT 1 FROM control_points WHERE name = ?", (point,)):
        store.insert("control_points", place)
    shot = place | {"session_id": ID, "phase": phase, "fix_ids_json": []}
    store.insert("control_shots", shot | store.instant(at(second)))


def observe(store: Store, seconds: Sequence[float], pose: str | None, excluded: str | None = None) -> None:
    table = ObservationTable(store)
    with store.transaction():
        for second in seconds:
            table.add(None, at(second), session_id=ID, **PLACE, pose=pose, excluded=excluded)


def test_the_end_of_a_long_session_reads_few_of_its_poses(store: Store) -> None:
    shoot(store, "cp1", "start", 1.0)
    for pose in range(400):
        observe(store, [2.0 + pose + n / PER_POSE for n in range(PER_POSE)], f"1.{pose}")
    shoot(store, "cp1", "end", 500.0)
    observe(store, [501.0], "1.400")
    source = Counting(store)
    assert is_enclosed(source, ID, 0.25)
    assert not has_poses_before_enclosed(source, ID)
    assert source.read < 20


def test_queries_of_a_session_s_end_start_and_status_find_their_rows_by_the_index(store: Store) -> None:
    place = (1, 5, 1, 9)
    statements: dict[str, tuple[object, ...]] = {
        poses.POSES: (ID, *place, 3),
        sessions._MOVED_BETWEEN: (ID,),
        sessions._STANDSTILLS: ("S1", "swdt82", "x%", 0, 0),
        observations._FIRST_CONSTANTS: (ID,),
    }
    for sql, parameters in statements.items():
        plan = str(store.rows(f"EXPLAIN QUERY PLAN {sql}", parameters))
        assert "SCAN o" not in plan, plan
        assert "index observations_by_session" in plan.lower(), plan
    assert "(boot_id,monotonic_ns)>(?,?) AND (boot_id,monotonic_ns)<(?,?)" in str(
        store.rows(f"EXPLAIN QUERY PLAN {poses.POSES}", statements[poses.POSES])
    )
    moved = str(store.rows(f"EXPLAIN QUERY PLAN {sessions._MOVED_BETWEEN}", (ID,)))
    assert "boot_id=? AND monotonic_ns>? AND monotonic_ns<?" in moved
    for sql in (observations.TOTALS, observations.POSES, observations.EXCLUDED):
        newer = sql.format("NOT INDEXED")
        plan = str(store.rows(f"EXPLAIN QUERY PLAN {newer}", (ID, 1, 2)[: newer.count("?")]))
        assert "INTEGER PRIMARY KEY (rowid>?" in plan, plan


def test_the_tally_of_an_open_session_reads_only_what_is_new_and_is_right_after_every_change(store: Store) -> None:
    table, chance = ObservationTable(store), random.Random(1)
    read: list[int] = []

    class Source(Counting):
        def rows(self, sql: str, parameters: Sequence[object] = ()) -> list[dict[str, Any]]:
            if "max(id)" in sql:
                read.append(int(str(parameters[1])))
            return super().rows(sql, parameters)

    source, second = Source(store), 0.0
    for step in range(60):
        seconds = [second + n for n in range(chance.randrange(4))]
        second += 5.0
        reason = chance.choice([None, None, "moving", "another prism"])
        observe(store, seconds, chance.choice([None, f"1.{step // 3}"]), reason)
        if step % 7 == 6:
            changed = {at(second - 10.0).monotonic_ns: chance.choice([None, "late"])}
            table.exclude(ID, changed, at(second))
        assert table.tally(source, ID) == tally_of(store, ID)
    assert read.count(0) < 15, "only exclusions of stored observations make it count from the start"


def old_verdict(shots: list[tuple[str, str, float]], rows: list[tuple[float, object]]) -> tuple[int, int]:
    """Poses, and poses between two shots of a point, row by row."""
    enclosed = {
        pose
        for second, pose in rows
        if any(
            a[0] == b[0] and a[1] == "start" and b[1] == "end" and a[2] < second < b[2] for a in shots for b in shots
        )
    }
    return len({pose for _, pose in rows}), len(enclosed)


@pytest.mark.parametrize("seed", range(12))
def test_whether_enough_poses_are_enclosed_is_what_counting_every_row_gives(store: Store, seed: int) -> None:
    chance = random.Random(seed)
    shots = [("cp1", "start", chance.uniform(0, 40)), ("cp1", "end", chance.uniform(40, 100))]
    shots += [("cp2", "start", chance.uniform(0, 60)), ("cp2", "end", chance.uniform(60, 100))][: chance.choice([0, 2])]
    for shot in shots:
        shoot(store, *shot)
    rows: list[tuple[float, object]] = []
    for number in range(chance.randrange(1, 20)):
        seconds = sorted(chance.uniform(number * 5, number * 5 + 7) for _ in range(3))
        observe(store, seconds, f"1.{number}")
        rows += [(second, number) for second in seconds]
    count, enclosed = old_verdict(shots, rows)
    for least in (0.25, 0.5, 0.9):
        assert is_enclosed(store, ID, least) == (enclosed >= least * count)
