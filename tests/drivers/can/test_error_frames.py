from __future__ import annotations

import pytest

from drivers.can.error_frames import BusErrors
from drivers.can_decoder import CanDecoder
from drivers.readings import CanCapture, DeviceEvent, EventKind
from tests.drivers.can_support import at, events


def feed(errors: BusErrors, error_class: int, data: str = "", seconds: float = 0.0) -> list[DeviceEvent]:
    return errors.feed(at(seconds), error_class, bytes.fromhex(data).ljust(8, b"\0"))


@pytest.mark.parametrize(
    ("error_class", "data", "kind"),
    [
        (0x004, "0004", EventKind.BUS_ERROR_WARNING),
        (0x004, "0008", EventKind.BUS_ERROR_WARNING),
        (0x004, "0010", EventKind.BUS_ERROR_PASSIVE),
        (0x204, "0020", EventKind.BUS_ERROR_PASSIVE),
        (0x040, "", EventKind.BUS_OFF),
    ],
)
def test_states_of_the_controller(error_class: int, data: str, kind: EventKind) -> None:
    (event,) = feed(BusErrors("boom"), error_class, data)
    assert (event.kind, event.device) == (kind, "boom")
    assert event.text.startswith("boom: the controller")


def test_a_state_is_told_when_it_changes_and_only_then() -> None:
    errors = BusErrors("boom")
    assert feed(errors, 0x004, "0040") == []
    assert [e.kind for e in feed(errors, 0x004, "0030000000008087")] == [EventKind.BUS_ERROR_PASSIVE]
    assert feed(errors, 0x004, "0010") == []
    assert [e.kind for e in feed(errors, 0x040)] == [EventKind.BUS_OFF]
    assert [e.kind for e in feed(errors, 0x100)] == [EventKind.BUS_ERROR_ACTIVE]
    assert errors.count == 5


@pytest.mark.parametrize(("error_class", "data"), [(0x040, ""), (0x004, "0010")], ids=["bus-off", "passive"])
def test_a_state_that_the_controller_enters_again_after_its_link_was_reopened_is_told_again(
    error_class: int, data: str
) -> None:
    errors = BusErrors("boom")
    (first,) = feed(errors, error_class, data)
    (again,) = feed(errors, error_class, data, 5)
    assert (again.kind, again.stamp) == (first.kind, at(5))


def test_a_state_that_is_announced_again_within_four_seconds_is_told_when_these_are_over() -> None:
    boom = CanDecoder("boom", [])
    for seconds in (0, 0.3, 0.4):
        told = list(boom.feed(CanCapture("boom", at(seconds), 0x040, b"", is_error=True)))
        assert len(told) == (seconds == 0)
    assert boom.tick(at(3.9)) == []
    (again,) = events(boom.tick(at(4)))
    assert (again.kind, again.stamp) == (EventKind.BUS_OFF, at(0.4))
    assert boom.tick(at(9)) == []


def test_a_state_that_is_announced_all_the_time_is_told_every_four_seconds_however_often_time_is_told() -> None:
    def storm(*, tick: bool) -> list[DeviceEvent]:
        errors = BusErrors("boom")
        told = []
        for n in range(3990):
            told += feed(errors, 0x004, "0010", n * 0.01)
            told += errors.tick(at(n * 0.01 + 0.005)) if tick else []
        return told

    told = storm(tick=False)
    assert len(told) == 10
    assert storm(tick=True) == told


def test_an_error_active_controller_is_told_once() -> None:
    errors = BusErrors("boom")
    feed(errors, 0x040)
    assert [event.kind for event in feed(errors, 0x100, "", 1)] == [EventKind.BUS_ERROR_ACTIVE]
    assert feed(errors, 0x100, "", 9) == errors.tick(at(20)) == []


def test_error_counters_are_told() -> None:
    (event,) = feed(BusErrors("boom"), 0x204, "0020000000008007")
    assert "(error counters: 128 sending, 7 receiving)" in event.text


@pytest.mark.parametrize(
    ("error_class", "data", "words"),
    [
        (0x001, "", "transmission timed out"),
        (0x002, "05", "arbitration lost in bit 5"),
        (0x002, "", "arbitration lost"),
        (0x088, "000004", "bit stuffing error"),
        (0x008, "000003", "single bit error, frame format error"),
        (0x008, "", "protocol violation"),
        (0x010, "0000000004", "transceiver status 04h"),
        (0x020, "", "no node acknowledged a frame"),
        (0x080, "", "bus error"),
    ],
)
def test_errors_on_the_wire_are_put_into_words(error_class: int, data: str, words: str) -> None:
    (event,) = feed(BusErrors("boom"), error_class, data)
    assert event.kind is EventKind.BUS_ERROR
    assert event.text.startswith(f"boom: {words}")


def test_a_storm_of_errors_is_counted_and_not_repeated() -> None:
    errors = BusErrors("boom")
    told = [event for n in range(2500) for event in feed(errors, 0x088, "000004", n * 0.01)]
    assert [event.stamp for event in told] == [at(0), at(10), at(20)]
    assert [event.code for event in told] == [1, 1001, 2001]
    assert told[1].text == "boom: bit stuffing error; 1000 times since the last report"
    assert errors.count == 2500


def test_an_overflow_of_the_controller_is_a_loss_of_frames() -> None:
    (event,) = feed(BusErrors("boom"), 0x004, "0001")
    assert (event.kind, event.code) == (EventKind.FRAMES_DROPPED, 1)
    assert event.text == "boom: the controller's buffer of received frames overflowed"
    assert "transmitted" in feed(BusErrors("boom"), 0x004, "0002")[0].text


def test_the_decoder_passes_error_frames_on_and_counts_them() -> None:
    boom = CanDecoder("boom", [])
    item = CanCapture("boom", at(0), 0x040, b"", is_error=True)
    assert [event.kind for event in boom.feed(item) if isinstance(event, DeviceEvent)] == [EventKind.BUS_OFF]
    assert boom.summary(at(1)).error_frames == 1
