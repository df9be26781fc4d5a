"""A live model that cannot be loaded: whether it or the computer is at fault, and that it is loaded once it can be."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from daemon.models.live_model import Loaded, Missing
from tests.daemon.support.models import ModelRig, wait


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelRig]:
    """A live model, loaded, that is looked at again soon where that has failed."""
    monkeypatch.setattr("daemon.models.live_model.RETRY_S", 0.05)
    rig = ModelRig(tmp_path)
    rig.accepted()
    assert isinstance(rig.settled(), Loaded)
    yield rig
    rig.close()


@contextmanager
def no_descriptors() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_model_for_which_there_is_no_descriptor_is_no_defect_and_is_loaded_once_there_is_one(
    rig: ModelRig, caplog: pytest.LogCaptureFixture
) -> None:
    with no_descriptors():
        rig.live.changed()
        state, health = rig.settled(), rig.live.health()
    assert isinstance(state, Missing)
    assert (state.is_defect, state.is_hindered) == (True, True)
    assert "Too many open files" in state.reason
    assert health is not None
    assert (health.defect, health.hindrance) == ("", state.reason)
    wait(lambda: isinstance(rig.live.now(), Loaded))
    health = rig.live.health()
    assert health is not None
    assert health.hindrance == ""
    assert sum("Too many open files" in record.message for record in caplog.records) == 1


def test_a_damaged_model_is_a_defect_until_its_files_are_as_they_were(rig: ModelRig) -> None:
    live = rig.models.live()
    assert live is not None
    file = live.path / "model.json"
    sound = file.read_bytes()
    file.write_bytes(sound[:-10])
    rig.live.changed()
    state, health = rig.settled(), rig.live.health()
    assert isinstance(state, Missing)
    assert (state.is_defect, state.is_hindered) == (True, False)
    assert health is not None
    assert (health.defect, health.hindrance) == (state.reason, "")
    file.write_bytes(sound)
    wait(lambda: isinstance(rig.live.now(), Loaded))
