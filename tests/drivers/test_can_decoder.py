from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.dbc import DbcFile
from drivers.can.raw_signal import BitField, Multiplexing, SignalChannel, SignalDecoder
from drivers.can_decoder import CanDecoder
from drivers.canopen.cia404 import AnalogueChannel, AnalogueDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.pdo import TransmitPdo
from drivers.canopen.supervision import VOIDS
from drivers.clock import Stamp
from drivers.readings import (
    CanCapture,
    DecodeFailure,
    DeviceEvent,
    EventKind,
    Gap,
    GapReason,
    Reading,
    Record,
    SerialCapture,
    Status,
)
from tests.drivers.can_support import DBC, START, at, capture, events, late, the_reading


def encoder(name: str = "theta1", node: int = 32, **settings: object) -> EncoderDecoder:
    pdo = TransmitPdo.usual(node, 1, (0x60040020,))
    return EncoderDecoder(EncoderChannel(name=name, node=node, pdo=pdo, **settings))


def decoder(**settings: object) -> CanDecoder:
    return CanDecoder("boom", [encoder(**settings)])


def feed(decoder: CanDecoder, text: str, seconds: float = 0.0, **flags: bool) -> list[Record]:
    return list(decoder.feed(capture(text, seconds, **flags)))


def kinds(records: object) -> list[EventKind]:
    return [event.kind for event in events(records)]


def test_a_tpdo_becomes_a_reading() -> None:
    reading = the_reading(feed(decoder(), "1A0 00 40 00 00"))
    assert (reading.channel, reading.value, reading.stamp) == ("theta1", 90.0, at(0))


def test_all_signals_of_a_message_are_read() -> None:
    file = DbcFile(DBC)
    names = ("P_Pump_bar", "P_BoomA_bar", "OilTemp_C")
    channels = [SignalDecoder(file.channel(name, "x", "Pressure1", name)) for name in names]
    records = feed(CanDecoder("boom", channels), "201 32 09 14 07 78 00 5C 05")
    assert [r.channel for r in records if isinstance(r, Reading)] == list(names)


def test_the_same_identifier_with_29_bits_is_another() -> None:
    boom = decoder()
    assert feed(boom, "000001A0 00 40 00 00") == []
    heard = [one for one in boom.summary(at(0)).ids if one.count]
    assert [(one.arbitration_id, one.is_extended, one.count) for one in heard] == [(0x1A0, True, 1)]


def test_frames_of_others_are_counted_and_are_no_failure() -> None:
    boom = decoder()
    assert feed(boom, "333 01") == feed(boom, "333 02") == []
    (unknown,) = [one for one in boom.summary(at(1)).ids if one.arbitration_id == 0x333]
    assert (unknown.count, unknown.names, unknown.age_s) == (2, "", 1.0)


def test_what_rigcal_sent_and_remote_frames_mean_nothing_to_readings() -> None:
    boom = decoder()
    assert feed(boom, "1A0 00 40 00 00", is_transmitted=True) == []
    assert feed(boom, "1A0", is_remote=True) == []
    assert boom.feed(SerialCapture("station", START, b"x")) == ()


def test_a_channel_that_was_never_heard_is_listed_and_reported_silent() -> None:
    boom = decoder()
    (listed,) = boom.summary(at(0)).ids
    assert (listed.arbitration_id, listed.names, listed.count, listed.rate_per_s) == (0x1A0, "theta1", 0, None)
    assert boom.tick(at(0)) == []
    assert boom.tick(at(1.0)) == []
    assert boom.tick(at(1.1)) == [Gap("theta1", GapReason.SILENT, at(0))]
    assert boom.tick(at(9)) == []


def test_silence_opens_a_gap_and_the_return_closes_it() -> None:
    boom = decoder(timeout_s=0.5)
    feed(boom, "1A0 00 40 00 00", 0.0)
    assert boom.tick(at(0.6)) == [Gap("theta1", GapReason.SILENT, at(0))]
    closed, reading = feed(boom, "1A0 00 40 00 00", 2.0)
    assert closed == Gap("theta1", GapReason.SILENT, at(0), at(2))
    assert isinstance(reading, Reading)
    assert feed(boom, "1A0 00 40 00 00", 2.1) == [Reading("theta1", at(2.1), 90.0, "deg", Status.OK, 16384)]


def test_a_silence_that_no_tick_fell_into_is_told_all_the_same() -> None:
    boom = decoder(timeout_s=0.5)
    feed(boom, "1A0 00 40 00 00", 0.0)
    opened, closed, _ = feed(boom, "1A0 00 40 00 00", 2.0)
    assert opened == Gap("theta1", GapReason.SILENT, at(0))
    assert closed == Gap("theta1", GapReason.SILENT, at(0), at(2))


def test_a_failure_keeps_a_channel_from_being_silent() -> None:
    boom = decoder(timeout_s=0.5)
    assert isinstance(feed(boom, "1A0 00", 0.0)[0], DecodeFailure)
    assert boom.tick(at(0.4)) == []


def test_a_message_without_the_channel_s_multiplexed_signal_does_not_count_as_heard() -> None:
    selected = SignalChannel(
        name="pump",
        unit="bar",
        arbitration_id=0x201,
        field=BitField(8, 8),
        multiplexing=Multiplexing(BitField(0, 8), frozenset({1})),
    )
    boom = CanDecoder("boom", [SignalDecoder(selected)])
    feed(boom, "201 01 05", 0.0)
    assert feed(boom, "201 00 05", 0.9) == []
    assert boom.tick(at(1.1)) == [Gap("pump", GapReason.SILENT, at(0))]


def test_monotonic_time_alone_counts_within_a_boot() -> None:
    boom = decoder(timeout_s=0.5)
    feed(boom, "1A0 00 40 00 00")
    stepped = Stamp(START.utc_ns + 3600 * 10**9, START.monotonic_ns + 10**8, START.boot_id)
    assert boom.tick(stepped) == []


def test_a_reboot_between_two_captures_is_a_silence_by_utc() -> None:
    boom = decoder(timeout_s=0.5)
    feed(boom, "1A0 00 40 00 00")
    rebooted = Stamp(START.utc_ns + 60 * 10**9, 5, "next boot")
    records = boom.feed(CanCapture("boom", rebooted, 0x1A0, bytes(4)))
    assert [type(r) for r in records] == [Gap, Gap, Reading]


# SYNC


def test_a_synchronous_pdo_carries_the_instant_of_its_sync() -> None:
    boom = CanDecoder("boom", [encoder("theta1", 32, is_synchronous=True), encoder("theta3", 33, is_synchronous=True)])
    feed(boom, "080", 0.100, is_transmitted=True)
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.102)).stamp == at(0.100)
    assert the_reading(feed(boom, "1A1 00 40 00 00", 0.104)).stamp == at(0.100)
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.110)).stamp == at(0.110), "one SYNC is one sample"
    feed(boom, "080", 0.120, is_remote=True)
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.121)).stamp == at(0.121), "a request is no SYNC"
    feed(boom, "080", 0.200)
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.190)).stamp == at(0.190), "received before the SYNC was sent"


def test_a_sync_long_ago_or_an_asynchronous_pdo_changes_nothing() -> None:
    boom = CanDecoder("boom", [encoder("theta1", 32, is_synchronous=True), encoder("theta3", 33)])
    feed(boom, "080", 0.1)
    assert the_reading(feed(boom, "1A1 00 40 00 00", 0.102)).stamp == at(0.102)
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.3)).stamp == at(0.3)


# Supervision of nodes


def test_boot_up_and_states_are_told_when_they_change() -> None:
    boom = decoder()
    assert kinds(feed(boom, "720 00")) == [EventKind.BOOT_UP]
    (event,) = events(feed(boom, "720 7F", 0.1))
    assert (event.kind, event.device, event.code) == (EventKind.NMT_STATE, "theta1", 0x7F)
    assert event.text == "node 32 is pre-operational, was boot-up"
    assert feed(boom, "720 7F", 1.0) == []
    assert [e.text for e in events(feed(boom, "720 05", 1.1))] == ["node 32 is operational, was pre-operational"]


def test_a_missing_heartbeat_is_told_once_at_its_deadline_and_its_return_too() -> None:
    boom = decoder(heartbeat_ms=100, timeout_s=100.0)
    feed(boom, "720 05", 0.0)
    assert boom.tick(at(0.25)) == []
    (lost,) = events(boom.tick(at(0.9)))
    assert (lost.kind, lost.stamp) == (EventKind.HEARTBEAT_LOST, at(0.25))
    assert "no heartbeat for 0.25 s" in lost.text
    assert boom.tick(at(2)) == []
    assert kinds(feed(boom, "720 05", 3.0)) == [EventKind.HEARTBEAT_RESTORED]
    assert kinds(feed(boom, "720 05", 4.0)) == [EventKind.HEARTBEAT_LOST, EventKind.HEARTBEAT_RESTORED]


def test_supervision_starts_with_the_first_heartbeat_and_0_switches_it_off() -> None:
    assert not events(decoder(heartbeat_ms=100).tick(at(99)))
    unsupervised = decoder(heartbeat_ms=0, timeout_s=1000.0)
    feed(unsupervised, "720 05", 0.0)
    assert unsupervised.tick(at(99)) == []


def test_a_boot_up_is_no_heartbeat_yet_but_a_sign_of_life() -> None:
    boom = decoder(heartbeat_ms=100, timeout_s=1000.0)
    feed(boom, "720 00", 0.0)
    assert boom.tick(at(9)) == []
    feed(boom, "720 7F", 10.0)
    assert kinds(boom.tick(at(11))) == [EventKind.HEARTBEAT_LOST]
    assert kinds(feed(boom, "720 00", 12.0)) == [EventKind.HEARTBEAT_RESTORED, EventKind.BOOT_UP]
    assert boom.tick(at(99)) == []


def test_a_heartbeat_that_is_none_is_a_failure() -> None:
    (failure,) = feed(decoder(), "720 42")
    assert isinstance(failure, DecodeFailure)
    assert failure.reason == "node 32: 42h is not an NMT state (00, 04, 05, 7F)"


def test_emergency_of_the_protocol_facts_voids_the_values_until_it_is_taken_back() -> None:
    boom = decoder()
    (event,) = events(feed(boom, "0A0 00 50 81 01 02 03 04 05"))
    assert (event.kind, event.code) == (EventKind.EMERGENCY, 0x5000)
    assert event.text.startswith("node 32: emergency 5000h (device hardware), error register 81h")
    assert the_reading(feed(boom, "1A0 00 40 00 00")).status is Status.DEVICE_ALARM
    feed(boom, "0A0 20 81 11 00 00 00 00 00")
    assert the_reading(feed(boom, "1A0 00 40 00 00")).status is Status.DEVICE_ALARM, "another does not make it valid"
    assert kinds(feed(boom, "0A0 00 00 00 00 00 00 00 00")) == [EventKind.EMERGENCY_CLEARED]
    assert the_reading(feed(boom, "1A0 00 40 00 00")).value == 90.0


@pytest.mark.parametrize("data", ["20 81 11 00 00 00 00 00", "00 30 05 00 00 00 00 00", "10 42 09 00 00 00 00 00"])
def test_an_emergency_that_is_not_of_the_measurement_leaves_the_values(data: str) -> None:
    boom = decoder()
    assert kinds(feed(boom, f"0A0 {data}")) == [EventKind.EMERGENCY]
    assert the_reading(feed(boom, "1A0 00 40 00 00")).value == 90.0


def test_one_error_less_is_not_none() -> None:
    boom = decoder()
    feed(boom, "0A0 00 FF 21 00 00 00 00 00")
    feed(boom, "0A0 00 00 20 00 00 00 00 00")
    assert the_reading(feed(boom, "1A0 00 40 00 00")).status is Status.DEVICE_ALARM


@pytest.mark.parametrize("left", ["01", "20"])
def test_errors_are_gone_only_with_the_last_bit_of_the_register(left: str) -> None:
    boom = decoder()
    feed(boom, "0A0 00 50 01 00 00 00 00 00")
    feed(boom, "0A0 10 81 11 00 00 00 00 00")
    (event,) = events(feed(boom, f"0A0 00 00 {left} 00 00 00 00 00"))
    assert (event.kind, event.code) == (EventKind.EMERGENCY, None), "code 0 would take it back"
    assert "one error has cleared, others remain" in event.text
    assert the_reading(feed(boom, "1A0 00 40 00 00")).status is Status.DEVICE_ALARM
    assert kinds(feed(boom, "0A0 00 00 00 00 00 00 00 00")) == [EventKind.EMERGENCY_CLEARED]
    assert the_reading(feed(boom, "1A0 00 40 00 00")).value == 90.0


@pytest.mark.parametrize(
    ("told", "status"),
    [
        ("0A0 00 50 81 00 00 00 00 00", Status.DEVICE_ALARM),
        ("0A0 20 81 11 00 00 00 00 00", Status.OK),
        ("0A0 00 50 81 00 00 00 00 00; 0A0 20 81 11 00 00 00 00 00", Status.DEVICE_ALARM),
        ("0A0 00 50 81 00 00 00 00 00; 0A0 00 00 00 00 00 00 00 00", Status.OK),
        ("0A0 00 50 81 00 00 00 00 00; 720 00", Status.OK),
        ("5A0 4B 03 65 00 01 00 00 00", Status.DEVICE_ALARM),
        ("5A0 4B 03 65 00 01 00 00 00; 5A0 4B 03 65 00 00 00 00 00", Status.OK),
    ],
    ids=["void", "other", "both", "taken back", "booted", "alarm", "alarm gone"],
)
def test_a_new_decoder_goes_on_from_what_devices_have_told_before(told: str, status: Status) -> None:
    before, after = decoder(), decoder()
    after.recall([event for frame in told.split("; ") for event in events(feed(before, frame))])
    assert the_reading(feed(after, "1A0 00 40 00 00")).status is status
    assert the_reading(feed(before, "1A0 00 40 00 00")).status is status


VOID = DeviceEvent("theta1", at(0), EventKind.EMERGENCY, f"node 32: broken; {VOIDS}", 0x5000)


def test_what_a_node_told_is_its_own_whatever_channel_it_was_then() -> None:
    """The rig file was changed: node 33 was theta1, and theta3 node 32."""
    boom = CanDecoder("boom", [encoder(), encoder("theta3", 33)])
    (taken,) = boom.recall([replace(VOID, text=VOID.text.replace("32", "33"))])
    assert taken.device == "theta3", "so that what takes it back has the same name"
    assert the_reading(feed(boom, "1A0 00 40 00 00")).status is Status.OK
    assert the_reading(feed(boom, "1A1 00 40 00 00")).status is Status.DEVICE_ALARM


@pytest.mark.parametrize("told", ["0A0 00 50 81 00 00 00 00 00", "5A0 4B 03 65 00 01 00 00 00"])
def test_what_a_node_told_holds_when_its_channel_is_renamed(told: str) -> None:
    renamed = CanDecoder("boom", [encoder("slew")])
    (taken,) = renamed.recall(events(feed(decoder(), told)))
    assert taken.device == "slew"
    assert the_reading(feed(renamed, "1A0 00 40 00 00")).status is Status.DEVICE_ALARM


def test_an_emergency_that_leaves_the_values_valid_is_recalled_too() -> None:
    (told,) = events(feed(decoder(), "0A0 20 81 11 00 00 00 00 00"))
    assert decoder().recall([told]) == [told]


def test_a_heartbeat_that_is_expected_no_more_is_not_missed() -> None:
    lost = DeviceEvent("theta1", at(0), EventKind.HEARTBEAT_LOST, "node 32: no heartbeat for 2.5 s")
    assert decoder(heartbeat_ms=0).recall([lost]) == []


@pytest.mark.parametrize(
    "text", ["alarms (6503h): position error", "node 33: alarms (6503h) read over SDO: position error"]
)
def test_alarms_of_pdos_are_told_by_the_next_one_and_those_of_other_nodes_are_theirs(text: str) -> None:
    assert decoder().recall([DeviceEvent("theta1", at(0), EventKind.ALARM, text, 1)]) == []


def test_a_heartbeat_that_was_lost_before_is_told_when_it_is_back() -> None:
    before, after = decoder(), decoder()
    told = [*events(feed(before, "720 7F", 0.0)), *events(before.tick(at(60)))]
    assert EventKind.HEARTBEAT_LOST in kinds(told)
    after.recall(told)
    assert kinds(after.tick(at(61))) == [], "once is enough"
    assert EventKind.HEARTBEAT_RESTORED in kinds(feed(after, "720 7F", 62.0))


def test_a_boot_up_ends_an_emergency() -> None:
    boom = decoder()
    feed(boom, "0A0 00 50 81 00 00 00 00 00")
    feed(boom, "720 00")
    assert the_reading(feed(boom, "1A0 00 40 00 00")).value == 90.0


def test_an_emergency_voids_all_channels_of_its_node_and_of_no_other() -> None:
    analogue = AnalogueDecoder(
        AnalogueChannel(name="pump", unit="bar", node=32, pdo=TransmitPdo.usual(32, 2, (0x71300110,)))
    )
    boom = CanDecoder("boom", [encoder(), analogue, encoder("theta3", 33)])
    feed(boom, "0A0 00 50 81 00 00 00 00 00")
    assert the_reading(feed(boom, "2A0 01 00")).status is Status.DEVICE_ALARM
    assert the_reading(feed(boom, "1A1 00 40 00 00")).status is Status.OK


def test_an_emergency_that_is_too_short_is_a_failure() -> None:
    assert isinstance(feed(decoder(), "0A0 00 50")[0], DecodeFailure)


def test_alarms_that_anyone_reads_over_sdo_are_heard() -> None:
    boom = decoder()
    assert [e.text for e in events(feed(boom, "5A0 4B 03 65 00 01 00 00 00"))] == [
        "node 32: alarms (6503h) read over SDO: position error"
    ]
    assert the_reading(feed(boom, "1A0 00 40 00 00")).status is Status.DEVICE_ALARM
    for other in (
        "5A0 60 00 18 05 00 00 00 00",
        "5A0 80 54 76 00 00 00 02 06",
        "5A0 A4",
        "5A0 41 03 65 00 14 00 00 00",
    ):
        assert feed(boom, other) == []


# Everything together


@given(
    st.lists(
        st.tuples(
            st.one_of(st.sampled_from([0x1A0, 0x0A0, 0x720, 0x5A0, 0x080, 0x201]), st.integers(0, 0x1FFFFFFF)),
            st.binary(max_size=8),
            st.booleans(),
            st.booleans(),
            st.booleans(),
            st.integers(-(10**10), 10**10),
        ),
        max_size=30,
    )
)
def test_no_frames_make_the_decoder_raise_or_give_a_number_that_is_none(
    frames: list[tuple[int, bytes, bool, bool, bool, int]],
) -> None:
    pump = SignalDecoder(DbcFile(DBC).channel("pump", "bar", "Pressure1", "P_Pump_bar"))
    boom = CanDecoder("boom", [encoder(max_rate_per_s=20.0, is_synchronous=True), pump])
    for arbitration_id, data, is_extended, is_remote, is_error, offset_ns in frames:
        stamp = START.shifted(offset_ns)
        item = CanCapture("boom", stamp, arbitration_id, data, is_extended, is_remote, is_error)
        for record in (*boom.feed(item), *boom.tick(stamp)):
            if isinstance(record, Reading):
                assert (record.status is Status.OK) == (record.value is not None)
                assert record.value is None or math.isfinite(record.value)
            elif isinstance(record, DeviceEvent):
                assert record.text
    boom.summary(START)


def test_the_same_captures_give_the_same_records_whenever_time_is_told() -> None:
    captures = [
        capture(text, seconds)
        for text, seconds in (("720 05", 0.0), ("1A0 00 40 00 00", 0.1), ("1A0 00 41 00 00", 5.0), ("720 05", 9.0))
    ]

    def run(ticks_s: list[float]) -> set[Record]:
        boom = decoder(heartbeat_ms=1000)
        records: set[Record] = set()
        for item in captures:
            while ticks_s and at(ticks_s[0]).monotonic_ns <= item.stamp.monotonic_ns:
                records |= set(boom.tick(at(ticks_s.pop(0))))
            records |= set(boom.feed(item))
        return records | set(boom.tick(at(9.5)))

    assert run([]) == run([0.5 * n for n in range(20)])


# Frames of doubtful time


def test_a_reading_of_a_late_frame_has_no_value_and_keeps_its_counts() -> None:
    boom = decoder()
    feed(boom, "1A0 00 40 00 00")
    reading = the_reading(boom.feed(late("1A0 00 20 00 00", 0.1)))
    assert (reading.value, reading.status, reading.raw_counts) == (None, Status.TIME_DOUBTFUL, 0x2000)
    assert reading.stamp == at(0.1).doubted()
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.2)).status is Status.OK


def test_a_signal_of_a_late_frame_has_no_value_and_its_counter_still_counts() -> None:
    field, counter = BitField(0, 16), BitField(16, 8)
    channel = SignalChannel(name="pump", unit="bar", arbitration_id=0x201, field=field, counter=counter)
    boom = CanDecoder("boom", [SignalDecoder(channel)])
    feed(boom, "201 10 00 01")
    reading = the_reading(boom.feed(late("201 20 00 02", 0.1)))
    assert (reading.value, reading.status, reading.raw_counts) == (None, Status.TIME_DOUBTFUL, 0x20)
    assert [type(record) for record in feed(boom, "201 10 00 03", 0.2)] == [Reading]


def test_what_a_device_says_of_itself_stands_however_late_it_is_read() -> None:
    pdo = TransmitPdo.usual(32, 1, (0x60040020, 0x65030010))
    boom = CanDecoder("boom", [EncoderDecoder(EncoderChannel(name="theta1", node=32, pdo=pdo))])
    records = boom.feed(late("1A0 00 40 00 00 01 00"))
    assert kinds(records) == [EventKind.ALARM]
    assert the_reading(records).status is Status.DEVICE_ALARM
    assert kinds(boom.feed(late("720 05", 0.1))) == [EventKind.NMT_STATE]


def test_a_late_frame_is_neither_taken_for_a_jump_nor_held_against_the_next() -> None:
    boom = decoder(max_rate_per_s=20.0)
    for number in range(5):
        feed(boom, "1A0 00 40 00 00", number * 0.02)
    assert kinds(boom.feed(late("1A0 00 10 00 00", 0.1))) == []
    for number in range(5):
        records = feed(boom, "1A0 00 40 00 00", 0.12 + number * 0.02)
        assert kinds(records) == []
        assert the_reading(records).status is Status.OK
    assert kinds(feed(boom, "1A0 00 10 00 00", 0.24)) == [EventKind.PRESET_JUMP]


def test_a_jump_is_told_from_5_s_after_the_first_late_frame_on_however_many_were_late() -> None:
    boom = decoder(max_rate_per_s=20.0)
    feed(boom, "1A0 00 40 00 00", 0.0)  # then nobody reads for 10 s
    for number in range(5):
        assert kinds(boom.feed(late("1A0 00 40 00 00", 10.0 + number * 0.2))) == []
    for number in range(20):
        assert kinds(feed(boom, "1A0 00 40 00 00", 11.2 + number * 0.2)) == []
    assert kinds(feed(boom, "1A0 00 10 00 00", 15.2)) == [EventKind.PRESET_JUMP]


def test_a_late_sync_says_nothing_of_when_a_node_was_sampled() -> None:
    boom = decoder(is_synchronous=True)
    boom.feed(late("080", 0.0))
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.01)).stamp == at(0.01)
    feed(boom, "080", 0.02)
    assert the_reading(boom.feed(late("1A0 00 40 00 00", 0.03))).stamp == at(0.03).doubted()
    feed(boom, "080", 0.04)
    assert the_reading(feed(boom, "1A0 00 40 00 00", 0.05)).stamp == at(0.04)
