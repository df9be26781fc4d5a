"""The status shows what was heard of every CAN identifier, asked for by the rig or not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.status.snapshot import FrameStatus
from daemon.store import Store
from drivers.can.raw_signal import BitField, SignalChannel, SignalDecoder
from drivers.can_decoder import IDS_MAX, CanDecoder
from drivers.clock import ManualClock
from drivers.readings import CanCapture, LinkItem
from tests.daemon.support.acquisition import ListLink, NumberDecoder, wait_until
from tests.daemon.support.store import at, serial_bytes

PUMP = SignalChannel(
    name="pump", unit="bar", arbitration_id=0x201, field=BitField(0, 8), counter=BitField(8, 4), timeout_s=60.0
)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(tmp_path / "rigcal.sqlite")
    store.declare_channels({}, {"pump": "bar"})
    yield store
    store.close()


def frame(arbitration_id: int, seconds: float, data: str = "", **flags: bool) -> CanCapture:
    return CanCapture("boom", at(seconds), arbitration_id, bytes.fromhex(data), **flags)


def heard(store: Store, items: list[LinkItem]) -> Acquisition:
    """An acquisition that has decoded `items` of a CAN link, and stopped."""
    links = [ListLink("boom", items), ListLink("station", [serial_bytes(b"Q", 0.5)])]
    decoders = {"boom": lambda: CanDecoder("boom", [SignalDecoder(PUMP)]), "station": NumberDecoder}
    clock = ManualClock(at(2.0))
    acquisition = Acquisition(links, decoders, store, clock, batch_seconds=0.01, on_records=lambda _: None)
    acquisition.start()
    wait_until(lambda: all(link.done.is_set() for link in links))
    clock.advance(2.0)
    acquisition.stop()
    return acquisition


def test_every_identifier_is_shown_with_its_count_age_and_what_is_missing(store: Store) -> None:
    items = [
        frame(0x201, 1.0, "05 01"),
        frame(0x201, 1.5, "05 04"),
        frame(0x0CFE3021, 3.0, "7D", is_extended=True),
        frame(0x333, 3.5),
        frame(0x204, 3.75, "00", is_error=True),
    ]
    status = heard(store, items).status()
    assert [(f.link, f.identifier, f.names, f.count, f.age_s, f.missed) for f in status.frames] == [
        ("boom", "201", "pump", 2, 2.5, 2),
        ("boom", "333", "", 1, 0.5, None),
        ("boom", "0CFE3021", "PGN FE30h from 21h, priority 3", 1, 1.0, None),
    ]
    boom, station = status.links
    assert (boom.error_frames, boom.unlisted_frames) == (1, 0)
    assert (station.error_frames, station.unlisted_frames) == (None, None)
    assert json.loads(json.dumps(asdict(status)))["frames"][0]["names"] == "pump"


def test_a_channel_that_was_never_heard_is_shown(store: Store) -> None:
    (shown,) = heard(store, []).status().frames
    assert shown == FrameStatus("boom", "201", "pump", 0, shown.rate_per_s, None, None)
    assert not shown.rate_per_s


def test_identifiers_without_end_are_a_number_and_the_status_stays_small(store: Store) -> None:
    items: list[LinkItem] = [frame(0x10000 + n, 1.0, is_extended=True) for n in range(IDS_MAX + 1000)]
    status = heard(store, items).status()
    counted = sum(one.count for one in status.frames)
    assert status.links[0].unlisted_frames == IDS_MAX + 1000 - counted > 0
    assert len(json.dumps(asdict(status))) < 1 << 18
