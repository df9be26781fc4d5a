"""What `status` recommends is what would be accepted now, and a comparison with another live model is made again."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from daemon.cli.lines.state import model_lines
from daemon.commands import CHECK, CommandError
from daemon.next_step import next_line
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.store.queries.models import ModelRow
from tests.daemon.support.jobs import SOURCE
from tests.daemon.support.models import PRISMS, ModelRig


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


def rejected(rig: ModelRig, name: str) -> None:
    SessionLifecycle(rig.store, SOURCE.rig, rig.clock, 10.0).reject(name, "Ada", "measured on w")
    rig.clock.advance(3600.0)


def compared_on_check(rig: ModelRig) -> int:
    """A candidate that was trained on session a and was found better on check session c."""
    rig.jobs.measured("a", 5, prisms=PRISMS)
    rig.jobs.measured("c", 4, CHECK, prisms=PRISMS)
    model = rig.candidate()
    rig.registry.compare_command({"id": model})
    rig.compare()
    assert f"`rigcal model accept {model}`" in advice(rig)
    return model


def refusal(rig: ModelRig, model: int) -> str:
    """Why a candidate is refused, as `status` and `model accept` say."""
    with pytest.raises(CommandError) as refused:
        rig.registry.accept_command({"id": model})
    candidate = rig.registry.status()["candidate"]
    assert not candidate["is_acceptable"]
    assert candidate["refused_because"] in str(refused.value)
    return str(refused.value)


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


def compared_again_by_itself(rig: ModelRig, waiting: int) -> int | None:
    """The model that was live at the one comparison that the scheduler has made again."""
    rig.jobs.start()
    rig.jobs.wait(lambda: comparisons(rig, waiting) == ["done"], "the comparison")
    rig.jobs.look_on()
    assert comparisons(rig, waiting) == ["done"]
    compared = rig.models.get(waiting).comparison
    assert compared is not None
    live: int | None = compared["live"]
    return live


def test_a_comparison_with_another_live_model_is_made_again_by_itself_and_once(rig: ModelRig) -> None:
    live, waiting = checked(rig)
    assert compared_again_by_itself(rig, waiting) == live
    assert f"`rigcal model accept {waiting}`" in advice(rig)


@pytest.mark.long
def test_a_comparison_with_a_live_model_that_was_rejected_is_made_again_by_itself_and_once(rig: ModelRig) -> None:
    live, waiting = checked(rig)
    rig.compared(waiting, live=live)
    rig.registry.reject_command({"id": live, "reason": "trained on another prism"})
    assert compared_again_by_itself(rig, waiting) is None


def test_a_comparison_that_fails_is_not_made_again_for_ever(rig: ModelRig) -> None:
    _, waiting = checked(rig)
    rig.jobs.plan(comparison="fail")
    rig.jobs.start()
    rig.jobs.wait(lambda: comparisons(rig, waiting) == ["failed"], "the comparison")
    rig.jobs.look_on(5)
    assert comparisons(rig, waiting) == ["failed"]
    assert "model accept" not in advice(rig)


@pytest.mark.long
def test_a_model_whose_only_check_was_rejected_waits_for_another_check(rig: ModelRig) -> None:
    model = compared_on_check(rig)
    rejected(rig, "c")
    start, _, end = refusal(rig, model).partition("measured on w")
    why = "was compared on session c, which calibration does not use any more (it was rejected by Ada: "
    assert start == f"model {model} {why}"
    told = ": hold a check session (`rigcal session start --kind check`)"
    assert end.endswith(f"{told}; `rigcal model compare {model}` compares it again")
    (shown,) = rig.registry.list_command({})
    assert shown["comparison"]["is_stale"]
    assert shown["comparison"]["stale_because"].startswith("on session c, which")
    status = {"setup": {"state": "ok"}, "gap": None, "session": None, "jobs": [], "alarms": {"active": []}}
    step = next_line(status | {"models": rig.registry.status()})
    assert "hold a check session" in step
    assert "other prisms" not in step


@pytest.mark.long
def test_a_check_that_is_rejected_while_the_model_is_loaded_keeps_it_from_going_live(
    rig: ModelRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = compared_on_check(rig)
    load, rejections = rig.live.load, iter(["c"])

    def loading(row: ModelRow) -> object:
        for session in rejections:
            rejected(rig, session)
        return load(row)

    monkeypatch.setattr(rig.live, "load", loading)
    with pytest.raises(CommandError, match="models or sessions were changed in the meantime"):
        rig.registry.accept_command({"id": model})
    assert rig.models.live() is None


@pytest.mark.long
def test_a_model_that_was_trained_on_a_rejected_session_is_not_recommended(rig: ModelRig) -> None:
    model = compared_on_check(rig)
    rejected(rig, "a")
    why = "it was trained on session a, which calibration does not use any more (it was rejected by Ada: measured on w"
    assert refusal(rig, model).startswith(f"model {model} cannot go live: {why}")
    assert rig.registry.status()["candidate"]["is_outdated"]


@pytest.mark.long
def test_a_comparison_that_was_made_while_the_live_model_was_away_does_not_count_once_it_is_back(rig: ModelRig) -> None:
    live = rig.accepted()
    rig.jobs.measured("c", 4, CHECK, prisms=PRISMS)
    waiting = rig.candidate()  # the very same model, so it cannot be better
    path = rig.models.get(live).path
    away = path.rename(path.with_name("away"))
    rig.registry.compare_command({"id": waiting})
    assert rig.compare()["live_was_unreadable"]
    assert f"`rigcal model accept {waiting}`" in advice(rig), "nothing else can replace a model that is lost"
    away.rename(path)
    assert refusal(rig, waiting) == (
        f"model {waiting} was compared when the files of model {live} could not be read, but now they can; "
        f"`rigcal model compare {waiting}` compares it again"
    )
    rig.registry.compare_command({"id": waiting})
    assert not rig.compare()["live_was_unreadable"]
    assert "could not be read" not in refusal(rig, waiting)


@pytest.mark.long
def test_a_model_that_no_check_could_judge_waits_for_a_check(rig: ModelRig) -> None:
    rig.jobs.measured("c", 4, CHECK, prisms=PRISMS)
    model = rig.candidate(sessions=("c",))
    rig.registry.compare_command({"id": model})
    assert rig.compare()["sessions"] == []
    assert "hold a check session (`rigcal session start --kind check`)" in refusal(rig, model)


def test_without_a_check_session_nothing_is_compared_again(rig: ModelRig) -> None:
    _, waiting = stale(rig)
    rig.jobs.start()
    rig.jobs.look_on(5)
    assert comparisons(rig, waiting) == []
