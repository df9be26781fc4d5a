"""A store, and where jobs run in tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.store import Store
from tests.daemon.support.jobs import JobRig


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A place for a store."""
    return tmp_path / "rigcal.sqlite"


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    """A new store."""
    store = Store(path)
    yield store
    store.close()


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[JobRig]:
    """A store with a scheduler that looks what is due ten times as often as in a daemon: tests need not wait for it."""
    monkeypatch.setattr("daemon.jobs.runner.POLL_S", 0.05)
    rig = JobRig(tmp_path)
    yield rig
    rig.close()
