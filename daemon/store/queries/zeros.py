"""Zeros of joints over time: an encoder that jumps has a new zero, until an operator confirms that it is as before.

Between two jumps of an encoder its zero does not change. An operator's confirmation for the live model states that the
zero is the one with which that model was trained; in between, the encoder may have had yet another zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from daemon.store.connection import Connection
from drivers.clock import Stamp

# The number of the boot increases from boot to boot, and monotonic_ns within a boot; utc_ns may step.
_JUMPS = """SELECT id, device, utc_ns, monotonic_ns, boot_id FROM device_events
    WHERE kind = 'preset_jump' AND (boot_id, monotonic_ns) >= (?, ?) ORDER BY boot_id, monotonic_ns, id"""
_JUMPED_SINCE = """SELECT device, max(id) AS number FROM device_events
    WHERE kind = 'preset_jump' AND (boot_id, monotonic_ns) >= (?, ?) GROUP BY device ORDER BY device"""
_LAST = """SELECT boot_id, monotonic_ns, id FROM device_events
    WHERE kind = 'preset_jump' AND device = ? AND (boot_id, monotonic_ns) < (?, ?) AND id <= ?
    ORDER BY boot_id DESC, monotonic_ns DESC, id DESC LIMIT 1"""
# Each confirmation with the start of the newest session on which the model was trained; after a jump in that session
# nothing is used.
_WORDS = """SELECT state.zeros_checked_through AS through, max(session.rowid) AS newest,
        session.started_boot_id AS boot_id, session.started_monotonic_ns AS monotonic_ns
    FROM model_states AS state JOIN models AS model ON model.id = state.model_id
        JOIN jobs AS job ON job.id = model.job_id JOIN json_each(job.result_json, '$.sessions') AS trained
        JOIN calibration_sessions AS session ON session.id = trained.value
    WHERE model.rig = ? AND state.zeros_checked_through IS NOT NULL GROUP BY state.id"""
_END = 2**63 - 1  # greater than every instant and every number

_Stretch = tuple[int, int, int]
"""The time from a jump to the next one, identified by its first jump."""


@dataclass(frozen=True)
class Jump:
    """A jump of a joint's encoder by more than the joint can move.

    Attributes:
        number: number of the device event.
        device: name of the joint.
        at: instant of the jump.
    """

    number: int
    device: str
    at: Stamp


def preset_jumps(store: Connection, since: Stamp | None) -> list[Jump]:
    """Return the encoder jumps from an instant on, in order; all jumps if it is None."""
    rows = store.rows(_JUMPS, (0, 0) if since is None else store.order(since))
    return [Jump(row["id"], row["device"], store.stamp(row)) for row in rows]


def lost_zeros(store: Connection, rig_name: str, since: Stamp | None) -> dict[str, int]:
    """Return the devices whose zero now differs from that at an instant, by jumps and operators' confirmations.

    Args:
        store: the database.
        rig_name: name of the rig, whose models the confirmations concern.
        since: the instant; None for before the first jump.

    Returns:
        Device -> number of its newest jump among the store's device events.
    """
    first = (0, 0) if since is None else store.order(since)
    jumped = {row["device"]: row["number"] for row in store.rows(_JUMPED_SINCE, first)}
    words = store.rows(_WORDS, (rig_name,)) if jumped else []
    return {name: number for name, number in jumped.items() if not words or not _is_checked(store, name, first, words)}


def _is_checked(store: Connection, device: str, first: tuple[int, int], words: Sequence[Mapping[str, int]]) -> bool:
    """Return True if operators' confirmations, taken together, show that the zero at an instant is the present one."""
    same: list[set[_Stretch]] = []
    for word in words:
        trained = _stretch(store, device, (word["boot_id"], word["monotonic_ns"]))
        checked = _stretch(store, device, through=word["through"])
        if checked > trained:  # otherwise it had not jumped
            same.append({trained, checked})
    alike = {_stretch(store, device)}
    while more := [pair for pair in same if pair & alike and not pair <= alike]:
        alike = alike.union(*more)
    return _stretch(store, device, first) in alike


def _stretch(store: Connection, device: str, before: tuple[int, int] = (_END, _END), through: int = _END) -> _Stretch:
    """Return a device's stretch at an instant, among jumps up to the event number `through`."""
    rows = store.rows(_LAST, (device, *before, through))
    return (rows[0]["boot_id"], rows[0]["monotonic_ns"], rows[0]["id"]) if rows else (0, 0, 0)
