from collections.abc import Mapping, Sequence
from dataclasses import replace

from daemon.jobs.scheduler import (
    CHAIN,
    CHECKS,
    DRIFT,
    DueChain,
    DueComparison,
    DueRetry,
    State,
    awaited_session,
    due_jobs,
    next_job,
    spent_jobs,
)
from daemon.store.queries.jobs import JobFacts, JobKind, SessionFacts
from drivers.clock import NS_PER_S, Stamp

T0 = Stamp(1_700_000_000 * NS_PER_S, 100 * NS_PER_S, "boot")
LATER = T0.shifted(60 * NS_PER_S)
BOTH = {JobKind.GAP: 1, JobKind.REPORT: 1}  # a chain was queued when the first session was closed


def session(number: int, kind: str = "static_poses", state: str = "closed", ended: Stamp = T0) -> SessionFacts:
    return SessionFacts(f"s{number}", number, kind, state, None if state == "open" else ended)


def job(number: int, state: str, attempts: int = 1, *, is_ready: bool = True) -> JobFacts:
    return JobFacts(number, CHAIN[number - 1], "s1", state, attempts, is_ready, T0)


def state(
    *sessions: SessionFacts,
    jobs: Sequence[JobFacts] = (),
    covered: Mapping[JobKind, int] | None = None,
    has_model: bool = False,
    live_from: int | None = None,
    drifted: tuple[int, str] | None = None,
) -> State:
    return State(sessions, jobs, covered or {}, has_model, live_from, drifted)


def test_a_closed_session_triggers_the_whole_chain() -> None:
    assert due_jobs(state(session(1)), LATER) == [DueChain(CHAIN, "s1", "s1")]


def test_a_session_is_identified_once() -> None:
    assert due_jobs(state(session(1), covered=BOTH), LATER) == []


def test_a_session_after_the_last_chain_triggers_the_next() -> None:
    assert due_jobs(state(session(1), session(2), covered=BOTH), LATER) == [DueChain(CHAIN, "s2", "s2")]


def test_times_of_different_boots_do_not_decide_what_is_covered() -> None:
    for years in (-5, 5):
        ended = Stamp(T0.utc_ns + years * 365 * 86_400 * NS_PER_S, NS_PER_S, "other boot")
        assert due_jobs(state(session(1, ended=ended), covered=BOTH), LATER) == []
        new = state(session(1, ended=ended), session(2, ended=ended), covered=BOTH)
        assert due_jobs(new, LATER) == [DueChain(CHAIN, "s2", "s2")]


def test_of_several_closed_sessions_the_newest_triggers_for_all() -> None:
    assert due_jobs(state(session(1), session(2)), LATER) == [DueChain(CHAIN, "s2", "s2")]


def test_nothing_is_due_while_a_session_is_open() -> None:
    interrupted = job(1, "interrupted")
    assert due_jobs(state(session(1), session(2, state="open"), jobs=[interrupted]), LATER) == []


def test_an_aborted_session_triggers_nothing() -> None:
    assert due_jobs(state(session(1, state="aborted")), LATER) == []


def test_sessions_of_an_open_guide_wait_longer_for_its_next_prism() -> None:
    opened = replace(state(session(1)), has_guide=True)
    assert due_jobs(opened, T0.shifted(30 * NS_PER_S)) == []
    assert due_jobs(opened, T0.shifted(60 * NS_PER_S)) == [DueChain(CHAIN, "s1", "s1")]


def test_a_session_whose_jobs_are_not_due_yet_is_told() -> None:
    assert awaited_session(state()) is None
    assert awaited_session(state(session(1))) == "s1"
    assert awaited_session(state(session(1), session(2, state="open"))) is None
    assert awaited_session(state(session(1), covered=BOTH)) is None
    assert awaited_session(state(session(1), session(2, "check"), covered=BOTH, has_model=True)) == "s2"


def test_sessions_wait_for_the_next_to_begin_after_the_newest() -> None:
    just_now = T0.shifted(NS_PER_S)
    assert due_jobs(state(session(1)), just_now) == []
    assert due_jobs(state(session(1, ended=T0.shifted(-60 * NS_PER_S)), session(2)), just_now) == []


def test_a_reboot_ends_every_wait() -> None:
    assert due_jobs(state(session(1)), replace(T0, boot_id="next")) != []


def test_a_log_replayed_once_more_waits_for_nothing() -> None:
    assert due_jobs(state(session(1)), T0.shifted(-30 * NS_PER_S)) != []


def test_a_step_of_the_wall_clock_changes_nothing() -> None:
    stepped = replace(T0, utc_ns=T0.utc_ns + 3600 * NS_PER_S)
    assert due_jobs(state(session(1)), stepped) == []


def test_a_check_session_triggers_report_and_comparison_alone_and_only_with_a_model() -> None:
    sessions = (session(1), session(2, "check"))
    assert due_jobs(state(*sessions, covered=BOTH, has_model=True), LATER) == [DueChain(CHECKS, "s2", "s2")]
    assert due_jobs(state(session(1, "check")), LATER) == []


def test_a_chain_covers_the_checks_that_were_closed_before_it() -> None:
    sessions = (session(1), session(2, "check"))
    assert due_jobs(state(*sessions, has_model=True), LATER) == [DueChain(CHAIN, "s1", "s2")]
    covered = {JobKind.GAP: 2, JobKind.REPORT: 2}
    assert due_jobs(state(*sessions, covered=covered, has_model=True), LATER) == []


def test_a_check_since_the_model_went_live_is_held_against_it_once() -> None:
    sessions = (session(1), session(2, "check"))
    covered = {**BOTH, JobKind.REPORT: 2}
    assert due_jobs(state(*sessions, covered=covered, live_from=1), LATER) == [DueChain(DRIFT, "s2", "s2")]
    assert due_jobs(state(*sessions, covered=covered, live_from=2), LATER) == []
    assert due_jobs(state(*sessions, covered={**covered, JobKind.DRIFT: 2}, live_from=1), LATER) == []


def test_drifted_checks_trigger_one_recalibration() -> None:
    sessions = (session(1), session(2, "check"), session(3, "check"))
    covered = {JobKind.GAP: 1, JobKind.REPORT: 3, JobKind.DRIFT: 3}
    drifted = state(*sessions, covered=covered, live_from=1, drifted=(2, "s2"))
    assert due_jobs(drifted, LATER) == [DueChain(CHAIN, "s2", "s3")]
    assert due_jobs(replace(drifted, covered={**covered, JobKind.GAP: 3}), LATER) == []
    assert due_jobs(replace(drifted, sessions=(*sessions, session(4, state="open"))), LATER) == []
    measured_since = replace(drifted, sessions=(*sessions, session(4)))
    assert due_jobs(measured_since, LATER) == [DueChain(CHAIN, "s4", "s4")], "a new session is calibrated by itself"


def test_an_interrupted_job_is_offered_again_after_a_pause_until_its_attempts_are_used() -> None:
    def after(attempts: int) -> State:
        waiting = [job(2, "queued", 0, is_ready=False), job(3, "queued", 0, is_ready=False)]
        return state(session(1), jobs=[job(1, "interrupted", attempts), *waiting], covered=BOTH)

    assert due_jobs(after(1), T0.shifted(4 * NS_PER_S)) == []
    assert due_jobs(after(1), T0.shifted(5 * NS_PER_S)) == [DueRetry(1)]
    assert due_jobs(after(2), T0.shifted(9 * NS_PER_S)) == []
    assert due_jobs(after(2), T0.shifted(10 * NS_PER_S)) == [DueRetry(1)]
    assert due_jobs(after(3), LATER) == []
    assert spent_jobs(after(2)) == []
    assert [j.id for j in spent_jobs(after(3))] == [1]


def test_a_job_that_the_computers_end_interrupted_waits_too_and_ends_after_twenty_times() -> None:
    cut = replace(job(1, "interrupted", attempts=0), interruptions=3)
    assert due_jobs(state(session(1), jobs=[cut], covered=BOTH), T0.shifted(14 * NS_PER_S)) == []
    assert due_jobs(state(session(1), jobs=[cut], covered=BOTH), T0.shifted(15 * NS_PER_S)) == [DueRetry(1)]
    assert spent_jobs(state(jobs=[replace(cut, interruptions=19)])) == []
    spent = replace(cut, interruptions=20)
    assert spent_jobs(state(jobs=[spent])) == [spent]
    assert due_jobs(state(session(1), jobs=[spent], covered=BOTH), LATER) == []


def test_queued_jobs_wait_while_a_session_is_open() -> None:
    assert next_job(state(session(2, state="open"), jobs=[job(1, "queued")])) is None


def test_jobs_run_one_at_a_time_in_the_order_of_their_dependence() -> None:
    waiting = job(2, "queued", is_ready=False)
    assert next_job(state(jobs=[job(1, "queued"), waiting])) == job(1, "queued")
    assert next_job(state(jobs=[job(1, "running"), job(2, "queued")])) is None
    assert next_job(state(jobs=[job(1, "interrupted"), waiting, job(3, "queued")])) == job(3, "queued")
    assert next_job(state(jobs=[waiting])) is None


def test_a_stale_comparison_is_made_again_once_nothing_else_will_make_it() -> None:
    checked = state(session(1), session(2, "check"), covered={JobKind.GAP: 1, JobKind.REPORT: 2}, has_model=True)
    stale = replace(checked, stale_candidate=7)
    assert due_jobs(checked, LATER) == []
    assert due_jobs(stale, LATER) == [DueComparison(7)]
    compares = JobFacts(4, JobKind.COMPARISON, "s2", "running", 1, True, T0)
    assert due_jobs(replace(stale, jobs=[compares]), LATER) == []
    assert due_jobs(replace(stale, covered={JobKind.GAP: 1, JobKind.REPORT: 1}), LATER) == [
        DueChain(CHECKS, "s2", "s2")
    ]
    assert due_jobs(replace(state(session(1), covered=BOTH), stale_candidate=7), LATER) == [], "nothing is held out"
