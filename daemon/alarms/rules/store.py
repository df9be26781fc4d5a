"""The store and its disk."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from daemon.monitoring.notice import Severity
from drivers.clock import NS_PER_S

CRITICAL_BYTES = 200 * 2**20
OVERDUE_NS = 3 * 86_400 * NS_PER_S


@rule(
    "critical",
    "Free space on a full disk, end the program that locks the store, or check the disk, as the alarm says. Until then "
    "captures are held in memory.",
    hold_s=5.0,
)
def not_storing(evidence: Evidence) -> Iterator[Finding]:
    """Nothing can be written to the store.

    Captures are decoded only after they are stored, so silence of links, channels and stations raises no alarms
    meanwhile. Cleared 5 s after the store can be written again.
    """
    if evidence.acquisition.error is not None:
        yield "store", evidence.acquisition.error


@rule(
    "critical",
    "Check the disk of the store and its cable. Captures wait in memory until the disk answers.",
    after_s=1.0,
    hold_s=5.0,
)
def store_hangs(evidence: Evidence) -> Iterator[Finding]:
    """A write to the store has not ended for 4 s: its disk does not answer, or the computer is too busy.

    Captures wait in memory and are stored when the write ends. If it does not end, the watchdog restarts rigcal. Silent
    links, channels and stations raise no alarms meanwhile. Cleared 5 s after the write has ended.
    """
    if evidence.acquisition.is_write_hung and evidence.acquisition.error is None:
        yield "store", "a write to the store does not end"


@rule(
    "critical",
    "If the store is damaged, stop rigcal and restore a backup (`rigcal store restore`). If a file is gone or was "
    "replaced, save it as the alarm text says before you stop rigcal: it is lost for good when rigcal stops.",
)
def store_unsound(evidence: Evidence) -> Iterator[Finding]:
    """The store is damaged, or one of its files was replaced or is missing."""
    if evidence.store is not None and evidence.store.is_unsound:
        yield "store", evidence.store.text


@rule(
    "critical",
    "Stop rigcal and restore the store from a backup. If the new store is intended, move the old models away.",
)
def store_new(evidence: Evidence) -> Iterator[Finding]:
    """The store is new, but models lie beside it.

    The store to which these models belong was deleted or moved, together with its sessions, set-ups and live model.
    Cleared with the first job of the new store, or when the models are moved away.
    """
    if evidence.is_store_new:
        yield "store", "the store is new and empty, but models of an earlier store lie beside it"


@rule(
    "warning",
    "Free space on the disk of the store, or move the state directory to a larger disk as docs/how-to/store.md "
    "describes.",
)
def store_short_of_room(evidence: Evidence) -> Iterator[Finding]:
    """The store has less space to grow than `free_gb`, so the oldest captures outside sessions are deleted.

    Free space on the disk and in the store's own file is counted. Critical when nothing more may be deleted.
    Cleared when there is enough space again.
    """
    keeping = evidence.keeping
    if not keeping.is_short:
        return
    if keeping.has_nothing_left:
        yield (
            "store",
            "little space is left, and nothing more may be deleted: only sessions and the last hour remain",
            "critical",
        )
    else:
        yield "store", "little space is left, so the oldest captures outside sessions are deleted"


@rule("warning", "Check the disk of the backups; `rigcal store backup` makes a backup now and shows what is wrong.")
def backup_overdue(evidence: Evidence) -> Iterator[Finding]:
    """The last backup failed or has run for 6 hours, or the newest backup is older than 3 days.

    Cleared by the next successful backup.

    Raised only where `backup_directory` is configured.
    """
    keeping = evidence.keeping
    if not keeping.has_backups:
        return
    if keeping.backup_error:
        yield "backup", f"the backup failed: {keeping.backup_error}"
    elif keeping.newest_backup_utc_ns is not None and evidence.now.utc_ns - keeping.newest_backup_utc_ns > OVERDUE_NS:
        yield "backup", "the newest backup is older than 3 days"


@rule(
    "warning",
    "End the process that the alarm names, or close the query that it has left open: a program that watches the store "
    "should open it anew for each query. Where space is short, free as much as the alarm says.",
    after_s=30.0,
    hold_s=60.0,
)
def store_log_grows(evidence: Evidence) -> Iterator[Finding]:
    """Another program has been reading the store for so long that its log (`-wal`) is larger than 256 MiB.

    SQLite cannot empty the log while a transaction or a cursor is left open, so it takes up all the disk in time.
    Deletion of old captures would give no space back, and does not begin. Critical once less space is free than the log
    takes: its pages are first written to the database, which may grow by as much. Cleared a minute after the log can
    be emptied, or is shorter.
    """
    if (store := evidence.store) is not None and store.log_fault:
        severity: Severity = "critical" if store.is_log_stuck else "warning"
        yield "store", f"the store's log grows and cannot be emptied: {store.log_fault}", severity


@rule("warning", "Free space on the disk of the store.", hold_s=60.0)
def disk_nearly_full(evidence: Evidence) -> Iterator[Finding]:
    """Little of the store's disk is free: less than 1 GiB, or less than both 5 % and 10 GiB.

    Critical below 200 MiB. Cleared after a minute with more free space.
    """
    store = evidence.store
    if store is None:
        return
    if store.free_bytes is not None and store.free_bytes < CRITICAL_BYTES:
        yield "store", "less than 200 MiB are free on the disk", "critical"
    elif store.is_low:
        yield "store", "the disk is nearly full"
