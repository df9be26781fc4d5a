"""The gap workflow in the daemon: after every session, and once the checks have drifted from the live model."""

import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from calibration.numerics.statistics import CLIP
from daemon.cli.lines.state import gap_lines
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Order, Outcome
from daemon.jobs.process import perform
from daemon.jobs.scheduler import CHAIN, DueChain
from daemon.models.drift import drift_status, gap_status, note_drift
from daemon.models.model_files import read_model
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.models import ModelTable
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.daemon.support.jobs import SOURCE, JobRig
from tests.daemon.support.models import written
from tests.simulated.observations import simulate_observations

LOOSE = "backlash@theta4:width_rad=3e-3"


def with_live_model(rig: JobRig) -> ModelTable:
    """A chain has run for session a, and the operator has accepted its model."""
    rig.session("a")
    rig.start()
    rig.wait_for(*["done"] * 4)
    models = ModelTable(rig.store, "swdt82", rig.clock)
    models.go_live(models.all()[-1], None, "accepted", operator="Ada")
    return models


def model_table(rig: JobRig) -> ModelTable:
    return ModelTable(rig.store, "swdt82", rig.clock)


def check(rig: JobRig, name: str, *, jobs: int) -> None:
    """A check session is held, and so many jobs have run since the start."""
    rig.session(name, kind="check")
    rig.clock.advance(3.0)
    rig.wait(lambda: rig.states() == ["done"] * jobs, f"{jobs} jobs")


def lifecycle(rig: JobRig) -> SessionLifecycle:
    return SessionLifecycle(rig.store, SOURCE.rig, rig.clock, 10.0)


def rejected(rig: JobRig, name: str) -> None:
    lifecycle(rig).reject(name, "Ada", "measured on w")


def kinds(rig: JobRig) -> list[str]:
    return [job["kind"] for job in rig.jobs()]


def drift(rig: JobRig) -> dict[str, Any]:
    status = drift_status(model_table(rig))
    assert status is not None
    return status


# ---- when ------------------------------------------------------------------------------------------------------------


def test_after_a_session_the_workflow_makes_the_candidate_with_the_checks_held_out(rig: JobRig) -> None:
    rig.session("a")
    rig.session("c", kind="check")
    rig.session("b")
    rig.start()
    rig.wait_for(*["done"] * 4)
    order = rig.orders()[0]
    assert (order["kind"], order["session_ids"], order["held_out_ids"]) == ("gap", ["a", "b"], ["c"])
    first = rig.store.rows("SELECT job_id, state FROM models ORDER BY id")[0]
    assert first == {"job_id": 1, "state": "candidate"}


def test_checks_are_held_against_the_live_model_alone_and_once(rig: JobRig) -> None:
    rig.session("before", kind="check")
    with_live_model(rig)
    check(rig, "c1", jobs=7)
    check(rig, "c2", jobs=10)
    told = [o["session_ids"] for o in rig.orders() if o["kind"] == "drift"]
    assert told == [["c1"], ["c2"]]
    status = drift(rig)
    assert (status["checks"], status["newest"], status["alarm"]) == (2, "c2", "none")


def test_drifted_checks_trigger_a_proposal_made_from_all_sessions_and_that_once(rig: JobRig) -> None:
    models = with_live_model(rig)
    rig.plan(drift=f"scores {CLIP} {CLIP}")
    check(rig, "c1", jobs=7)
    assert drift(rig)["alarm"] == "none", "two standstills are not enough"
    check(rig, "c2", jobs=14)
    assert (drift(rig)["alarm"], drift(rig)["drifted_with"]) == ("worse", "c2")
    assert sorted(kinds(rig)[10:]) == ["comparison", "gap", "report", "residual"]
    orders = {o["kind"]: o for o in rig.orders()[10:]}
    assert (orders["gap"]["session_ids"], orders["gap"]["held_out_ids"]) == (["a", "c1", "c2"], [])
    assert orders["residual"]["train_ids"] == ["a", "c1", "c2"]
    assert orders["report"]["session_ids"] == orders["comparison"]["session_ids"] == [], "nothing is held out any more"
    proposal = models.all()[-1]
    assert (proposal.state, proposal.sessions) == ("candidate", ("a", "c1", "c2"))
    live = models.live()
    assert live is not None
    assert live.id == 2, "it waits for the operator"
    check(rig, "c3", jobs=17)
    assert sorted(kinds(rig)[14:]) == ["comparison", "drift", "report"], "one proposal, and now a check to judge it"
    compared = next(o for o in rig.orders()[14:] if o["kind"] == "comparison")
    assert (compared["session_ids"], compared["model"]) == (["c3"], str(proposal.path))


def test_a_rejected_check_shows_no_drift(rig: JobRig) -> None:
    with_live_model(rig)
    rig.plan(drift=f"scores {CLIP} {CLIP}")
    check(rig, "c1", jobs=7)
    before = drift(rig)
    check(rig, "c2", jobs=14)
    assert drift(rig)["drifted_with"] == "c2"
    rejected(rig, "c2")
    assert drift(rig) == before


def test_the_sums_are_made_anew_without_a_check_that_is_rejected_and_with_it_once_it_is_accepted(rig: JobRig) -> None:
    with_live_model(rig)
    rig.plan(drift=f"scores {CLIP} {CLIP}")
    check(rig, "c1", jobs=7)
    rig.plan(drift="scores 1.5 1.5")
    check(rig, "c2", jobs=10)
    both = drift(rig)
    rejected(rig, "c1")
    assert drift(rig)["checks"] == 0
    rig.clock.advance(3600.0)
    rig.wait(lambda: drift(rig)["checks"] == 1, "the drift job")
    alone = drift(rig)
    assert (alone["newest"], alone["upper"] < both["upper"], alone["alarm"]) == ("c2", True, "none")
    lifecycle(rig).accept("c1", "Ada")
    rig.clock.advance(3600.0)
    rig.wait(lambda: drift(rig)["checks"] == 2, "the drift job")
    assert [row["session_id"] for row in rig.store.rows("SELECT session_id FROM drift_checks ORDER BY id")] == [
        "c1",
        "c2",
    ]


@pytest.mark.parametrize("others", [0, 1])
def test_without_a_later_check_nothing_is_left_of_a_rejected_one_and_no_job_is_repeated_for_ever(
    rig: JobRig, others: int
) -> None:
    with_live_model(rig)
    names = [f"c{n}" for n in range(others + 1)]
    for n, name in enumerate(names):
        check(rig, name, jobs=7 + 3 * n)
    rejected(rig, names[-1])
    rig.clock.advance(3600.0)
    jobs = 11 + 4 * others  # the whole chain again, and a check of drift if a check is left
    rig.wait(lambda: rig.states() == ["done"] * jobs, f"{jobs} jobs")
    rig.look_on()
    assert (rig.states(), drift(rig)["checks"]) == (["done"] * jobs, others)


def test_what_a_check_of_drift_found_before_a_check_session_was_rejected_does_not_count(rig: JobRig) -> None:
    with_live_model(rig)
    rig.plan(drift="hang")
    rig.session("c1", kind="check")
    rig.clock.advance(3.0)
    rig.wait(lambda: rig.states() == [*["done"] * 6, "running"], "the check of drift")
    queue = JobQueue(rig.store, "swdt82", rig.clock)
    run = model_table(rig).live_run()
    assert run is not None
    rejected(rig, "c1")
    found = {"session": "c1", "scores": [CLIP] * 3, "fixes": 3, "ratio": 9.0, "reason": ""}
    queue.end(7, Outcome("done", result={"drift": {"live_since": run.since, "checks": [found]}}))
    assert (drift(rig)["checks"], drift(rig)["alarm"]) == (0, "none")


def test_a_chain_whose_session_is_rejected_while_its_first_job_runs_ends_and_says_why(
    rig: JobRig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.session("a")
    rig.session("b")
    queue = JobQueue(rig.store, "swdt82", rig.clock)
    queue.queue(DueChain(CHAIN, "b", "b"))
    gap = queue.state().jobs[0]
    assert queue.begin(gap, 60.0)
    rejected(rig, "b")
    made = {"model": "/x", "manifest_sha256": "0", "stage": "geometric", "sessions": ["a", "b"], "metrics": {}}
    queue.end(gap.id, Outcome("done", result=made))
    rig.start()
    rig.wait(lambda: rig.states() == ["done", *["cancelled"] * 3, *["done"] * 4], "the chain without b")
    why = "session b, on which its model was trained, is not used any more: it was rejected by Ada: measured on w"
    assert rig.job(2)["error"].startswith(why)
    assert f"job 2 (residual) is cancelled: {why}" in caplog.text
    assert rig.job(3)["error"] == "it needs job 2, which was cancelled"
    assert [o["train_ids"] for o in rig.orders() if o["kind"] == "residual"] == [["a"]]


def test_a_model_that_waits_is_the_one_that_a_check_session_judges_though_its_residual_was_cancelled(
    rig: JobRig,
) -> None:
    rig.session("a")
    rig.start()
    rig.wait_for(*["done"] * 4)
    rig.plan(residual="fail")
    rig.session("b")
    rig.clock.advance(3.0)
    rig.wait(lambda: rig.states()[4:] == ["done", "failed", "cancelled", "cancelled"], "the failed chain")
    waiting = model_table(rig).waiting()
    assert waiting is not None
    rig.session("c", kind="check")
    rig.clock.advance(3.0)
    rig.wait(lambda: rig.states()[8:] == ["done"] * 2, "report and comparison")
    assert {o["model"] for o in rig.orders()[-2:]} == {str(waiting.path)}
    assert model_table(rig).get(waiting.id).comparison is not None


def test_a_proposal_that_was_trained_on_a_check_is_made_again_without_it_once_it_is_rejected(
    rig: JobRig,
) -> None:
    with_live_model(rig)
    rig.plan(drift=f"scores {CLIP} {CLIP}")
    check(rig, "c1", jobs=7)
    check(rig, "c2", jobs=14)
    rejected(rig, "c2")

    def trained() -> list[list[str]]:
        return [order["session_ids"] for order in rig.orders() if order["kind"] == "gap"]

    rig.clock.advance(3600.0)
    rig.wait(lambda: len(trained()) > 2, "training without the check")
    assert trained()[1] == ["a", "c1", "c2"]
    assert "c2" not in trained()[2]


def test_the_sums_begin_anew_with_each_model_that_goes_live(rig: JobRig) -> None:
    models = with_live_model(rig)
    rig.plan(drift=f"scores {CLIP} {CLIP}")
    check(rig, "c1", jobs=7)
    assert drift(rig)["upper"] == 4.0
    old = models.live()
    models.go_live(models.get(1), old, "accepted", operator="Ada")
    assert (drift(rig)["upper"], drift(rig)["checks"], drift(rig)["newest"]) == (0.0, 0, None)
    check(rig, "c2", jobs=10)
    assert drift(rig)["upper"] == 4.0
    rig.look_on()
    assert len(kinds(rig)) == 10, "each model had two standstills"


def test_errors_that_are_too_small_are_told_and_trigger_nothing(rig: JobRig) -> None:
    with_live_model(rig)
    rig.plan(drift=f"scores {-CLIP} {-CLIP} {-CLIP}")
    check(rig, "c1", jobs=7)
    assert drift(rig)["alarm"] == "better"
    rig.look_on()
    assert "drift of model 2: none; errors are smaller than the model predicts" in "\n".join(lines(rig))
    assert len(kinds(rig)) == 7


def test_a_result_that_is_written_down_twice_counts_once(rig: JobRig) -> None:
    with_live_model(rig)
    check(rig, "c1", jobs=7)
    (row,) = rig.store.rows("SELECT * FROM drift_checks")
    again = {"session": "c1", "scores": [CLIP] * 9, "fixes": 9, "ratio": 9.0, "reason": ""}
    note_drift(model_table(rig), {"live_since": row["live_since"], "checks": [again]})
    assert rig.store.rows("SELECT * FROM drift_checks") == [row]


def test_a_model_of_an_older_store_counts_all_checks_that_it_was_not_trained_on(rig: JobRig) -> None:
    models = with_live_model(rig)
    rig.store.update("model_states", {"state": "live"}, {"after_session": None})
    run = models.live_run()
    assert run is not None
    assert run.after_session == 0
    check(rig, "c1", jobs=7)
    live = models.live()
    assert live is not None
    assert drift(rig)["model"] == live.id


# ---- with the real work ----------------------------------------------------------------------------------------------


def order(rig: JobRig, kind: str, sessions: tuple[str, ...], **more: Any) -> Order:
    directory = str(rig.config.models_directory)
    return Order(kind, 7, str(rig.config.store_path), directory, sessions, 0, **more)


def measured(rig: JobRig, name: str, poses: int, seed: int, kind: str = "static_poses", hidden: str = LOOSE) -> None:
    """A closed session of the simulated boom with a backlash."""
    rig.measured(name, 0, kind)
    truth = RigTruth(SOURCE.rig, 1, effects=parse_effects(hidden))
    rig.observed(name, simulate_observations(truth, poses, seed, setup="S1", prisms=["r", "s"]))


@pytest.mark.long
def test_the_job_names_what_is_missing_and_proposes_a_model_that_has_it(rig: JobRig) -> None:
    """Also where a check lies at a set-up with too few fixes to place a base, be one pose measured often."""
    measured(rig, "a", 40, 20)
    measured(rig, "c", 5, 21, "check")
    measured(rig, "lost", 1, 22, "check")
    again = simulate_observations(
        RigTruth(SOURCE.rig, 1, effects=parse_effects(LOOSE)), 1, 22, setup="S1", prisms=["r"]
    )
    for _ in range(5):
        rig.observed("lost", again)
    elsewhere = {"id": "S2", "instrument": "", "serial": "", "state": "ok"}
    rig.store.insert("station_setups", elsewhere | rig.store.instant(rig.clock.now(), "created_"))
    rig.store.update("observations", {"session_id": "lost"}, {"setup_id": "S2"})
    told: list[str] = []
    wanted = order(rig, "gap", ("a", "lost"), held_out_ids=("c", "lost"))
    result = perform(wanted, lambda share, text: told.append(text))
    assert told
    assert (result["sentence"], result["stage"]) == ("The simulation lacked backlash at theta4.", "effects")
    found = result["gap"]
    assert found["holdout"]["rms_after_mm"] < found["holdout"]["rms_before_mm"] / 2.0
    directory = rig.config.models_directory / "00007-gap"
    assert sorted(path.name for path in directory.iterdir()) == ["gap.json", "model", "report.html"]
    model = read_model(Path(result["model"]), result["manifest_sha256"])
    assert [(e.family, e.where) for e in model.effects] == [("backlash", "theta4")]
    assert json.loads((directory / "gap.json").read_text("utf-8"))["seconds"] > 0.0
    assert result["metrics"]["effects"] == [effect.as_dict() for effect in model.effects]
    assert (list(model.placements), result["sessions"]) == (["S1"], ["a", "lost"])
    keep(rig, "gap", result)
    shown = lines(rig)
    assert shown[0] == "gap (named, after session a): The simulation lacked backlash at theta4."
    assert shown[-1].endswith("report.html")


def test_checks_are_scored_one_by_one_and_a_useless_one_says_why(rig: JobRig) -> None:
    model = written(30)
    measured(rig, "c1", 4, 31, "check", hidden="")
    measured(rig, "c2", 4, 32, "check")
    rig.session("empty", kind="check")
    live = {"live_model": str(model), "live_sha256": None, "live_id": 3, "live_since": 5}
    result = perform(order(rig, "drift", ("c1", "c2", "empty"), **live), lambda share, text: None)
    well, loose, empty = result["drift"]["checks"]
    assert (result["drift"]["live"], result["drift"]["live_since"]) == (3, 5)
    assert (len(well["scores"]), well["fixes"], well["reason"]) == (4, 8, "")
    assert well["ratio"] < 1.6 < loose["ratio"]
    assert max(well["scores"]) < sum(loose["scores"]) / 4.0
    assert (empty["scores"], empty["ratio"]) == ([], None)
    assert "no observations" in empty["reason"]


# ---- what status says ------------------------------------------------------------------------------------------------


def keep(rig: JobRig, kind: str, result: dict[str, Any]) -> None:
    """A job's result, as the daemon writes it down."""
    row = {"kind": kind, "session_id": "a", "through_session_id": "a", "state": "done", "result_json": result}
    rig.store.insert("jobs", row | rig.store.instant(rig.clock.now(), "created_"))


def lines(rig: JobRig) -> list[str]:
    return list(gap_lines(gap_status(JobTable(rig.store, "swdt82"), model_table(rig))))


def test_status_says_nothing_before_there_is_anything(rig: JobRig) -> None:
    assert lines(rig) == []


def test_status_says_verdict_next_measurements_and_drift(rig: JobRig) -> None:
    with_live_model(rig)
    experiments = [{"kind": "dwell", "text": f"Measure {n}."} for n in range(5)]
    keep(
        rig,
        "gap",
        {
            "gap": {"verdict": "indistinguishable", "effects": [], "experiments": experiments},
            "sentence": "The simulation lacks one of two.",
            "report": "/r/report.html",
        },
    )
    assert lines(rig) == [
        "gap (indistinguishable, after session a): The simulation lacks one of two.",
        "  next: Measure 0.",
        "  next: Measure 1.",
        "  next: Measure 2.",
        "  report: /r/report.html",
        "drift of model 2: no check session since it went live",
    ]
    rig.plan(drift=f"scores {CLIP} {CLIP} {CLIP}")
    check(rig, "c1", jobs=12)
    assert lines(rig)[-1] == (
        "drift of model 2: the machine has drifted from the model (since check session c1); 1 check session, in the "
        "last, c1, errors are 1.0 times the predicted ones (sums 6.0 and 0 of 5.0)"
    )


def test_status_says_why_nothing_came_of_the_newest_session_until_something_does(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="fail")
    rig.start()
    rig.wait(lambda: rig.states() == ["failed", *["cancelled"] * 3])
    assert lines(rig) == ["gap: the job of session a failed (job 1): the data are too poor"]
    rig.plan()
    rig.session("b")
    rig.clock.advance(3.0)
    rig.wait(lambda: rig.states()[4:] == ["done"] * 4)
    assert lines(rig)[0] == "gap (none, after session b): they agree"


def test_status_gives_no_verdict_that_rests_on_a_session_which_is_not_used_any_more(rig: JobRig) -> None:
    rig.session("a")
    rig.start()
    rig.wait_for(*["done"] * 4)
    assert lines(rig) == ["gap (none, after session a): they agree", "  report: r"]
    rejected(rig, "a")
    assert lines(rig) == []


def test_what_makes_no_sense_in_the_table_is_refused_by_the_store(rig: JobRig) -> None:
    with_live_model(rig)
    row = {"live_since": 1, "session_id": "a", "fixes": 1, "standstills": 1, "upper": 0.0, "lower": 0.0}
    with pytest.raises(sqlite3.IntegrityError):
        rig.store.insert("drift_checks", row | {"alarm": "perhaps"} | rig.store.instant(rig.clock.now()))
    assert JobQueue(rig.store, "swdt82", rig.clock).state().drifted is None
