"""Total stations: silent, not locked, tilted, in error, on another prism."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.present import SILENT, is_present
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from daemon.sessions.prisms.standstill_places import ELSEWHERE
from drivers.readings import EventKind, GapReason, LockState

_TURNED_AWAY = (LockState.STANDBY, LockState.SEARCHING, LockState.WAITING, LockState.ROTATING)


@rule(
    "critical", "Check that the station is on, its cable, and its settings (baud rate, parity, line end).", hold_s=3.0
)
def station_silent(evidence: Evidence) -> Iterator[Finding]:
    """A station gives no records for longer than its time-out, and nothing that it has sent waits to be decoded.

    A warning while no session is open. Cleared 3 s after it is heard again. While its link is closed that alarm stands
    for this one.
    """
    # A status is silent also while fixes wait for a busy computer; a gap opens once all that was captured is decoded.
    speaks = {link.name for link in evidence.acquisition.links if link.captures_per_s > 0.0}
    gaps = {gap.channel for gap in evidence.acquisition.gaps if gap.reason == GapReason.SILENT}
    for station in evidence.acquisition.stations:
        is_silent = station.status == SILENT and (station.name in gaps or station.name not in speaks)
        if evidence.is_storing and is_silent:
            yield station.name, "the station gives no records", "warning" if evidence.session is None else "critical"


@rule("warning", "Aim the station at the session's prism; check what blocks the line of sight.", after_s=2.5, hold_s=3)
def station_not_locked(evidence: Evidence) -> Iterator[Finding]:
    """A station follows no prism for 2.5 s while a session is open; it has gone on as if it did for a second before.

    Searching and waiting are usual at other times. Cleared when it has been locked for 3 s.
    """
    for station in evidence.acquisition.stations:
        if evidence.session is not None and is_present(station.status) and station.lock in _TURNED_AWAY:
            yield station.name, f"the station is {station.lock} while session {evidence.session.id} is open"


@rule(
    "critical", "Level the instrument, or switch its compensator on; then describe a new set-up.", after_s=3, hold_s=3
)
def station_tilted(evidence: Evidence) -> Iterator[Finding]:
    """A station says that its compensator is out of range or off, for 3 s; its fixes are not used."""
    for station in evidence.acquisition.stations:
        if is_present(station.status) and station.tilt_ok is False:
            yield station.name, station.reason or "the compensator is out of range or off"


@rule("warning", "Look at the instrument's display; its manual explains an error code.")
def instrument_error(evidence: Evidence) -> Iterator[Finding]:
    """A station has reported an error, refused a command or not answered.

    Cleared when it has given a good fix since, and half a minute after the last error at the earliest. While it is
    silent that alarm stands for this one.
    """
    good_s = {station.name: station.good_age_s for station in evidence.acquisition.stations}
    silent = {station.name for station in evidence.acquisition.stations if station.status == SILENT}
    for event in evidence.active_events(EventKind.INSTRUMENT_ERROR):
        since = good_s.get(event.device)
        is_over = since is not None and since < event.age_s and event.age_s > 30.0
        if not is_over and event.device not in silent and not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("critical", "Aim the station at the session's prism; if it is on it, say `rigcal session confirm-prism`.")
def prism_jump(evidence: Evidence) -> Iterator[Finding]:
    """A station's target jumped further than a boom can move while a session is open.

    It may follow another prism, and its fixes do not count. Cleared when the target is the earlier one again, when
    an operator confirms the prism, and with the session; never by time.
    """
    for suspicion in evidence.suspicions:
        yield suspicion.station, f"{suspicion.reason}; its fixes do not count"


@rule(
    "warning",
    "Check which prism the station is on, and cover reflections. If it is on the session's, `rigcal session "
    "confirm-prism` says so.",
    hold_s=10.0,
)
def fixes_elsewhere(evidence: Evidence) -> Iterator[Finding]:
    """Fixes of one standstill lie at two places, too near to each other for `prism_jump`.

    Those of the place with fewer fixes do not count. Cleared 10 s after the newest fix counts, or with the session.
    """
    why = evidence.newest_excluded
    if evidence.session is not None and not evidence.suspicions and why is not None and why.startswith(ELSEWHERE):
        yield evidence.session.id, f"fixes do not count: {why}"


@rule(
    "warning",
    "Put right what the text says the computer lacks; if the alarm stays, restart rigcal. Meanwhile see yourself "
    "that each lock is on the session's prism.",
)
def prisms_not_compared(evidence: Evidence) -> Iterator[Finding]:
    """The joints cannot be asked whether a station is on the session's prism: the mathematics cannot be loaded.

    A wrong prism is noticed by its distance alone. It is tried again every 30 s.
    """
    if evidence.prisms_fault is not None:
        yield "prisms", f"wrong prisms are noticed by their distance alone: {evidence.prisms_fault}"
