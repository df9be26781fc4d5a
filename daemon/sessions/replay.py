"""Captures read back from captured files, on one time axis and with the configured link names; readings as text."""

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
    """Yield the captures of one file, in order, with the link names of the configuration.

    The channels of a CAN log are matched with the names of the configured links, then with their channels (`can0`).
    Channel numbers of `.asc` and `.blf` are matched by the session file, or else as in `vector_channels`. If the log
    has one channel and one link is configured, they are matched in any case, unless the session file contradicts. Two
    channels never become one link.

    A log contains UTC only, so all stamps use UTC as their monotonic axis. Where recorded time steps back, monotonic
    time stands still until recorded time has caught up.

    Args:
        path: the file.
        config: the configuration, which names the links.
        told: the session file of the log; None without one.

    Raises:
        DescriptionError: the file is malformed (the message gives file and line), is not a captured log, has several
            channels for one link or a channel that fits several links, or is not the file that the session file
            describes.
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
            at_s = capture.stamp.utc_ns / NS_PER_S
            raise DescriptionError(str(path), f"the time of a capture, {at_s:.0f} s, is not between 1970 and 2100")
        latest_ns = max(latest_ns, capture.stamp.utc_ns)
        is_doubtful = link in doubtful and doubtful[link].is_among(counts[link])
        counts[link] += 1
        yield replace(capture, link=link, stamp=Stamp(capture.stamp.utc_ns, latest_ns, BOOT_ID, is_doubtful))
    for link, count in counts.items():
        if link in doubtful and doubtful[link].captures != count:
            expected = f"but the session file expects {doubtful[link].captures}"
            raise DescriptionError(
                str(path), f"has {count} captures of link {link!r}, {expected}: give the log exported with that file"
            )


def _several_channels(path: Path, link: str, what: str, known: Mapping[str, str]) -> DescriptionError:
    found = ", ".join(sorted({capture.link for capture in read_can_log(path)}))
    return DescriptionError(
        str(path),
        f"contains frames of several channels, {found}, and more than one would become link {link!r}: configure each "
        f"as a {what} (known: {', '.join(known)}), or give a log of only the link's channel",
    )


def first_captures(paths: Sequence[Path], config: Config, told: SessionFile | None = None) -> dict[Path, Capture]:
    """Return the first capture of each file; every file is read completely, so that faults are found before the replay.

    A file without captures is accepted, and left out of the result, if its name is that of a link of which the session
    file knows no capture.

    Args:
        paths: the files.
        config: the configuration, which names the links.
        told: the session file of the logs; None without one.

    Raises:
        DescriptionError, ConfigError: as for `captures_of`; or a file contains no captures, is given twice, or overlaps
            in time with another file of the same link; or a link has no captures from the time of the session.
    """
    firsts: dict[Path, Capture] = {}
    spans: dict[str, list[_Span]] = {}
    for path in paths:
        if path in firsts:
            raise DescriptionError(str(path), "is given twice, so its captures would be stored twice; give it once")
        found: dict[str, _Span] = {}
        for capture in captures_of(path, config, told):
            firsts.setdefault(path, capture)
            at_ns = capture.stamp.monotonic_ns
            span = found.get(capture.link)
            found[capture.link] = _Span(path, at_ns, at_ns) if span is None else span._replace(last_ns=at_ns)
        if path not in firsts and not _is_of_silent_link(path, config, told):
            raise DescriptionError(str(path), "contains no captures: leave it out")
        for link, span in found.items():
            others = spans.setdefault(link, [])
            for other in others:
                span.check_apart(other, link)
            others.append(span)
    if not firsts:
        raise DescriptionError(", ".join(map(str, paths)), "no file contains captures: nothing can be replayed")
    if told is not None:
        for link, found_in in spans.items():
            _check_overlap(found_in, link, told)
    return firsts


def _is_of_silent_link(path: Path, config: Config, told: SessionFile | None) -> bool:
    """Return True if a file is named after a link of the session file which has no doubtful captures there."""
    if told is None:
        return False
    stations = (section.name for section in config.station)
    named = links_named_by(path, stations if path.suffix.lower() == SERIAL_SUFFIX else told.can_channels)
    return bool(named) and named[0] not in told.doubtful


class _Span(NamedTuple):
    """Time of the first and the last capture of a link in a file."""

    path: Path
    first_ns: int
    last_ns: int

    def check_apart(self, other: _Span, link: str) -> None:
        """Refuse a file that overlaps in time with another file of the link; they may share one instant."""
        first_ns, last_ns = max(self.first_ns, other.first_ns), min(self.last_ns, other.last_ns)
        if first_ns < last_ns or (self.first_ns, self.last_ns) == (other.first_ns, other.last_ns):
            raise DescriptionError(
                str(self.path),
                f"contains captures of link {link!r} from {_utc(first_ns)} to {_utc(last_ns)}, and so does "
                f"{other.path}: they would be stored twice; give one of the two",
            )

    def is_of(self, told: SessionFile) -> bool:
        """Return True if part of the span may lie in a session."""
        return self.first_ns <= told.until_utc_ns + AFTER_NS and self.last_ns >= told.since_utc_ns - BEFORE_NS

    def zone_of_second_hour(self, told: SessionFile) -> str | None:
        """Return a TZ of fixed offset in which an ambiguous local time matches the session; None if there is none."""
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
    """Refuse a link whose files have no captures from the time of the session: their clocks differ."""
    if any(span.is_of(told) for span in spans):
        return
    path, first_ns, last_ns = spans[0]
    zone = spans[0].zone_of_second_hour(told) if path.suffix.lower() == ".asc" else None
    if zone is not None:
        remedy = (
            "local time in an .asc is ambiguous at the end of summer time, and was read as the earlier one: set the "
            f"environment variable TZ to {zone}, with which the log matches the session, or export the session with "
            "--format candump"
        )
    elif path.suffix.lower() == ".asc":
        remedy = (
            "an .asc contains local time without a time zone: set the environment variable TZ to the zone where it was "
            "made, such as TZ=Europe/Berlin, or export the session with --format candump"
        )
    else:
        remedy = "give the files that were exported with the session"
    raise DescriptionError(
        str(path),
        f"contains captures of link {link!r} from {_utc(first_ns)} to {_utc(last_ns)}, but the session lasted from "
        f"{_utc(told.since_utc_ns)} to {_utc(told.until_utc_ns)}: {remedy}",
    )


def _utc(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns / NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"


def merged(paths: Sequence[Path], config: Config, told: SessionFile | None = None) -> Iterator[Capture]:
    """Yield the captures of several files in order of time; at equal instants in the order of the files."""
    files = (captures_of(path, config, told) for path in paths)
    return heapq.merge(*files, key=lambda capture: capture.stamp.monotonic_ns)


def stored_readings(reader: Reader) -> Iterator[str]:
    """Yield all decoded records as JSON lines that depend only on the captures.

    There is one line per joint sample, signal, fix, event, failure and gap, each kind in the order it was stored.
    """
    for table, row in reader.records():
        plain = {key: value.hex() if isinstance(value, bytes) else value for key, value in row.items()}
        yield json.dumps({"table": table, **plain}, separators=(",", ":"))
