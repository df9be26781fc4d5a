"""Links: closed ports, failed reading loops, an overflowing queue."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.decode_failures import kind_of
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.readings import EventKind

OPENING_S = 15.0  # a link that has reported nothing about its port for this long does not open
LATELY_S = 300.0


@rule("critical", "Check the plug, the adapter and its power. rigcal reopens the link by itself.", hold_s=3.0)
def link_down(evidence: Evidence) -> Iterator[Finding]:
    """A link is closed: its port cannot be opened, or was lost.

    This alarm stands for all faults of the link's devices that it explains; they raise no alarms of their own. It is a
    warning for a station's link while no session is open. Cleared 3 s after the link is open again, so that a loose
    plug raises only one alarm. Not raised while `simulated_rig_ended` is active.
    """
    if evidence.has_simulation_ended:
        return
    stations = {station.name for station in evidence.acquisition.stations}
    for link in evidence.acquisition.links:
        if link.up is False:
            text = link.reason or "the link is closed"
        elif link.up is None and evidence.running_s > OPENING_S:
            text = f"the link has not been opened within {OPENING_S:g} s"
        else:
            continue
        is_idle = link.name in stations and evidence.session is None
        yield link.name, text, "warning" if is_idle else "critical"


@rule("critical", "Stop the daemon, and start it again with a new simulated rig: `rigcal run --sim`.")
def simulated_rig_ended(evidence: Evidence) -> Iterator[Finding]:
    """The process of the simulated rig of `rigcal run --sim` has ended, which closes all links."""
    if evidence.has_simulation_ended:
        yield "simulation", "the simulated rig has ended, so nothing is measured"


@rule("warning", "Report the fault together with rigcal's log. Data that arrived between failure and restart are lost.")
def link_restarted(evidence: Evidence) -> Iterator[Finding]:
    """The loop that reads a link has ended by an internal error and was restarted within the last 5 minutes."""
    for link in evidence.acquisition.links:
        if link.restarted_age_s is not None and link.restarted_age_s <= LATELY_S:
            yield link.name, "the loop that reads the link has failed and was restarted"


@rule("critical", "Free space on the disk, or check whether it is too slow or faulty.", hold_s=5.0)
def queue_full(evidence: Evidence) -> Iterator[Finding]:
    """Within the last 5 s captures of a link were lost because the queue to the store was full."""
    for link in evidence.acquisition.links:
        if link.dropped_age_s is not None and link.dropped_age_s <= 5.0:
            yield link.name, "captures are being lost: the queue to the store is full"


@rule("warning", "Check adapter and cable, and what else keeps the computer busy.")
def frames_lost(evidence: Evidence) -> Iterator[Finding]:
    """The kernel, an adapter or a full queue has lost frames of a link within the last 5 minutes."""
    for event in evidence.recent_events(EventKind.FRAMES_DROPPED, LATELY_S):
        yield event.device, event.text


@rule("warning", "Check the device, the bus and whether the message counter is described correctly.", hold_s=60.0)
def frames_missing(evidence: Evidence) -> Iterator[Finding]:
    """In about the last minute, at least 10 readings of a channel, and at least 1 %, were missing by message counter.

    The frames did not reach this computer. Cleared when fewer have been missing for a minute.
    """
    channels = {channel.name for channel in evidence.acquisition.channels}
    for gaps in evidence.acquisition.gap_counts:
        is_many = gaps.lately >= 10 and gaps.lately_share >= 0.01
        if is_many and gaps.channel in channels and not evidence.is_cut_off(gaps.channel):
            yield gaps.channel, "frames are missing according to their message counter"


@rule("warning", "Check what else keeps the computer busy, and whether its clock is being set while rigcal runs.")
def time_doubtful(evidence: Evidence) -> Iterator[Finding]:
    """Within the last 5 minutes captures arrived whose time of arrival is not known.

    The link was not read for a while, or the clock was set. Such captures are stored and marked, but their readings are
    not used.
    """
    for event in evidence.recent_events(EventKind.TIME_DOUBTFUL, LATELY_S):
        yield event.device, event.text


@rule("warning", "Check bit rate, wiring and the description of the device (DBC, EDS, profile).", hold_s=60.0)
def decode_failures(evidence: Evidence) -> Iterator[Finding]:
    """In about the last minute, at least 10 captures of a device, and at least 1 % of them, could not be decoded.

    At least 3 are enough if none was decoded: a station that measures on request sends few. Cleared when fewer have
    failed for a minute.
    """
    for device in evidence.acquisition.decoding:
        are_many = device.lately >= 10 and device.lately_share >= 0.01
        are_all = device.lately >= 3 and device.lately_share == 1.0
        if (are_many or are_all) and not evidence.is_cut_off(device.device):
            yield device.device, f"captures cannot be decoded; most frequent reason: {kind_of(device.reason)}"


@rule("critical", "Report the fault together with rigcal's log. Raw captures are kept and can be decoded again.")
def decoder_defective(evidence: Evidence) -> Iterator[Finding]:
    """The decoder of a link has failed by an internal error within the last 10 minutes."""
    for link in evidence.acquisition.links:
        if link.decoder_failed_age_s is not None and link.decoder_failed_age_s <= 600.0:
            yield link.name, "the decoder of the link failed by an internal error; its captures are kept"
