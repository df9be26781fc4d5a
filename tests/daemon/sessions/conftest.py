"""A rig whose station is set up, for tests of what its sessions do; `rig` is that of jobs, from the folder above."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.support.sessions import Rig


@pytest.fixture
def session_rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path / "rigcal.sqlite")
    made.say("setup_new", id="S1")
    yield made
    made.store.close()
