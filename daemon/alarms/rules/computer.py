"""The computer's clock, and the daemon's own parts."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.clock import NS_PER_S
from drivers.readings import EventKind

STEPPED_S = 900.0
EARLIEST_NS = round(datetime(2025, 1, 1, tzinfo=UTC).timestamp()) * NS_PER_S  # rigcal did not exist before
BEHIND_NS = 60 * NS_PER_S


@rule(
    "warning",
    "Make sure that the clock is right and stays right (NTP). Records are ordered by a separate clock; none are lost.",
)
def clock_stepped(evidence: Evidence) -> Iterator[Finding]:
    """The computer's clock was set within the last 15 minutes."""
    for event in evidence.recent_events(EventKind.CLOCK_STEP, STEPPED_S):
        yield event.device, event.text


@rule("critical", "Set the computer's clock. If it is wrong after every start, replace the clock's battery.")
def clock_behind(evidence: Evidence) -> Iterator[Finding]:
    """The computer's clock shows a date before 2025, or a time before rigcal's last run.

    Cleared when the clock is set.
    """
    now_ns, before = evidence.now.utc_ns, evidence.previous_run
    if now_ns < EARLIEST_NS:
        yield "clock", f"the computer's clock shows the date {_utc(now_ns):%Y-%m-%d}"
    elif before is not None and now_ns < before.utc_ns - BEHIND_NS:
        last = f"{_utc(before.utc_ns):%Y-%m-%d %H:%M} UTC"
        yield "clock", f"the computer's clock shows a time before {last}, when rigcal last ran"


@rule(
    "warning",
    "Check the time service and its network (`chronyc tracking`, `timedatectl`). If the rig no longer has a time "
    "service, restart rigcal to clear the alarm. Records are ordered by a separate clock; none are lost.",
    after_s=600.0,
)
def clock_unsynchronized(evidence: Evidence) -> Iterator[Finding]:
    """A time service synchronised the computer's clock in this run of rigcal, but has not for 10 minutes.

    Not raised where no time service has synchronised the clock in this run, such as on a rig without a network: the
    clock then drifts by some seconds a day, which matters only to people who read the times.
    """
    if evidence.clock_lost is not None:
        yield "clock", f"the computer's clock was last synchronised at {_utc(evidence.clock_lost.utc_ns):%H:%M} UTC"


@rule(
    "warning",
    "Check what else keeps the computer busy. Nothing is lost, and the backlog clears by itself.",
    after_s=60.0,
    hold_s=5.0,
)
def decoding_behind(evidence: Evidence) -> Iterator[Finding]:
    """For a minute, captures in the store have been waiting to be decoded.

    This happens after an unclean shutdown, or where the computer is too slow. Readings and fixes are late, and no job
    is started.
    """
    if evidence.acquisition.is_behind:
        yield "decoding", "captures are waiting to be decoded: readings and fixes are late, and jobs wait"


@rule(
    "critical",
    "Correct what the alarm names. If the alarm stays, restart rigcal: `systemctl restart rigcal`.",
    hold_s=5.0,
)
def control_dead(evidence: Evidence) -> Iterator[Finding]:
    """No one can connect to a control socket of the daemon.

    Its file was replaced or cannot be created, or the computer is short of descriptors. Cleared when clients can
    connect again.
    """
    yield from evidence.control_faults.items()


@rule("critical", "Restart rigcal (`systemctl restart rigcal`), and report the fault together with rigcal's log.")
def thread_ended(evidence: Evidence) -> Iterator[Finding]:
    """An error has ended a thread of the daemon, so that its work is no longer done.

    The threads that read links, write the store, run jobs and send notices continue after an error, or have alarms of
    their own. Cleared when rigcal is restarted.
    """
    for name, why in evidence.ended_threads.items():
        yield name, f"the thread {name} has ended: {why}"


@rule(
    "warning",
    "Report the fault together with rigcal's log. Until it is corrected, alarms of this kind keep their last state.",
    hold_s=5.0,
)
def not_watched(evidence: Evidence) -> Iterator[Finding]:
    """A rule of an alarm, or a check that it depends on, has itself failed.

    Cleared 5 s after it works again.
    """
    for part, why in evidence.unwatched.items():
        yield part, f"{part} cannot be checked: {why}"


def _utc(utc_ns: int) -> datetime:
    return datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
