"""`rigcal replay`: replays captured logs into a new store."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import click

from daemon.cli.command import Command, json_option
from daemon.cli.terminal import echo, echo_error
from daemon.commands import SESSION_KINDS
from daemon.host.safe_output import write_file

COUNTED = ("joint_samples", "signals", "fixes", "device_events", "decode_failures", "gaps", "observations")
_OF_EARLIER_VERSION = (
    "the file is of an earlier version, which did not write when the station was on no prism: if the session was "
    "guided, fixes of another prism from those times may be used; export the session again"
)


@click.command(cls=Command)
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    required=True,
    help="Configuration with the rig and links of the logs.",
)
@click.option(
    "--store",
    "path",
    type=click.Path(path_type=Path),
    required=True,
    help="Store to write: a new file, ending in .sqlite.",
)
@click.option("--prism", help="Assign all fixes to one closed session on this prism; no session by default.")
@click.option(
    "--kind", type=click.Choice(SESSION_KINDS), default="static_poses", show_default=True, help="Kind of that session."
)
@click.option(
    "--session",
    "session_file",
    type=click.Path(path_type=Path),
    help="Instead of --prism and --kind: session file of `rigcal session export` (.json), to repeat the live session.",
)
@click.option("--readings", type=click.Path(path_type=Path), help="File for all decoded data, as JSON lines.")
@json_option
def replay(
    files: tuple[Path, ...],
    config: Path,
    path: Path,
    prism: str | None,
    kind: str,
    session_file: Path | None,
    readings: Path | None,
    *,
    as_json: bool,
) -> dict[str, Any]:
    """Decode captured logs into a new store at full speed.

    The same logs give the same rows. FILES are CAN logs (candump .log, Vector .asc or .blf) and serial captures
    (.serial).
    """
    from daemon.cli.log_replay import replay_logs, whole_session
    from daemon.config.config import read_config
    from daemon.rig_files import load_rig
    from daemon.sessions.export.session_file import read_session_file
    from daemon.sessions.replay import stored_readings
    from daemon.store.reader import Reader

    settings = read_config(config)
    source = load_rig(settings.rig, named_in=config)
    if path.exists():
        raise click.UsageError(f"{path} exists; a replay writes a new store: name a new file with --store")
    if prism is not None and session_file is not None:
        raise click.UsageError("give --prism or --session, not both")
    told = None if session_file is None else read_session_file(session_file)
    if told is not None and told.away_utc_ns is None:
        echo_error(f"Warning: {session_file}: {_OF_EARLIER_VERSION}", logging.WARNING)
    if prism is not None:
        told = whole_session(prism, kind)
    session = replay_logs(files, settings, source, path, told)
    with Reader(path) as reader:
        if readings is not None:
            write_file(readings, "".join(f"{line}\n" for line in stored_readings(reader)).encode())
        counts = {table: reader.count(table) for table in COUNTED}
    if not as_json:
        for table, n in counts.items():
            echo(f"{n:9d} {table.replace('_', ' ')}")
        if session is not None:
            echo(f"{session['observations']:9d} of these observations can be used")
            for reason, n in session["excluded"].items():
                echo(f"{n:9d} cannot be used: {reason}")
    return counts | ({} if session is None else {"session": session})
