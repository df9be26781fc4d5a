"""Comparisons of a candidate with the live model: what is compared, and which verdicts count."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from calibration.errors import ModelError
from calibration.observations import parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import parse_rig
from daemon.commands import REFUSED, CommandError
from daemon.jobs.process import perform
from daemon.jobs.runner import JobRunner
from daemon.models.live_model import Loaded, Missing
from daemon.models.model_files import write_model
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.store.queries.models import ModelRow
from tests.daemon.support.jobs import SOURCE, TRUTH, JobRig
from tests.daemon.support.models import PRISMS, ModelRig, measured, refusal, states
from tests.simulated.observations import simulate_observations


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[ModelRig]:
    rig = ModelRig(tmp_path)
    yield rig
    rig.close()


def test_a_candidate_that_is_not_better_than_the_live_model_is_refused(rig: ModelRig) -> None:
    live = rig.accepted()
    measured(rig, "c", 4, "check")
    again = rig.candidate(sessions=("a", "b"))
    rig.registry.compare_command({"id": again})
    compared = rig.compare()
    assert (compared["live"], compared["is_better"], compared["p"]) == (live, False, 1.0), "it is the same model"
    assert "no gain beyond chance" in refusal(rig.registry.accept_command, REFUSED, id=again)
    assert states(rig) == {live: "live", again: "candidate"}
    status = rig.registry.status()
    assert status["live"]["id"] == live
    assert (status["candidate"]["id"], status["candidate"]["comparison"]["is_better"]) == (again, False)


@pytest.mark.long
def test_one_that_is_better_takes_the_live_models_place(rig: ModelRig) -> None:
    first = rig.accepted(poses=30)
    second = rig.accepted(poses=40)
    assert states(rig) == {first: "retired", second: "live"}
    history = rig.registry.show_command({"id": first})["history"]
    assert [h["state"] for h in history] == ["candidate", "live", "retired"]
    loaded = rig.settled()
    assert isinstance(loaded, Loaded)
    assert loaded.id == second
    assert rig.models.get(first).path.is_dir(), "a retired model stays on disk"


def test_sessions_that_either_model_was_trained_on_are_no_held_out_data(rig: ModelRig) -> None:
    for name in ("c1", "c2", "c3"):
        rig.jobs.session(name, kind="check")
    live = rig.candidate(sessions=("c1",))
    rig.compared(live, live=None)
    rig.registry.accept_command({"id": live})
    model = rig.candidate(sessions=("a", "c2"))
    rig.registry.compare_command({"id": model})
    (job,) = (job for job in rig.job_table.state().jobs if job.kind == "comparison")
    order = rig.job_table.order(job, rig.config)
    assert order.session_ids == ("c3",)
    assert (order.live_id, order.live_model) == (live, str(rig.models.get(live).path))


def test_a_live_model_that_is_damaged_does_not_keep_a_good_one_from_its_place(rig: ModelRig) -> None:
    live = rig.accepted()
    measured(rig, "c", 4, "check")
    (rig.models.get(live).path / "model.json").write_text("{}", encoding="utf-8")
    model = rig.candidate(poses=40)
    rig.registry.compare_command({"id": model})
    compared = rig.compare()
    assert (compared["live"], compared["against"], compared["is_better"]) == (live, "nominal", True)
    assert compared["sentence"].startswith("the live model cannot be read (")
    assert rig.registry.accept_command({"id": model})["retired"] == live


def test_a_live_model_of_another_rig_file_says_nothing_of_the_readings_of_this_one(
    rig: ModelRig, tmp_path: Path
) -> None:
    """Its channel L2 had another zero: what it would err on these readings is the zero's doing."""
    channel = 'name = "L2"\ndevice = "cia406_linear"\n'
    other = parse_rig(SOURCE.text.replace(channel, f"{channel}zero_counts = 9\n"), "other")
    data = simulate_observations(TRUTH, 30, 20, setup="S1", prisms=PRISMS)
    rows = parse_observations(data.csv_text().encode(), other, "simulated.csv")
    write_model(tmp_path / "other", identify(other, other.text, rows))
    live = rig.compared(rig.candidate(trained=tmp_path / "other"), live=None)
    assert rig.models.go_live(rig.models.get(live), None, "accepted before the rig file was changed")
    measured(rig, "c", 4, "check")
    rig.registry.compare_command({"id": rig.candidate(poses=40)})
    compared = rig.compare()
    assert (compared["live"], compared["against"]) == (live, "nominal")
    assert compared["sentence"].startswith("the live model has a different rig file (its channel L2 has zero_counts")


def test_in_place_of_a_damaged_live_model_nothing_goes_live_on_one_standstill(rig: ModelRig) -> None:
    live = rig.accepted()
    measured(rig, "c", 1, "check")
    (rig.models.get(live).path / "model.json").write_text("{}", encoding="utf-8")
    model = rig.candidate(poses=40)
    rig.registry.compare_command({"id": model})
    compared = rig.compare()
    assert (compared["against"], compared["standstills"], compared["is_better"]) == ("nominal", 1, False)
    assert "more check fixes" in refusal(rig.registry.accept_command, REFUSED, id=model)
    assert states(rig) == {live: "live", model: "candidate"}


def test_without_held_out_data_nothing_goes_live(rig: ModelRig) -> None:
    model = rig.candidate()
    assert "hold a check session" in refusal(rig.registry.accept_command, REFUSED, id=model)
    assert "no closed check session can be used" in refusal(rig.registry.compare_command, REFUSED, id=model)
    rig.jobs.session("c", kind="check")
    trained_on_it = rig.candidate(sessions=("c",))
    rig.registry.compare_command({"id": trained_on_it})
    assert rig.compare()["is_better"] is False
    assert "neither model was trained on" in refusal(rig.registry.accept_command, REFUSED, id=trained_on_it)
    assert rig.settled() == Missing("no model is live; `rigcal model list` shows the candidates")


def test_a_comparison_says_which_models_it_compared_and_takes_no_others(rig: ModelRig) -> None:
    live = rig.accepted(30)
    measured(rig, "c", 4, "check")
    model = rig.candidate(40)
    rig.registry.compare_command({"id": model})
    (job,) = (job for job in rig.job_table.state().jobs if job.kind == "comparison")
    order = rig.job_table.order(job, rig.config)
    rows = rig.models.get(model), rig.models.get(live)
    assert (order.model_sha256, order.live_sha256) == tuple(row.manifest_sha256 for row in rows)
    for row, other in (rows, rows[::-1]):  # each other's files, whole in themselves
        shutil.copytree(other.path, row.path.with_name(f"of-{row.id}"))
    for row in rows:
        shutil.rmtree(row.path)
        row.path.with_name(f"of-{row.id}").rename(row.path)
    with pytest.raises(ModelError, match="does not hold the model that was written there"):
        perform(order, lambda share, text: None)
    shutil.rmtree(rows[0].path)
    shutil.copytree(rows[1].path, rows[0].path)
    compared = perform(order, lambda share, text: None)["comparison"]
    assert compared["manifest_sha256"] == rows[0].manifest_sha256
    assert (compared["live"], compared["live_manifest_sha256"]) == (live, rows[1].manifest_sha256)
    assert "the live model cannot be read" in compared["sentence"]


def test_a_verdict_that_changes_while_the_model_is_loaded_does_not_count(
    rig: ModelRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = rig.compared(rig.candidate(), live=None)

    def load(row: ModelRow) -> None:
        rig.compared(model, live=None, is_better=False)

    monkeypatch.setattr(rig.live, "load", load)
    told = refusal(rig.registry.accept_command, REFUSED, id=model)
    assert "models or sessions were changed in the meantime by another command" in told
    assert states(rig) == {model: "candidate"}


def test_a_session_that_is_rejected_while_the_model_is_loaded_keeps_it_from_going_live(
    rig: ModelRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = rig.compared(rig.candidate(), live=None)

    def load(row: ModelRow) -> None:
        SessionLifecycle(rig.store, SOURCE.rig, rig.clock, 10.0).reject("a", "Ada", "measured on w")

    monkeypatch.setattr(rig.live, "load", load)
    told = refusal(rig.registry.accept_command, REFUSED, id=model)
    assert "models or sessions were changed in the meantime" in told
    assert states(rig) == {model: "candidate"}


def test_a_comparison_that_no_job_would_make_is_not_promised(tmp_path: Path) -> None:
    jobs = JobRig(tmp_path, enabled=False)
    try:
        jobs.session("c", kind="check")
        runner = JobRunner(jobs.store, jobs.config, "swdt82", jobs.clock)
        row = ModelRow(1, "swdt82", "candidate", "hybrid", tmp_path, "ab", ("a",), 0, {})
        with pytest.raises(CommandError, match=r"jobs are disabled; set \[jobs\] enabled = true") as caught:
            runner.compare(row)
        assert caught.value.status == REFUSED
        assert jobs.jobs() == []
    finally:
        jobs.close()


def test_a_comparison_with_a_model_that_is_live_no_more_does_not_count(rig: ModelRig) -> None:
    early = rig.compared(rig.candidate(), live=None)
    live = rig.accepted(poses=40)
    told = refusal(rig.registry.accept_command, REFUSED, id=early)
    assert f"no model was live, but model {live} is live now; `rigcal model compare {early}`" in told
