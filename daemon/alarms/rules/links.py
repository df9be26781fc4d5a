"""Links: ports that are closed, loops that fail, a queue that overflows."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.acquisition.status.decode_failures import kind_of
from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from drivers.readings import EventKind

OPENING_S = 15.0  # a link that has said nothing of its port for so long does not open
LATELY_S = 300.0


@rule("critical", "Check the plug, the adapter and its power; rigcal opens the link again by itself.", hold_s=3.0)
def link_down(evidence: Evidence) -> Iterator[Finding]:
    """A link is closed: its port cannot be opened, or was lost.

    What its channels lack is explained by this alarm and raises none of its own. A station's link is a warning
    while no session is open. Cleared 3 s after the link has been opened, so that a loose plug is one alarm. Not raised
    where `simulated_rig_ended` is.
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


@rule("critical", "Stop the daemon; `rigcal run --sim` starts it again with a simulated rig.")
def simulated_rig_ended(evidence: Evidence) -> Iterator[Finding]:
    """The process of the simulated rig of `rigcal run --sim` has ended, which closes all links."""
    if evidence.has_simulation_ended:
        yield "simulation", "the simulated rig has ended, so nothing is measured"


@rule("warning", "Report the fault with rigcal's log; what the link brought meanwhile is lost.")
def link_restarted(evidence: Evidence) -> Iterator[Finding]:
    """The loop that reads a link has ended by a fault of its own and was started again within the last 5 minutes."""
    for link in evidence.acquisition.links:
        if link.restarted_age_s is not None and link.restarted_age_s <= LATELY_S:
            yield link.name, "the loop that reads the link has failed and was started again"


@rule("critical", "Free space, or check whether the disk is too slow or faulty.", hold_s=5.0)
def queue_full(evidence: Evidence) -> Iterator[Finding]:
    """Captures of a link found the queue to the store full and were lost within the last 5 s."""
    for link in evidence.acquisition.links:
        if link.dropped_age_s is not None and link.dropped_age_s <= 5.0:
            yield link.name, "captures are being lost: the queue to the store is full"


@rule("warning", "Check adapter and cable, and what else keeps the computer busy.")
def frames_lost(evidence: Evidence) -> Iterator[Finding]:
    """The kernel, an adapter or a full queue has lost frames of a link within the last 5 minutes."""
    for event in evidence.recent_events(EventKind.FRAMES_DROPPED, LATELY_S):
        yield event.device, event.text


@rule("warning", "See what else keeps the computer busy, and whether its clock is set while rigcal runs.")
def time_doubtful(evidence: Evidence) -> Iterator[Finding]:
    """Within the last 5 minutes captures came at instants that are not known.

    The link was not read for a while, or the clock was set. They are stored and marked, and their readings are not
    used.
    """
    for event in evidence.recent_events(EventKind.TIME_DOUBTFUL, LATELY_S):
        yield event.device, event.text


@rule("warning", "Check bit rate, wiring and the description of the device (DBC, EDS, profile).", hold_s=60.0)
def decode_failures(evidence: Evidence) -> Iterator[Finding]:
    """One in a hundred captures of a device or more, and ten at least, could not be decoded in the last minute or so.

    Cleared when it has been fewer for a minute.
    """
    for device in evidence.acquisition.decoding:
        if device.lately >= 10 and device.lately_share >= 0.01 and not evidence.is_cut_off(device.device):
            yield device.device, f"captures cannot be decoded, mostly: {kind_of(device.reason)}"


@rule("critical", "Report the fault with rigcal's log; the raw captures are kept and can be decoded again.")
def decoder_defective(evidence: Evidence) -> Iterator[Finding]:
    """The decoder of a link has failed by a fault of its own within the last 10 minutes."""
    for link in evidence.acquisition.links:
        if link.decoder_failed_age_s is not None and link.decoder_failed_age_s <= 600.0:
            yield link.name, "the decoder of the link is defective; its captures are kept"
