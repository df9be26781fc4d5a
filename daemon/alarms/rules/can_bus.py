"""CAN buses and the CANopen nodes on them, by what the controllers and nodes themselves report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from daemon.acquisition.status.present import is_present
from daemon.acquisition.status.snapshot import EventStatus
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.readings import EventKind

_CABLING = "Check cabling, termination (120 ohm at both ends) and bit rate."


@rule("critical", f"{_CABLING} Set restart-ms of the interface, so that the controller restarts by itself.", hold_s=3.0)
def bus_off(evidence: Evidence) -> Iterator[Finding]:
    """The controller of a CAN link has gone bus-off.

    Cleared when the controller reports that it works again, when the link is reopened, or when a channel of the link is
    received again.
    """
    ended_by = EventKind.BUS_ERROR_ACTIVE, EventKind.BUS_ERROR_WARNING, EventKind.BUS_ERROR_PASSIVE, EventKind.LINK_UP
    for event in evidence.active_events(EventKind.BUS_OFF, *ended_by):
        channels = [c for c in evidence.acquisition.channels if c.link == event.device]
        is_heard = any(is_present(c.status) and (c.age_s or 0.0) < event.age_s for c in channels)
        if not is_heard and not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("warning", _CABLING, hold_s=10.0)
def bus_error_passive(evidence: Evidence) -> Iterator[Finding]:
    """The controller of a CAN link is error-passive: about every second frame is disturbed.

    Cleared 10 s after the controller reports a better state, or after the link is reopened.
    """
    ended_by = EventKind.BUS_ERROR_ACTIVE, EventKind.BUS_ERROR_WARNING, EventKind.BUS_OFF, EventKind.LINK_UP
    for event in evidence.active_events(EventKind.BUS_ERROR_PASSIVE, *ended_by):
        if not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule(
    "warning",
    "Check the node: it may be about to fail, or it was configured without a heartbeat.",
    after_s=3.0,
    needs_decoding=True,
)
def heartbeat_lost(evidence: Evidence) -> Iterator[Finding]:
    """A CANopen node has stopped its heartbeat but still sends values: it is no longer supervised.

    A node that sends nothing at all raises the alarm of a silent joint or signal instead. Cleared when the heartbeat is
    received again.
    """
    present = {channel.name for channel in evidence.acquisition.channels if is_present(channel.status)}
    for event in evidence.active_events(EventKind.HEARTBEAT_LOST, EventKind.HEARTBEAT_RESTORED):
        if event.device in present:
            yield event.device, event.text


@rule(
    "critical",
    "Give one of the two devices a different node number. If there is only one, it sends more often than at SYNC: run "
    "`rigcal devices configure` where the link may transmit, or let whoever sets it up change its transmission type to "
    "1. If SYNC is no longer sent, send it again, or change the channel's `mode` in the rig file.",
    hold_s=3.0,
)
def duplicate_node(evidence: Evidence) -> Iterator[Finding]:
    """Two devices on a CAN bus send values under the same CANopen node number.

    More different values arrive than SYNCs, and none of them is used. The alarm survives a restart of the daemon.
    Cleared 3 s after at most one value has arrived for each SYNC of 20 or more, over half a second or more. Without
    SYNC nothing shows whether one of the devices is gone.
    """
    for event in evidence.active_events(EventKind.DUPLICATE_NODE, EventKind.DUPLICATE_NODE_GONE):
        if not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule("critical", "Look up the code in the device's manual. If it gives no other remedy, switch the device off and on.")
def emergency(evidence: Evidence) -> Iterator[Finding]:
    """A CANopen node has sent an emergency (EMCY) and has not withdrawn it.

    The alarm survives a restart of the daemon. Cleared when the node withdraws its last error (code 0 with an error
    register of zero), or boots.
    """
    for event in evidence.active_events(EventKind.EMERGENCY, EventKind.EMERGENCY_CLEARED, EventKind.BOOT_UP):
        if not evidence.is_cut_off(event.device):
            yield event.device, event.text


@rule(
    "critical",
    "Check the device. If its set-up has failed, run `rigcal devices configure` to set it up "
    "again, which the link must permit (`allow_transmit`, `transmit_nodes`).",
)
def device_alarm(evidence: Evidence) -> Iterator[Finding]:
    """A device reports an alarm (object 6503h), or its set-up has failed.

    Cleared when the device reports that the alarm is gone, or boots. After a failed set-up, cleared when a set-up
    succeeds, also if the daemon or the computer is restarted before. If the set-up has shown that the device is not the
    one in the rig file, its readings are not used until then.
    """
    of_devices = [e for e in evidence.active_events(EventKind.ALARM, EventKind.BOOT_UP) if e.code is not None]
    of_set_ups = [e for e in evidence.active_events(EventKind.ALARM, EventKind.CONFIGURED) if e.code is None]
    yield from _by_device(evidence, sorted([*of_devices, *of_set_ups], key=lambda event: event.number))


@rule("warning", "Follow the text of the warning. The device's values are still used.")
def device_warning(evidence: Evidence) -> Iterator[Finding]:
    """A device has given a warning (object 6505h, its set-up, a station's settings) and has not withdrawn it.

    A CAN link warns while its transmit queue is full. Cleared when the device withdraws the warning or boots. A warning
    that the device cannot withdraw is cleared when the link is reopened.
    """
    active = evidence.active_events(EventKind.WARNING, EventKind.BOOT_UP)
    yield from _by_device(evidence, [event for event in active if not _is_of_before(event, evidence)])


def _is_of_before(event: EventStatus, evidence: Evidence) -> bool:
    """Return True if a warning that no device withdraws is older than the present opening of its link."""
    link = evidence.link_of(event.device)
    return event.code is None and link is not None and link.up is True and link.since_s < event.age_s


def _by_device(evidence: Evidence, events: Sequence[EventStatus]) -> Iterator[Finding]:
    """Yield one finding of each device: what it reports itself, and what rigcal reports about it."""
    texts: dict[str, list[str]] = {}
    for event in events:
        texts.setdefault(event.device, []).append(event.text)
    for device, told in texts.items():
        if not evidence.is_cut_off(device):
            yield device, "; ".join(told)
