"""Decodes stored captures again, so that a stretch of time has all its readings and fixes, as a session has them."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence

from daemon.acquisition.link_decoders import LinkDecoders
from daemon.store import Store
from daemon.store.full_samples import Stretch, put_again
from daemon.store.reader import Reader
from daemon.store.sessions import AFTER_NS, BEFORE_NS
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import Capture, Decoder, Fix, Reading

QUERY_NS = 600 * NS_PER_S  # while captures are read, the write-ahead log of the store grows
SLICE_NS = NS_PER_S  # stored at once: acquisition must not wait for more


def redecode(
    store: Store,
    decoders: Mapping[str, Callable[[], Decoder]],
    stretches: Sequence[Stretch],
    go_on: Callable[[], None] = lambda: None,
) -> int:
    """Store every reading and fix that the captures of some stretches of time hold.

    Decoders begin a minute earlier, so that they know by then what devices say now and then.

    Args:
        store: open for writing.
        decoders: link -> what makes its decoder.
        stretches: of time, each within one boot.
        go_on: called for each second of captures; what it raises ends the work, and what is stored stays.

    Returns:
        How many readings and fixes there are now that were not there before.

    Raises:
        StoreError: a chunk of captures is damaged; all before it is stored.
    """
    added = 0
    with store.reader() as reader:
        for since, until in stretches:
            decoding = LinkDecoders(decoders)
            for batch in _slices(_captures(reader, [*decoders], since.shifted(-BEFORE_NS), until.shifted(AFTER_NS))):
                go_on()
                records = [
                    record
                    for record in decoding.feed_and_tick(batch)
                    if isinstance(record, Reading | Fix)
                    and since.monotonic_ns <= record.stamp.monotonic_ns <= until.monotonic_ns
                ]
                added += put_again(store, records)
    return added


def _captures(reader: Reader, links: Sequence[str], since: Stamp, until: Stamp) -> Iterator[Capture]:
    """Captures of all links by their instants; a link's own stay in order."""
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
