"""Zeros of joints over time: an encoder that jumps has a new zero, until an operator confirms that it is as before.

Between two jumps of an encoder its zero does not change. An operator's confirmation for the live model states that the
zero is the one with which that model was trained; in between, the encoder may have had yet another zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from daemon.store.connection import Connection
from daemon.store.queries.device_states import NAMED
from drivers.clock import Stamp

# The number of the boot increases from boot to boot, and monotonic_ns within a boot; utc_ns may step. A faulty encoder
# may jump at every frame: the index leads from one device to the next, and to the one jump of each that is read.
_JUMPS = f"""{NAMED}
    SELECT jump.id, jump.device, jump.utc_ns, jump.monotonic_ns, jump.boot_id
    FROM named CROSS JOIN device_events AS jump ON jump.id = (SELECT id FROM device_events AS own
        WHERE own.device = named.device AND kind = 'preset_jump' AND (boot_id, monotonic_ns) >= (?, ?)
        ORDER BY boot_id {{0}}, monotonic_ns {{0}}, id {{0}} LIMIT 1)
    ORDER BY jump.device"""
_LAST = """SELECT boot_id, monotonic_ns, id FROM device_events
    WHERE device = ? AND kind = 'preset_jump' AND (boot_id, monotonic_ns) < (?, ?) AND id <= ?
    ORDER BY boot_id DESC, monotonic_ns DESC, id DESC LIMIT 1"""
# Each confirmation with the start of the newest session on which the model was trained; after a jump in that session
# nothing is used.
_WORDS = """SELECT state.zeros_checked_through AS through, state.boot_id AS said_boot_id,
        state.monotonic_ns AS said_monotonic_ns, max(session.rowid) AS newest,
        session.started_boot_id AS boot_id, session.started_monotonic_ns AS monotonic_ns
    FROM model_states AS state JOIN models AS model ON model.id = state.model_id
        JOIN jobs AS job ON job.id = model.job_id JOIN json_each(job.result_json, '$.sessions') AS trained
        JOIN calibration_sessions AS session ON session.id = trained.value
    WHERE model.rig = ? AND state.zeros_checked_through IS NOT NULL GROUP BY state.id"""
_MOST = 2**63 - 1  # greater than every number of an event

_Stretch = tuple[int, int, int]
"""The time from a jump to the next one, identified by its first jump: boot, monotonic time and number of the event."""


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


def first_jumps(store: Connection, since: Stamp) -> list[Jump]:
    """Return the first jump of each device whose encoder has jumped since an instant."""
    return [_jump(store, row) for row in store.rows(_JUMPS.format("ASC"), store.order(since))]


def newest_jumps(store: Connection, since: Stamp | None = None) -> list[Jump]:
    """Return the newest jump of each device whose encoder has jumped since an instant; None for ever."""
    first = (0, 0) if since is None else store.order(since)
    return [_jump(store, row) for row in store.rows(_JUMPS.format("DESC"), first)]


def _jump(store: Connection, row: dict[str, Any]) -> Jump:
    return Jump(row["id"], row["device"], store.stamp(row))


class Zeros:
    """The devices' present zeros, by the jumps and operators' confirmations that are stored when it is made.

    Args:
        store: the database.
        rig_name: name of the rig, whose models the confirmations concern.
    """

    def __init__(self, store: Connection, rig_name: str) -> None:
        self._store, self._rig = store, rig_name
        self._present: dict[str, _Stretch] = {
            jump.device: (*store.order(jump.at), jump.number) for jump in newest_jumps(store)
        }
        self._alike: dict[str, set[_Stretch]] = {}

    def lost(self, since: Stamp | None) -> dict[str, int]:
        """Return the devices whose present zero is not known to be that of an instant.

        Args:
            since: the instant; None for before the first jump.

        Returns:
            Device -> number of its newest jump among the store's device events.
        """
        first = (0, 0) if since is None else self._store.order(since)
        jumped = {device: newest for device, newest in self._present.items() if newest[:2] >= first}
        return {device: newest[2] for device, newest in jumped.items() if not self._is_checked(device, first)}

    def _is_checked(self, device: str, first: tuple[int, int]) -> bool:
        """Return True if confirmations show that the zero of a device that has jumped since an instant is as before."""
        if device not in self._alike:
            self._alike[device] = self._alike_present(device)
        alike = self._alike[device]
        return len(alike) > 1 and self._stretch(device, first) in alike

    def _alike_present(self, device: str) -> set[_Stretch]:
        """Return the stretches that have a device's present zero, by operators' confirmations taken together."""
        same: list[set[_Stretch]] = []
        for word in self._words:
            trained = self._stretch(device, (word["boot_id"], word["monotonic_ns"]))
            # All jumps known then were before the confirmation; so later ones, which may be many, need not be read.
            said = word["said_boot_id"], word["said_monotonic_ns"] + 1
            checked = self._stretch(device, said, word["through"])
            if checked > trained:  # otherwise it had not jumped
                same.append({trained, checked})
        alike = {self._present[device]}
        while more := [pair for pair in same if pair & alike and not pair <= alike]:
            alike = alike.union(*more)
        return alike

    def _stretch(self, device: str, before: tuple[int, int], through: int = _MOST) -> _Stretch:
        """Return a device's stretch just before an instant, among jumps up to the event number `through`."""
        rows = self._store.rows(_LAST, (device, *before, through))
        return (rows[0]["boot_id"], rows[0]["monotonic_ns"], rows[0]["id"]) if rows else (0, 0, 0)

    @cached_property
    def _words(self) -> list[dict[str, Any]]:
        return self._store.rows(_WORDS, (self._rig,))
