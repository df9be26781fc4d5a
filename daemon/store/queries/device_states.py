"""The last reports on the states of CANopen devices: emergencies, alarms, boot-ups, heartbeats, set-ups, duplicates."""

from __future__ import annotations

from typing import Any

from daemon.store.connection import Connection
from daemon.store.reader import Reader
from drivers.canopen.node_setup import NOT_USED
from drivers.canopen.supervision import EXCHANGED, VOIDS
from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind

STATES = (
    EventKind.ALARM,
    EventKind.BOOT_UP,
    EventKind.DUPLICATE_NODE,
    EventKind.DUPLICATE_NODE_GONE,
    EventKind.EMERGENCY,
    EventKind.EMERGENCY_CLEARED,
    EventKind.HEARTBEAT_LOST,
    EventKind.HEARTBEAT_RESTORED,
    EventKind.WARNING,
)
# `named`, the devices: goes from one to the next by the index, however many events each has. The last row is NULL.
NAMED = """WITH RECURSIVE named(device) AS (
        SELECT min(device) FROM device_events
        UNION ALL SELECT (SELECT min(device) FROM device_events WHERE device > named.device)
            FROM named WHERE named.device IS NOT NULL)"""
DEVICES = f"{NAMED} SELECT device FROM named WHERE device IS NOT NULL"
_LAST = """SELECT id, utc_ns, monotonic_ns, boot_id, device, kind, text, code FROM device_events
    WHERE device = ? AND kind = ? AND boot_id = ? AND monotonic_ns < ? AND {}
    ORDER BY monotonic_ns DESC, id DESC LIMIT 1"""
# A set-up outlasts boots of the computer, whose numbers increase.
_LAST_OF_SET_UPS = """SELECT id, utc_ns, monotonic_ns, boot_id, device, kind, text, code FROM device_events
    WHERE device = ? AND kind = ? AND (boot_id, monotonic_ns) < (?, ?) AND (boot_id, monotonic_ns) >= (?, ?) AND {}
    ORDER BY boot_id DESC, monotonic_ns DESC, id DESC LIMIT 1"""
_NEXT_BOOT = 2**63 - 1  # number of a boot that has no row yet


def device_states(source: Connection | Reader, before: Stamp) -> list[DeviceEvent]:
    """Return the last event of each device and kind before an instant, in its boot, oldest first.

    For emergencies both the last one and the last one that voids values are returned. Of set-ups, the last one that
    succeeded and the last one that has failed since are returned, also from earlier boots, and the last one since that
    found a wrong device or a different serial number. Other alarms and warnings without a code were not sent by the
    devices, and are left out.

    Args:
        source: the store.
        before: the instant.
    """
    boots = list(source.rows("SELECT id FROM boots WHERE kernel_boot_id = ?", [before.boot_id]))
    boot = boots[0]["id"] if boots else _NEXT_BOOT
    found: dict[int, dict[str, Any]] = {}
    for device in [row["device"] for row in source.rows(DEVICES)]:
        for kind in STATES:
            about = (device, kind.value, boot, before.monotonic_ns)
            sent = "code IS NOT NULL" if kind in (EventKind.ALARM, EventKind.WARNING) else "TRUE"
            rows = list(source.rows(_LAST.format(sent), about))
            if kind is EventKind.EMERGENCY:
                rows += source.rows(_LAST.format("text LIKE '%' || ?"), (*about, VOIDS))
            found |= {row["id"]: row for row in rows}
        found |= {row["id"]: row for row in _set_ups(source, device, (boot, before.monotonic_ns))}
    return [
        DeviceEvent(row["device"], source.stamp(row), EventKind(row["kind"]), row["text"], row["code"])
        # Frames that were read together share a stamp.
        for row in sorted(found.values(), key=lambda row: (row["boot_id"], row["monotonic_ns"], row["id"]))
    ]


def _set_ups(source: Connection | Reader, device: str, before: tuple[int, int]) -> list[dict[str, Any]]:
    """Return the rows of a node's last set-ups before an instant, given as its boot and its monotonic time."""
    of_node, failed = "text LIKE '% (node %'", "code IS NULL"  # a station is configured, too
    rows = list(source.rows(_LAST_OF_SET_UPS.format(of_node), (device, EventKind.CONFIGURED.value, *before, 0, 0)))
    since = (rows[0]["boot_id"], rows[0]["monotonic_ns"]) if rows else (0, 0)
    jumped = (device, EventKind.PRESET_JUMP.value, *before, *since, EXCHANGED)
    rows += source.rows(_LAST_OF_SET_UPS.format("text LIKE '%' || ? || '%'"), jumped)
    about = (device, EventKind.ALARM.value, *before, *since)
    if last := list(source.rows(_LAST_OF_SET_UPS.format(failed), about)):  # else a second search is in vain, too
        rows += last
        rows += source.rows(_LAST_OF_SET_UPS.format(f"{failed} AND text LIKE '%' || ?"), (*about, NOT_USED))
    return rows
