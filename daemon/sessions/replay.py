"""Captured files back into captures: one time axis, link names of the configuration; and stored readings as text."""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from daemon.config.config import Config, ConfigError
from daemon.sessions.export.session_file import SessionFile
from daemon.sessions.vector_channels import SUFFIXES as VECTOR_SUFFIXES
from daemon.sessions.vector_channels import links_named_by, links_of_channels
from daemon.store.queries.sessions import AFTER_NS, BEFORE_NS
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S, Stamp
from drivers.errors import DescriptionError
from drivers.logs.can_log import read_can_log
from drivers.logs.serial_log import read_serial_log
from drivers.readings import Capture

CAN_SUFFIXES = (".log", *VECTOR_SUFFIXES)
SERIAL_SUFFIX = ".serial"
BOOT_ID = "replayed"
LATEST_UTC_NS = 4_102_444_800 * NS_PER_S  # the year 2100


def captures_of(path: Path, config: Config, told: SessionFile | None = None) -> Iterator[Capture]:
    """Captures of one file, in order, with the link names of the configuration.

    A CAN log's channels are matched with the configured links' names, then with their channels (`can0`); the numbers
    of `.asc` and `.blf` by the session file, else as `vector_channels` has it. A log of one channel and a configuration
    of one link belong together in any case, unless the session file says otherwise. Two channels never become one link.

    A log knows UTC alone, so all stamps are put on one monotonic axis: that of UTC. Recorded time that steps back
    stands still until it is past again.

    Args:
        path: the file.
        config: names the links.
        told: the session file of the log; None without one.

    Raises:
        DescriptionError: the file is malformed (file and line), is no captured log, or has several channels for a link,
            or one that may be several links'; or it is not the one that the session file speaks of.
        ConfigError: a link of the file is not configured.
    """
    captures: Iterator[Capture]
    suffix = path.suffix.lower()
    doubtful = {} if told is None else told.doubtful
    if suffix in CAN_SUFFIXES:
        what, captures = "[[can]]", read_can_log(path)
        only = config.can[0].name if len(config.can) == 1 else None
        if suffix in VECTOR_SUFFIXES:
            numbers = {} if told is None else told.can_channels
            known = links_of_channels(path, config, numbers)
            only = None if only in numbers else only
        else:
            known = {section.channel: section.name for section in config.can} | {s.name: s.name for s in config.can}
    elif suffix == SERIAL_SUFFIX:
        known = {station.name: station.name for station in config.station}
        what, captures = "[[station]]", read_serial_log(path)
        only = config.station[0].name if len(config.station) == 1 else None
    else:
        allowed = ", ".join((*CAN_SUFFIXES, SERIAL_SUFFIX))
        raise DescriptionError(str(path), f"not a captured log by its name; allowed endings: {allowed}")
    latest_ns = 0
    counts: Counter[str] = Counter()
    channels: dict[str, str] = {}
    for capture in captures:
        link = known.get(capture.link, only)
        if link is None:
            raise ConfigError(f"{path}: link {capture.link!r} is not configured as {what}; known: {', '.join(known)}")
        if channels.setdefault(link, capture.link) != capture.link:
            raise _several_channels(path, link, what, known)
        if not 0 <= capture.stamp.utc_ns < LATEST_UTC_NS:
            raise DescriptionError(str(path), f"a capture at {capture.stamp.utc_ns / NS_PER_S:.0f} s is beyond 2100")
        latest_ns = max(latest_ns, capture.stamp.utc_ns)
        is_doubtful = link in doubtful and doubtful[link].is_among(counts[link])
        counts[link] += 1
        yield replace(capture, link=link, stamp=Stamp(capture.stamp.utc_ns, latest_ns, BOOT_ID, is_doubtful))
    for link, count in counts.items():
        if link in doubtful and doubtful[link].captures != count:
            expected = f"the session file is of one with {doubtful[link].captures}"
            raise DescriptionError(
                str(path), f"has {count} captures of link {link!r}, {expected}: give the log that was exported with it"
            )


def _several_channels(path: Path, link: str, what: str, known: Mapping[str, str]) -> DescriptionError:
    found = ", ".join(sorted({capture.link for capture in read_can_log(path)}))
    return DescriptionError(
        str(path),
        f"holds frames of several channels, {found}, of which more than one would become link {link!r}: configure each "
        f"as a {what} (known: {', '.join(known)}), or give a log of the link's channel alone",
    )


def first_captures(paths: Sequence[Path], config: Config, told: SessionFile | None = None) -> dict[Path, Capture]:
    """The first capture of each file; every file is read through, so that a bad one is refused before anything runs.

    A file without captures has none, and is taken where it is named by a link that had none by the session file.

    Raises:
        DescriptionError, ConfigError: as `captures_of`; or a file holds no captures, is given twice, or has captures of
            a link from a time from which another file has them; or a link has none from the time of the session.
    """
    firsts: dict[Path, Capture] = {}
    spans: dict[str, list[_Span]] = {}
    for path in paths:
        if path in firsts:
            raise DescriptionError(str(path), "is given twice: its captures would be stored twice; give it once")
        found: dict[str, _Span] = {}
        for capture in captures_of(path, config, told):
            firsts.setdefault(path, capture)
            at_ns = capture.stamp.monotonic_ns
            span = found.get(capture.link)
            found[capture.link] = _Span(path, at_ns, at_ns) if span is None else span._replace(last_ns=at_ns)
        if path not in firsts and not _is_of_silent_link(path, config, told):
            raise DescriptionError(str(path), "holds no captures: leave it out")
        for link, span in found.items():
            others = spans.setdefault(link, [])
            for other in others:
                span.check_apart(other, link)
            others.append(span)
    if not firsts:
        raise DescriptionError(", ".join(map(str, paths)), "no file holds captures: nothing can be replayed")
    if told is not None:
        for link, found_in in spans.items():
            _check_overlap(found_in, link, told)
    return firsts


def _is_of_silent_link(path: Path, config: Config, told: SessionFile | None) -> bool:
    """Return True for the log of a link that a session file knows, and of which it knows no capture."""
    if told is None:
        return False
    stations = (section.name for section in config.station)
    named = links_named_by(path, stations if path.suffix.lower() == SERIAL_SUFFIX else told.can_channels)
    return bool(named) and named[0] not in told.doubtful


class _Span(NamedTuple):
    """From when to when a file has captures of a link."""

    path: Path
    first_ns: int
    last_ns: int

    def check_apart(self, other: _Span, link: str) -> None:
        """Refuse a file that has captures of the link from the time of another; they may meet at one instant."""
        first_ns, last_ns = max(self.first_ns, other.first_ns), min(self.last_ns, other.last_ns)
        if first_ns < last_ns or (self.first_ns, self.last_ns) == (other.first_ns, other.last_ns):
            raise DescriptionError(
                str(self.path),
                f"holds captures of link {link!r} from {_utc(first_ns)} to {_utc(last_ns)}, and so does {other.path}: "
                "they would be stored twice; give one of the two",
            )

    def is_of(self, told: SessionFile) -> bool:
        """Return True if some of it may be from the time of a session."""
        return self.first_ns <= told.until_utc_ns + AFTER_NS and self.last_ns >= told.since_utc_ns - BEFORE_NS

    def zone_of_second_hour(self, told: SessionFile) -> str | None:
        """Return a TZ of fixed offset in which a log of a local time that comes twice is the session's; else None."""
        second = datetime.fromtimestamp(self.first_ns / NS_PER_S, UTC).astimezone().replace(tzinfo=None, fold=1)
        later_ns = round(second.timestamp() * NS_PER_S) - self.first_ns
        moved = self._replace(first_ns=self.first_ns + later_ns, last_ns=self.last_ns + later_ns)
        offset = second.astimezone().utcoffset()
        if offset is None or abs(later_ns) < NS_PER_S or not moved.is_of(told):
            return None
        hours, minutes = divmod(abs(round(offset.total_seconds() / 60)), 60)
        sign = "-" if offset > timedelta(0) else "+"  # POSIX counts to the west
        return f"UTC{sign}{hours}" + (f":{minutes:02d}" if minutes else "")


def _check_overlap(spans: Sequence[_Span], link: str, told: SessionFile) -> None:
    """Refuse a link whose files have nothing from the time of their session: the clock of one of them is another."""
    if any(span.is_of(told) for span in spans):
        return
    path, first_ns, last_ns = spans[0]
    zone = spans[0].zone_of_second_hour(told) if path.suffix.lower() == ".asc" else None
    if zone is not None:
        remedy = (
            "the local time of an .asc may come twice at the end of summer time, and the first one was read: set the "
            f"environment variable TZ to {zone}, in which the log is of the session's time, or export the session with "
            "--format candump"
        )
    elif path.suffix.lower() == ".asc":
        remedy = (
            "an .asc holds local time without its zone: set the environment variable TZ to the zone where it was made, "
            "as TZ=Europe/Berlin, or export the session with --format candump"
        )
    else:
        remedy = "give the files that were exported with it"
    raise DescriptionError(
        str(path),
        f"holds captures of link {link!r} from {_utc(first_ns)} to {_utc(last_ns)}, and the session was from "
        f"{_utc(told.since_utc_ns)} to {_utc(told.until_utc_ns)}: {remedy}",
    )


def _utc(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns / NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"


def merged(paths: Sequence[Path], config: Config, told: SessionFile | None = None) -> Iterator[Capture]:
    """Captures of several files in the order of their instants; at one instant in the order of the files."""
    files = (captures_of(path, config, told) for path in paths)
    return heapq.merge(*files, key=lambda capture: capture.stamp.monotonic_ns)


def stored_readings(reader: Reader) -> Iterator[str]:
    """Yield what decoding has stored as JSON lines that depend on nothing but the captures.

    One line a joint sample, signal, fix, event, failure and gap, each kind in the order it was stored.
    """
    for table, row in reader.records():
        plain = {key: value.hex() if isinstance(value, bytes) else value for key, value in row.items()}
        yield json.dumps({"table": table, **plain}, separators=(",", ":"))
