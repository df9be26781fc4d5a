"""The decoders of all links, from captures to records; a failing decoder stops neither the others nor acquisition."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

from drivers.can.summary import CanSummary
from drivers.can_decoder import CanDecoder
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import Capture, DecodeFailure, Decoder, DeviceEvent, Record

log = logging.getLogger(__name__)

TICK_NS = NS_PER_S // 10  # decoders are told the time this often


class LinkDecoders:
    """The decoders of all links, each within one boot.

    Args:
        factories: link -> function that makes its decoder; captures of other links are ignored.
        recalled: returns the events that describe the devices' states before an instant, in its boot; a new decoder
            starts from these states.
    """

    def __init__(
        self,
        factories: Mapping[str, Callable[[], Decoder]],
        recalled: Callable[[Stamp], Sequence[DeviceEvent]] = lambda _: (),
    ) -> None:
        self._factories, self._recalled = factories, recalled
        self._decoders: dict[str, Decoder] = {}
        self._boots: dict[str, str] = {}
        self._defects: dict[str, Stamp] = {}
        self._ticked_ns = -TICK_NS

    def feed(self, captures: Sequence[Capture]) -> list[Record]:
        """Decode captures, and return their records in order."""
        records: list[Record] = []
        link = boot = None
        decoder: Decoder | None = None
        for capture in captures:
            if capture.link != link or capture.stamp.boot_id != boot:
                link, boot = capture.link, capture.stamp.boot_id
                decoder = self._decoder(link, capture.stamp) if link in self._factories else None
            if decoder is None:
                continue
            try:
                produced = decoder.feed(capture)
            except Exception as error:  # noqa: BLE001 - see _failure
                produced = [self._failure(capture.link, capture.stamp, error, capture.data)]
            if produced:
                records.extend(produced)
        return records

    def feed_and_tick(self, captures: Sequence[Capture]) -> list[Record]:
        """Decode captures, and return their records and those caused by the passing of time in their stamps."""
        records: list[Record] = []
        start = 0
        for i, capture in enumerate(captures):
            if not 0 <= capture.stamp.monotonic_ns - self._ticked_ns < TICK_NS:
                records += self.feed(captures[start:i])
                records += self.tick(capture.stamp)
                start, self._ticked_ns = i, capture.stamp.monotonic_ns
        return records + self.feed(captures[start:])

    def tick(self, now: Stamp) -> list[Record]:
        """Tell the time to the decoders of the boot of `now`, and return the records that it causes."""
        records: list[Record] = []
        for link in self._factories:
            if self._boots.setdefault(link, now.boot_id) != now.boot_id:
                continue
            try:
                records.extend(self._decoder(link, now).tick(now))
            except Exception as error:  # noqa: BLE001 - see _failure
                records.append(self._failure(link, now, error, b""))
        return records

    def summaries(self, now: Stamp) -> list[CanSummary]:
        """Return the frames that CAN links have received until `now`; may be called from any thread."""
        decoders = [self._decoders.get(link) for link in self._factories]
        return [decoder.summary(now) for decoder in decoders if isinstance(decoder, CanDecoder)]

    def defects(self) -> dict[str, Stamp]:
        """Return link -> when its decoder last failed by an internal error; may be called from any thread."""
        return dict(self._defects)

    def _failure(self, link: str, stamp: Stamp, error: Exception, raw: bytes) -> DecodeFailure:
        """Return the failure of a defective decoder; a decoder should never raise. Only the first failure is logged."""
        if link not in self._defects:
            log.critical("link %s: its decoder failed; captures are kept", link, exc_info=error)
        self._defects[link] = stamp
        return DecodeFailure(link, stamp, f"the decoder failed: {type(error).__name__}: {error}", raw)

    def begin(self, at: Stamp) -> list[DeviceEvent]:
        """Make the decoders of all links, and return the events before that instant from which they start."""
        return [event for link in self._factories for event in self._make(link, at)]

    def _decoder(self, link: str, at: Stamp) -> Decoder:
        if link not in self._decoders or self._boots[link] != at.boot_id:
            self._make(link, at)
        return self._decoders[link]

    def _make(self, link: str, at: Stamp) -> list[DeviceEvent]:
        decoder, recalled = self._factories[link](), list[DeviceEvent]()
        if isinstance(decoder, CanDecoder):
            states = self._recalled(at)  # may raise: then no decoder is made
            recalled = decoder.recall(event for event in states if self._links.get(event.device, link) == link)
        self._decoders[link], self._boots[link] = decoder, at.boot_id
        return recalled

    @cached_property
    def _links(self) -> dict[str, str]:
        """Channel -> its CAN link. A channel that an earlier rig file named may have been on any link."""
        made = {link: make() for link, make in self._factories.items()}
        return {
            channel: link
            for link, decoder in made.items()
            if isinstance(decoder, CanDecoder)
            for channel in decoder.channels
        }
