"""Where jobs run in tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.job_support import JobRig


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[JobRig]:
    """A store with a scheduler that looks what is due ten times as often as in a daemon: tests need not wait for it."""
    monkeypatch.setattr("daemon.jobs.runner.POLL_S", 0.05)
    rig = JobRig(tmp_path)
    yield rig
    rig.close()
