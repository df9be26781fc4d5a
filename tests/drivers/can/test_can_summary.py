from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

import pytest

from drivers.can.dbc import DbcFile
from drivers.can.raw_signal import SignalDecoder
from drivers.can.summary import CanSummary, IdSummary
from drivers.can_decoder import IDS_MAX, CanDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.pdo import TransmitPdo
from drivers.readings import CanCapture
from tests.drivers.can_support import DBC, START, at, capture


def encoder() -> EncoderDecoder:
    return EncoderDecoder(EncoderChannel(name="theta1", node=32, pdo=TransmitPdo.usual(32, 1, (0x60040020,))))


def pressures() -> list[SignalDecoder]:
    file = DbcFile(DBC)
    return [
        SignalDecoder(file.channel("pump", "bar", "Pressure1", "P_Pump_bar")),
        SignalDecoder(file.channel("oil", "degC", "Pressure1", "OilTemp_C")),
    ]


def decoder() -> CanDecoder:
    return CanDecoder("boom", [encoder(), *pressures()])


def one(summary: CanSummary, arbitration_id: int) -> IdSummary:
    (found,) = [item for item in summary.ids if item.arbitration_id == arbitration_id]
    return found


def names(boom: CanDecoder, text: str) -> str:
    item = capture(text)
    boom.feed(item)
    return one(boom.summary(at(0)), item.arbitration_id).names


def test_channels_are_there_before_anything_was_heard() -> None:
    summary = decoder().summary(at(0))
    assert summary == CanSummary(
        "boom",
        (
            IdSummary(0x1A0, False, "theta1", 0, None, None, None),
            IdSummary(0x201, False, "pump, oil", 0, None, None, None),
        ),
        unlisted_frames=0,
        error_frames=0,
    )


def test_frames_are_counted_and_aged_identifier_by_identifier() -> None:
    boom = decoder()
    for text, seconds in (("1A0 00 40 00 00", 0.0), ("1A0 00 40 00 00", 0.5), ("333 01", 0.25)):
        boom.feed(capture(text, seconds))
    summary = boom.summary(at(2.5))
    assert (one(summary, 0x1A0).count, one(summary, 0x1A0).age_s) == (2, 2.0)
    assert (one(summary, 0x333).count, one(summary, 0x333).age_s) == (1, 2.25)


def test_what_no_channel_wants_is_named_by_its_identifier() -> None:
    boom = decoder()
    assert names(boom, "0CFE3021 7D") == "PGN FE30h from 21h, priority 3"
    assert names(boom, "18EAFF21 CA FE 00") == "PGN EA00h (request) from 21h to all, priority 6"
    assert names(boom, "18FECA00 00") == "PGN FECAh (DM1, active faults) from 00h, priority 6"
    assert names(boom, "720 05") == "heartbeat of node 32"
    assert names(boom, "0A0 00 00 00 00 00 00 00 00") == "emergencies of node 32"
    assert names(boom, "5A0 60 00 18 05 00 00 00 00") == "SDO answers of node 32"
    assert names(boom, "080") == "SYNC"
    assert names(boom, "721 05") == "", "no node of this rig: an 11-bit identifier alone says nothing"


def test_the_rate_is_that_of_the_last_ten_seconds() -> None:
    boom = decoder()

    def run(start_s: int, seconds: int, per_s: int) -> float | None:
        for n in range(seconds * per_s):
            boom.feed(capture("1A0 00 40 00 00", start_s + n / per_s))
            boom.tick(at(start_s + n / per_s))
        boom.tick(at(start_s + seconds))
        return one(boom.summary(at(start_s + seconds)), 0x1A0).rate_per_s

    boom.tick(at(0))
    boom.feed(capture("1A0 00 40 00 00", 0.1))
    boom.tick(at(0.5))
    assert one(boom.summary(at(0.5)), 0x1A0).rate_per_s is None, "half a second tells no rate"
    assert run(1, 20, 50) == pytest.approx(50.0, rel=0.02)
    assert run(21, 5, 10) == pytest.approx(30.0, rel=0.05), "5 s at 50 and 5 s at 10 per second"
    boom.tick(at(30))
    boom.tick(at(40))
    boom.tick(at(41))
    assert one(boom.summary(at(41)), 0x1A0).rate_per_s == 0.0


def test_time_that_goes_back_gives_no_rate_rather_than_a_wrong_one() -> None:
    boom = decoder()
    for seconds in (0.0, 1.0, 2.0):
        boom.feed(capture("1A0 00 40 00 00", seconds))
        boom.tick(at(seconds))
    boom.tick(at(0.5))
    assert one(boom.summary(at(2)), 0x1A0).rate_per_s is None


def test_frames_missing_by_their_counter_are_counted_once_for_a_message() -> None:
    boom = decoder()
    for count, seconds in ((5, 0.0), (6, 0.01), (9, 0.02), (1, 0.03)):
        boom.feed(capture(f"201 32 09 14 07 78 00 5C 0{count}", seconds))
    assert one(boom.summary(at(1)), 0x201).missed == 2 + 7
    boom.feed(capture("1A0 00 40 00 00"))
    assert one(boom.summary(at(1)), 0x1A0).missed is None, "a PDO carries no counter"


def test_a_counter_that_stands_still_tells_of_no_frame() -> None:
    boom = decoder()
    for n in range(5):
        boom.feed(capture("201 32 09 14 07 78 00 5C 05", n * 0.01))
    assert one(boom.summary(at(1)), 0x201).missed is None


def test_noise_on_many_identifiers_fills_neither_memory_nor_the_summary() -> None:
    boom = decoder()
    listed = len(("encoder", "heartbeat", "emcy", "sdo", "pressure"))
    for number in range(IDS_MAX + 100):
        boom.feed(CanCapture("boom", START, 0x10000 + number, b"", is_extended=True))
    summary = boom.summary(at(1))
    assert len(summary.ids) <= IDS_MAX
    assert summary.unlisted_frames == 100 + listed
    assert sum(item.count for item in summary.ids) + summary.unlisted_frames == IDS_MAX + 100


def test_error_frames_are_counted() -> None:
    boom = decoder()
    for _ in range(3):
        boom.feed(CanCapture("boom", at(0), 0x204, bytes(8), is_error=True))
    assert boom.summary(at(1)).error_frames == 3


@pytest.fixture
def often_switched() -> Iterator[None]:
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("often_switched")
def test_a_summary_may_be_asked_for_while_frames_come_in() -> None:
    total = 20 * IDS_MAX
    for _ in range(5):
        boom = decoder()
        done = threading.Event()

        def take(boom: CanDecoder = boom, done: threading.Event = done) -> None:
            try:
                for n in range(total):
                    boom.feed(CanCapture("boom", at(n * 0.01), 0x300 + n % IDS_MAX, b"", is_extended=True))
                    boom.tick(at(n * 0.01))
            finally:
                done.set()

        thread = threading.Thread(target=take)
        thread.start()
        heard = 0
        while not done.is_set():
            summary = boom.summary(at(0))
            now = sum(item.count for item in summary.ids) + summary.unlisted_frames
            assert heard <= now <= total
            heard = now
        thread.join()
        summary = boom.summary(at(0))
        assert sum(item.count for item in summary.ids) + summary.unlisted_frames == total
