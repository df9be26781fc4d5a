"""Captured files back into captures: one time axis, link names of the configuration; and stored readings as text."""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from daemon.config import Config, ConfigError
from daemon.sessions.export.session_file import DoubtfulCaptures
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S, Stamp
from drivers.errors import DescriptionError
from drivers.logs.can_log import read_can_log
from drivers.logs.serial_log import read_serial_log
from drivers.readings import Capture

CAN_SUFFIXES = (".log", ".asc", ".blf")
SERIAL_SUFFIX = ".serial"
BOOT_ID = "replayed"
LATEST_UTC_NS = 4_102_444_800 * NS_PER_S  # the year 2100


NO_DOUBTS: Mapping[str, DoubtfulCaptures] = {}


def captures_of(path: Path, config: Config, doubtful: Mapping[str, DoubtfulCaptures] = NO_DOUBTS) -> Iterator[Capture]:
    """Captures of one file, in order, with the link names of the configuration.

    A CAN log's channels are matched with the configured links' names, then with their channels (`can0`); a log of one
    channel and a configuration of one link belong together in any case.

    A log knows UTC alone, so all stamps are put on one monotonic axis: that of UTC. Recorded time that steps back
    stands still until it is past again.

    Args:
        path: the file.
        config: names the links.
        doubtful: link -> its captures of doubtful time, as a session file tells them.

    Raises:
        DescriptionError: the file is malformed (file and line), or is no captured log; or it is not the one that
            `doubtful` speaks of.
        ConfigError: a link of the file is not configured.
    """
    captures: Iterator[Capture]
    suffix = path.suffix.lower()
    if suffix in CAN_SUFFIXES:
        known = {section.channel: section.name for section in config.can} | {s.name: s.name for s in config.can}
        what, captures = "[[can]]", read_can_log(path)
        only = config.can[0].name if len(config.can) == 1 else None
    elif suffix == SERIAL_SUFFIX:
        known = {station.name: station.name for station in config.station}
        what, captures = "[[station]]", read_serial_log(path)
        only = config.station[0].name if len(config.station) == 1 else None
    else:
        allowed = ", ".join((*CAN_SUFFIXES, SERIAL_SUFFIX))
        raise DescriptionError(str(path), f"not a captured log by its name; allowed endings: {allowed}")
    latest_ns = 0
    counts: Counter[str] = Counter()
    for capture in captures:
        link = known.get(capture.link, only)
        if link is None:
            raise ConfigError(f"{path}: link {capture.link!r} is not configured as {what}; known: {', '.join(known)}")
        if not 0 <= capture.stamp.utc_ns < LATEST_UTC_NS:
            raise DescriptionError(str(path), f"a capture at {capture.stamp.utc_ns / NS_PER_S:.0f} s is beyond 2100")
        latest_ns = max(latest_ns, capture.stamp.utc_ns)
        told = doubtful.get(link)
        is_doubtful = told is not None and told.is_among(counts[link])
        counts[link] += 1
        yield replace(capture, link=link, stamp=Stamp(capture.stamp.utc_ns, latest_ns, BOOT_ID, is_doubtful))
    for link, count in counts.items():
        if link in doubtful and doubtful[link].captures != count:
            expected = f"the session file is of one with {doubtful[link].captures}"
            raise DescriptionError(
                str(path), f"has {count} captures of link {link!r}, {expected}: give the log that was exported with it"
            )


def first_captures(
    paths: Sequence[Path], config: Config, doubtful: Mapping[str, DoubtfulCaptures] = NO_DOUBTS
) -> dict[Path, Capture]:
    """The first capture of each file; every file is read through, so that a bad one is refused before anything runs.

    Raises:
        DescriptionError, ConfigError: as `captures_of`; or a file holds no captures.
    """
    firsts: dict[Path, Capture] = {}
    for path in paths:
        for capture in captures_of(path, config, doubtful):
            firsts.setdefault(path, capture)
        if path not in firsts:
            raise DescriptionError(str(path), "holds no captures")
    return firsts


def merged(
    paths: Sequence[Path], config: Config, doubtful: Mapping[str, DoubtfulCaptures] = NO_DOUBTS
) -> Iterator[Capture]:
    """Captures of several files in the order of their instants; at one instant in the order of the files."""
    files = (captures_of(path, config, doubtful) for path in paths)
    return heapq.merge(*files, key=lambda capture: capture.stamp.monotonic_ns)


def stored_readings(reader: Reader) -> Iterator[str]:
    """Everything that decoding has stored, as JSON lines that depend on nothing but the captures.

    One line a joint sample, signal, fix, event, failure and gap, each kind in the order it was stored.
    """
    for table, row in reader.records():
        plain = {key: value.hex() if isinstance(value, bytes) else value for key, value in row.items()}
        yield json.dumps({"table": table, **plain}, separators=(",", ":"))
