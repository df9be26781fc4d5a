"""Total stations: silent, not locked, tilted, in error, on a wrong prism."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.present import is_present
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from daemon.sessions.open_session import OTHER_CONSTANT
from daemon.sessions.prisms.standstill_places import ELSEWHERE
from drivers.readings import EventKind, LockState

_TURNED_AWAY = (LockState.STANDBY, LockState.SEARCHING, LockState.WAITING, LockState.ROTATING)


@rule(
    "critical",
    "Check that the station is on; check its cable and its settings (baud rate, parity, line end).",
    hold_s=3.0,
    is_of_decoded=True,
)
def station_silent(evidence: Evidence) -> Iterator[Finding]:
    """A station has sent no records for longer than its timeout, and none of its captures wait to be decoded.

    A warning while no session is open. Cleared 3 s after it sends again. Not raised while the station's link is closed,
    which has its own alarm.
    """
    for station in evidence.acquisition.stations:
        if station.is_silent:
            yield station.name, "the station sends no records", "warning" if evidence.session is None else "critical"


@rule(
    "warning",
    "Aim the station at the session's prism, and check whether something blocks the line of sight.",
    after_s=2.5,
    hold_s=3,
    needs_decoding=True,
)
def station_not_locked(evidence: Evidence) -> Iterator[Finding]:
    """A station has followed no prism for 2.5 s while a session is open.

    Before it reports the loss, a station predicts the prism's motion for about a second. Without an open session,
    searching and waiting are normal. Cleared when the station has been locked for 3 s.
    """
    for station in evidence.acquisition.stations:
        if evidence.session is not None and is_present(station.status) and station.lock in _TURNED_AWAY:
            yield station.name, f"the station is {station.lock} while session {evidence.session.id} is open"


@rule(
    "critical",
    "Level the instrument, or switch its compensator on; then describe a new set-up.",
    after_s=3,
    hold_s=3,
    needs_decoding=True,
)
def station_tilted(evidence: Evidence) -> Iterator[Finding]:
    """A station has reported for 3 s that its compensator is out of range or off; its fixes are not used."""
    for station in evidence.acquisition.stations:
        if is_present(station.status) and station.tilt_ok is False:
            yield station.name, station.reason or "the compensator is out of range or off"


@rule("warning", "Check the instrument's display; its manual explains the error codes.")
def instrument_error(evidence: Evidence) -> Iterator[Finding]:
    """A station has reported an error, refused a command, or not answered a command.

    Cleared when it has given a good fix since, and at the earliest half a minute after the last error. Not raised while
    the station is silent, which has its own alarm.
    """
    good_s = {station.name: station.good_age_s for station in evidence.acquisition.stations}
    silent = {station.name for station in evidence.acquisition.stations if station.is_silent}
    for event in evidence.active_events(EventKind.INSTRUMENT_ERROR):
        since = good_s.get(event.device)
        is_over = since is not None and since < event.age_s and event.age_s > 30.0
        if not is_over and event.device not in silent and not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule(
    "critical",
    "Aim the station at the session's prism. If the station or its tripod was moved, stop the session and describe a "
    "new set-up. If the alarm stays although the station stands where it was and is on that prism, check that no "
    "joint's zero has changed, and run `rigcal session confirm-prism`.",
)
def prism_jump(evidence: Evidence) -> Iterator[Finding]:
    """While a session is open, a station's target has jumped further than a boom can move.

    The station may follow a different prism, and its fixes are not used. Cleared when the target is the earlier one
    again, when an operator confirms the prism, or when the session ends, and while a guide has turned the station to a
    control point; never by the passing of time.
    """
    for suspicion in evidence.suspicions:
        yield suspicion.station, f"{suspicion.reason}; its fixes are not used"


@rule(
    "warning",
    "Check which prism the station follows, and cover reflecting surfaces. If it follows the session's prism, run "
    "`rigcal session confirm-prism`.",
    hold_s=10.0,
)
def fixes_elsewhere(evidence: Evidence) -> Iterator[Finding]:
    """Fixes of one standstill lie at two places, which are too close to each other for `prism_jump`.

    Fixes of the place with fewer fixes are not used. Cleared 10 s after the newest fix is used again, or when the
    session ends.
    """
    why = evidence.newest_excluded
    if evidence.session is not None and not evidence.suspicions and why is not None and why.startswith(ELSEWHERE):
        yield evidence.session.id, f"fixes are not used: {why}"


@rule(
    "critical",
    "Set the station's prism constant back. If the new one is right, stop the session and start another one.",
    hold_s=10.0,
)
def other_prism_constant(evidence: Evidence) -> Iterator[Finding]:
    """The station's prism constant was changed during the session, so its distances do not fit the earlier ones.

    Fixes with the new constant are not used. Cleared 10 s after the newest fix is used again, or when the session ends.
    """
    why = evidence.newest_excluded
    if evidence.session is not None and why is not None and why.startswith(OTHER_CONSTANT):
        yield evidence.session.id, f"fixes are not used: {why}"


@rule(
    "warning",
    "Provide what the alarm says the computer lacks. If the alarm stays, restart rigcal. Until then, check yourself at "
    "each lock that the station is on the session's prism.",
)
def prisms_not_compared(evidence: Evidence) -> Iterator[Finding]:
    """A station's prism cannot be checked against the joints, because the mathematical code cannot be loaded.

    A wrong prism is then detected by its distance alone. Loading is retried every 30 s.
    """
    if evidence.prisms_fault is not None:
        yield "prisms", f"wrong prisms are detected by their distance alone: {evidence.prisms_fault}"
