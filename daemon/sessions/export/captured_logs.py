"""Export of a stored session as captured logs, with the session file for `rigcal replay` and the observations CSV."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from calibration.rig.description import parse_rig
from daemon.commands import CommandError
from daemon.config.config import Config, ConfigError
from daemon.host.safe_output import write_file
from daemon.sessions.export.session_file import DeviceState, DoubtfulCaptures, SessionFile
from daemon.sessions.session_data import sessions_csv
from daemon.sessions.vector_channels import channel_numbers
from daemon.store.queries.decoding import is_being_joined, is_undecoded
from daemon.store.queries.device_states import device_states
from daemon.store.queries.sessions import AFTER_NS, BEFORE_NS, prism_confirmations, session
from daemon.store.queries.setups import control_points
from daemon.store.reader import Reader
from daemon.store.upkeep.full_samples import stretches_of_session
from drivers.clock import NS_PER_S, Stamp
from drivers.logs.can_log import write_can_log
from drivers.logs.serial_log import SerialLogHeader, SerialLogWriter
from drivers.readings import CanCapture, Capture, SerialCapture

CanFormat = Literal["log", "asc", "blf"]
Away = tuple[Stamp, Stamp | None]
TimesAway = Callable[[Reader, str], Iterable[Away]]

JOINED_WITHIN_S = 5.0  # after the session's end, if links are alive; a killed daemon joins no more fixes
LOOK_S = 0.1
_OUTAGE_NS = 300 * NS_PER_S  # assumed between two boots if the clock does not show it; joints may be anywhere by then


def export_session(
    config: Config, session_id: str, out: Path, can_format: CanFormat, times_away: TimesAway
) -> list[Path]:
    """Write a session's captures, one file per link, the operator's commands, and its observations.

    Logs contain UTC only, so steps of the computer's clock are removed from it: otherwise captures recorded around a
    step would be replayed at wrong times. Logs cannot mark a capture whose time is doubtful; the session file does.

    Args:
        config: configuration of the daemon that wrote the store; it gives the stations' profiles and speeds.
        session_id: a session that has ended.
        out: directory, created if needed.
        can_format: format of the CAN logs: candump `log`, Vector `asc` or `blf`.
        times_away: returns when the station was turned away from the session's prism, and when it was back; None if it
            was not back by the session's end.

    Returns:
        The files, `<session>-<link>.<format>`, `<session>-<station>.serial`, `<session>.json` and `<session>.csv`.

    Raises:
        CommandError: there is no such session, it is still open, or it is not decoded.
        ConfigError: its station is not in the configuration.
    """
    with Reader(config.store_path) as reader:
        found = ended_session(reader, session_id)
        out.mkdir(parents=True, exist_ok=True)
        # A damaged store must not leave an incomplete log that looks complete
        with tempfile.TemporaryDirectory(prefix=f".{session_id}.", dir=out) as scratch:
            away = [*times_away(reader, session_id)]
            files = _write(reader, config, found, Path(scratch), can_format, away)
            return [file.replace(out / file.name) for file in files]


def _write(
    reader: Reader, config: Config, found: Mapping[str, Any], out: Path, can_format: CanFormat, away: Sequence[Away]
) -> list[Path]:
    session_id = found["id"]
    started, ended = reader.stamp(found, "started_"), reader.stamp(found, "ended_")
    since, until = started.shifted(-BEFORE_NS), ended.shifted(AFTER_NS)
    steady = _SteadyTime()
    for instant in (since, *(each for stretch in stretches_of_session(reader, session_id) for each in stretch)):
        steady.of(instant)
    doubtful: dict[str, DoubtfulCaptures] = {}
    links = reader.links()
    numbers = channel_numbers(config, [link["name"] for link in links if link["kind"] == "can"])
    files: list[Path] = []
    for link in links:
        stored = reader.captures(link["name"], since, until)
        doubts = _Doubts()
        captures = doubts.noted(replace(capture, stamp=steady.of(capture.stamp)) for capture in stored)
        if link["kind"] == "can":
            path = out / f"{session_id}-{link['name']}.{can_format}"
            write_can_log(path, (c for c in captures if isinstance(c, CanCapture)), numbers)
        else:
            path = out / f"{session_id}-{link['name']}.serial"
            with path.open("w", encoding="utf-8", newline="\n") as stream:
                writer = SerialLogWriter(stream, _header(config, link["name"]))
                for capture in captures:
                    if isinstance(capture, SerialCapture):
                        writer.write(capture)
        files.append(path)
        if doubts.runs:
            doubtful[link["name"]] = DoubtfulCaptures(captures=doubts.captures, runs=tuple(doubts.runs))
    booted_ns = max(steady.of(replace(since, monotonic_ns=0)).utc_ns, 0)
    states = [
        DeviceState(
            device=e.device,
            kind=e.kind,
            text=e.text,
            code=e.code,
            # Set-ups of earlier boots come first
            utc_ns=steady.of(e.stamp).utc_ns if e.stamp.boot_id == since.boot_id else booted_ns,
        )
        for e in device_states(reader, since)
    ]
    words = [(row["turning"], steady.of(reader.stamp(row)).utc_ns) for row in prism_confirmations(reader, session_id)]
    told = SessionFile(
        prism=found["prism"],
        kind=found["kind"],
        since_utc_ns=steady.of(started).utc_ns,
        until_utc_ns=steady.of(ended).utc_ns,
        prism_confirmed_utc_ns=tuple(at_ns for turning, at_ns in words if not turning),
        prism_turned_utc_ns=tuple(at_ns for turning, at_ns in words if turning),
        away_utc_ns=tuple((steady.of(left).utc_ns, steady.of(back or ended).utc_ns) for left, back in away),
        control_points={
            point["name"]: (point["x_mm"], point["y_mm"], point["z_mm"])
            for point in control_points(reader, found["setup_id"], session_id)
        },
        doubtful=doubtful,
        can_channels=numbers,
        device_states=tuple(states),
    )
    path = out / f"{session_id}.json"
    write_file(path, told.model_dump_json(indent=2, exclude_defaults=True).encode() + b"\n")
    files.append(path)
    table = out / f"{session_id}.csv"
    write_file(table, sessions_csv(reader, parse_rig(found["rig_text"], "the session's rig"), [session_id]))
    return [*files, table]


def ended_session(reader: Reader, session_id: str) -> dict[str, Any]:
    """Return the row of an ended session, once its last captures are decoded and its last fixes are joined.

    Args:
        reader: the store.
        session_id: the session.

    Raises:
        CommandError: there is no such session, it is still open, or its captures are not decoded within the time that
            a session that was just stopped needs.
    """
    found = session(reader, session_id)
    if found is None:
        raise CommandError(f"{reader.path} has no session {session_id!r}; `rigcal session list` shows them")
    if found["ended_utc_ns"] is None:
        raise CommandError(f"session {session_id!r} is still open; stop it first")
    deadline = time.monotonic() + JOINED_WITHIN_S
    while is_being_joined(reader, session_id, AFTER_NS) and time.monotonic() < deadline:
        time.sleep(LOOK_S)
    if is_undecoded(reader, session_id, AFTER_NS):
        raise CommandError(
            f"captures of session {session_id!r} wait to be decoded, so its tables are incomplete; `rigcal run` "
            "decodes them: export the session when `rigcal store stats` shows that none wait"
        )
    return found


class _SteadyTime:
    """Puts instants on one axis of UTC without steps of the computer's clock.

    Within a boot, time follows the monotonic clock from the UTC of the boot's first instant; a boot that seems to begin
    before the previous one ends is taken to begin five minutes later. The first and the last instant of each boot, of
    all links, must be given first, because one link may have fallen silent before the others.
    """

    def __init__(self) -> None:
        self._offsets_ns: dict[str, int] = {}
        self._latest_ns = -(2**63)

    def of(self, stamp: Stamp) -> Stamp:
        """Return the stamp with steady UTC instead of the computer's."""
        if stamp.boot_id not in self._offsets_ns:
            is_after = stamp.utc_ns > self._latest_ns
            begun_ns = stamp.utc_ns if is_after else self._latest_ns + _OUTAGE_NS
            self._offsets_ns[stamp.boot_id] = begun_ns - stamp.monotonic_ns
        utc_ns = stamp.monotonic_ns + self._offsets_ns[stamp.boot_id]
        self._latest_ns = max(self._latest_ns, utc_ns)
        return replace(stamp, utc_ns=utc_ns)


class _Doubts:
    """Notes which of the captures passed through are of doubtful time, for a `DoubtfulCaptures`."""

    def __init__(self) -> None:
        self.captures = 0
        self.runs: list[tuple[int, int]] = []

    def noted(self, captures: Iterable[Capture]) -> Iterator[Capture]:
        for capture in captures:
            if capture.stamp.is_doubtful:
                number = self.captures
                first = self.runs.pop()[0] if self.runs and self.runs[-1][1] == number - 1 else number
                self.runs.append((first, number))
            self.captures += 1
            yield capture


def _header(config: Config, link: str) -> SerialLogHeader:
    for station in config.station:
        if station.name == link:
            return SerialLogHeader(link, station.serial.baud, station.profile)
    raise ConfigError(f"station {link!r} of the stored session is not in the configuration; add its [[station]]")
