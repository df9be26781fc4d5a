"""Decodes stored captures again, so that a period has all its readings and fixes, like a session."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.link_decoders import LinkDecoders
from daemon.commands import HOW_TO_READ_AGAIN, REFUSED, CommandError
from daemon.rig_files import misreading, tells_decoding
from daemon.store import Store
from daemon.store.queries.decoding import decoded_before
from daemon.store.queries.device_states import device_states
from daemon.store.queries.sessions import AFTER_NS, BEFORE_NS, sessions_between
from daemon.store.reader import Reader
from daemon.store.upkeep.full_samples import Stretch, put_again, stretches_between, stretches_of_session
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import Capture, Decoder, Fix, Reading

QUERY_NS = 600 * NS_PER_S  # period of one query; while captures are read, the store's write-ahead log grows
SLICE_NS = NS_PER_S  # period stored at once; acquisition waits for one slice at most


def redecode(
    store: Store,
    decoders: Mapping[str, Callable[[], Decoder]],
    stretches: Sequence[Stretch],
    go_on: Callable[[], None] = lambda: None,
    *,
    may_differ: bool = False,
) -> int:
    """Store all readings and fixes decoded from the captures of some periods.

    Decoders start a minute earlier, so that they have received messages that devices send only now and then.

    Args:
        store: the database, open for writing.
        decoders: link -> function that makes its decoder.
        stretches: the periods, each within one boot.
        go_on: called for each second of captures; an exception that it raises ends the work, and stored rows stay.
        may_differ: decoded values may differ from the stored ones, because the rig file is known to be the same and a
            decoder was wrong.

    Returns:
        Number of readings and fixes added.

    Raises:
        StoreError: a chunk of captures is damaged, or decoded readings differ from the stored ones; all readings before
            that are stored.
    """
    added = 0
    with store.reader() as reader:
        for since, until in stretches:
            decoding = LinkDecoders(decoders, partial(device_states, store))
            for batch in _slices(_captures(reader, [*decoders], since.shifted(-BEFORE_NS), until.shifted(AFTER_NS))):
                go_on()
                records = [
                    record
                    for record in decoding.feed_and_tick(batch)
                    if isinstance(record, Reading | Fix)
                    and since.monotonic_ns <= record.stamp.monotonic_ns <= until.monotonic_ns
                ]
                added += put_again(store, records, may_differ=may_differ)
    return added


def _captures(reader: Reader, links: Sequence[str], since: Stamp, until: Stamp) -> Iterator[Capture]:
    """Yield the captures of all links in order of time; each link's order is kept."""
    while since.monotonic_ns <= until.monotonic_ns:
        last = min(until, since.shifted(QUERY_NS), key=lambda stamp: stamp.monotonic_ns)
        own = [reader.captures(link, since, last) for link in links]
        yield from heapq.merge(*own, key=lambda capture: capture.stamp.monotonic_ns)
        since = last.shifted(1)


def _slices(captures: Iterator[Capture]) -> Iterator[list[Capture]]:
    batch: list[Capture] = []
    for capture in captures:
        if batch and not 0 <= capture.stamp.monotonic_ns - batch[0].stamp.monotonic_ns < SLICE_NS:
            yield batch
            batch = []
        batch.append(capture)
    if batch:
        yield batch


def redecode_command(
    store: Store,
    rig: Rig,
    decoders: Mapping[str, Callable[[], Decoder]],
    arguments: Mapping[str, Any],
    go_on: Callable[[], None],
) -> dict[str, Any]:
    """Decode the raw captures of a session, or of a period, again into readings and fixes.

    Only captures older than the oldest ones that wait to be decoded for the first time are decoded.

    Args:
        store: the database, open for writing.
        rig: the rig of the decoders.
        decoders: link -> function that makes its decoder.
        arguments: `session`, or `first_utc_ns` and `last_utc_ns`.
        go_on: called repeatedly; an exception that it raises ends the work, and stored rows stay.

    Raises:
        CommandError: there is nothing to decode, all captures wait to be decoded for the first time, or a session in
            the period was recorded with a rig file that gives different readings.
        StoreError: as for `redecode`.
    """
    with store.reader() as reader:
        if session := arguments.get("session"):
            stretches = stretches_of_session(reader, str(session))
            what = f"session {str(session)!r:.80}"
        else:
            first_ns, last_ns = arguments.get("first_utc_ns"), arguments.get("last_utc_ns")
            if not isinstance(first_ns, int) or not isinstance(last_ns, int) or first_ns >= last_ns:
                raise CommandError("give a session, or a period whose end is later than its start")
            stretches = stretches_between(reader, first_ns, last_ns)
            what = f"the period from {_text(first_ns)} to {_text(last_ns)}"
        if not stretches:
            raise CommandError(f"the store has no captures of {what}; `rigcal session list` shows the sessions")
        wanted, stretches = stretches, decoded_before(reader, stretches, AFTER_NS)
        if not stretches:
            raise CommandError(
                f"{what} waits to be decoded for the first time; try again when `rigcal store stats` shows that no "
                "captures wait"
            )
        may_differ = session is not None
        for since, until in stretches:
            for row in sessions_between(reader, since, until, store.boot_row(since)):
                if why := misreading(rig, row["rig_text"], row["prism"]):
                    raise CommandError(
                        f"session {row['id']} was recorded with a rig file other than the one in use: {why}; "
                        f"{HOW_TO_READ_AGAIN}",
                        REFUSED,
                    )
                may_differ &= tells_decoding(rig, row["rig_text"])
    # Outside sessions, and in sessions of versions that did not store the decoding of channels, only the readings
    # themselves show with which files they were decoded.
    added = redecode(store, decoders, stretches, go_on, may_differ=may_differ)
    return {
        "added": added,
        "is_whole": stretches == wanted,  # False if newer captures wait to be decoded for the first time
        "stretches": [{"first_utc_ns": first.utc_ns, "last_utc_ns": last.utc_ns} for first, last in stretches],
    }


def _text(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"
