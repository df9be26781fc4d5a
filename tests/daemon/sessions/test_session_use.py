"""Which sessions calibration uses: those whose control points held from start to end, and those that were accepted."""

import re
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from daemon.cli.main import main
from daemon.commands import NO_POSE, CommandError
from daemon.config.config import Config
from daemon.control.server import ControlServer
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Order, Outcome
from daemon.jobs.scheduler import CHAIN, CHECKS, DueChain, due_jobs, next_job
from daemon.report.words import not_used
from daemon.store.errors import NotInStoreError
from daemon.store.queries.sessions import SessionTable
from drivers.clock import NS_PER_S
from tests.daemon.support.sessions import SOURCE, Rig, controlled

CP1 = (9000.0, 500.0, 2000.0)
ELSEWHERE = (9000.0, 520.0, 2000.0)
CP2 = (9000.0, 4000.0, 2000.0)


def uncontrolled(rig: Rig, kind: str = "static_poses") -> str:
    name = str(rig.say("start", prism="r", kind=kind)["id"])
    rig.live(2)
    rig.say("stop")
    return name


class Jobs:
    """The scheduler of the rig's store, and jobs that get done at once."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.table = rig, JobQueue(rig.store, "swdt82", rig.clock)
        self.config = Config(rig="swdt82", state_directory=rig.store.path.parent)

    def due(self) -> list[DueChain]:
        found = due_jobs(self.table.state(), self.rig.clock.now().shifted(60 * NS_PER_S))
        return [item for item in found if isinstance(item, DueChain)]

    def run(self) -> list[Order]:
        """Do all that is due; what the jobs were asked to do."""
        for chain in self.due():
            self.table.queue(chain)
        orders = []
        while (job := next_job(self.table.state())) is not None:
            assert self.table.begin(job, 60.0)
            order = self.table.order(job, self.config)
            made = {"manifest_sha256": "", "stage": "geometric", "metrics": {}, "sessions": list(order.session_ids)}
            result = {"model": f"m{job.id}", **(made if job.kind in {"gap", "residual"} else {})}
            self.table.end(job.id, Outcome("done", result=result))
            orders.append(order)
        return orders


# ---- set-ups ---------------------------------------------------------------------------------------------------------


def test_a_station_that_moved_is_not_taken_for_where_it_stood_before(session_rig: Rig) -> None:
    session_rig.say("setup_new", id="S2")
    session_rig.say("start", prism="r")
    session_rig.shoot("cp1", CP1)
    session_rig.live(2)
    assert session_rig.shoot("cp1", ELSEWHERE)["moved"]
    session_rig.say("abort")
    with pytest.raises(CommandError) as caught:
        session_rig.say("start", prism="r")
    assert caught.value.status == 3
    assert str(caught.value) == (
        "the current set-up 'S2' has moved; describe a new one with `rigcal setup new`, or name another one "
        "with --setup if the station stands there again"
    )
    assert session_rig.setups.current() is None, "nor does the live tip"
    assert session_rig.say("start", prism="r", setup="S1")["setup"] == "S1"


def test_a_shot_that_finds_a_move_says_what_to_do(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.shoot("cp1", CP1)
    session_rig.live(2)
    assert session_rig.shoot("cp1", CP1)["advice"] == []
    stop, accept = session_rig.shoot("cp1", ELSEWHERE)["advice"]
    assert "stop the session, describe the station's new set-up with `rigcal setup new`" in stop
    assert "`rigcal session accept s001-r`" in accept


# ---- what is used ----------------------------------------------------------------------------------------------------


def test_a_session_whose_control_points_held_is_used(session_rig: Rig) -> None:
    name = controlled(session_rig)
    assert session_rig.say("show", id=name)["not_used"] is None
    assert Jobs(session_rig).due() == [DueChain(CHAIN, name, name)]


def test_a_session_without_control_shots_is_stored_and_shown_and_nothing_trains_on_it(session_rig: Rig) -> None:
    name = uncontrolled(session_rig)
    shown = session_rig.say("show", id=name)
    assert shown["observations"] > 10
    assert shown["not_used"].startswith("no control point was shot at both start and end")
    assert Jobs(session_rig).due() == []
    other = controlled(session_rig)
    orders = Jobs(session_rig).run()
    assert [order.session_ids for order in orders if order.kind == "gap"] == [(other,)]
    assert all(name not in (*order.session_ids, *order.train_ids) for order in orders)


def test_a_session_with_control_shots_but_no_pose_says_so(session_rig: Rig) -> None:
    """Both shots are of its start, so it would seem to lack those of its end."""
    session_rig.say("start", prism="r")
    session_rig.shoot("cp1", CP1)
    session_rig.shoot("cp1", CP1)
    stopped = session_rig.say("stop")
    assert stopped["not_used"] == "no pose of it can be used"
    assert not_used(stopped["id"], stopped["not_used"]).endswith("; hold another one")
    assert Jobs(session_rig).due() == []


@pytest.mark.parametrize(
    ("start", "end", "why"),
    [
        (CP1, None, "no control point was shot at both start and end"),
        (None, CP1, "no control point was shot at both start and end"),
        (CP1, ELSEWHERE, "control point cp1 was 20.0 mm off at the session's end, so the station had moved"),
    ],
)
def test_a_session_whose_ends_were_not_controlled_is_not_used(
    session_rig: Rig, start: tuple[float, float, float] | None, end: tuple[float, float, float] | None, why: str
) -> None:
    session_rig.say("start", prism="r")
    if start:
        session_rig.shoot("cp1", start)
    session_rig.live(2)
    if end:
        session_rig.shoot("cp1", end)
    assert session_rig.say("stop")["not_used"].startswith(why)
    assert Jobs(session_rig).due() == []


def test_two_shots_at_the_end_do_not_make_up_for_the_one_at_the_start(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    for rate in (5.0, -5.0, 5.0, -5.0, 5.0, -5.0):
        session_rig.live(1, theta1=rate)
        session_rig.live(2)
    assert session_rig.shoot("cp1", CP1)["phase"] == "start"
    session_rig.live(2)
    assert session_rig.shoot("cp1", CP1)["phase"] == "end"
    assert session_rig.say("stop")["not_used"].startswith(
        "most poses do not lie between a control point's shot at the session's start"
    )


def test_a_pose_before_the_first_shot_does_not_spoil_a_session(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.live(30)  # the operator walks to the station
    session_rig.shoot("cp1", CP1)
    for rate in (5.0, -5.0, 5.0):
        session_rig.live(1, theta1=rate)
        session_rig.live(2)
    session_rig.shoot("cp1", CP1)
    assert session_rig.say("stop")["not_used"] is None


def test_a_point_that_is_shot_later_does_not_vouch_for_the_poses_before_it(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.shoot("cp1", CP1)
    session_rig.live(2)
    session_rig.live(1, theta1=3.0)  # another pose, and meanwhile the station is carried elsewhere
    session_rig.live(2)
    session_rig.shoot("cp2", CP2)
    session_rig.live(1, theta1=3.0)
    session_rig.live(4)
    session_rig.shoot("cp2", CP2)
    name = session_rig.say("stop")["id"]
    assert session_rig.say("show", id=name)["not_used"].startswith(
        "the control point shot at the session's start was not"
    )


def test_no_set_up_is_described_while_a_session_goes_on_in_another(session_rig: Rig) -> None:
    name = session_rig.say("start", prism="r")["id"]
    with pytest.raises(CommandError, match=f"session '{name}' is open in the present set-up") as caught:
        session_rig.say("setup_new", id="S2")
    assert caught.value.status == 3
    session_rig.say("abort")
    session_rig.say("setup_new", id="S2")
    assert session_rig.say("start", prism="r")["setup"] == "S2"


def test_a_moving_session_is_controlled_like_any_other(session_rig: Rig) -> None:
    session_rig.say("start", prism="r", kind="multi_joint")
    session_rig.shoot("cp1", CP1)
    session_rig.live(4, theta1=5.0)
    session_rig.shoot("cp1", CP1)
    summary = session_rig.say("stop")
    assert summary["observations"] > 50
    assert summary["not_used"] is None


def test_an_aborted_session_is_never_used(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.say("abort")
    with pytest.raises(CommandError, match="session 's001-r' was aborted, and cannot be accepted"):
        session_rig.say("accept", id="s001-r")
    assert Jobs(session_rig).due() == []


# ---- what is accepted ------------------------------------------------------------------------------------------------


def test_an_accepted_session_is_trained_on_and_who_said_so_is_kept(session_rig: Rig) -> None:
    name = uncontrolled(session_rig)
    told = session_rig.say("accept", id=name, operator="Ada")
    assert told["not_used"] is None
    assert told["accepted"]["by"] == "Ada"
    assert told["accepted"]["despite"].startswith("no control point was shot")
    assert told["accepted"]["utc_ns"] == session_rig.clock.now().utc_ns
    assert [order.session_ids for order in Jobs(session_rig).run() if order.kind == "gap"] == [(name,)]


def test_a_session_without_a_usable_pose_is_not_accepted(session_rig: Rig) -> None:
    name = str(session_rig.say("start", prism="r")["id"])
    session_rig.shoot("cp1", CP1)
    assert session_rig.say("stop")["not_used"] == NO_POSE
    with pytest.raises(CommandError, match=f"session '{name}': {NO_POSE}; hold another session"):
        session_rig.say("accept", id=name)
    assert session_rig.say("show", id=name)["accepted"] is None


def test_a_session_that_is_accepted_after_a_later_one_was_trained_on_is_trained_on_with_it(session_rig: Rig) -> None:
    early, late = uncontrolled(session_rig), controlled(session_rig)
    jobs = Jobs(session_rig)
    jobs.run()
    assert jobs.due() == []
    session_rig.say("accept", id=early)
    assert jobs.due() == [DueChain(CHAIN, late, late)]
    assert [order.session_ids for order in jobs.run() if order.kind == "gap"] == [(early, late)]
    assert jobs.due() == []


def test_a_job_that_was_queued_before_works_on_what_was_used_then(session_rig: Rig) -> None:
    early, late = uncontrolled(session_rig), controlled(session_rig)
    jobs = Jobs(session_rig)
    jobs.table.queue(DueChain(CHAIN, late, late))
    session_rig.say("accept", id=early)
    orders = jobs.run()
    assert [order.session_ids for order in orders if order.kind == "gap"] == [(late,), (early, late)]


def test_a_check_session_without_control_shots_judges_nothing_until_it_is_accepted(session_rig: Rig) -> None:
    jobs = Jobs(session_rig)
    trained = controlled(session_rig)
    jobs.run()
    check = uncontrolled(session_rig, "check")
    assert jobs.due() == []
    model = jobs.table._models.all()[-1]
    with pytest.raises(CommandError, match="no closed check session can be used"):
        jobs.table.compare(model)
    session_rig.say("accept", id=check)
    assert jobs.due() == [DueChain(CHECKS, check, check)]
    for order in jobs.run():
        assert (order.session_ids, order.train_ids) == ((check,), (trained,))
    assert jobs.due() == []
    assert jobs.table.compare(model)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("nothing", "there is no session 'nothing'"),
        ("s001-r", "session 's001-r' is already used by calibration; there is nothing to accept"),
        ("s002-r", "session 's002-r' is open; stop it first"),
    ],
)
def test_what_cannot_be_accepted_is_refused_in_a_sentence(session_rig: Rig, name: str, why: str) -> None:
    controlled(session_rig)
    session_rig.say("start", prism="r")
    with pytest.raises((CommandError, NotInStoreError), match=why):
        session_rig.say("accept", id=name)


# ---- what is rejected ------------------------------------------------------------------------------------------------


def test_a_rejected_session_is_used_by_no_job_and_who_said_so_is_kept(session_rig: Rig) -> None:
    good, bad = controlled(session_rig), controlled(session_rig)
    told = session_rig.say("reject", id=bad, operator="Ada", reason="measured on w")
    assert told["not_used"] == "it was rejected by Ada: measured on w"
    now_ns = session_rig.clock.now().utc_ns
    assert told["rejected"] == {"reason": "measured on w", "by": "Ada", "user": None, "utc_ns": now_ns}
    assert [order.session_ids for order in Jobs(session_rig).run() if order.kind == "gap"] == [(good,)]
    table = SessionTable(session_rig.store, SOURCE.rig.name)
    assert table.untrained() == {}, "the operator knows"
    session_rig.keeper = session_rig.new_keeper()
    assert session_rig.say("show", id=bad)["not_used"] == told["not_used"], "also after a restart"


def test_a_rejected_session_shows_nothing_about_the_prism_of_the_next_one(session_rig: Rig) -> None:
    bad = controlled(session_rig, seconds=5.0)
    table = SessionTable(session_rig.store, SOURCE.rig.name)
    assert {row["session_id"] for row in table.standstill_observations("S1", None)} == {bad}
    session_rig.say("reject", id=bad)
    assert table.standstill_observations("S1", None) == []


def test_training_that_used_a_session_is_repeated_without_it_when_it_is_rejected(session_rig: Rig) -> None:
    good, bad = controlled(session_rig), controlled(session_rig)
    jobs = Jobs(session_rig)
    assert [order.session_ids for order in jobs.run() if order.kind == "gap"] == [(good, bad)]
    session_rig.say("reject", id=bad)
    assert jobs.due() == [DueChain(CHAIN, good, good)]
    assert [order.session_ids for order in jobs.run() if order.kind == "gap"] == [(good,)]
    assert jobs.due() == []
    session_rig.say("accept", id=bad)
    assert [order.session_ids for order in jobs.run() if order.kind == "gap"] == [(good, bad)]


def test_nothing_is_repeated_when_a_session_that_no_job_used_is_rejected(session_rig: Rig) -> None:
    controlled(session_rig)
    unused = uncontrolled(session_rig)
    jobs = Jobs(session_rig)
    jobs.run()
    session_rig.say("reject", id=unused)
    assert jobs.due() == []


def test_an_acceptance_is_taken_back_by_a_rejection_and_a_rejection_by_an_acceptance(session_rig: Rig) -> None:
    name = uncontrolled(session_rig)
    session_rig.say("accept", id=name, operator="Ada")
    rejected = session_rig.say("reject", id=name, operator="Ben")
    assert rejected["not_used"].startswith("it was rejected by Ben; no control point was shot")
    assert rejected["accepted"] is None
    accepted = session_rig.say("accept", id=name, operator="Ada")
    assert accepted["not_used"] is accepted["rejected"] is None
    assert accepted["accepted"]["despite"] == rejected["not_used"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("nothing", "there is no session 'nothing'"),
        ("s001-r", "session 's001-r' was aborted, and is never used"),
        ("s002-r", "session 's002-r' is already rejected"),
        ("s003-r", "session 's003-r' is open; abort it: `rigcal session abort`"),
    ],
)
def test_what_cannot_be_rejected_is_refused_in_a_sentence(session_rig: Rig, name: str, why: str) -> None:
    session_rig.say("start", prism="r")
    session_rig.say("abort")
    session_rig.say("reject", id=controlled(session_rig))
    session_rig.say("start", prism="r")
    with pytest.raises((CommandError, NotInStoreError), match=why):
        session_rig.say("reject", id=name)


def test_sessions_of_an_older_store_are_used_as_before(session_rig: Rig) -> None:
    """What was trained on before this rule was there needs no operator's word."""
    name = uncontrolled(session_rig)
    session_rig.store.update("calibration_sessions", {"id": name}, {"excluded": None})  # as the migration leaves it
    assert Jobs(session_rig).due() == [DueChain(CHAIN, name, name)]


# ---- what people are told --------------------------------------------------------------------------------------------


def test_people_are_told_that_a_session_is_not_used_and_what_to_type(session_rig: Rig, tmp_path: Path) -> None:
    handlers = {
        f"session.{name}": getattr(session_rig.keeper, f"{name}_command")
        for name in ("stop", "show", "list", "accept", "reject", "shoot")
    }
    server = ControlServer(tmp_path / "s", handlers)

    def rigcal(*arguments: str) -> str:
        result = CliRunner().invoke(main, [*arguments, "--socket", str(tmp_path / "s")], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return " ".join(result.output.split())

    try:
        assert "no sessions yet" in rigcal("session", "list")
        session_rig.say("start", prism="r")
        session_rig.live(2)
        assert "no control point has been shot yet: `rigcal session shoot NAME`" in rigcal("session", "show", "s001-r")
        for text in (rigcal("session", "stop"), rigcal("session", "show", "s001-r")):
            assert "calibration does not use this session: no control point was shot" in text
            assert "`rigcal session accept s001-r`" in text
        assert "not used" in rigcal("session", "list")
        told: Any = rigcal("session", "accept", "s001-r", "--operator", "Ada")
        assert re.search(r"accepted by Ada \(user \S+\), although no control point was shot", told)
        assert "does not use" not in told
        for text in (
            rigcal("session", "reject", "s001-r", "--operator", "Ben", "--reason", "fog"),
            rigcal("session", "show", "s001-r"),
            rigcal("session", "list"),
        ):
            assert re.search(r"rejected by Ben \(user \S+\), 20\d\d-\d\d-\d\d \S+ UTC: fog", text), text
        assert "closed, rejected" in rigcal("session", "list")
        assert "although it was rejected by Ben: fog" in rigcal("session", "accept", "s001-r", "--operator", "Ada")
    finally:
        server.close()


def test_a_bad_shot_that_is_made_anew_before_any_pose_counts_for_nothing(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.shoot("cp1", (CP1[0] + 4000.0, *CP1[1:]))
    session_rig.shoot("cp1", CP1)
    session_rig.live(2)
    session_rig.shoot("cp1", CP1)
    assert session_rig.say("stop")["not_used"] is None


def test_a_shot_in_the_middle_does_not_hide_how_far_a_point_was_off_in_all(session_rig: Rig) -> None:
    east, north, up = CP1
    session_rig.say("setup_new", id="S2", control_points={"cp1": list(CP1)})
    session_rig.say("start", prism="r")
    for off in (-4.5, 0.0, 4.5):
        session_rig.shoot("cp1", (east + off, north, up))
        if off < 4.5:
            session_rig.live(2)
    told = session_rig.say("stop")["not_used"]
    assert told == "control point cp1 was 9.0 mm off when it was shot again, so the station had moved"
