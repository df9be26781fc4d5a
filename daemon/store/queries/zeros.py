"""Zeros of joints over time: an encoder that jumps has another one, until an operator says that it is as before.

Between two jumps of an encoder its zero is one and the same. An operator's word about the live model says that the zero
is the one with which that model was trained: what lies between may have had a third one.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

from daemon.store.connection import Connection
from drivers.clock import Stamp

# A boot's number rises from boot to boot, and monotonic_ns within one; utc_ns may step.
_JUMPS = """SELECT id, device, utc_ns, monotonic_ns, boot_id FROM device_events
    WHERE kind = 'preset_jump' AND (boot_id, monotonic_ns) >= (?, ?) ORDER BY boot_id, monotonic_ns, id"""
# Each word with the start of the newest session that the model was trained on: after a jump in it nothing is used.
_WORDS = """SELECT state.zeros_checked_through AS through, max(session.rowid) AS newest,
        session.started_boot_id AS boot_id, session.started_monotonic_ns AS monotonic_ns
    FROM model_states AS state JOIN models AS model ON model.id = state.model_id
        JOIN jobs AS job ON job.id = model.job_id JOIN json_each(job.result_json, '$.sessions') AS trained
        JOIN calibration_sessions AS session ON session.id = trained.value
    WHERE model.rig = ? AND state.zeros_checked_through IS NOT NULL GROUP BY state.id ORDER BY state.id"""


@dataclass(frozen=True)
class Jump:
    """A joint's encoder that has jumped by more than the joint can move.

    Attributes:
        number: of the device event.
        device: name of the joint.
        at: when.
    """

    number: int
    device: str
    at: Stamp


def preset_jumps(store: Connection, since: Stamp | None) -> list[Jump]:
    """Return the encoder jumps from an instant on, from the first one on where it is None, in their order."""
    rows = store.rows(_JUMPS, (0, 0) if since is None else store.order(since))
    return [Jump(row["id"], row["device"], store.stamp(row)) for row in rows]


def lost_zeros(store: Connection, rig_name: str, since: Stamp | None) -> dict[str, int]:
    """Return the devices that have another zero now than at an instant, as far as jumps and operators' words tell.

    Args:
        store: the database.
        rig_name: whose models operators have given their word about.
        since: the instant; before the first jump when None.

    Returns:
        device -> number of its newest jump among the store's device events.
    """
    if not preset_jumps(store, since):  # as nearly always
        return {}
    first = (0, 0) if since is None else store.order(since)
    words = [(row["through"], (row["boot_id"], row["monotonic_ns"])) for row in store.rows(_WORDS, (rig_name,))]
    by_device: dict[str, list[Jump]] = {}
    for jump in preset_jumps(store, None):
        by_device.setdefault(jump.device, []).append(jump)
    lost: dict[str, int] = {}
    for device, jumps in sorted(by_device.items()):
        instants = [store.order(jump.at) for jump in jumps]
        zeros = list(range(len(jumps) + 1))  # of the stretches between jumps; equal numbers are the same zero
        for through, trained_at in words:
            trained = bisect_left(instants, trained_at)
            checked = max((n for n, jump in enumerate(jumps, 1) if jump.number <= through), default=0)
            if checked > trained:
                zeros = [zeros[trained] if zero == zeros[checked] else zero for zero in zeros]
        if zeros[bisect_left(instants, first)] != zeros[-1]:
            lost[device] = max(jump.number for jump in jumps)
    return lost
