"""CAN buses and the CANopen nodes on them, by what controllers and nodes say of themselves."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.present import is_present
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.readings import EventKind

_CABLING = "Check cabling, termination (120 ohm at both ends) and bit rate."


@rule("critical", f"{_CABLING} Set restart-ms of the interface, so that the controller restarts by itself.", hold_s=3.0)
def bus_off(evidence: Evidence) -> Iterator[Finding]:
    """The controller of a CAN link has gone bus-off.

    Cleared when it says that it works again, when the link is opened anew, or when a channel of the link is heard
    again.
    """
    ended_by = EventKind.BUS_ERROR_ACTIVE, EventKind.BUS_ERROR_WARNING, EventKind.BUS_ERROR_PASSIVE, EventKind.LINK_UP
    for event in evidence.active_events(EventKind.BUS_OFF, *ended_by):
        channels = [c for c in evidence.acquisition.channels if c.link == event.device]
        is_heard = any(is_present(c.status) and (c.age_s or 0.0) < event.age_s for c in channels)
        if not is_heard and not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("warning", _CABLING, hold_s=10.0)
def bus_error_passive(evidence: Evidence) -> Iterator[Finding]:
    """The controller of a CAN link is error-passive: every second frame or so is disturbed.

    Cleared 10 s after it says that it is not, or after the link was opened anew.
    """
    ended_by = EventKind.BUS_ERROR_ACTIVE, EventKind.BUS_ERROR_WARNING, EventKind.BUS_OFF, EventKind.LINK_UP
    for event in evidence.active_events(EventKind.BUS_ERROR_PASSIVE, *ended_by):
        if not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("warning", "Look at the node: it may be about to fail, or was set up anew without a heartbeat.", after_s=3.0)
def heartbeat_lost(evidence: Evidence) -> Iterator[Finding]:
    """A CANopen node has stopped its heartbeat and still sends values: it is not supervised any more.

    One that sends nothing at all is a joint or signal that is silent. Cleared when the heartbeat is heard again.
    """
    present = {channel.name for channel in evidence.acquisition.channels if is_present(channel.status)}
    for event in evidence.active_events(EventKind.HEARTBEAT_LOST, EventKind.HEARTBEAT_RESTORED):
        if event.device in present:
            yield event.device, event.text


@rule("critical", "Look the code up in the device's manual; switch it off and on if it says nothing else.")
def emergency(evidence: Evidence) -> Iterator[Finding]:
    """A CANopen node has sent an emergency (EMCY) and has not taken it back.

    It goes on over a restart of the daemon. Cleared when the node takes back its last error (code 0 with an error
    register of zero), or boots.
    """
    for event in evidence.active_events(EventKind.EMERGENCY, EventKind.EMERGENCY_CLEARED, EventKind.BOOT_UP):
        if not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("critical", "Look at the device; `rigcal devices configure` sets it up again where set-up is what failed.")
def device_alarm(evidence: Evidence) -> Iterator[Finding]:
    """A device reports an alarm (object 6503h), or its set-up has failed.

    Cleared when it says that the alarm is gone, or boots; one of its set-up when it has been set up.
    """
    set_up = {event.device for event in evidence.active_events(EventKind.ALARM, EventKind.CONFIGURED)}
    for event in evidence.active_events(EventKind.ALARM, EventKind.BOOT_UP):
        is_mended = event.code is None and event.device not in set_up
        if not is_mended and not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("warning", "Do what the warning says; values are used as before.")
def device_warning(evidence: Evidence) -> Iterator[Finding]:
    """A device has given a warning (object 6505h, its set-up, a station's settings) and has not taken it back.

    Cleared when it does or boots; one that nothing takes back when the link is opened anew.
    """
    for event in evidence.active_events(EventKind.WARNING, EventKind.BOOT_UP):
        link = evidence.link_of(event.device)
        is_of_before = event.code is None and link is not None and link.up is True and link.since_s < event.age_s
        if not is_of_before and not evidence.is_cut_off(event.device):
            yield event.device, event.text
