"""Joints and machine signals that are silent or cannot be used."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.present import SILENT, is_present
from daemon.acquisition.status.snapshot import ChannelStatus
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.readings import EventKind, Status

START_S = 5.0  # devices take so long to start after their link was opened
AT_ONCE_S = 0.5  # devices that were heard last so close together fell silent together

_WHY = {
    Status.NOT_AVAILABLE: "the device sends that it has no value",
    Status.OUT_OF_RANGE: "the value is beyond what the device can measure",
    Status.DEVICE_ALARM: "the device reports an alarm that makes its value void",
    Status.MALFORMED: "the value cannot be decoded",
    Status.TIME_DOUBTFUL: "this computer reads too late to know when the value was measured; see what keeps it busy",
}


@rule("critical", "Check that the machine is switched on, and the cable between bus and adapter.", after_s=1, hold_s=3)
def link_silent(evidence: Evidence) -> Iterator[Finding]:
    """A CAN link has been open for 5 s, channels of it are silent, and no other frame has come since they were heard.

    It explains that they are silent, and they raise no alarms of their own. Cleared 3 s after a frame has come.
    """
    for link, channels in _by_link(evidence).items():
        if evidence.is_storing and _is_quiet(evidence, link, channels) and _has_started(evidence, channels[0]):
            yield link, "the link is open, and nothing is heard on it"


@rule("critical", "Check the encoder's power and cable; without it no fix can be used.", after_s=1.0, hold_s=3.0)
def joint_silent(evidence: Evidence) -> Iterator[Finding]:
    """A joint has not been read for 1 s longer than its time-out, and its link has been open for 5 s.

    Cleared when it has been read again for 3 s.
    """
    yield from _silent(evidence, "joint")


@rule("warning", "Check the signal's device and cable; effects that need it cannot be told.", after_s=1.0, hold_s=3.0)
def signal_silent(evidence: Evidence) -> Iterator[Finding]:
    """A machine signal has not been read for 1 s longer than its time-out.

    Raised and cleared as for joints.
    """
    yield from _silent(evidence, "signal")


@rule("critical", "Look at the device; without the joint no fix can be used.", after_s=1.5, hold_s=3.0)
def joint_not_usable(evidence: Evidence) -> Iterator[Finding]:
    """The readings of a joint carry no value.

    The device has none, reports an alarm, is out of its range, its value cannot be decoded, or it was read so late that
    its time is not known. Raised after 1.5 s, so that one bad sample is no alarm; cleared after 3 s of good ones. Where
    the device's own alarm or emergency stands, it explains that its values are void.
    """
    yield from _not_usable(evidence, "joint")


@rule("warning", "Look at the device; effects that need the signal cannot be told.", after_s=1.5, hold_s=3.0)
def signal_not_usable(evidence: Evidence) -> Iterator[Finding]:
    """The readings of a machine signal carry no value.

    Raised and cleared as for joints.
    """
    yield from _not_usable(evidence, "signal")


def _by_link(evidence: Evidence) -> dict[str, list[ChannelStatus]]:
    found: dict[str, list[ChannelStatus]] = {}
    for channel in evidence.acquisition.channels:
        found.setdefault(channel.link, []).append(channel)
    return found


def _is_quiet(evidence: Evidence, link: str, channels: list[ChannelStatus]) -> bool:
    """True if the link itself seems to be cut: it has several channels, and nothing came since a silent one was heard.

    Other channels may have longer time-outs: they will be silent in a moment.
    """
    silent = [channel for channel in channels if channel.status == SILENT]
    if len(channels) < 2 or not silent:
        return False
    heard_s = [f.age_s for f in evidence.acquisition.frames if f.link == link and f.age_s is not None]
    silent_s = [channel.age_s for channel in silent if channel.age_s is not None]
    return not heard_s or (bool(silent_s) and min(heard_s) >= min(silent_s) - AT_ONCE_S)


def _has_started(evidence: Evidence, channel: ChannelStatus) -> bool:
    link = evidence.link_of(channel.name)
    return link is None or link.since_s >= START_S


def _silent(evidence: Evidence, kind: str) -> Iterator[Finding]:
    for link, channels in _by_link(evidence).items():
        if not evidence.is_storing or _is_quiet(evidence, link, channels):
            continue
        for channel in channels:
            if channel.kind == kind and channel.status == SILENT and _has_started(evidence, channel):
                before = "since the start" if channel.last_status is None else f"any more (last: {channel.last_status})"
                yield channel.name, f"{channel.name} is not heard {before}"


def _not_usable(evidence: Evidence, kind: str) -> Iterator[Finding]:
    told = {event.device for event in evidence.active_events(EventKind.ALARM, EventKind.BOOT_UP)}
    told |= {
        e.device for e in evidence.active_events(EventKind.EMERGENCY, EventKind.EMERGENCY_CLEARED, EventKind.BOOT_UP)
    }
    for channel in evidence.acquisition.channels:
        if channel.status == Status.DEVICE_ALARM and channel.name in told:
            continue
        if channel.kind == kind and is_present(channel.status) and channel.status != Status.OK:
            yield channel.name, f"{channel.name}: {_WHY[Status(channel.status)]}"
