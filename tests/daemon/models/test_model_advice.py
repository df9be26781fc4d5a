"""What `status` recommends is what would be accepted now, and a comparison with another live model is made again."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from daemon.cli.lines.state import model_lines
from daemon.commands import CommandError
from tests.daemon.support.models import ModelRig


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelRig]:
    monkeypatch.setattr("daemon.jobs.runner.POLL_S", 0.05)
    rig = ModelRig(tmp_path)
    yield rig
    rig.close()


def advice(rig: ModelRig) -> str:
    return "\n".join(model_lines(rig.registry.status()))


def stale(rig: ModelRig) -> tuple[int, int]:
    """A live model, and a newer candidate that was compared when none was live."""
    live = rig.candidate(30)
    waiting = rig.compared(rig.candidate(40), live=None)
    rig.registry.accept_command({"id": rig.compared(live, live=None), "operator": "Ada"})
    return live, waiting


def checked(rig: ModelRig) -> tuple[int, int]:
    """As `stale`, beside a closed check session whose jobs have run."""
    rig.jobs.session("a")
    rig.jobs.session("c", kind="check")
    for kind in ("gap", "report"):
        job = {"kind": kind, "session_id": "c", "through_session_id": "c", "state": "done"}
        result = {"result_json": {"model": "none", "sessions": ["a"]}}
        rig.store.insert("jobs", job | result | rig.store.instant(rig.clock.now(), "created_"))
    return stale(rig)


def comparisons(rig: ModelRig, model: int) -> list[str]:
    return [job["state"] for job in rig.jobs.jobs() if (job["kind"], job["model_id"]) == ("comparison", model)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("place", "error", "told"),
    [
        ("calibration.model.files.read_npz", MemoryError(), "this computer has too little memory to load the model"),
        ("calibration.model.files.parse_rig", MemoryError(), "this computer has too little memory to load the model"),
        ("daemon.warm_up.prepare", OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
    ],
)
def test_a_model_that_the_computer_could_not_load_is_recommended_once_it_can(
    rig: ModelRig, monkeypatch: pytest.MonkeyPatch, place: str, error: Exception, told: str
) -> None:
    model = rig.compared(rig.candidate(), live=None)

    def lacking(*_: object) -> NoReturn:
        raise error

    with monkeypatch.context() as short:
        short.setattr(place, lacking)
        assert told in advice(rig)
    assert f"model accept {model}" in advice(rig)
    assert rig.registry.accept_command({"id": model})["live"] == model


@pytest.mark.long
def test_a_model_that_was_compared_with_another_live_model_is_not_recommended(rig: ModelRig) -> None:
    live, waiting = stale(rig)
    told = advice(rig)
    assert "model accept" not in told
    assert f"no model was live, but model {live} is live now" in told
    with pytest.raises(CommandError) as refused:
        rig.registry.accept_command({"id": waiting})
    assert str(refused.value) in told, "status gives the reason that accepting would give"
    shown = {model["id"]: model["comparison"]["is_stale"] for model in rig.registry.list_command({})}
    assert shown == {live: False, waiting: True}


def test_a_model_whose_files_are_damaged_is_not_recommended(rig: ModelRig) -> None:
    waiting = rig.compared(rig.candidate(), live=None)
    assert f"`rigcal model accept {waiting}` makes it the live one" in advice(rig)
    file = rig.models.get(waiting).path / "model.json"
    whole = file.read_bytes()
    file.write_bytes(whole[:-10])
    told = advice(rig)
    assert "model accept" not in told
    assert "model.json is truncated" in told
    file.write_bytes(whole)
    assert f"`rigcal model accept {waiting}`" in advice(rig)
    rig.registry.accept_command({"id": waiting})


def test_a_model_that_is_no_better_is_not_recommended_and_status_says_why(rig: ModelRig) -> None:
    rig.compared(rig.candidate(), live=None, is_better=False)
    assert "model accept" not in advice(rig)
    assert "would be refused now: it errs by 1 mm" in advice(rig)


def test_a_comparison_with_another_live_model_is_made_again_by_itself_and_once(rig: ModelRig) -> None:
    live, waiting = checked(rig)
    rig.jobs.start()
    rig.jobs.wait(lambda: comparisons(rig, waiting) == ["done"], "the comparison")
    rig.jobs.look_on()
    assert comparisons(rig, waiting) == ["done"]
    compared = rig.models.get(waiting).comparison
    assert compared is not None
    assert compared["live"] == live
    assert f"`rigcal model accept {waiting}`" in advice(rig)


def test_a_comparison_that_fails_is_not_made_again_for_ever(rig: ModelRig) -> None:
    _, waiting = checked(rig)
    rig.jobs.plan(comparison="fail")
    rig.jobs.start()
    rig.jobs.wait(lambda: comparisons(rig, waiting) == ["failed"], "the comparison")
    rig.jobs.look_on(5)
    assert comparisons(rig, waiting) == ["failed"]
    assert "model accept" not in advice(rig)


def test_without_a_check_session_nothing_is_compared_again(rig: ModelRig) -> None:
    _, waiting = stale(rig)
    rig.jobs.start()
    rig.jobs.look_on(5)
    assert comparisons(rig, waiting) == []
