"""The store and its disk."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence

CRITICAL_BYTES = 200 * 2**20


@rule("critical", "Free space on the disk, or check it; captures wait in memory meanwhile.", hold_s=5.0)
def not_storing(evidence: Evidence) -> Iterator[Finding]:
    """Nothing can be written to the store.

    What comes is decoded only when it is stored, so silence of links, channels and stations raises no alarms
    meanwhile. Cleared 5 s after it can be written again.
    """
    if evidence.acquisition.error is not None:
        yield "store", evidence.acquisition.error


@rule("critical", "Do what the alarm says before you stop rigcal: a deleted file is lost for good when rigcal stops.")
def store_unsound(evidence: Evidence) -> Iterator[Finding]:
    """The store is damaged, or a file of it was replaced or is gone."""
    if evidence.store is not None and evidence.store.is_unsound:
        yield "store", evidence.store.text


@rule("critical", "Stop rigcal and restore the store from a backup; if a new one is meant, move the old models away.")
def store_new(evidence: Evidence) -> Iterator[Finding]:
    """The store is new, but models lie beside it.

    The store that they came from was deleted or moved, and with it its sessions, set-ups and live model. Cleared
    with the first job of the new store, or when the models are moved away.
    """
    if evidence.is_store_new:
        yield "store", "the store is new and empty, but models of an earlier one lie beside it"


@rule("warning", "Free space on the disk of the store.", hold_s=60.0)
def disk_nearly_full(evidence: Evidence) -> Iterator[Finding]:
    """Little of the store's disk is free: less than 1 GiB, or less than 5 % and 10 GiB.

    Critical below 200 MiB. Cleared after a minute with more.
    """
    store = evidence.store
    if store is None:
        return
    if store.free_bytes is not None and store.free_bytes < CRITICAL_BYTES:
        yield "store", "less than 200 MiB are free on the disk", "critical"
    elif store.is_low:
        yield "store", "the disk is nearly full"
