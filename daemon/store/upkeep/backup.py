"""Backups of a store and its models: made while the daemon writes, verified, rotated and restored.

A backup is a directory, `rigcal-<UTC>`: `rigcal.sqlite`, `models/`, and `backup.json`, which is written last. A backup
without `backup.json` was never finished. A directory may contain backups of several stores, such as another rig's or
an earlier one. Stores are distinguished by their first boot.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from daemon.host.safe_output import write_file
from daemon.store.errors import StoreError, storage_errors
from daemon.store.files import BESIDE, RestoreNote, WriterLock, restore_note_path
from daemon.store.queries.sessions import OPEN_IN_BACKUP
from daemon.store.upkeep.soundness import Soundness, check_store
from daemon.version import VERSION

STORE, MODELS, ABOUT = "rigcal.sqlite", "models", "backup.json"
FORM = 1
RESERVE_BYTES = 256 * 2**20  # free space to leave where a backup is written
STEP_PAGES = 4096
# After the backup was made there may have been more fixes, and other sessions, so present fixes may not belong to the
# session that was open in the backup.
CLOSE_OPEN_SESSIONS = f"""UPDATE calibration_sessions AS s SET state = 'closed',
        (ended_utc_ns, ended_monotonic_ns, ended_boot_id) = (SELECT * FROM (
            SELECT alive_utc_ns, alive_monotonic_ns, alive_boot_id FROM daemon_runs
            UNION ALL SELECT s.started_utc_ns, s.started_monotonic_ns, s.started_boot_id)
            ORDER BY alive_boot_id DESC, alive_monotonic_ns DESC LIMIT 1),
        excluded = '{OPEN_IN_BACKUP} from which the store was restored'
    WHERE state = 'open'"""
_FIRST_BOOT = "SELECT kernel_boot_id, booted_utc_ns FROM boots ORDER BY id LIMIT 1"
_NAME = re.compile(r"rigcal-\d{8}T\d{6}Z")
_UNFINISHED = ".unfinished"
_ABOUT_MOST = 1 << 16  # most characters read of backup.json, which has about a hundred

GoOn = Callable[[], None]


@dataclass(frozen=True)
class Backup:
    """A finished backup.

    Attributes:
        path: its directory.
        made_utc_ns: when it was begun.
        size_bytes: size of its files.
        rigcal: version of the rigcal that made it.
    """

    path: Path
    made_utc_ns: int
    size_bytes: int
    rigcal: str


def backups(directory: Path) -> list[Backup]:
    """Return the finished backups in a directory, oldest first; none if there is no such directory."""
    found = []
    for path in sorted(directory.glob("rigcal-*")) if directory.is_dir() else ():
        if _NAME.fullmatch(path.name):
            with contextlib.suppress(StoreError):
                found.append(read_backup(path))
    return found


def read_backup(path: Path) -> Backup:
    """Read the description of a backup.

    Raises:
        StoreError: the directory is not a backup, was never finished, or has a newer format.
    """
    try:
        with (path / ABOUT).open(encoding="utf-8") as file:
            about = json.loads(file.read(_ABOUT_MOST))
        form, made_utc_ns, size_bytes = (_count(about[name]) for name in ("form", "made_utc_ns", "size_bytes"))
        backup = Backup(path, made_utc_ns, size_bytes, f"{about['rigcal']!s:.40}")
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        why = f"{ABOUT}: {error!s:.200}"
        raise StoreError(f"{path}: not a backup of rigcal, or one that was never finished ({why})") from error
    if form > FORM:
        raise StoreError(
            f"{path}: a backup of format {form}, made by rigcal {backup.rigcal!r}; install that version to use it"
        )
    if missing := [part for part in (STORE, MODELS) if not (path / part).exists()]:
        raise StoreError(f"{path}: an incomplete backup: {' and '.join(missing)} missing; use another backup")
    return backup


def _count(value: object) -> int:
    """Return a number of `backup.json`; raise ValueError for a value that no backup writes."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**63:
        raise ValueError(f"{value!r:.40} is not a count")
    return value


def make_backup(store: Path, models: Path, directory: Path, keep: int, now_utc_ns: int, go_on: GoOn) -> Backup:
    """Copy a store and its models, verify the copy, and delete the oldest backups of this store.

    Args:
        store: the database; the daemon may write to it, and what it has committed is copied.
        models: directory of the models.
        directory: directory of the backups; created if needed.
        keep: how many backups of this store are kept, including this one.
        now_utc_ns: instant after which the backup is named.
        go_on: called repeatedly; an exception that it raises ends the work and leaves no backup.

    Raises:
        StoreError: there is not enough space, the file system refuses, the copy is not sound, or another backup is
            being made there; earlier backups are kept.
    """
    name = f"rigcal-{_named(now_utc_ns)}"
    target, scratch = directory / name, directory / f".{name}{_UNFINISHED}"
    if directory.resolve().is_relative_to(models.resolve()):
        raise StoreError(f"{directory} is inside the models' directory and would be part of every backup: name another")
    with storage_errors(directory):
        directory.mkdir(parents=True, exist_ok=True)
        with _alone_in(directory):
            for left in directory.glob(f".rigcal-*{_UNFINISHED}"):  # left by a killed process
                shutil.rmtree(left)
            if target.exists():
                raise StoreError(f"{target} exists already: a backup was made within the last second; try again")
            _require_room(directory, _size(store) + _size(models))
            scratch.mkdir()
            try:
                _copy_store(store, scratch / STORE, go_on)
                _copy_models(models, scratch / MODELS, go_on)
                _require_sound(check_store(scratch / STORE, scratch / MODELS, go_on), scratch / STORE)
                size = _size(scratch)
                about = {
                    "form": FORM,
                    "made_utc_ns": now_utc_ns,
                    "size_bytes": size,
                    "rigcal": VERSION,
                }
                write_file(scratch / ABOUT, json.dumps(about).encode() + b"\n")
                _sync_tree(scratch)
                scratch.rename(target)
            except BaseException:
                shutil.rmtree(scratch, ignore_errors=True)
                raise
            _sync(directory)
            _forget_oldest(directory, target, keep)
    return read_backup(target)


@contextlib.contextmanager
def _alone_in(directory: Path) -> Iterator[None]:
    """Lock a directory against a second backup, which would delete this unfinished one as left by a killed process."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a network file system may not support such locks
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(f"{directory}: another backup is being made there; wait for its end") from None
        yield
    finally:
        os.close(descriptor)


def _forget_oldest(directory: Path, newest: Path, keep: int) -> None:
    """Delete the oldest other backups of the store of `newest`, so that `keep` remain, whatever the clock showed."""
    own = _origin(newest)
    others = [made for made in backups(directory) if made.path != newest and _origin(made.path) == own]
    for old in others[: max(0, len(others) + 1 - keep)]:
        shutil.rmtree(old.path)


def _origin(backup: Path) -> tuple[str, int] | None:
    """Return id and time of the first boot in a backup's store; None if the store cannot be read.

    The time distinguishes two stores created in the same boot, because each store computes it anew, to the nanosecond.
    """
    uri = f"{(backup / STORE).resolve().as_uri()}?mode=ro"
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(uri, uri=True)) as db:
        first: tuple[str, int] | None = db.execute(_FIRST_BOOT).fetchone()
        return first
    return None


def restore_backup(backup: Path, store: Path, models: Path, now_utc_ns: int, go_on: GoOn) -> Path | None:
    """Replace a store and its models by a backup; the replaced files are kept beside the store.

    A session that was open when the backup was made is closed, and is used only if an operator accepts it.

    An interrupted earlier restore is completed: files that it moved aside stay there, and files that it put in place
    are overwritten.

    Args:
        backup: directory of the backup.
        store: the database to replace or create.
        models: directory of the models, likewise.
        now_utc_ns: instant after which the directory of replaced files is named.
        go_on: as for `make_backup`.

    Returns:
        The directory with the replaced files; None if there were none.

    Raises:
        StoreBusyError: a daemon uses the store.
        StoreError: the backup is damaged or was made by a newer rigcal, the store is a symbolic link, or the file
            system refuses; nothing has changed.
    """
    if store.is_symlink():
        raise StoreError(
            f"{store} is a link to {store.resolve()}, and a restore would replace the link by a file: remove the link "
            "and restore, or set `state_directory` of the configuration to the directory to which it leads"
        )
    read_backup(backup)
    with storage_errors(store):
        store.parent.mkdir(parents=True, exist_ok=True)
    lock = WriterLock(store)
    try:
        with storage_errors(store):
            _require_sound(check_store(backup / STORE, backup / MODELS, go_on), backup / STORE)
            _require_room(store.parent, _size(backup))
            scratch = store.parent / f".rigcal-restore{_UNFINISHED}"
            _make_writable(scratch)
            shutil.rmtree(scratch, ignore_errors=True)
            try:
                shutil.copytree(backup, scratch)
                _make_writable(scratch)
                _close_open_sessions(scratch / STORE)
                _give_to_owner_of(store.parent, scratch)
                _sync_tree(scratch)
                aside = _exchange(backup, scratch, store, models, f"replaced-{_named(now_utc_ns)}")
            finally:
                shutil.rmtree(scratch, ignore_errors=True)
    finally:
        lock.release()
    return aside


def _make_writable(directory: Path) -> None:
    """Make a directory and its contents writable for the owner; it may be the copy of a read-only backup."""
    for path in (directory, *directory.rglob("*")) if directory.exists() else ():
        if not path.is_symlink():
            path.chmod(path.stat().st_mode | (0o700 if path.is_dir() else 0o600))


def _close_open_sessions(store: Path) -> None:
    with contextlib.closing(sqlite3.connect(store)) as db, db:
        db.execute(CLOSE_OPEN_SESSIONS)


def _exchange(backup: Path, scratch: Path, store: Path, models: Path, name: str) -> Path | None:
    """Move a store and its models aside and a copy of the backup into their place; a note exists during the renames.

    Returns:
        The directory with the replaced files, called `name` if this is free; None if there were none.
    """
    parts = {path.name: path for path in _files_of(store)} | {MODELS: models}
    begun = RestoreNote.of(store)
    note = begun
    if note is None:
        replaced = tuple(part for part, path in parts.items() if path.exists())
        note = RestoreNote(str(backup.absolute()), _new_name(store.parent, name).name, replaced)
        note.write(store)
        _sync(store.parent)
    aside = store.parent / note.aside
    left = [part for part in note.replaced if not (aside / part).exists() and parts[part].exists()]
    for part, path in parts.items():
        if part not in left:
            _remove(path)  # put there by the interrupted restore
    moves = [(parts[part], aside / part) for part in left]
    try:
        _move_all([*moves, (scratch / STORE, store), (scratch / MODELS, models)])
    except OSError:
        if begun is None:
            restore_note_path(store).unlink()
        raise
    _sync(store.parent)
    restore_note_path(store).unlink()
    _sync(store.parent)
    return aside if note.replaced else None


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _named(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // 10**9, UTC):%Y%m%dT%H%M%SZ}"


def _new_name(directory: Path, name: str) -> Path:
    """Return an unused path, so that files replaced within the same second are not overwritten."""
    paths = (directory / f"{name}{'' if not n else f'-{n}'}" for n in itertools.count())
    return next(path for path in paths if not path.exists())


def _give_to_owner_of(directory: Path, tree: Path) -> None:
    """Give files written by root to the owner of their directory, so that the service can write to them."""
    if os.geteuid() == 0:
        owner = directory.stat()
        for path in (tree, *tree.rglob("*")):
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


def _files_of(store: Path) -> list[Path]:
    return [store.with_name(store.name + suffix) for suffix in BESIDE]


def _move_all(moves: list[tuple[Path, Path]]) -> None:
    """Rename files and directories in order; if one rename fails, undo the others."""
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            target.parent.mkdir(parents=True, exist_ok=True)
            source.rename(target)
            done.append((source, target))
    except OSError:
        for source, target in reversed(done):
            target.rename(source)
        raise


def _copy_store(store: Path, copy: Path, go_on: GoOn) -> None:
    if not store.is_file():
        raise StoreError(f"{store}: there is no store")
    with (
        contextlib.closing(sqlite3.connect(f"{store.resolve().as_uri()}?mode=ro", uri=True)) as source,
        contextlib.closing(sqlite3.connect(copy)) as target,
    ):
        # Within one read transaction, commits of the daemon do not restart the copy.
        source.isolation_level = None
        source.execute("BEGIN")
        source.execute("SELECT count(*) FROM boots").fetchone()
        source.backup(target, pages=STEP_PAGES, progress=lambda *_: go_on(), sleep=0.0)
        # A single file that can be read without companion files.
        target.execute("PRAGMA journal_mode = DELETE")


def _copy_models(models: Path, copy: Path, go_on: GoOn) -> None:
    """Copy all models; a directory whose name begins with a dot is still being written and is skipped."""
    copy.mkdir()
    for directory in sorted(models.iterdir()) if models.is_dir() else ():
        if directory.is_dir() and not directory.name.startswith("."):
            go_on()
            shutil.copytree(directory, copy / directory.name)


def _require_sound(found: Soundness, path: Path) -> None:
    if found.findings:
        raise StoreError(f"{path}: damaged, so it is not used: {'; '.join(found.findings)}")


def _require_room(directory: Path, needed_bytes: int) -> None:
    free_bytes = shutil.disk_usage(directory).free
    if free_bytes < needed_bytes + RESERVE_BYTES:
        raise StoreError(
            f"{directory}: {free_bytes / 2**20:.0f} MiB are free, but {(needed_bytes + RESERVE_BYTES) / 2**20:.0f} MiB "
            "are needed: free space there, or name a directory on a different disk"
        )


def _size(path: Path) -> int:
    """Return the size of a file, or of all files in a directory, in bytes; 0 if there is none."""
    return sum(file.stat().st_size for file in _walk(path))


def _walk(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    elif path.is_dir():
        yield from (file for file in path.rglob("*") if file.is_file())


def _sync_tree(path: Path) -> None:
    for file in (path, *path.rglob("*")):
        _sync(file)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
