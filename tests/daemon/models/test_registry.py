"""Which model is live: what an operator may do, what is refused, and what is kept of it."""

import contextlib
import dataclasses
import json
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest
from sqlite_utils import Database

from calibration.errors import ModelError
from calibration.rig.description import parse_rig
from daemon.commands import REFUSED, WRONG_USE
from daemon.jobs.order import Outcome
from daemon.jobs.scheduler import CHAIN, DueChain
from daemon.models.live_model import NO_MODEL, LiveModel, Loaded, Missing
from daemon.models.model_files import model_sha256
from daemon.store.migrations import MIGRATIONS
from daemon.store.queries.models import ModelRow, ModelTable
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind
from tests.daemon.support.jobs import SOURCE, JobRig
from tests.daemon.support.models import ModelRig, measured, refusal, states, wait, written


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[ModelRig]:
    rig = ModelRig(tmp_path)
    yield rig
    rig.close()


# ---- from candidate to live ------------------------------------------------------------------------------------------


def test_a_candidate_is_compared_on_check_sessions_then_accepted_and_loaded(rig: ModelRig) -> None:
    measured(rig, "a", 5)
    measured(rig, "c", 4, "check")
    model = rig.candidate()
    assert rig.registry.compare_command({"id": model}) == (
        f"job 2 will compare model {model} with its nominal stage, as no model is live"
    )
    assert "wait for job 2, which will compare it" in refusal(rig.registry.accept_command, REFUSED, id=model)
    compared = rig.compare()
    assert compared["against"] == "nominal"
    assert (compared["sessions"], compared["fixes"], compared["standstills"]) == (["c"], 8, 4)
    assert compared["after_mm"] < compared["before_mm"] / 2
    assert rig.models.get(model).comparison == json.loads(json.dumps(compared))
    done = rig.registry.accept_command({"id": model, "operator": "Ada"})
    assert (done["live"], done["retired"]) == (model, None)
    assert states(rig) == {model: "live"}
    loaded = rig.settled()
    assert isinstance(loaded, Loaded)
    assert loaded.id == model
    shown = rig.registry.show_command({})
    assert [(h["state"], h["operator"]) for h in shown["history"]] == [("candidate", ""), ("live", "Ada")]
    assert shown["history"][-1]["reason"].startswith("accepted: on 8 held-out fixes of 4 standstills its error is")


def test_the_model_of_an_early_stage_names_the_job_that_compares_the_last_one(rig: ModelRig) -> None:
    rig.jobs.session("a")
    rig.jobs.session("c", kind="check")
    queue = rig.job_table
    queue.queue(DueChain(CHAIN, "a", "c"))
    gap, residual, _, comparison = (job.id for job in queue.state().jobs)
    directory = Path(shutil.copytree(written(30), rig.config.models_directory / "00001-geometric"))
    result = {"model": str(directory), "manifest_sha256": model_sha256(directory), "stage": "geometric"}
    queue.end(gap, Outcome("done", result=result | {"sessions": ["a"], "metrics": {}}))
    (model,) = rig.models.all()
    assert refusal(rig.registry.accept_command, REFUSED, id=model.id) == (
        f"model {model.id} was not compared on held-out data yet; wait for job {comparison}, which will compare the "
        f"model that job {residual} makes of the same sessions"
    )


# ---- back ------------------------------------------------------------------------------------------------------------


def test_nothing_is_named_where_no_other_model_was_ever_live(rig: ModelRig) -> None:
    live = rig.accepted(30)
    rig.candidate()
    told = refusal(rig.registry.rollback_command, WRONG_USE)
    assert told == f"model {live} replaced no other one when it went live; accept a better model"


def test_rollback_puts_back_what_the_live_model_replaced_step_by_step(rig: ModelRig) -> None:
    one, two, three = rig.accepted(30), rig.accepted(40), rig.accepted(30)
    assert rig.registry.rollback_command({"operator": "Bo"})["live"] == two
    assert rig.registry.rollback_command({})["live"] == one
    assert states(rig) == {one: "live", two: "retired", three: "retired"}
    told = refusal(rig.registry.rollback_command, WRONG_USE)
    assert f"replaced no other one when it went live; name one, as `rigcal model rollback {three}`" in told
    assert rig.registry.rollback_command({"id": three})["retired"] == one
    assert rig.registry.rollback_command({})["live"] == two, "what the third had replaced when it was accepted"
    loaded = rig.settled()
    assert isinstance(loaded, Loaded)
    assert loaded.id == two
    assert len(rig.store.rows("SELECT id FROM model_states")) == 3 + 2 * 7 - 1, "every change is kept"


def test_a_jump_counts_for_models_from_before_it_alone(rig: ModelRig) -> None:
    before = rig.models.get(rig.candidate(sessions=("a",)))
    rig.clock.advance(10.0)
    rig.store.insert_records([DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])
    rig.clock.advance(10.0)
    after = rig.models.get(rig.candidate(sessions=("b",)))
    assert rig.models.jumped(before) == {"theta1": 1}
    assert rig.models.jumped(after) == {}


@pytest.mark.parametrize("years", [-5, 5])
def test_a_wall_clock_that_is_wrong_for_a_whole_boot_hides_no_jump_and_makes_none(rig: ModelRig, years: int) -> None:
    def boot(name: str, years: int) -> None:
        utc_ns = rig.clock.now().utc_ns + years * 365 * 86_400 * NS_PER_S
        rig.clock.set(Stamp(utc_ns, NS_PER_S, name))

    def jump() -> None:
        rig.clock.advance(10.0)
        rig.store.insert_records([DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])

    jump()
    boot("boot-b", years)
    model = rig.models.get(rig.accepted())
    assert rig.models.jumped(model) == {}, "it was trained after the jump"
    boot("boot-c", -years)
    jump()
    assert rig.models.jumped(model) == {"theta1": 2}
    boot("boot-d", years)
    assert "theta1" in rig.registry.zeros_checked_command({"operator": "Ada"})
    assert rig.models.jumped(model) == {}
    boot("boot-e", -years)
    jump()
    assert rig.models.jumped(model) == {"theta1": 3}


def test_a_jump_that_comes_after_the_operator_looked_counts(rig: ModelRig) -> None:
    model = rig.models.get(rig.accepted())
    event = DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")
    rig.clock.advance(10.0)
    rig.store.insert_records([event])
    shown = rig.models.jumped(model)
    rig.store.insert_records([dataclasses.replace(event, device="theta3")])
    rig.models.note_zeros_checked(model, max(shown.values()), operator="Ada")
    assert list(rig.models.jumped(model)) == ["theta3"]


def test_where_no_model_is_live_a_word_about_the_zeros_is_about_the_one_that_waits(rig: ModelRig) -> None:
    assert "there is no model yet" in refusal(rig.registry.zeros_checked_command, WRONG_USE)
    model = rig.models.get(rig.candidate())
    rig.clock.advance(10.0)
    rig.store.insert_records([DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])
    assert rig.registry.zeros_checked_command({}) == f"model {model.id}: earlier jumps are now ignored: theta1"
    assert rig.models.jumped(model) == {}
    assert not rig.models.was_live(model)
    assert states(rig) == {model.id: "candidate"}


def test_a_word_about_the_zeros_is_kept_with_what_follows_from_it_or_not_at_all(
    rig: ModelRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full() -> NoReturn:
        raise sqlite3.OperationalError("database or disk is full")

    model = rig.models.get(rig.accepted())
    rig.clock.advance(10.0)
    rig.store.insert_records([DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])
    monkeypatch.setattr(rig.registry, "_zeros_checked", full)  # a disk that is full at its second write
    with pytest.raises(sqlite3.OperationalError):
        rig.registry.zeros_checked_command({})
    assert list(rig.models.jumped(model)) == ["theta1"]


def test_what_makes_no_sense_is_refused_in_a_sentence(rig: ModelRig) -> None:
    assert "no model is live" in refusal(rig.registry.rollback_command, WRONG_USE)
    assert "no model is live" in refusal(rig.registry.show_command, WRONG_USE)
    for command in (rig.registry.accept_command, rig.registry.rollback_command, rig.registry.compare_command):
        assert "there is no model 9" in refusal(command, WRONG_USE, id=9)
    assert "there is no model None" in refusal(rig.registry.accept_command, WRONG_USE)
    one, two = rig.accepted(30), rig.accepted(40)
    waiting = rig.candidate()
    assert "is live; only a candidate" in refusal(rig.registry.accept_command, WRONG_USE, id=two)
    assert f"`rigcal model rollback {one}`" in refusal(rig.registry.accept_command, WRONG_USE, id=one)
    assert "was never live" in refusal(rig.registry.rollback_command, WRONG_USE, id=waiting)
    assert "operator must be a text" in refusal(rig.registry.rollback_command, WRONG_USE, operator=["x"])
    assert states(rig) == {one: "retired", two: "live", waiting: "candidate"}


# ---- what must not go live -------------------------------------------------------------------------------------------


def test_a_damaged_or_exchanged_model_does_not_go_live(rig: ModelRig) -> None:
    live = rig.accepted(30)
    damaged = rig.compared(rig.candidate(40), live=live)
    file = rig.models.get(damaged).path / "model.json"
    file.write_bytes(file.read_bytes()[:-10])
    assert "model.json is truncated" in refusal(rig.registry.accept_command, REFUSED, id=damaged)
    exchanged = rig.compared(rig.candidate(40), live=live)
    for name in ("manifest.json", "model.json", "covariance.npz"):  # another model, whole in itself
        (rig.models.get(exchanged).path / name).write_bytes((rig.models.get(live).path / name).read_bytes())
    assert "does not hold the model that was written" in refusal(rig.registry.accept_command, REFUSED, id=exchanged)
    gone = rig.compared(rig.candidate(40), live=live)
    rig.models.get(gone).path.rename(rig.config.models_directory / "elsewhere")
    assert "is not a directory" in refusal(rig.registry.accept_command, REFUSED, id=gone)
    assert states(rig)[live] == "live"


def test_a_model_of_another_rig_does_not_go_live(rig: ModelRig) -> None:
    model = rig.compared(rig.candidate(), live=None)
    rig.store.update("models", {"id": model}, {"rig": "ur10"})
    for command in (rig.registry.accept_command, rig.registry.rollback_command, rig.registry.compare_command):
        assert "is of rig 'ur10', but this is rig 'swdt82'" in refusal(command, REFUSED, id=model)


def test_a_model_stays_live_where_the_rig_file_has_another_comment_or_signal(tmp_path: Path) -> None:
    before = ModelRig(tmp_path)
    before.accepted()
    before.close()
    after = ModelRig(tmp_path, parse_rig(f"# mine\n{SOURCE.rig.with_signals('tilt_x_deg').text}", "boom.toml"))
    try:
        assert isinstance(after.settled(), Loaded)
    finally:
        after.close()


def test_a_model_of_another_rig_file_does_not_go_live_and_a_live_one_is_not_used(tmp_path: Path) -> None:
    before = ModelRig(tmp_path)
    model = before.accepted()
    before.close()
    row = SOURCE.rig.rows[4].model_copy(update={"a_mm": 5001.0})
    changed = SOURCE.rig.model_copy(update={"rows": (*SOURCE.rig.rows[:4], row, *SOURCE.rig.rows[5:])})
    after = ModelRig(tmp_path, changed)
    try:
        state = after.settled()
        assert isinstance(state, Missing)
        assert state.is_defect
        assert "was made for a rig file" in state.reason
        other = after.compared(after.candidate(), live=model)
        assert "that describes a different machine" in refusal(after.registry.accept_command, REFUSED, id=other)
    finally:
        after.close()


def test_models_of_a_store_from_before_have_a_history_too(tmp_path: Path) -> None:
    path = tmp_path / "rigcal.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as connection:
        db = Database(connection)
        MIGRATIONS.apply(db, stop_before="m006_models_go_live")
        with db.atomic():
            db.execute("INSERT INTO boots VALUES (1, 'boot-a', 0)")
            db.execute(
                "INSERT INTO models (rig, path, manifest_sha256, stage, state, created_utc_ns, created_monotonic_ns, "
                "created_boot_id) VALUES ('swdt82', '/models/1', 'ab', 'hybrid', 'candidate', 7, 7, 1)"
            )
    rig = ModelRig(tmp_path)
    try:
        (change,) = rig.registry.show_command({"id": 1})["history"]
        assert (change["state"], change["utc_ns"], change["reason"]) == ("candidate", 7, "made")
    finally:
        rig.close()


def test_the_live_model_is_live_again_after_a_restart(tmp_path: Path) -> None:
    before = ModelRig(tmp_path)
    model = before.accepted()
    before.close()
    after = ModelRig(tmp_path)
    try:
        loaded = after.settled()
        assert isinstance(loaded, Loaded)
        assert loaded.id == model
    finally:
        after.close()


class SlowTable(ModelTable):
    """Waits for a nod before it says what is live, from the second time on."""

    def __init__(self, jobs: JobRig) -> None:
        super().__init__(jobs.store, "swdt82", jobs.clock)
        self.looked = 0
        self.nod = threading.Event()

    def live(self) -> ModelRow | None:
        self.looked += 1
        if self.looked > 1:
            self.nod.wait(10.0)
        return super().live()


class InTheMidst(threading.Event):
    """When asked whether it is set, lets another thread call something before the answer can be acted on."""

    def __init__(self) -> None:
        super().__init__()
        self.call = lambda: None
        self.asked = threading.Event()

    def is_set(self) -> bool:
        answer = super().is_set()
        other = threading.Thread(target=self.call)
        other.start()
        other.join(timeout=0.2)  # for ever, where what it calls waits its turn
        self.asked.set()
        return answer


def test_a_change_in_the_midst_of_loading_is_not_overwritten_by_what_was_looked_up_before(tmp_path: Path) -> None:
    jobs = JobRig(tmp_path)
    table = SlowTable(jobs)
    live = LiveModel(table, SOURCE.rig)
    event = live._changed = InTheMidst()
    event.call = live.changed
    event.set()
    live.start()
    try:
        assert event.asked.wait(10.0)
        wait(lambda: table.looked == 2)
        assert live.now() == Missing("the live model is being loaded"), "what was looked up is out of date"
        event.call = lambda: None
        table.nod.set()
        wait(lambda: live.now() == Missing("no model is live; `rigcal model list` shows the candidates"))
    finally:
        table.nod.set()
        live.stop()
        jobs.close()


def test_a_load_that_a_stop_cuts_short_is_no_defect_of_the_model(
    rig: ModelRig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig.accepted()
    live = LiveModel(rig.models, SOURCE.rig)
    loads, stopped = threading.Event(), threading.Event()

    def cut_short(_row: ModelRow) -> NoReturn:
        loads.set()
        assert stopped.wait(60.0)
        raise ModelError("the process that loads it was ended")

    monkeypatch.setattr(live, "load", cut_short)
    monkeypatch.setattr("daemon.models.live_model.STOP_TIMEOUT_S", 0.0)
    live.start()
    assert loads.wait(60.0)
    caplog.clear()
    live.stop()
    stopped.set()
    live._thread.join()
    assert not caplog.records
    assert live.now() == Missing("the live model is being loaded")


def test_a_rejected_candidate_never_goes_live(rig: ModelRig) -> None:
    live = rig.accepted()
    model = rig.compared(rig.candidate(), live=live)
    assert "give a reason" in refusal(rig.registry.reject_command, WRONG_USE, id=model)
    assert rig.registry.reject_command({"id": model, "reason": "measured in a storm", "operator": "Ada"})
    change = rig.registry.show_command({"id": model})["history"][-1]
    assert (change["state"], change["reason"], change["operator"]) == (
        "retired",
        "rejected: measured in a storm",
        "Ada",
    )
    assert rig.registry.status()["candidate"] is None
    assert "only a candidate" in refusal(rig.registry.accept_command, WRONG_USE, id=model)
    assert "was rejected" in refusal(rig.registry.rollback_command, WRONG_USE, id=model)
    assert "only a candidate" in refusal(rig.registry.reject_command, WRONG_USE, id=model, reason="again")


def test_a_live_model_that_is_rejected_is_out_of_use_at_once_and_can_be_put_back(rig: ModelRig) -> None:
    live = rig.accepted()
    assert isinstance(rig.settled(), Loaded)
    told = rig.registry.reject_command({"id": live, "reason": "trained on w", "operator": "Ada"})
    assert "no model is live now" in told
    assert isinstance(rig.live.now(), Missing)
    assert rig.settled() == Missing(NO_MODEL)
    assert rig.registry.status()["live"] is None
    told = refusal(rig.registry.rollback_command, WRONG_USE)
    assert told.endswith(f"name one: model {live} was live, but is rejected: trained on w")
    back = rig.registry.rollback_command({"id": live, "operator": "Ada"})
    assert (back["live"], back["reason"]) == (live, "note that it had been rejected: trained on w")


def test_of_the_models_that_were_live_one_that_is_not_rejected_is_named_to_be_put_back(rig: ModelRig) -> None:
    one, two = rig.accepted(30), rig.accepted(40)
    told = rig.registry.reject_command({"id": two, "reason": "trained on w"})
    assert told.endswith(f"`rigcal model rollback {one}` puts model {one} back")
    assert f"as `rigcal model rollback {one}`" in refusal(rig.registry.rollback_command, WRONG_USE)
    assert rig.registry.status()["to_put_back"] == one
    assert rig.registry.rollback_command({"id": one})["live"] == one
    assert rig.registry.status()["to_put_back"] is None
