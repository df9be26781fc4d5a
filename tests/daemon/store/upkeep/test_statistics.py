"""What `rigcal store stats` tells of a store."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from daemon.store import Store, StoreError
from daemon.store.upkeep.statistics import statistics
from tests.daemon.support.store import frame


def test_it_tells_size_and_contents_while_the_store_is_written_to(tmp_path: Path) -> None:
    path = tmp_path / "rigcal.sqlite"
    with contextlib.closing(Store(path)) as store:
        for n in range(3):
            store.append_captures([frame(60 * n), frame(60 * n + 1)])
        found = statistics(path)
        assert (found["chunks"], found["small_chunks"], found["undecoded_chunks"]) == (3, 3, 3)
        assert (found["sessions"], found["boots"]) == (0, 1)
        assert (found["oldest_utc_ns"], found["newest_utc_ns"]) == (frame(0).stamp.utc_ns, frame(121).stamp.utc_ns)
        assert found["file_bytes"] >= path.stat().st_size
        assert found["disk_free_bytes"] > 0
        assert "tables" not in found
        sizes = statistics(path, tables=True)["tables"]
        assert sizes is None or sizes["raw_chunks"] > 0  # a SQLite without dbstat cannot tell


def test_an_empty_store_has_no_instants_and_a_missing_one_is_said(tmp_path: Path) -> None:
    path = tmp_path / "rigcal.sqlite"
    Store(path).close()
    found = statistics(path)
    assert (found["oldest_utc_ns"], found["newest_utc_ns"], found["chunks"]) == (None, None, 0)
    with pytest.raises(StoreError):
        statistics(tmp_path / "none.sqlite")
