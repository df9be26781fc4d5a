"""Models are found where they lie after the state directory was moved, copied or restored elsewhere."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.store import Store
from daemon.store.upkeep.model_places import follow_moved_models, place_of_model
from tests.daemon.support.store import at

GAP, HYBRID = Path("00001-gap", "model"), Path("00002-hybrid")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """A store with two models, and the results of the jobs that have made them."""
    before = tmp_path / "be\u00e4fore" / "models"
    store = Store(tmp_path / "rigcal.sqlite")
    for number, place in enumerate((GAP, HYBRID), 1):
        (before / place).mkdir(parents=True)
        result = {"model": str(before / place), "report": str(before / place.parts[0] / "report.html")}
        job = {"kind": "gap", "state": "done", "attempts": 1, "result_json": result}
        store.insert("jobs", job | store.instant(at(0.0), "created_"))
        row = {"rig": "swdt82", "path": result["model"], "manifest_sha256": str(number), "stage": "gap"}
        store.insert("models", row | {"state": "candidate"} | store.instant(at(0.0), "created_"))
    yield store
    store.close()


def paths(store: Store) -> list[str]:
    return [row["path"] for row in store.rows("SELECT path FROM models ORDER BY id")]


@pytest.mark.parametrize("are_kept", [False, True], ids=["moved", "copied"])
def test_models_are_found_in_the_directory_to_which_they_were_taken(
    store: Store, tmp_path: Path, *, are_kept: bool
) -> None:
    before, after = Path(paths(store)[1]).parent, tmp_path / "after" / "models"
    shutil.copytree(before, after)
    if not are_kept:
        shutil.rmtree(before)
    for _ in range(2):
        follow_moved_models(store, after)
        assert paths(store) == [str(after / GAP), str(after / HYBRID)]
    results = [json.loads(row["result_json"]) for row in store.rows("SELECT result_json FROM jobs ORDER BY id")]
    assert [result["model"] for result in results] == paths(store)
    assert results[0]["report"] == str(after / "00001-gap" / "report.html")


def test_models_that_are_not_in_the_new_directory_stay_where_they_were(store: Store, tmp_path: Path) -> None:
    before = paths(store)
    (tmp_path / "after" / "models" / HYBRID).mkdir(parents=True)
    follow_moved_models(store, tmp_path / "after" / "models")
    assert paths(store) == [before[0], str(tmp_path / "after" / "models" / HYBRID)]


def test_a_model_that_no_job_has_made_has_no_place_among_models() -> None:
    assert place_of_model("/home/ada/model") is None
    assert place_of_model("/var/lib/rigcal/models/00012-gap/model") == Path("00012-gap", "model")
    assert place_of_model("models/123456-hybrid") == Path("123456-hybrid")
