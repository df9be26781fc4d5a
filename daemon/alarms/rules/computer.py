"""The computer's clock, and the daemon's own parts."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.clock import NS_PER_S
from drivers.readings import EventKind

STEPPED_S = 900.0
EARLIEST_NS = round(datetime(2025, 1, 1, tzinfo=UTC).timestamp()) * NS_PER_S  # rigcal is not older
BEHIND_NS = 60 * NS_PER_S


@rule(
    "warning", "See that the clock is right and stays so (NTP); records are ordered by another clock and are not lost."
)
def clock_stepped(evidence: Evidence) -> Iterator[Finding]:
    """The computer's clock was set within the last 15 minutes."""
    for event in evidence.recent_events(EventKind.CLOCK_STEP, STEPPED_S):
        yield event.device, event.text


@rule("critical", "Set the computer's clock; if it starts so each time, change the battery of its clock.")
def clock_behind(evidence: Evidence) -> Iterator[Finding]:
    """The computer's clock stands before the year 2025, or at an earlier time than when rigcal last ran.

    Cleared when it is set.
    """
    now_ns, before = evidence.now.utc_ns, evidence.previous_run
    if now_ns < EARLIEST_NS:
        yield "clock", f"the computer's clock stands at {_utc(now_ns):%Y-%m-%d}"
    elif before is not None and now_ns < before.utc_ns - BEHIND_NS:
        last = f"{_utc(before.utc_ns):%Y-%m-%d %H:%M} UTC"
        yield "clock", f"the computer's clock stands at an earlier time than {last}, when rigcal last ran"


@rule(
    "warning",
    "Look after the time service and its network (`chronyc tracking`, `timedatectl`); where the rig has none any more, "
    "restarting rigcal ends the alarm. Records are ordered by another clock, and lose nothing.",
    after_s=600.0,
)
def clock_unsynchronized(evidence: Evidence) -> Iterator[Finding]:
    """A time service kept the computer's clock in this run of rigcal, and has not for 10 minutes.

    A computer whose clock nobody keeps, such as that of a rig without a network, has no such alarm: its clock is off by
    some seconds a day, which matters to people who read times, and to nothing else.
    """
    if evidence.clock_lost is not None:
        yield "clock", f"the computer's clock was synchronised until {_utc(evidence.clock_lost.utc_ns):%H:%M} UTC"


@rule("warning", "Look what else the computer does; nothing is lost, and it stops by itself.", after_s=60.0, hold_s=5.0)
def decoding_behind(evidence: Evidence) -> Iterator[Finding]:
    """Captures have waited in the store to be decoded for a minute.

    After a kill, or where the computer is too slow: readings and fixes come late, and no job is started.
    """
    if evidence.acquisition.is_behind:
        yield "decoding", "captures wait to be decoded: readings and fixes come late, and jobs wait"


@rule("critical", "Put right what the text says; if the alarm stays, restart rigcal: `systemctl restart rigcal`.")
def control_dead(evidence: Evidence) -> Iterator[Finding]:
    """No one can connect to a control socket of the daemon.

    Its file was replaced or cannot be made, or the computer lacks descriptors. Cleared when commands are taken
    again.
    """
    yield from evidence.control_faults.items()


@rule("critical", "Restart rigcal: `systemctl restart rigcal`, and report the fault with its log.")
def thread_ended(evidence: Evidence) -> Iterator[Finding]:
    """An error has ended a thread of the daemon: what it did is not done any more.

    The threads that read links, keep the store, run jobs and send notices go on after an error, or have alarms of
    their own. Cleared when rigcal is restarted.
    """
    for name, why in evidence.ended_threads.items():
        yield name, f"the thread {name} has ended: {why}"


@rule("warning", "Report the fault with rigcal's log; alarms of this sort stand as they were.", hold_s=5.0)
def not_watched(evidence: Evidence) -> Iterator[Finding]:
    """A rule of an alarm, or what it looks at, has failed itself.

    Cleared 5 s after it works again.
    """
    for part, why in evidence.unwatched.items():
        yield part, f"{part} cannot be watched: {why}"


def _utc(utc_ns: int) -> datetime:
    return datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
