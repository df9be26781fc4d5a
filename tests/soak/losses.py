"""What the rig sent beside what the store holds: every difference must be accounted for by a gap."""

from __future__ import annotations

import json
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from pathlib import Path

from daemon.store.reader import Reader
from drivers.clock import NS_PER_S
from drivers.readings import CanCapture, Capture

EARLIEST_NS = -NS_PER_S // 20  # a stored stamp may lie this much before the log's: neither clock is read on the wire
LATEST_NS = 4 * NS_PER_S  # and this much behind it, where the computer is busy
RUN_LENGTHS = (24, 8, 3)  # after a loss: this many in a row must fit again, the longest run first
EDGE_NS = NS_PER_S // 4  # the ends of gaps are known to a quarter of a second: the links look that often


@dataclass(frozen=True)
class Item:
    """A frame, or a byte, with its instant.

    Attributes:
        at_ns: on the rig's monotonic clock.
        what: what makes it differ from others.
    """

    at_ns: int
    what: str


@dataclass(frozen=True)
class Measured:
    """A distance that the station measured: see `simulators.wire_log`."""

    at_ns: int
    target: str
    place_mm: tuple[float, float, float]
    pose: Mapping[str, float]


@dataclass
class Wire:
    """A wire log, read.

    Attributes:
        frames: on the bus.
        station: bytes from the station.
        measured: in the order of time.
        events: with their instants.
    """

    frames: list[Item] = field(default_factory=list)
    station: list[Item] = field(default_factory=list)
    measured: list[Measured] = field(default_factory=list)
    events: list[tuple[int, Mapping[str, object]]] = field(default_factory=list)


def read_wire_log(path: Path) -> Wire:
    """Everything in a wire log."""
    wire = Wire()
    with path.open(encoding="ascii") as lines:
        for line in lines:
            kind, at, rest = line.rstrip("\n").split(" ", 2)
            at_ns = int(at)
            if kind == "C":
                identifier, flags, data = rest.split(" ")
                wire.frames.append(Item(at_ns, _frame(int(identifier, 16), flags, data)))
            elif kind == "S":
                wire.station += [Item(at_ns, rest[i : i + 2]) for i in range(0, len(rest), 2)]
            elif kind == "M":
                target, x, y, z, pose = rest.split(" ", 4)
                wire.measured.append(Measured(at_ns, target, (float(x), float(y), float(z)), json.loads(pose)))
            else:
                wire.events.append((at_ns, json.loads(rest)))
    return wire


def _frame(identifier: int, flags: str, data: str) -> str:
    # An adapter tells of an error in its own words, which lack the details.
    return f"{identifier:X} e" if "e" in flags else f"{identifier:X} {flags} {data}"


def stored_items(captures: Iterable[Capture]) -> list[Item]:
    """What was received among captures, as `read_wire_log` has what was sent."""
    items: list[Item] = []
    for capture in captures:
        if capture.is_transmitted:
            continue
        at_ns = capture.stamp.monotonic_ns
        if isinstance(capture, CanCapture):
            flags = "x" * capture.is_extended + "r" * capture.is_remote + "e" * capture.is_error or "-"
            items.append(Item(at_ns, _frame(capture.arbitration_id, flags, capture.data.hex())))
        else:
            items += [Item(at_ns, f"{byte:02x}") for byte in capture.data]
    return items


@dataclass(frozen=True)
class Comparison:
    """Sent and stored items of one link, side by side.

    Attributes:
        stored_ns: for each sent item the stamp under which it was stored; None if it was lost.
        foreign: stored, never sent so.
    """

    stored_ns: list[int | None]
    foreign: list[Item]


def compare(sent: Sequence[Item], stored: Sequence[Item]) -> Comparison:
    """Find every stored item among the sent ones, in order, each as early as may be."""
    places: dict[str, list[int]] = {}
    for place, item in enumerate(sent):
        places.setdefault(item.what, []).append(place)
    stored_ns: list[int | None] = [None] * len(sent)
    foreign: list[Item] = []
    at = 0
    for number, item in enumerate(stored):
        if at >= len(sent) or sent[at].what != item.what:
            found = _resume(sent, stored, places, at, number)
            if found is None:
                foreign.append(item)
                continue
            at = found
        stored_ns[at] = item.at_ns
        at += 1
    return Comparison(stored_ns, foreign)


def _resume(
    sent: Sequence[Item], stored: Sequence[Item], places: Mapping[str, list[int]], at: int, number: int
) -> int | None:
    """Where in `sent`, from `at` on, the stored items from `number` on go on."""
    wanted = places.get(stored[number].what, [])
    first = bisect_left(wanted, at)
    latest_ns = stored[number].at_ns - EARLIEST_NS
    for length in RUN_LENGTHS:
        run = [item.what for item in stored[number : number + length]]
        for place in wanted[first:]:
            if sent[place].at_ns > latest_ns:
                break
            if [item.what for item in sent[place : place + len(run)]] == run:
                return place
    return None


@dataclass(frozen=True)
class Gap:
    """A stored gap: nanoseconds on the rig's clock; `end_ns` None while it lasts."""

    channel: str
    reason: str
    start_ns: int
    end_ns: int | None
    missed: int | None

    def covers(self, at_ns: int) -> bool:
        """Whether it says that something was lost at that instant."""
        return self.start_ns - EDGE_NS <= at_ns and (self.end_ns is None or at_ns <= self.end_ns + EDGE_NS)


# Nothing of a stretch of doubtful time may be used: it tells as well of what an adapter could not hold meanwhile.
LOSSES = ("link_down", "not_running", "frames_lost", "time_doubtful")


def stored_gaps(reader: Reader) -> list[Gap]:
    """All gaps in a store."""
    rows = reader.rows("SELECT channel, reason, start_monotonic_ns, end_monotonic_ns, missed FROM gaps ORDER BY id")
    return [Gap(*row.values()) for row in rows]


@dataclass(frozen=True)
class Account:
    """How a link's losses are accounted for.

    Attributes:
        sent, stored: how many items.
        lost: how many were not stored.
        told: of those, how many lie in a gap.
        untold: the others.
        foreign: stored, and never sent so.
        understated: gaps that give a number of losses that is too small, in words.
        backwards: stamps of the link that lie before the one before.
        delay_p99_s: from the wire to the stamp, rig seconds.
    """

    sent: int
    stored: int
    lost: int
    told: int
    untold: list[Item]
    foreign: list[Item]
    understated: list[str]
    backwards: int
    delay_p99_s: float


def _told(sent: Sequence[Item], gaps: Sequence[Gap]) -> list[bool]:
    """Whether each item lies in a gap."""
    told = [False] * len(sent)
    at_ns = [item.at_ns for item in sent]
    for gap in gaps:
        first = bisect_left(at_ns, gap.start_ns - EDGE_NS)
        end = len(sent) if gap.end_ns is None else bisect_right(at_ns, gap.end_ns + EDGE_NS)
        told[first:end] = [True] * max(0, end - first)
    return told


def _untold(
    sent: Sequence[Item], stored: Sequence[Item], must_be_there: Sequence[bool], stored_ns: Sequence[int | None]
) -> list[Item]:
    """Items that must be there and are not.

    Between two gaps everything that was sent must be found in one piece. Only where it is not, single items are looked
    at: a station that searches says the same again and again, and which of these records is missing, nobody can tell.
    """
    untold: list[Item] = []
    stamps = [item.at_ns for item in stored]
    for is_wanted, run in groupby(range(len(sent)), key=lambda place: must_be_there[place]):
        if not is_wanted:
            continue
        places = list(run)
        first = bisect_left(stamps, sent[places[0]].at_ns + EARLIEST_NS)
        end = bisect_right(stamps, sent[places[-1]].at_ns + LATEST_NS)
        if _text(sent[places[0] : places[-1] + 1]) not in _text(stored[first:end]):
            untold += [sent[place] for place in places if stored_ns[place] is None]
    return untold


def _text(items: Sequence[Item]) -> str:
    return "\n" + "\n".join(item.what for item in items) + "\n"


def account(link: str, sent: Sequence[Item], stored: Sequence[Item], gaps: Sequence[Gap], until_ns: int) -> Account:
    """Hold what was sent on a link until `until_ns` against what was stored, and against the gaps.

    Args:
        link: whose gaps count, with those of the whole daemon.
        sent, stored: see `read_wire_log` and `stored_items`.
        gaps: all of the store.
        until_ns: what was sent later need not be there.
    """
    begin_ns = stored[0].at_ns + EARLIEST_NS if stored else 0
    begin = bisect_left([item.at_ns for item in sent], begin_ns - NS_PER_S)
    sent = sent[begin:]
    compared = compare(sent, stored)
    of_link = [gap for gap in gaps if gap.channel in (link, "daemon") and gap.reason in LOSSES]
    counts = [begin_ns <= item.at_ns <= until_ns for item in sent]
    told = _told(sent, of_link)
    must_be_there = [is_counted and not is_told for is_counted, is_told in zip(counts, told, strict=True)]
    untold = _untold(sent, stored, must_be_there, compared.stored_ns)
    lost = [
        item for item, at, is_counted in zip(sent, compared.stored_ns, counts, strict=True) if at is None and is_counted
    ]
    alone = Counter(gaps_of[0] for item in lost if len(gaps_of := [g for g in of_link if g.covers(item.at_ns)]) == 1)
    understated = [
        f"{gap.reason} at {gap.start_ns / NS_PER_S:.1f} s: says {gap.missed}, lost {n}"
        for gap, n in alone.items()
        if gap.missed is not None and n > gap.missed
    ]
    delays = sorted(at - item.at_ns for at, item in zip(compared.stored_ns, sent, strict=True) if at is not None)
    return Account(
        sent=len(sent),
        stored=len(stored),
        lost=len(lost),
        told=len(lost) - len(untold),
        untold=untold,
        foreign=compared.foreign,
        understated=understated,
        backwards=sum(b.at_ns < a.at_ns for a, b in pairwise(stored)),
        delay_p99_s=delays[int(0.99 * (len(delays) - 1))] / NS_PER_S if delays else 0.0,
    )
