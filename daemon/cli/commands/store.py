"""`rigcal store`: contents, integrity, backups and pruning of the store."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from calibration.rig.words import counted
from daemon.cli.client import config_option, utc
from daemon.cli.command import DONE, FAILED, Command, Delivered, json_option
from daemon.cli.terminal import echo, echo_error

if TYPE_CHECKING:
    from daemon.config.config import Config
    from daemon.store import Store

TIMEOUT_S = 86_400.0  # for deleting a year, or decoding a week again; Ctrl-C cancels
_MIB = 2**20


@click.group()
def store() -> None:
    """Check, back up, restore, prune and describe the store."""


@store.command(cls=Command, name="stats")
@click.option("--tables", is_flag=True, help="Also show the size of each table and index (reads the whole store).")
@config_option
@json_option
def store_stats(config: Path, *, tables: bool, as_json: bool) -> dict[str, Any]:
    """Show the size and the contents of the store."""
    from daemon.config.config import read_config
    from daemon.store.upkeep.statistics import statistics

    found = statistics(read_config(config).store_path, tables=tables)
    if not as_json:
        echo(f"{found['store']}: {_size(found['file_bytes'])}, of which {_size(found['free_inside_bytes'])} will be")
        echo(f"reused; {_size(found['disk_free_bytes'])} are free on its disk")
        if found["oldest_utc_ns"] is not None:
            echo(f"captures from {utc(found['oldest_utc_ns'])} to {utc(found['newest_utc_ns'])}")
        echo(f"{counted(found['chunks'], 'chunk')} of captures, {found['small_chunks']} of them waiting to be packed")
        held = f"{counted(found['sessions'], 'session')}, {counted(found['boots'], 'boot')}"
        echo(f"{found['undecoded_chunks']} waiting to be decoded; {held}")
        for name, size in (found.get("tables") or {}).items():
            echo(f"  {name:32} {size / _MIB:12.2f} MiB")
    return found


@store.command(cls=Command, name="describe")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="File; standard output by default.")
@config_option
@json_option
def store_describe(config: Path, out: Path | None, *, as_json: bool) -> dict[str, Any]:
    """Write a metadata.yaml for Datasette.

    It has titles, descriptions of columns, and queries.
    """
    from daemon.config.config import read_config
    from daemon.host.safe_output import write_file
    from daemon.store.describe.description import describe_store
    from daemon.store.describe.metadata import datasette_metadata

    path = read_config(config).store_path
    text = datasette_metadata(describe_store(path), path.stem)
    if out is not None:
        write_file(out, text.encode())
    if not as_json:
        echo(f"{out}: `datasette serve {path} -m {out}` shows the store" if out is not None else text)
    return {"store": str(path), "metadata": text} if out is None else {"store": str(path), "out": str(out)}


@store.command(cls=Command, name="check")
@click.option("--backup", type=click.Path(path_type=Path), help="Check this backup instead of the store.")
@config_option
@json_option
def store_check(config: Path, backup: Path | None, *, as_json: bool) -> Delivered:
    """Check the store and the live model for damage.

    The database and all chunks of captures are checked. The daemon may run in the meantime. The exit status is 1 if
    something is damaged.
    """
    from daemon.config.config import read_config
    from daemon.store.upkeep import backup as backup_module
    from daemon.store.upkeep.soundness import check_store

    settings = read_config(config)
    path, models = settings.store_path, settings.models_directory
    if backup is not None:
        backup_module.read_backup(backup)
        path, models = backup / backup_module.STORE, backup / backup_module.MODELS
    found = check_store(path, models)
    if not as_json:
        parts = [
            counted(found.captures, "capture"),
            counted(found.chunks, "chunk"),
            counted(found.models, "live model"),
        ]
        echo(f"{path}: checked {parts[0]} in {parts[1]}, {parts[2]}")
        for finding in found.findings:
            echo(f"  damaged: {finding}", fg="red")
        if not found.findings:
            echo("no damage found")
        elif backup is None:
            echo("restore the store from a backup: `rigcal store restore`")
        else:
            echo("do not restore this backup; make another one of the store: `rigcal store backup`")
    result = {
        "store": str(path),
        "is_sound": not found.findings,
        "findings": list(found.findings),
        "chunks": found.chunks,
        "captures": found.captures,
        "live_models": found.models,
    }
    return Delivered(result, FAILED if found.findings else DONE)


@store.command(cls=Command, name="backup")
@click.option(
    "--to", type=click.Path(file_okay=False, path_type=Path), help="Directory of backups; as configured by default."
)
@click.option("--keep", type=click.IntRange(1), help="Number of backups to keep there; as configured by default.")
@click.option("--list", "is_list", is_flag=True, help="List the backups without making one.")
@config_option
@json_option
def store_backup(config: Path, to: Path | None, keep: int | None, *, is_list: bool, as_json: bool) -> dict[str, Any]:
    """Make and verify a backup of store and models.

    Backups beyond the number to keep are deleted, the oldest first. The daemon may run in the meantime.
    """
    from daemon.config.config import read_config
    from daemon.store.upkeep.backup import backups, make_backup

    settings = read_config(config)
    directory = to or settings.store.backup_directory
    if directory is None:
        raise click.UsageError(
            "give the directory with --to, or set `backup_directory` in [store] of the configuration"
        )
    if not is_list:
        now_ns = _now_ns()
        made = make_backup(
            settings.store_path, settings.models_directory, directory, keep or settings.store.backups, now_ns, _go_on
        )
        if not as_json:
            echo(f"{made.path}: made and verified, {_size(made.size_bytes)}")
    found = backups(directory)
    if not as_json and is_list:
        for backup in found:
            echo(f"{backup.path}  {utc(backup.made_utc_ns)}  {_size(backup.size_bytes)}")
        if not found:
            echo(f"{directory}: no backups")
    listed = [
        {"path": str(b.path), "made_utc_ns": b.made_utc_ns, "size_bytes": b.size_bytes, "rigcal": b.rigcal}
        for b in found
    ]
    return {"backups": listed} if is_list else {"backup": str(made.path), "backups": listed}


@store.command(cls=Command, name="restore")
@click.argument("backup", type=click.Path(path_type=Path))
@config_option
@json_option
def store_restore(backup: Path, config: Path, *, as_json: bool) -> dict[str, Any]:
    """Restore store and models from a backup.

    BACKUP is a directory that `rigcal store backup` made. Stop the daemon first. The previous files are moved to a
    directory next to the store, and none is deleted.
    """
    from daemon.config.config import read_config
    from daemon.store.upkeep.backup import restore_backup

    settings = read_config(config)
    aside = restore_backup(backup, settings.store_path, settings.models_directory, _now_ns(), _go_on)
    if not as_json:
        echo(f"{settings.store_path} is restored from {backup}")
        if aside is not None:
            echo(f"the previous files are in {aside}; delete them when they are no longer needed")
    return {"store": str(settings.store_path), "replaced": None if aside is None else str(aside)}


@store.command(cls=Command, name="prune")
@click.option("--days", type=click.FloatRange(1), help="Days to keep; `keep_days` of the configuration by default.")
@config_option
@json_option
def store_prune(config: Path, days: float | None, *, as_json: bool) -> dict[str, Any]:
    """Delete old captures and readings outside sessions.

    Sessions with their captures, from a minute before their start, and models are always kept. The file does not
    shrink; its free pages are reused. The daemon may run in the meantime.
    """
    from daemon.config.config import read_config
    from daemon.service import keeping_of
    from daemon.store.upkeep.housekeeping import Housekeeping
    from drivers.clock import SystemClock

    settings = read_config(config)
    kept = days or settings.store.keep_days
    if kept is None:
        raise click.UsageError("give --days, or set `keep_days` in [store] of the configuration")
    arguments = {"days": kept}

    def work(store: Store) -> dict[str, Any]:
        housekeeping = Housekeeping(store, SystemClock(), keeping_of(settings))
        return housekeeping.prune_command(arguments, _go_on)

    result = _on_store(settings, work, "store.prune", arguments)
    if not as_json:
        until_ns = result["deleted_until_utc_ns"]
        echo("nothing to delete" if until_ns is None else f"deleted records outside sessions up to {utc(until_ns)}")
    return result


@store.command(cls=Command, name="redecode")
@click.option("--session", help="Session to decode.")
@click.option("--from", "since", type=click.DateTime(), help="Start of a time span, UTC, instead of a session.")
@click.option("--to", "until", type=click.DateTime(), help="End of the time span, UTC.")
@config_option
@json_option
def store_redecode(
    config: Path, session: str | None, since: datetime | None, until: datetime | None, *, as_json: bool
) -> dict[str, Any]:
    """Decode raw captures again into readings and fixes.

    Give a session or a time span. Outside sessions the store keeps one reading per second and channel; raw captures
    have all readings. All chunks of captures that overlap the time span are decoded, so the result may extend beyond
    it. The daemon may run in the meantime.
    """
    from daemon.acquisition.channel_files import with_files
    from daemon.acquisition.redecoding import redecode_command
    from daemon.composition import decoders
    from daemon.config.config import read_config
    from daemon.rig_files import load_rig

    if (session is None) == (since is None or until is None):
        raise click.UsageError("give either --session, or --from and --to")
    settings = read_config(config)
    source = load_rig(settings.rig, named_in=config)
    arguments = {
        "session": session,
        "first_utc_ns": None if since is None else _utc_ns(since),
        "last_utc_ns": None if until is None else _utc_ns(until),
    }

    def work(store: Store) -> dict[str, Any]:
        from daemon.service import declare_channels

        decoded, files = with_files(source)
        declare_channels(store, decoded.rig)
        return redecode_command(store, decoded.rig, decoders(settings, decoded, files), arguments, _go_on)

    result = _on_store(settings, work, "store.redecode", arguments)
    if not as_json:
        for stretch in result["stretches"]:
            echo(f"decoded again: {utc(stretch['first_utc_ns'])} to {utc(stretch['last_utc_ns'])}")
        echo(f"{result['added']} readings and fixes more than before")
        if not result.get("is_whole", True):  # an older daemon does not send it
            echo("later captures are still waiting to be decoded for the first time; repeat the command afterwards")
    return result


def _on_store(
    settings: Config, work: Callable[[Store], dict[str, Any]], command: str, arguments: dict[str, Any]
) -> dict[str, Any]:
    """Change the store: through the daemon if it runs or if only it has write permission, else in this process."""
    from daemon.control.protocol import request
    from daemon.store import Store, StoreBusyError, StoreError

    path, opened = settings.store_path, None
    if not path.parent.exists() or os.access(path.parent, os.W_OK):
        if not path.is_file():
            raise StoreError(f"{path}: there is no store; check --config")
        with contextlib.suppress(StoreBusyError):
            opened = Store(path)
    if opened is None:
        given = {key: value for key, value in arguments.items() if value is not None}
        answer: dict[str, Any] = request(settings.socket_path, command, given, timeout_s=TIMEOUT_S)
        return answer
    with contextlib.closing(opened), _told(path):
        return work(opened)


@contextlib.contextmanager
def _told(path: Path) -> Iterator[None]:
    from daemon.store.errors import storage_errors

    echo_error(f"no daemon is running on {path}: changing the store directly")
    with storage_errors(path):
        yield


def _go_on() -> None:
    """Do nothing: Ctrl-C ends this process anyway."""


def _now_ns() -> int:
    from drivers.clock import SystemClock

    return SystemClock().now().utc_ns


def _utc_ns(when: datetime) -> int:
    return round(when.replace(tzinfo=UTC).timestamp()) * 10**9


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 2**30:.2f} GiB" if size_bytes >= 2**30 else f"{size_bytes / _MIB:.1f} MiB"
