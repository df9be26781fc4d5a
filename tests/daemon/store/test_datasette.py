"""Datasette opens a store with the metadata that is made for it: titles, descriptions, links, queries."""

from __future__ import annotations

import asyncio
import contextlib
import html
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from daemon.store import Store
from daemon.store.describe.description import StoreDescription, describe_store
from daemon.store.describe.metadata import datasette_metadata
from daemon.store.queries.observations import ObservationTable
from daemon.store.queries.sessions import SessionTable
from tests.daemon.support.store import at, fix, reading

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of its own imports
    app = pytest.importorskip("datasette.app")
    utils = pytest.importorskip("datasette.utils")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "rigcal.sqlite"
    with contextlib.closing(Store(path)) as store:
        store.declare_channels({"theta1": "deg", "y": "mm"}, {"oil": "degC"})
        store.insert_records([reading("theta1", 1.0, 5.0), fix(1.0)])
        created = store.instant(at(0.0), "created_")
        store.insert("station_setups", {"id": "S1", "instrument": "GTS", "serial": "1", "state": "ok", **created})
        table, observations = SessionTable(store, "swdt82"), ObservationTable(store)
        table.start(at(0.0), "name = 1\n", id="s001-r", setup_id="S1", prism="r", operator="", kind="static_poses")
        place = {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0, "moving": 0, "values_json": {"theta1_deg": 5.0}}
        observations.add(1, at(1.0), session_id="s001-r", setup_id="S1", prism="r", pose="1", **place)
        table.change("s001-r", state="closed", **store.instant(at(2.0), "ended_"))
        job = {"kind": "gap", "session_id": "s001-r", "through_session_id": "s001-r", "state": "done", **created}
        job_id = store.insert("jobs", job)
        model = {"rig": "swdt82", "path": "00001-gap", "manifest_sha256": "", "stage": "effects", "state": "candidate"}
        store.insert(
            "models", {**model, "job_id": job_id, "rig_sha256": store.rig_file("swdt82", "name = 1\n"), **created}
        )
    return path


@pytest.fixture(scope="module")
def described(path: Path) -> StoreDescription:
    return describe_store(path)


@pytest.fixture(scope="module")
def pages(path: Path, described: StoreDescription) -> Mapping[str, Any]:
    """Every page of the store as Datasette shows it: address -> HTML, or rows of a query."""

    async def visit() -> dict[str, Any]:
        metadata = utils.parse_metadata(datasette_metadata(described))
        datasette = app.Datasette([str(path)], metadata=metadata)
        found: dict[str, Any] = {}
        wanted = ["/rigcal", *(f"/rigcal/{table.name}" for table in described.tables)]
        queries = [f"/rigcal/{query.name}" for query in described.queries]
        for address in [*wanted, *(f"{query}.json?_shape=array&session=s001-r" for query in queries)]:
            answer = await datasette.client.get(address)
            assert answer.status_code == 200, f"{address}: {answer.text[:500]}"
            found[address.partition(".json")[0]] = answer.json() if ".json" in address else html.unescape(answer.text)
        for database in datasette.databases.values():
            database.close()
        datasette.executor.shutdown()
        return found

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return asyncio.run(visit())


def test_every_table_has_its_title_and_its_columns_their_meaning(
    described: StoreDescription, pages: Mapping[str, Any]
) -> None:
    for table in described.tables:
        page = pages[f"/rigcal/{table.name}"]
        title = re.search(r"<h1[^>]*>(.*?)</h1>", page, re.DOTALL)
        assert title is not None
        assert table.words.title in title.group(1), table.name
        assert table.words.description in page, table.name
        for column in table.columns:
            assert f'data-column-description="{column.meaning}"' in page or f"<dd>{column.meaning}</dd>" in page, (
                f"{table.name}.{column.name}"
            )


def test_rows_are_linked_with_those_that_they_name(pages: Mapping[str, Any]) -> None:
    for table, links in {
        "observations": ["calibration_sessions/s001-r", "station_setups/S1", "fixes/1", "boots/1"],
        "joint_samples": ["channels/1"],
        "calibration_sessions": ["rig_files/", "station_setups/S1"],
        "models": ["jobs/1", "rig_files/"],
        "jobs": ["calibration_sessions/s001-r"],
    }.items():
        for link in links:
            assert f'href="/rigcal/{link}' in pages[f"/rigcal/{table}"], f"{table} -> {link}"
    assert ">theta1</a>" in pages["/rigcal/joint_samples"]  # by its name, not by its number


def test_every_foreign_key_is_known_to_the_description(described: StoreDescription, path: Path) -> None:
    named = {(table.name, c.name) for table in described.tables for c in table.columns if c.refers_to}
    with contextlib.closing(Store(path)) as store:
        for table in described.tables:
            if not table.is_view:
                keys = store.rows(f'PRAGMA foreign_key_list("{table.name}")')
                alone = [key for key in keys if sum(other["id"] == key["id"] for other in keys) == 1]
                assert {(table.name, key["from"]) for key in alone} <= named


def test_every_query_is_offered_and_answers(described: StoreDescription, pages: Mapping[str, Any]) -> None:
    assert len(described.queries) == 10
    assert not {query.name for query in described.queries} & {table.name for table in described.tables}
    for query in described.queries:
        assert query.title in pages["/rigcal"]
        assert isinstance(pages[f"/rigcal/{query.name}"], list)
    (row,) = pages["/rigcal/observations_of_session"]
    assert (row["theta1_deg"], row["time"]) == (5.0, "2023-11-14T22:13:21.000000Z")
