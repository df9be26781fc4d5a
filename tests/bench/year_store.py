"""A store of a year: `python -m tests.bench.year_store [--samples 1e9] [--keep DIRECTORY]`.

Makes a store that has been sent so many samples at the rates of `store_growth`, with a session every ten hours, and
measures what a user waits for: the start, `status`, and what is asked of sessions. Between sessions every large chunk
is a copy of one of ten that were made from simulated traffic, under its own time: rows, indexes and sizes are those of
a real store, and nothing looks at the captures in them. Sessions are whole: captures, all their readings and fixes, and
an observation a second. A run that ended in order was before. Exit status 1: a bar is missed.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from daemon.acquisition.link_decoders import LinkDecoders
from daemon.commands import CommandError
from daemon.composition import decoders
from daemon.config.config import parse_config
from daemon.control.protocol import request
from daemon.guide.times_away import times_away
from daemon.rig_files import load_rig
from daemon.service import declare_channels
from daemon.sessions.export.captured_logs import export_session
from daemon.store import Reader, Store
from daemon.store.captures import Chunk, decode_run, encode_captures
from daemon.store.queries.observations import ObservationTable, all_observations
from daemon.store.queries.sessions import SessionTable
from daemon.store.upkeep.packing import SPAN_NS, packed_run
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import Capture, Fix, Reading
from tests.bench.store_growth import CONFIG, UTC_0_NS, traffic
from tests.daemon.support.idle_daemon import idle_daemon

MINUTES = 10  # of simulated traffic, again and again
SESSION_EVERY = 600  # minutes
BOOT_MINUTES = 24 * 60
COMMIT_MINUTES = 60
OPEN_S, STATUS_S, QUERY_S = 5.0, 0.05, 1.0
CELL = 46

_CHUNK = """INSERT INTO raw_chunks (link_id, first_utc_ns, first_monotonic_ns, first_boot_id, last_utc_ns,
    last_monotonic_ns, last_boot_id, captures, bytes, chunk)
    VALUES ((SELECT id FROM links WHERE name = ?), ?, ?, ?, ?, ?, ?, ?, ?, ?)"""
# Rows of a minute of the traffic, in another minute: all of them, or one a second.
_SAMPLES = """INSERT INTO main.{0} (channel_id, utc_ns, monotonic_ns, boot_id, value, status, raw_counts)
    SELECT channel_id, utc_ns + ?1, monotonic_ns + ?2, ?3, value, status, raw_counts FROM traffic.{0}
    WHERE monotonic_ns >= ?4 AND monotonic_ns < ?4 + 60000000000 AND (?5 OR id IN (SELECT id FROM traffic.kept_{0}))"""
_FIXES = """INSERT INTO main.fixes (station, utc_ns, monotonic_ns, boot_id, last_byte_utc_ns, last_byte_monotonic_ns,
        last_byte_boot_id, status, lock, hz_angle_rad, zenith_angle_rad, slope_distance_m, reason, raw)
    SELECT station, utc_ns + ?1, monotonic_ns + ?2, ?3, last_byte_utc_ns + ?1, last_byte_monotonic_ns + ?2, ?3, status,
        lock, hz_angle_rad, zenith_angle_rad, slope_distance_m, reason, raw FROM traffic.fixes
    WHERE monotonic_ns >= ?4 AND monotonic_ns < ?4 + 60000000000
        AND (?5 OR id IN (SELECT id FROM traffic.kept_fixes))"""


class Traffic:
    """Minutes of simulated traffic: captures, large chunks, and a store with all that was decoded.

    Args:
        path: of that store.
        seed: of the traffic.
    """

    def __init__(self, path: Path, seed: int) -> None:
        self.path, source = path, load_rig("swdt82")
        decoding = LinkDecoders(decoders(parse_config(CONFIG, path.parent), source))
        self.captures: list[list[Capture]] = [[] for _ in range(MINUTES)]
        with contextlib.closing(Store(path)) as store:
            declare_channels(store, source.rig)
            with store.transaction():
                for batch in traffic(60.0 * MINUTES, seed):
                    for capture in batch:
                        self.captures[min(capture.stamp.monotonic_ns // SPAN_NS, MINUTES - 1)].append(capture)
                    records = decoding.feed_and_tick(batch)
                    store.insert_records([record for record in records if isinstance(record, Reading | Fix)])
            found = store.rows("SELECT (SELECT count(*) FROM joint_samples) + (SELECT count(*) FROM signals) AS n")
        self.samples_a_minute = found[0]["n"] / MINUTES
        self.chunks = [large_chunks(captures) for captures in self.captures]
        with contextlib.closing(sqlite3.connect(path)) as db, db:
            for table, of in (("joint_samples", "channel_id"), ("signals", "channel_id"), ("fixes", "station")):
                db.execute(
                    f"CREATE TABLE kept_{table} AS SELECT min(id) AS id FROM {table} "
                    f"GROUP BY {of}, monotonic_ns / 1000000000"
                )


def large_chunks(captures: Sequence[Capture]) -> list[Chunk]:
    """Return the large chunks of captures, one a link."""
    return [packed_run([decode_run(chunk.blob)]) for chunk in encode_captures(captures)]


def moved(stamp: Stamp, minute: int) -> Stamp:
    """Return an instant of the traffic as it is when the traffic is repeated in some minute; a boot lasts a day."""
    boot, within = divmod(minute, BOOT_MINUTES)
    origin = minute % MINUTES
    return Stamp(
        stamp.utc_ns + (minute - origin) * SPAN_NS, stamp.monotonic_ns + (within - origin) * SPAN_NS, f"boot-{boot}"
    )


def build(path: Path, samples: float, seed: int, *, is_dense: bool = False) -> None:
    """Make a store that has been sent so many samples; a dense one has a row for each, outside sessions too."""
    own = Traffic(path.with_name("traffic.sqlite"), seed)
    minutes = max(round(samples / own.samples_a_minute), SESSION_EVERY)
    with contextlib.closing(Store(path)) as store:
        declare_channels(store, load_rig("swdt82").rig)
        for link, kind in (("boom", "can"), ("station", "serial")):
            store.insert("links", {"name": link, "kind": kind})
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
            db.execute("ATTACH ? AS traffic", (str(own.path),))
            db.execute("PRAGMA synchronous = OFF")
            for begin in range(0, minutes, COMMIT_MINUTES):
                boot = store.boot_row(moved(Stamp(UTC_0_NS, 0, ""), begin))  # the same for the whole hour
                db.execute("BEGIN")
                for minute in range(begin, min(begin + COMMIT_MINUTES, minutes)):
                    add_minute(db, own, minute, boot, is_dense=is_dense)
                db.execute("COMMIT")
        add_sessions(store, minutes)
    own.path.unlink()
    print(f"{minutes * own.samples_a_minute:.3g} samples sent in {minutes / 60:.0f} hours")


def add_minute(db: sqlite3.Connection, own: Traffic, minute: int, boot: int, *, is_dense: bool) -> None:
    """Add a minute of the traffic to a store: all of it within sessions, thinned elsewhere."""
    origin = minute % MINUTES
    is_whole = minute % SESSION_EVERY >= SESSION_EVERY - MINUTES
    chunks = own.chunks[origin]
    if is_whole:
        chunks = large_chunks([replace(c, stamp=moved(c.stamp, minute)) for c in own.captures[origin]])
    for chunk in chunks:
        first, last = (stamp if is_whole else moved(stamp, minute) for stamp in (chunk.first, chunk.last))
        at = (first.utc_ns, first.monotonic_ns, boot, last.utc_ns, last.monotonic_ns, boot)
        db.execute(_CHUNK, (chunk.link, *at, chunk.captures, chunk.payload_bytes, chunk.blob))
    origin_ns = origin * SPAN_NS
    there = moved(Stamp(0, origin_ns, ""), minute)
    values = (there.utc_ns, there.monotonic_ns - origin_ns, boot, origin_ns, is_whole or is_dense)
    for statement in (_SAMPLES.format("joint_samples"), _SAMPLES.format("signals"), _FIXES):
        db.execute(statement, values)


def add_sessions(store: Store, minutes: int) -> None:
    """Add a closed session of eight minutes where all was stored, with an observation a second."""
    rig = load_rig("swdt82")
    table, observations = SessionTable(store, "swdt82"), ObservationTable(store)
    joints = {f"{joint.name}_{joint.unit}": 1.0 for joint in rig.rig.joints}
    for number in itertools.count(1):
        last = number * SESSION_EVERY - 1
        if last >= minutes:
            return
        begin = moved(Stamp(UTC_0_NS + SPAN_NS, SPAN_NS, ""), last - MINUTES + 2)
        name = f"s{number:04d}"
        with store.transaction():
            table.start(begin, id=name, rig_text=rig.text, prism="r", operator="", kind="static_poses")
            for second in range(60 * (MINUTES - 2)):
                place = {"x_mm": 1000.0 + second, "y_mm": 2000.0, "z_mm": 3000.0, "moving": 0}
                row = {"session_id": name, "prism": "r", "pose": f"1.{second // 10}", **place, "values_json": joints}
                observations.add(None, begin.shifted(second * NS_PER_S), **row)
            ended = store.instant(begin.shifted(60 * (MINUTES - 2) * NS_PER_S), "ended_")
            table.change(name, state="closed", **ended)


class Bars:
    """Times that are measured, and whether all are within their bars."""

    def __init__(self) -> None:
        self.are_held = True

    def note(self, what: str, seconds: float, bar_s: float | None) -> None:
        """Print a time."""
        bar = "" if bar_s is None else f"   bar {bar_s * 1000:.0f} ms"
        print(f"  {what:{CELL}s} {seconds * 1000:9.1f} ms{bar}", flush=True)
        self.are_held = self.are_held and (bar_s is None or seconds <= bar_s)

    def took(self, what: str, bar_s: float | None, work: Callable[..., object], *arguments: object) -> None:
        """Measure work, and print the longest of three times."""
        self.note(what, max(_seconds(work, *arguments) for _ in range(3)), bar_s)


def _seconds(work: Callable[..., object], *arguments: object) -> float:
    begin = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - begin


def _observations(reader: Reader, name: str) -> int:
    return sum(1 for _ in all_observations(reader, [name]))


def _first_capture(reader: Reader, since: Stamp, until: Stamp) -> Capture:
    return next(iter(reader.captures("boom", since, until)))


def _captures(reader: Reader, since: Stamp, until: Stamp) -> int:
    return sum(1 for _ in reader.captures(None, since, until))


def measure(directory: Path, path: Path) -> bool:
    """Print what a user waits for; returns whether all bars are held."""
    bars = Bars()
    bars.took("open and close the store", OPEN_S, lambda: Store(path).close())
    begin = time.perf_counter()
    with idle_daemon(directory) as running:
        socket = running.socket_path
        bars.note("start of the daemon, until `status` answers", _until_it_answers(socket) - begin, OPEN_S)
        bars.took("status", STATUS_S, request, socket, "status")
        sessions = request(socket, "session.list")
        names = [sessions[0]["id"], sessions[len(sessions) // 2]["id"], sessions[-1]["id"]]
        bars.took(f"session list ({len(sessions)} sessions)", QUERY_S, request, socket, "session.list")
        for name in names:
            bars.took(f"session show {name}", QUERY_S, request, socket, "session.show", {"id": name})
    with Reader(path) as reader:
        for name in names:
            (row,) = reader.rows("SELECT * FROM calibration_sessions WHERE id = ?", [name])
            since, until = reader.stamp(row, "started_"), reader.stamp(row, "ended_")
            bars.took(f"observations of {name}", QUERY_S, _observations, reader, name)
            bars.took(f"first capture of {name}", QUERY_S, _first_capture, reader, since, until)
            later = until.shifted(3600 * NS_PER_S)  # where no session is
            bars.took("captures of an instant", QUERY_S, _captures, reader, later, later)
        bars.took("all captures of 8 minutes", None, _captures, reader, since, until)
    config = parse_config(CONFIG, path).model_copy(update={"state_directory": directory})
    with tempfile.TemporaryDirectory() as out:
        bars.note(
            "session export of 8 minutes",
            _seconds(export_session, config, names[0], Path(out), "log", times_away),
            None,
        )
    return bars.are_held


def _until_it_answers(socket: Path) -> float:
    while True:
        with contextlib.suppress(CommandError):
            request(socket, "status")
            return time.perf_counter()
        time.sleep(0.005)


@contextlib.contextmanager
def scratch(keep: Path | None) -> Iterator[Path]:
    """Yield the directory of the store: one that stays, or one for the time being."""
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep
        return
    with tempfile.TemporaryDirectory() as scratch:
        yield Path(scratch)


def main() -> int:
    """Make the store and print what a user waits for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=float, default=1e8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="directory of the store, which stays and is measured again")
    options = parser.parse_args()
    with scratch(options.keep) as directory:
        path = directory / "rigcal.sqlite"
        if not path.exists():
            print(f"made in {_seconds(build, path, options.samples, options.seed):.0f} s")
        print(f"the store has {path.stat().st_size / 2**30:.2f} GiB")
        return int(not measure(directory, path))


if __name__ == "__main__":
    sys.exit(main())
