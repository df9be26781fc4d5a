"""What is asked by boot and monotonic time reads the rows between two places, and no others of the same boot."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator

import pytest

from daemon.store import Store, reader
from daemon.store.places import LEAST_NS, MOST_NS, between, since
from daemon.store.queries import observations, sessions, zeros
from daemon.store.upkeep import full_samples, retention
from drivers.clock import Stamp

BOOTS, ROWS = 4, 400
PLACES = [(0, LEAST_NS), (1, -5), (2, 40), (3, 7), (3, 60), (9, 0), (MOST_NS, MOST_NS)]
ASKED = "SELECT row.id FROM boots CROSS JOIN joint_samples AS row WHERE {} ORDER BY boots.id, monotonic_ns"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A store with readings at random instants of four boots."""
    rng = random.Random(3)
    with contextlib.closing(Store(tmp_path_factory.mktemp("store") / "rigcal.sqlite")) as store:
        boots = [store.boot_row(Stamp(0, 0, f"boot-{number}")) for number in range(BOOTS)]
        channel = {"name": "theta1", "unit": "deg", "kind": "joint"}
        store.insert("channels", channel)
        for _ in range(ROWS):
            row = {"channel_id": 1, "utc_ns": 0, "monotonic_ns": rng.randrange(-10, 90), "boot_id": rng.choice(boots)}
            store.insert("joint_samples", row | {"value": 0.0, "status": "ok"})
        yield store


@pytest.mark.parametrize("first", PLACES)
def test_rows_since_a_place_are_those_of_the_comparison(store: Store, first: tuple[int, int]) -> None:
    asked = ASKED.format(since("row.", ("?1", "?2")))
    plain = "SELECT id FROM joint_samples WHERE (boot_id, monotonic_ns) >= (?, ?) ORDER BY boot_id, monotonic_ns, id"
    assert store.rows(asked, first) == store.rows(plain, first)


@pytest.mark.parametrize("first", PLACES)
@pytest.mark.parametrize("last", PLACES)
def test_rows_between_places_are_those_of_the_comparison(
    store: Store, first: tuple[int, int], last: tuple[int, int]
) -> None:
    asked = ASKED.format(between("row.", ("?1", "?2"), ("?3", "?4")))
    plain = """SELECT id FROM joint_samples
        WHERE (boot_id, monotonic_ns) >= (?, ?) AND (boot_id, monotonic_ns) <= (?, ?)
        ORDER BY boot_id, monotonic_ns, id"""
    assert store.rows(asked, (*first, *last)) == store.rows(plain, (*first, *last))


_END = "(last_boot_id,last_monotonic_ns)"
_AT = "(boot_id,monotonic_ns)"


@pytest.mark.parametrize(
    ("sql", "parameters", "searched"),
    [
        (retention._CHUNKS, 6, f"raw_chunks_by_end ({_END}>(?,?) AND {_END}<(?,?))"),
        (retention._ROWS.format("joint_samples"), 5, f"joint_samples_by_instant ({_AT}>(?,?) AND {_AT}<(?,?))"),
        (retention._ROWS.format("signals"), 5, f"signals_by_instant ({_AT}>(?,?) AND {_AT}<(?,?))"),
        (retention._FIXES, 6, f"fixes_by_instant (station=? AND {_AT}>(?,?) AND {_AT}<(?,?))"),
        (reader.CHUNKS, 5, f"raw_chunks_by_end ({_END}>(?,?))"),
        (full_samples._BETWEEN, 4, f"raw_chunks_by_end ({_END}>(?,?))"),
        (zeros._JUMPS.format("DESC"), 2, f"device_events_of_states (device=? AND kind=? AND {_AT}>(?,?))"),
        (zeros._LAST, 4, f"device_events_of_states (device=? AND kind=? AND {_AT}<(?,?))"),
        (observations._FIXES, 2, "fixes_by_instant (station=? AND boot_id=? AND monotonic_ns>?)"),
        (sessions._FIXES_MEASURED, 1, "fixes_by_instant (station=? AND boot_id=? AND monotonic_ns>? AND"),
        (sessions._JOINTS_MEASURED, 1, "joint_samples_by_instant (boot_id=? AND monotonic_ns>? AND monotonic_ns<?)"),
    ],
)
def test_an_index_is_searched_by_boot_and_instant(store: Store, sql: str, parameters: int, searched: str) -> None:
    plan = [row["detail"] for row in store.rows(f"EXPLAIN QUERY PLAN {sql}", (1,) * parameters)]
    assert any(searched in step for step in plan), plan
