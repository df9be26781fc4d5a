"""Replays captured logs through decoders and a session into a separate store, at full speed."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.channel_files import with_files
from daemon.composition import decoders, joiner, motion_limits
from daemon.config.config import Config
from daemon.rig_files import RigSource
from daemon.service import declare_channels
from daemon.sessions.export.session_file import DeviceState, SessionFile
from daemon.sessions.manager import SessionManager
from daemon.sessions.replay import BOOT_ID, LATEST_UTC_NS, first_captures, merged
from daemon.sessions.station_setups import StationSetups
from daemon.store.errors import storage_errors
from daemon.store.store import Store
from drivers.clock import ManualClock, Stamp
from drivers.readings import Capture, DeviceEvent

REPLAYED = "replayed"

# Time of an operator's command (UTC, ns), and the command.
Commands = deque[tuple[int, Callable[[], object]]]


def whole_session(prism: str, kind: str) -> SessionFile:
    """Return a session on one prism that spans all captures.

    Args:
        prism: name of the prism.
        kind: one of `SESSION_KINDS`.
    """
    return SessionFile(prism=prism, kind=kind, since_utc_ns=0, until_utc_ns=LATEST_UTC_NS, control_points={})


def replay_logs(
    files: Sequence[Path], settings: Config, source: RigSource, path: Path, told: SessionFile | None
) -> dict[str, Any] | None:
    """Write a store from captured logs; the same logs give the same rows.

    Args:
        files: the logs.
        settings: configuration with which the logs were captured.
        source: rig from which the logs were captured.
        path: the new store.
        told: the session that the fixes belong to; None for no session.

    Returns:
        The closed session, as in `session.list`; None if there is none.

    Raises:
        DescriptionError, ConfigError: a log is malformed, empty, or of a link that is not configured.
        StoreError: the store cannot be written.
    """
    starts = first_captures(files, settings, told)  # refuses a bad log before the store is created
    clock = ManualClock()
    clock.set(min((capture.stamp for capture in starts.values()), key=lambda stamp: stamp.monotonic_ns))
    source, read = with_files(source)
    made = decoders(settings, source, read)
    with storage_errors(path), contextlib.closing(Store(path)) as store:
        declare_channels(store, source.rig)
        setups = StationSetups(source.rig, store, clock, settings.sessions.control_tolerance_mm)
        sessions = SessionManager(
            source.rig,
            source.text,
            store,
            setups,
            joiner(settings, source.rig),
            settings.sessions,
            clock,
            run_id=0,
            limits=motion_limits(settings),
        )
        commands = Commands()
        if told is not None:
            points = {name: list(place) for name, place in told.control_points.items()}
            setups.new_command({"id": REPLAYED, "instrument": REPLAYED, "control_points": points})
            commands = _commands_of(told, sessions, clock.monotonic_ns())
            store.insert_records([_event_of(state) for state in told.device_states])
        acquisition = Acquisition(
            (), made, store, clock, on_records=sessions.on_records, also_store=sessions.pending.store
        )
        acquisition.run_inline(_followed(merged(files, settings, told), clock, commands))
        for _, command in commands:  # commands after the last capture
            command()
        return sessions.list_command({})[0] if told is not None else None


def _event_of(state: DeviceState) -> DeviceEvent:
    return DeviceEvent(state.device, _instant(state.utc_ns), state.kind, state.text, state.code)


def _instant(utc_ns: int) -> Stamp:
    return Stamp(utc_ns, utc_ns, BOOT_ID)


def _commands_of(told: SessionFile, sessions: SessionManager, begin_ns: int) -> Commands:
    """Return the operator's commands of a session in the order of time."""
    start = {"id": REPLAYED, "prism": told.prism, "kind": told.kind, "operator": "replay"}
    confirm = partial(sessions.confirm_prism_command, {"operator": "replay"})
    away = [(_instant(since_ns), _instant(until_ns)) for since_ns, until_ns in told.away_utc_ns or ()]
    begin_ns = told.since_utc_ns or begin_ns
    between = [(at_ns, confirm) for at_ns in told.prism_confirmed_utc_ns]
    between += [(at_ns, partial(sessions.turned_command, {})) for at_ns in told.prism_turned_utc_ns]
    return Commands(
        [
            (begin_ns, partial(sessions.start_command, start)),
            (begin_ns, partial(sessions.was_away, lambda _: away)),
            *sorted(between, key=lambda command: command[0]),
            (told.until_utc_ns, partial(sessions.stop_command, {})),
        ]
    )


def _followed(captures: Iterable[Capture], clock: ManualClock, commands: Commands) -> Iterator[Capture]:
    """Yield captures; before each one, run the commands that are due and set the clock to its time."""
    for capture in captures:
        while commands and commands[0][0] <= capture.stamp.monotonic_ns:
            at_ns, command = commands.popleft()
            clock.set(_instant(at_ns))
            command()
        clock.set(capture.stamp)
        yield capture
