"""The last reports of CANopen devices on their own state: emergencies, alarms, boot-ups, heartbeats."""

from __future__ import annotations

from typing import Any

from daemon.store.connection import Connection
from daemon.store.reader import Reader
from drivers.canopen.supervision import VOIDS
from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind

STATES = (
    EventKind.ALARM,
    EventKind.BOOT_UP,
    EventKind.EMERGENCY,
    EventKind.EMERGENCY_CLEARED,
    EventKind.HEARTBEAT_LOST,
    EventKind.HEARTBEAT_RESTORED,
    EventKind.WARNING,
)
# Goes from one device to the next by the index, however many events each device has.
_DEVICES = """WITH RECURSIVE named(device) AS (
        SELECT min(device) FROM device_events
        UNION ALL SELECT (SELECT min(device) FROM device_events WHERE device > named.device)
            FROM named WHERE named.device IS NOT NULL)
    SELECT device FROM named WHERE device IS NOT NULL"""
_LAST = """SELECT id, utc_ns, monotonic_ns, boot_id, device, kind, text, code FROM device_events
    WHERE device = ? AND kind = ? AND boot_id = ? AND monotonic_ns < ? AND {}
    ORDER BY monotonic_ns DESC, id DESC LIMIT 1"""


def device_states(source: Connection | Reader, before: Stamp) -> list[DeviceEvent]:
    """Return the last event of each device and kind before an instant, in its boot, oldest first.

    For emergencies both the last one and the last one that voids values are returned. Events that were not sent by the
    devices themselves, such as that of a failed set-up, have no code and are left out.

    Args:
        source: the store.
        before: the instant.
    """
    boots = list(source.rows("SELECT id FROM boots WHERE kernel_boot_id = ?", [before.boot_id]))
    if not boots:
        return []
    found: dict[int, dict[str, Any]] = {}
    for device in [row["device"] for row in source.rows(_DEVICES)]:
        for kind in STATES:
            about = (device, kind.value, boots[0]["id"], before.monotonic_ns)
            sent = "code IS NOT NULL" if kind in (EventKind.ALARM, EventKind.WARNING) else "TRUE"
            rows = list(source.rows(_LAST.format(sent), about))
            if kind is EventKind.EMERGENCY:
                rows += source.rows(_LAST.format("text LIKE '%' || ?"), (*about, VOIDS))
            found |= {row["id"]: row for row in rows}
    return [
        DeviceEvent(row["device"], source.stamp(row), EventKind(row["kind"]), row["text"], row["code"])
        # Frames that were read together share a stamp.
        for row in sorted(found.values(), key=lambda row: (row["monotonic_ns"], row["id"]))
    ]
