"""`rigcal run`: runs the daemon with real, simulated or replayed links."""

from __future__ import annotations

import contextlib
import logging
import shlex
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command import Command, json_option
from daemon.cli.terminal import echo
from daemon.host.systemd import Notifier, set_up_logging

if TYPE_CHECKING:
    from daemon.config.config import Config
    from daemon.store.store import Store

SIMULATED_FILE = Path("rigcal-sim", "rigcal.toml")
MACHINE_FILE = "simulated-machine.txt"  # in the directory of the store: the options of its simulated machine

_RATE = click.FloatRange(0.1, 100)
_DWELL = click.FloatRange(1, 600)


@click.command(cls=Command)
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[FILE]...")
@click.option("--config", type=click.Path(path_type=Path), help="Configuration file (TOML); optional with --sim.")
@click.option("--sim", is_flag=True, help="Use a simulated rig instead of the configured links.")
@click.option(
    "--rig",
    metavar="RIG",
    help="With --sim: name of a shipped rig, or path of a rig file; joints without a channel get a simulated one.",
)
@click.option("--replay", "is_replay", is_flag=True, help="Replay the logs FILE... instead of the configured links.")
@click.option(
    "--rate", type=_RATE, default=1.0, show_default=True, help="Speed of simulation or replay, seconds per second."
)
@click.option("--seed", type=int, default=1, show_default=True, help="Seed of the simulated machine.")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="FAMILY@WHERE[:NAME=VALUE...]",
    help="Hidden effect of the simulated machine, such as backlash@theta4:width_rad=4e-3; by default it has only build "
    "errors. May be repeated.",
)
@click.option(
    "--secret",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Hide one more effect, which the simulated machine draws at random and records in a file in DIR.",
)
@click.option(
    "--dwell",
    "dwell_s",
    type=_DWELL,
    default=4.0,
    show_default=True,
    help="How long the simulated boom stands still at each pose, simulated seconds.",
)
@click.option(
    "--by-hand",
    "is_by_hand",
    is_flag=True,
    help="Boom and station of the simulated rig move only on `rigcal hand`, to practise an operator's work.",
)
@click.option("-v", "--verbose", is_flag=True, help="Also log debug messages.")
@json_option
def run(
    files: tuple[Path, ...],
    config: Path | None,
    rig: str | None,
    rate: float,
    seed: int,
    effects: tuple[str, ...],
    secret: Path | None,
    dwell_s: float,
    *,
    sim: bool,
    is_by_hand: bool,
    is_replay: bool,
    verbose: bool,
    as_json: bool,
) -> dict[str, Any]:
    """Run the daemon until it is stopped.

    SIGTERM or Ctrl-C stops it, or the end of a replay. A replay writes its store to a new directory within the
    configured state directory. A simulated rig is refused on the store of a real rig or of another simulated machine,
    and a real rig on that of a simulated one.
    """
    if not sim and (is_by_hand or rig is not None):
        raise click.UsageError("--rig and --by-hand are for a simulated rig: give --sim as well")
    from daemon.composition import live, replayed, simulated, simulated_machine
    from daemon.config.config import read_config
    from daemon.rig_files import load_rig
    from daemon.service import Daemon, stop_on_signals

    set_up_logging(level=logging.DEBUG if verbose else logging.INFO)
    if not verbose:
        logging.getLogger("can").setLevel(logging.WARNING)  # python-can logs every socket that it creates
    _check_files(files, sim=sim, is_replay=is_replay)
    if config is not None:
        settings = read_config(config)
    elif sim:
        settings = _simulated_settings()
    else:
        raise click.UsageError("give --config FILE (only --sim runs without one)")
    source = load_rig(rig or settings.rig, named_in=None if rig else config)
    settings = settings.model_copy(update={"rig": rig or settings.rig})
    if is_replay:
        settings = _apart(settings)
    stop, notifier = threading.Event(), Notifier()
    with contextlib.ExitStack() as stack:
        stack.callback(stop_on_signals(stop))
        with notifier.extending(f"opening the store {settings.store_path}"):
            _make_directory(settings)
            # Open the store first: its lock prevents a second daemon from interfering with the first.
            machine = simulated_machine(source.rig.name, seed, effects, has_secret=secret is not None) if sim else None
            store = stack.enter_context(contextlib.closing(_store(settings, machine)))
            if sim:
                _note_machine(settings, seed, effects, secret)
                rig_parts = simulated(
                    settings,
                    source,
                    rate=rate,
                    seed=seed,
                    effects=effects,
                    secret=secret,
                    dwell_s=dwell_s,
                    is_by_hand=is_by_hand,
                    after_utc_ns=store.last_utc_ns(),
                )
                parts = stack.enter_context(rig_parts)
                if config is None:
                    _write_config(settings, parts.rig_name)
            elif is_replay:
                parts = replayed(settings, source, files, rate)
            else:
                parts = live(settings, source)
            daemon = Daemon(settings, store, parts)
        daemon.run(stop, notifier)
    if not as_json:
        echo(f"the store is {settings.store_path}")
    return {"rig": source.rig.name, "mode": parts.mode, "store": str(settings.store_path)}


def _check_files(files: Sequence[Path], *, sim: bool, is_replay: bool) -> None:
    """Refuse files without --replay, and --replay without files or with --sim."""
    if bool(files) == is_replay and not (sim and is_replay):
        return
    if files and not is_replay and files[0].suffix == ".toml":
        raise click.UsageError(f"a configuration is given as an option: --config {files[0]}")
    raise click.UsageError("give either --sim, or --replay FILE..., or neither")


def _store(settings: Config, machine: str | None) -> Store:
    """Open the store for writing; CommandError if its records are of another machine, as in `require_apart`."""
    from daemon.composition import require_apart
    from daemon.store.store import Store

    store = Store(settings.store_path)
    try:
        options = _machine_options(settings)
        store.unless_damaged(lambda: require_apart(store.boots(), store.path, machine, options), None)
    except BaseException:
        store.close()
        raise
    return store


def _note_machine(settings: Config, seed: int, effects: Sequence[str], secret: Path | None) -> None:
    """Write the options of the simulated machine beside its store, for the message that refuses another machine."""
    from daemon.host.safe_output import write_file

    given = ["--rig", settings.rig, "--seed", str(seed), *(f"--effect={effect}" for effect in effects)]
    given += [] if secret is None else ["--secret", str(secret)]
    write_file(settings.state_directory / MACHINE_FILE, f"{shlex.join(given)}\n".encode())


def _machine_options(settings: Config) -> str:
    """Return the options of the simulated machine that ran last on the store; "" if there was none."""
    from daemon.host.safe_output import shown

    with contextlib.suppress(OSError, UnicodeError):
        return shown((settings.state_directory / MACHINE_FILE).read_text(encoding="utf-8").strip())
    return ""


def _simulated_settings() -> Config:
    from daemon.config.config import parse_config

    return parse_config(_simulated_config("swdt82"), SIMULATED_FILE.resolve())


def _write_config(settings: Config, rig: str) -> None:
    """Write the configuration of a simulated rig to the directory of its store."""
    from calibration.rig.description import shipped_rigs
    from daemon.host.safe_output import write_file

    named = rig if rig in shipped_rigs() else str(Path(rig).resolve())
    write_file(settings.state_directory / SIMULATED_FILE.name, _simulated_config(named).encode())


def _simulated_config(rig: str) -> str:
    from calibration.rig.toml import quoted
    from daemon.config.config import SIMULATED_CONFIG

    by = "`rigcal run --sim` at each start, for commands that ask for --config"
    return SIMULATED_CONFIG.format(written_by=by, rig=quoted(rig))


def _make_directory(settings: Config) -> None:
    from daemon.store.errors import storage_errors

    with storage_errors(settings.store_path):
        settings.state_directory.mkdir(parents=True, exist_ok=True)


def _apart(settings: Config) -> Config:
    """Return the configuration with a new state directory, to keep replayed logs apart from the rig's records."""
    _make_directory(settings)
    directory = Path(tempfile.mkdtemp(prefix="replay-", dir=settings.state_directory))
    return settings.model_copy(update={"state_directory": directory, "socket": directory / "control.sock"})
