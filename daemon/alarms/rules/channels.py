"""Joints and machine signals that are silent or cannot be used."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.present import is_present
from daemon.acquisition.status.silence import START_NODES
from daemon.acquisition.status.snapshot import ChannelStatus
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.readings import EventKind, Status

START_S = 5.0  # time that devices need to start after their link was opened
AT_ONCE_S = 0.5  # devices last received within this time of each other fell silent together

_WHY = {
    Status.NOT_AVAILABLE: "the device reports that it has no value",
    Status.OUT_OF_RANGE: "the value is outside the device's measuring range",
    Status.DEVICE_ALARM: "an alarm of the device, a wrong device or a second one of its node number voids its value",
    Status.MALFORMED: "the value cannot be decoded",
    Status.TIME_DOUBTFUL: "this computer reads too late to know when the value was measured; check what keeps it busy",
}


@rule(
    "critical",
    "Check that the machine is on, and check the cable between bus and adapter.",
    after_s=1,
    hold_s=3,
    is_of_decoded=True,
)
def link_silent(evidence: Evidence) -> Iterator[Finding]:
    """A CAN link has been open for 5 s, but no frame has arrived on it since its silent channels were last received.

    This alarm stands for all channels of the link; they raise no alarms of their own. Cleared 3 s after a frame has
    arrived.
    """
    for link, channels in _by_link(evidence).items():
        if _is_quiet(evidence, link, channels) and _has_started(evidence, channels[0]):
            yield link, "the link is open, but nothing is received on it"


@rule(
    "critical",
    "Check the encoder's power and cable; without this joint no fix can be used.",
    after_s=1.0,
    hold_s=3.0,
    is_of_decoded=True,
)
def joint_silent(evidence: Evidence) -> Iterator[Finding]:
    """No reading of a joint has arrived for 1 s longer than its timeout, and its link has been open for 5 s.

    If its node has booted since the last reading, or still sends its heartbeat, the alarm says so and asks to start the
    node instead. Cleared when readings have arrived again for 3 s.
    """
    yield from _silent(evidence, "joint")


@rule(
    "warning",
    "Check the signal's device and cable; effects that need this signal cannot be identified.",
    after_s=1.0,
    hold_s=3.0,
    is_of_decoded=True,
)
def signal_silent(evidence: Evidence) -> Iterator[Finding]:
    """No reading of a machine signal has arrived for 1 s longer than its timeout.

    Raised and cleared as for joints.
    """
    yield from _silent(evidence, "signal")


@rule(
    "critical", "Check the device; without this joint no fix can be used.", after_s=1.5, hold_s=3.0, needs_decoding=True
)
def joint_not_usable(evidence: Evidence) -> Iterator[Finding]:
    """The readings of a joint carry no usable value.

    The device has no value, reports an alarm or is out of its range; or its value cannot be decoded, or was read too
    late for its time to be known. Raised after 1.5 s, so that one bad sample raises no alarm; cleared after 3 s of good
    samples. Not raised where the device's own alarm, an emergency, a failed set-up or a second device with its node
    number explains the invalid values.
    """
    yield from _not_usable(evidence, "joint")


@rule(
    "warning",
    "Check the device; effects that need this signal cannot be identified.",
    after_s=1.5,
    hold_s=3.0,
    needs_decoding=True,
)
def signal_not_usable(evidence: Evidence) -> Iterator[Finding]:
    """The readings of a machine signal carry no usable value.

    Raised and cleared as for joints.
    """
    yield from _not_usable(evidence, "signal")


def _by_link(evidence: Evidence) -> dict[str, list[ChannelStatus]]:
    found: dict[str, list[ChannelStatus]] = {}
    for channel in evidence.acquisition.channels:
        found.setdefault(channel.link, []).append(channel)
    return found


def _is_quiet(evidence: Evidence, link: str, channels: list[ChannelStatus]) -> bool:
    """Return True if the whole link seems cut: it has several channels, and no frame followed a silent one's last.

    Other channels may have longer timeouts; they will be silent soon.
    """
    silent = [channel for channel in channels if channel.is_silent]
    if len(channels) < 2 or not silent:
        return False
    heard_s = [f.age_s for f in evidence.acquisition.frames if f.link == link and f.age_s is not None]
    silent_s = [channel.age_s for channel in silent if channel.age_s is not None]
    return not heard_s or (bool(silent_s) and min(heard_s) >= min(silent_s) - AT_ONCE_S)


def _has_started(evidence: Evidence, channel: ChannelStatus) -> bool:
    """Return True if the channel's link had been open long enough when the newest decoded capture was received."""
    link = evidence.link_of(channel.name)
    return link is None or link.since_s - (evidence.acquisition.decoded_age_s or 0.0) >= START_S


def _silent(evidence: Evidence, kind: str) -> Iterator[Finding]:
    for link, channels in _by_link(evidence).items():
        if _is_quiet(evidence, link, channels):
            continue
        for channel in channels:
            if channel.kind == kind and channel.is_silent and _has_started(evidence, channel):
                is_new = channel.last_status is None
                text = "not received since the start" if is_new else f"no longer received (last: {channel.last_status})"
                if channel.silence:
                    yield channel.name, f"{channel.name} is {text}: {channel.silence}", None, START_NODES
                else:
                    yield channel.name, f"{channel.name} is {text}"


def _not_usable(evidence: Evidence, kind: str) -> Iterator[Finding]:
    told = {event.device for event in evidence.active_events(EventKind.ALARM, EventKind.BOOT_UP) if event.code}
    told |= {e.device for e in evidence.active_events(EventKind.ALARM, EventKind.CONFIGURED) if e.code is None}
    told |= {
        e.device for e in evidence.active_events(EventKind.EMERGENCY, EventKind.EMERGENCY_CLEARED, EventKind.BOOT_UP)
    }
    told |= {e.device for e in evidence.active_events(EventKind.DUPLICATE_NODE, EventKind.DUPLICATE_NODE_GONE)}
    for channel in evidence.acquisition.channels:
        if channel.status == Status.DEVICE_ALARM and channel.name in told:
            continue
        if channel.kind == kind and is_present(channel.status) and channel.status != Status.OK:
            yield channel.name, f"{channel.name}: {_WHY[Status(channel.status)]}"
