"""`rigcal run`, `rigcal replay`, `rigcal config check`: the daemon itself, and captured logs through it."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click

from daemon.acquisition import Acquisition
from daemon.cli.output import Command, json_option
from daemon.cli.terminal import echo
from daemon.composition import decoders, joiner, live, motion_limits, replayed, simulated
from daemon.config import Config, parse_config, read_config
from daemon.files import write_file
from daemon.journal import set_up_logging
from daemon.notify import Notifier
from daemon.replay import BOOT_ID, LATEST_UTC_NS, first_captures, merged, stored_readings
from daemon.rigs import load_rig
from daemon.scheduler import SESSION_KINDS
from daemon.service import Daemon, declare_channels, stop_on_signals
from daemon.session_file import SessionFile, read_session_file
from daemon.sessions import SessionKeeper
from daemon.setups import SetupBook
from daemon.store.errors import storage_errors
from daemon.store.reader import Reader
from daemon.store.store import Store
from drivers.clock import ManualClock, Stamp
from drivers.readings import Capture

SIMULATED_CONFIG = """
rig = "swdt82"
state_directory = "rigcal-sim"

[[can]]
channel = "can0"

[[station]]
serial.path = "/dev/rigcal-station"
"""
REPLAYED = "replayed"
COUNTED = ("joint_samples", "signals", "fixes", "device_events", "decode_failures", "gaps", "observations")

_RATE = click.FloatRange(0.1, 100)
_DWELL = click.FloatRange(1, 600)


@click.command(cls=Command)
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[FILE]...")
@click.option("--config", type=click.Path(path_type=Path), help="Configuration file (TOML); --sim has one of its own.")
@click.option("--sim", is_flag=True, help="A simulated rig in place of the configured links.")
@click.option("--replay", "is_replay", is_flag=True, help="The captured logs FILE... in place of the configured links.")
@click.option("--rate", type=_RATE, default=1.0, show_default=True, help="Speed of the simulation or replay.")
@click.option("--seed", type=int, default=1, show_default=True, help="Which simulated machine.")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="FAMILY@WHERE[:NAME=VALUE...]",
    help="A hidden effect of the simulated machine, which else has build errors alone, such as "
    "backlash@theta4:width_rad=4e-3; may be repeated.",
)
@click.option(
    "--secret",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Hide one more effect, which the simulated machine draws and seals in an envelope there.",
)
@click.option("--dwell", "dwell_s", type=_DWELL, default=4.0, show_default=True, help="Simulated stand at a pose, s.")
@click.option("-v", "--verbose", is_flag=True, help="Log more.")
@json_option
def run(
    files: tuple[Path, ...],
    config: Path | None,
    rate: float,
    seed: int,
    effects: tuple[str, ...],
    secret: Path | None,
    dwell_s: float,
    *,
    sim: bool,
    is_replay: bool,
    verbose: bool,
    as_json: bool,
) -> dict[str, Any]:
    """Run the daemon until it is told to stop (SIGTERM, Ctrl-C) or a replay has ended.

    A replay keeps its store in a directory of its own, beside the configured one's.
    """
    set_up_logging(level=logging.DEBUG if verbose else logging.INFO)
    if not verbose:
        logging.getLogger("can").setLevel(logging.WARNING)  # python-can tells of every socket that it makes
    if bool(files) != is_replay or (sim and is_replay):
        raise click.UsageError("give either --sim, or --replay FILE..., or neither")
    settings = _settings(config, sim=sim)
    source = load_rig(settings.rig)
    if is_replay:
        settings = _apart(settings)
    stop, notifier = threading.Event(), Notifier()
    with contextlib.ExitStack() as stack:
        stack.callback(stop_on_signals(stop))
        with notifier.extending(f"opening the store {settings.store_path}"):
            _make_directory(settings)
            # The store first: it is what keeps a second daemon from touching anything of the first one's.
            store = stack.enter_context(contextlib.closing(Store(settings.store_path)))
            if sim:
                rig = simulated(settings, source, rate=rate, seed=seed, effects=effects, secret=secret, dwell_s=dwell_s)
                parts = stack.enter_context(rig)
            elif is_replay:
                parts = replayed(settings, source, files, rate)
            else:
                parts = live(settings, source)
            daemon = Daemon(settings, store, parts)
        daemon.run(stop, notifier)
    if not as_json:
        echo(f"the store is {settings.store_path}")
    return {"rig": source.rig.name, "mode": parts.mode, "store": str(settings.store_path)}


def _settings(config: Path | None, *, sim: bool) -> Config:
    if config is not None:
        return read_config(config)
    if not sim:
        raise click.UsageError("give --config FILE (only --sim runs without one)")
    return parse_config(SIMULATED_CONFIG, Path("simulated").resolve())


def _make_directory(settings: Config) -> None:
    with storage_errors(settings.store_path):
        settings.state_directory.mkdir(parents=True, exist_ok=True)


def _apart(settings: Config) -> Config:
    """The configuration with a new directory for its state: what was recorded elsewhere stays apart from the rig's."""
    _make_directory(settings)
    directory = Path(tempfile.mkdtemp(prefix="replay-", dir=settings.state_directory))
    return settings.model_copy(update={"state_directory": directory, "socket": directory / "control.sock"})


@click.command(cls=Command)
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    required=True,
    help="Configuration whose rig and links the logs are of.",
)
@click.option(
    "--store",
    "path",
    type=click.Path(path_type=Path),
    required=True,
    help="Store to write; a new file, ending in .sqlite.",
)
@click.option("--prism", help="Take the fixes as one closed session on this prism, so that they become observations.")
@click.option(
    "--kind", type=click.Choice(SESSION_KINDS), default="static_poses", show_default=True, help="Kind of that session."
)
@click.option(
    "--session",
    "session_file",
    type=click.Path(path_type=Path),
    help="In place of both: the session as `rigcal session export` told of it (.json), observed as it was live.",
)
@click.option(
    "--readings", type=click.Path(path_type=Path), help="Also write everything that was decoded as JSON lines."
)
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
    """Feed captured logs through drivers and store, as fast as it goes; the same logs give the same rows.

    FILES are CAN logs (candump .log, Vector .asc or .blf) and serial captures (.serial).
    """
    settings = read_config(config)
    source = load_rig(settings.rig)
    if path.exists():
        raise click.UsageError(f"{path} exists; a replay writes a store of its own, name a new file with --store")
    if prism is not None and session_file is not None:
        raise click.UsageError("give --prism or --session, not both")
    clock = ManualClock()
    told = None if session_file is None else read_session_file(session_file)
    doubtful = {} if told is None else told.doubtful
    starts = first_captures(files, settings, doubtful)  # a bad log is refused before a store is made
    clock.set(min((capture.stamp for capture in starts.values()), key=lambda stamp: stamp.monotonic_ns))
    begin_ns = clock.monotonic_ns()
    if prism is not None:
        told = SessionFile(prism=prism, kind=kind, since_utc_ns=begin_ns, until_utc_ns=LATEST_UTC_NS, control_points={})
    made = decoders(settings, source)
    with storage_errors(path), contextlib.closing(Store(path)) as store:
        declare_channels(store, source.rig)
        setups = SetupBook(source.rig, store, clock, settings.sessions.control_tolerance_mm)
        keeper = SessionKeeper(
            source.rig,
            source.text,
            store,
            setups,
            joiner(settings, source.rig),
            settings.sessions,
            clock,
            run_id=0,
            aim=None,
            limits=motion_limits(settings),
        )
        operator: deque[tuple[int, Callable[[], object]]] = deque()
        if told is not None:
            points = {name: list(place) for name, place in told.control_points.items()}
            setups.new_command({"id": REPLAYED, "instrument": "replayed", "control_points": points})
            start = {"id": REPLAYED, "prism": told.prism, "kind": told.kind, "operator": "replay"}
            operator.append((told.since_utc_ns, partial(keeper.start_command, start)))
            confirm = partial(keeper.confirm_prism_command, {"operator": "replay"})
            words = [(at_ns, confirm) for at_ns in told.prism_confirmed_utc_ns]
            words += [(at_ns, partial(keeper.turned_command, {})) for at_ns in told.prism_turned_utc_ns]
            operator.extend(sorted(words, key=lambda word: word[0]))
            operator.append((told.until_utc_ns, partial(keeper.stop_command, {})))
        acquisition = Acquisition((), made, store, clock, on_records=keeper.on_records)
        acquisition.run_inline(_followed(merged(files, settings, doubtful), clock, operator))
        for _, command in operator:  # what comes after the last capture
            command()
        session = keeper.list_command({})[0] if told is not None else None
    with Reader(path) as reader:
        if readings is not None:
            write_file(readings, "".join(f"{line}\n" for line in stored_readings(reader)).encode())
        counts = {table: next(reader.rows(f"SELECT count(*) AS n FROM {table}"))["n"] for table in COUNTED}
    if not as_json:
        for table, n in counts.items():
            echo(f"{n:9d} {table.replace('_', ' ')}")
    return counts | ({} if session is None else {"session": session})


def _followed(
    captures: Iterable[Capture], clock: ManualClock, operator: deque[tuple[int, Callable[[], object]]]
) -> Iterator[Capture]:
    """The captures; the clock shows each one's instant when it comes, and the operator speaks when it is time."""
    for capture in captures:
        while operator and operator[0][0] <= capture.stamp.monotonic_ns:
            at_ns, command = operator.popleft()
            clock.set(Stamp(at_ns, at_ns, BOOT_ID))
            command()
        clock.set(capture.stamp)
        yield capture


@click.group("config")
def config_group() -> None:
    """The configuration file."""


@config_group.command("check", cls=Command)
@click.argument("path", type=click.Path(path_type=Path))
@json_option
def config_check(path: Path, *, as_json: bool) -> dict[str, Any]:
    """Check a configuration, its rig, and the DBC and EDS files they name, without opening any device."""
    settings = read_config(path)
    source = load_rig(settings.rig)
    links = decoders(settings, source)
    if not as_json:
        echo(f"{path}: good: rig {source.rig.name}, links {', '.join(links) or 'none'}")
    return {"rig": source.rig.name, "links": list(links)}


COMMANDS = {"run": run, "replay": replay, "config": config_group}
