"""Why a CANopen node sends no values although it lives, by its boot-up, its state and its heartbeat."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from daemon.acquisition.status.snapshot import ChannelStatus, EventStatus, FrameStatus
from drivers.canopen.cia301 import NmtState, heartbeat_id
from drivers.readings import EventKind

START_NODES = (
    "Run `rigcal devices configure` while the machine is parked, where the link may transmit; otherwise the control "
    "system must start it. A node that is set up for SYNC also needs SYNC on the bus, from the control system or by "
    "the link's `sync_period_ms`."
)
"""What to do about a channel whose node lives but sends no values."""

_ALIVE_S = 5.0  # a node that was heard within this time lives; heartbeats usually come every second
_AT_ONCE_S = 0.5  # a node that dies falls silent with its heartbeat and its values within this time


def why_silent(
    channel: ChannelStatus,
    node: int,
    names: Collection[str],
    since_s: float,
    frames: Sequence[FrameStatus],
    events: Sequence[EventStatus],
) -> str:
    """Return why a silent channel's node sends no values, a clause; "" if nothing shows that the node lives.

    Args:
        channel: the channel.
        node: number of its node.
        names: names of the node's channels, one of which its events have.
        since_s: age of the channel's last reading, or of the opening of its link if there was none.
        frames: frames of all links, by identifier.
        events: last events of all devices, oldest first.
    """
    last = {EventKind(event.kind): event for event in events if event.device in names}
    order = {kind: event.number for kind, event in last.items()}
    if order.get(EventKind.HEARTBEAT_LOST, -1) > order.get(EventKind.HEARTBEAT_RESTORED, -1):
        return ""
    boot, nmt = last.get(EventKind.BOOT_UP), last.get(EventKind.NMT_STATE)
    state = None if nmt is None or (boot is not None and nmt.number < boot.number) else nmt.code
    if boot is not None and boot.age_s < since_s and state != NmtState.OPERATIONAL:
        return "its node has booted, and sends no values until it is started"
    heartbeat = f"{heartbeat_id(node):03X}"
    heard_s = [f.age_s for f in frames if (f.link, f.identifier) == (channel.link, heartbeat) and f.age_s is not None]
    if not heard_s or heard_s[0] > min(_ALIVE_S, since_s - _AT_ONCE_S):
        return ""
    if state in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED):
        return f"its node lives but is {NmtState(state).words}, and sends no values until it is started"
    return "its node lives, as its heartbeat shows, but sends no values: SYNC or its set-up is missing"
