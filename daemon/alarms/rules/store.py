"""The store and its disk."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence

_GB = 1_000_000_000


@rule("critical", "Free space on the disk, or check it; captures wait in memory meanwhile.", hold_s=5.0)
def not_storing(evidence: Evidence) -> Iterator[Finding]:
    """Nothing can be written to the store. Cleared 5 s after it can again."""
    if evidence.acquisition.error is not None:
        yield "store", evidence.acquisition.error


@rule("critical", "Stop rigcal, keep the file, and restore the store from a backup.")
def store_unsound(evidence: Evidence) -> Iterator[Finding]:
    """The file of the store is damaged, was replaced, or is gone."""
    if evidence.store.fault:
        yield "store", evidence.store.fault


@rule("warning", "Free space on the disk of the store.", hold_s=60.0)
def disk_nearly_full(evidence: Evidence) -> Iterator[Finding]:
    """Less than 2 GB are free on the disk of the store; critical below 200 MB. Cleared after a minute with more."""
    free = evidence.store.free_bytes
    if free is not None and free < 2 * _GB:
        least = "200 MB" if free < _GB // 5 else "2 GB"
        yield "store", f"less than {least} are free on the disk", "critical" if free < _GB // 5 else "warning"
