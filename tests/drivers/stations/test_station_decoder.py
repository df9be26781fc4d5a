from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.clock import Stamp
from drivers.readings import (
    CanCapture,
    DecodeFailure,
    DeviceEvent,
    EventKind,
    Fix,
    Gap,
    GapReason,
    LockState,
    Record,
    SerialCapture,
    Status,
)
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.replies import ByteTimes
from drivers.stations.serial_port import SerialConfig
from drivers.stations.survey import position_mm
from tests.drivers.serial_support import (
    ACK_FRAME,
    COORDINATES,
    SAMPLES,
    SET_REPLY,
    SLOPE_MM,
    START,
    TRACKING,
    at,
    framed,
    received,
    tracking_record,
)

BYTE_S = 10 / 9600
NEAR_COORDINATES = framed(b"U+00006148-00023344-00029912m+2515656d")


def config(**settings: object) -> StationConfig:
    return StationConfig.model_validate({"serial": {"path": "/dev/null"}, **settings})


def decoder(**settings: object) -> StationDecoder:
    return StationDecoder(config(**settings))


def decode(decoder: StationDecoder, records: Sequence[tuple[float, bytes]]) -> list[Record]:
    """Feed one record at each instant (seconds)."""
    return [record for seconds, data in records for record in decoder.feed(received(data, seconds))]


def fixes(records: Sequence[Record]) -> list[Fix]:
    return [record for record in records if isinstance(record, Fix)]


def events(records: Sequence[Record]) -> list[tuple[EventKind, str]]:
    return [(record.kind, record.text) for record in records if isinstance(record, DeviceEvent)]


def gaps(records: Sequence[Record]) -> list[tuple[GapReason, Stamp, Stamp | None]]:
    return [(record.reason, record.start, record.end) for record in records if isinstance(record, Gap)]


def failures(records: Sequence[Record]) -> list[tuple[str, bytes]]:
    return [(record.reason, record.raw) for record in records if isinstance(record, DecodeFailure)]


# --- instants


@pytest.mark.parametrize(
    ("baud", "command_s", "ack_s", "record_s"),
    [
        (1200, 0.075, 0.0583, 0.517),
        (4800, 0.0188, 0.0146, 0.129),
        (9600, 0.0094, 0.0073, 0.0646),
        (115200, 0.0008, 0.0006, 0.0054),
    ],
)
def test_bytes_take_the_time_on_the_wire_of_the_protocol_facts(
    baud: int, command_s: float, ack_s: float, record_s: float
) -> None:
    for count, expected_s in ((9, command_s), (7, ack_s), (62, record_s)):
        times = ByteTimes(SerialConfig(path="x", baud=baud, bytesize=7, parity="even").character_s)
        times.received(count + 1, at(1))  # from the end of the byte before the first one to the end of the last one
        assert (at(1).monotonic_ns - times.at(0).monotonic_ns) / 1e9 == pytest.approx(expected_s, rel=0.07)


def test_a_fix_is_stamped_with_the_arrival_of_its_first_byte() -> None:
    record = tracking_record()
    (fix,) = fixes(decoder().feed(received(record, 1.0)))
    assert (at(1.0).monotonic_ns - fix.stamp.monotonic_ns) / 1e9 == pytest.approx((len(record) - 1) * BYTE_S, abs=1e-6)
    assert (at(1.0).monotonic_ns - fix.last_byte.monotonic_ns) / 1e9 == pytest.approx(2 * BYTE_S, abs=1e-6)  # CR LF


def test_a_record_in_portions_is_stamped_by_the_portion_that_holds_its_first_byte() -> None:
    record = tracking_record()
    records = decode(decoder(), [(1.0, record[:10]), (1.05, record[10:])])
    assert (at(1.0).monotonic_ns - fixes(records)[0].stamp.monotonic_ns) / 1e9 == pytest.approx(9 * BYTE_S, abs=1e-6)


def test_no_byte_arrives_before_the_read_or_the_request_that_came_before_it() -> None:
    station = decoder()
    assert station.feed(SerialCapture("station", at(1.0), b"C11067\x03\r\n", is_transmitted=True)) == []
    (fix,) = fixes(station.feed(received(tracking_record(), 1.01)))  # faster than the baud rate: no real line
    assert fix.stamp == at(1.0)
    (fix,) = fixes(station.feed(received(tracking_record(), 1.02)))
    assert fix.stamp == at(1.01)


def test_a_new_boot_is_no_reference_for_instants() -> None:
    station = decoder()
    station.feed(received(tracking_record(), 1.0))
    later = Stamp(START.utc_ns, 5, "another boot")
    (fix,) = fixes(station.feed(SerialCapture("station", later, tracking_record())))
    assert fix.stamp.boot_id == "another boot"
    assert fix.stamp.monotonic_ns < 5


def test_byte_times_of_forgotten_bytes_are_those_of_the_oldest_kept() -> None:
    times = ByteTimes(BYTE_S, keep=10)
    for k in range(100):
        times.received(5, at(k))
    assert times.at(0).monotonic_ns == pytest.approx(at(98 - 4 * BYTE_S).monotonic_ns, abs=2)


# --- records


def test_all_records_of_a_classic_station_become_fixes() -> None:
    records = decode(
        decoder(profile="topcon_classic"), [(k, sample + b"\x03\r\n") for k, sample in enumerate(SAMPLES[:3])]
    )
    assert [fix.status for fix in fixes(records)] == [Status.OK, Status.OK, Status.NOT_AVAILABLE]
    assert all(fix.station == "station" for fix in fixes(records))


def test_a_passive_listener_understands_what_the_profiles_understand() -> None:
    (fix,) = fixes(decode(decoder(profile="passive"), [(1, NEAR_COORDINATES)]))
    assert position_mm(fix) == pytest.approx((-23344, 6148, -29912))
    (fix,) = fixes(decode(decoder(profile="passive", listen_to="sokkia"), [(1, SET_REPLY + b"\r\n")]))
    assert fix.slope_distance_m == pytest.approx(6.662)


def test_acknowledgements_yield_nothing() -> None:
    assert decoder().feed(received(ACK_FRAME)) == []
    assert decoder(profile="sokkia_set").feed(received(b"\x06")) == []


def test_what_is_transmitted_yields_no_fix() -> None:
    assert decoder().feed(SerialCapture("station", at(0), tracking_record(), is_transmitted=True)) == []


def test_can_frames_yield_nothing() -> None:
    assert decoder().feed(CanCapture("boom", at(0), 0x181, b"\0")) == []


def test_a_wrong_block_check_is_a_failure_with_its_bytes_and_instant() -> None:
    broken = TRACKING[:-1] + b"2\x03\r\n"
    (failure,) = decoder().feed(received(broken, 1.0))
    assert isinstance(failure, DecodeFailure)
    assert (failure.device, failure.reason, failure.raw) == (
        "station",
        "BCC is 122, computed 121",
        TRACKING[:-1] + b"2",
    )
    assert (at(1.0).monotonic_ns - failure.stamp.monotonic_ns) / 1e9 == pytest.approx(
        (len(broken) - 1) * BYTE_S, abs=1e-6
    )


def test_a_sound_frame_of_unknown_layout_is_a_failure_that_says_so() -> None:
    ((reason, raw),) = failures(decoder().feed(received(framed(b"X123"))))
    assert "unknown record header 'X'" in reason
    assert raw == b"X123"


def test_an_unfinished_record_is_given_up_two_seconds_after_its_last_byte() -> None:
    station = decoder()
    assert station.feed(received(TRACKING[:30], 1.0)) == []
    assert station.tick(at(2.9)) == []
    assert failures(station.tick(at(3.1))) == [("incomplete record", TRACKING[:30])]
    assert failures(station.tick(at(3.2))) == []


def test_a_record_amid_which_the_computer_does_not_run_for_a_moment_is_a_fix() -> None:
    station = decoder(profile="passive", listen_to="sokkia")
    record = b"0012345 0900000 0100000\r\n"
    assert station.feed(received(record[:12], 1.0)) == []
    (fix,) = fixes(station.feed(received(record[12:], 1.4)))
    assert fix.slope_distance_m == 12.345
    assert at(0.98).monotonic_ns < fix.stamp.monotonic_ns <= at(1.0).monotonic_ns


# --- errors that the instrument reports


def test_instrument_errors_are_events_once_each() -> None:
    records = decode(
        decoder(),
        [(1, framed(b"E60")), (2, framed(b"\x15")), (3, tracking_record(flag=6)), (4, tracking_record(flag=6))],
    )
    said = [text for kind, text in events(records) if kind is EventKind.INSTRUMENT_ERROR]
    assert said == [
        "station reports error 'E60'",
        "station refused a command (NAK)",
        "the station is recovering from an error (zero detection) (flag 6)",
    ]
    assert [fix.lock for fix in fixes(records)] == [LockState.ERROR] * 2


def test_errors_of_a_set_station_are_events_when_they_begin() -> None:
    good, bad = SET_REPLY + b"\r\n", b"E200 0804806 0394324\r\n"
    records = decode(
        decoder(profile="sokkia_set"),
        [
            (1, good),
            (2, bad),
            (3, bad),
            (4, good),
            (5, bad),
            (6, b"\x15"),
            (7, b"A SET2C,123456,4100,2506,39\r\n"),
            (8, b"?\r\n"),
        ],
    )
    assert events(records) == [
        (EventKind.INSTRUMENT_ERROR, "station reports E200"),
        (EventKind.INSTRUMENT_ERROR, "station reports E200"),
        (EventKind.INSTRUMENT_ERROR, "station refused a command (NAK)"),
        (EventKind.CONFIGURED, "station is SET2C, serial number 123456, ROM 4100, EDM 2506"),
    ]
    assert len(failures(records)) == 1


# --- lock


def test_losing_and_finding_the_prism_are_events_and_a_gap_that_opens_and_closes() -> None:
    records = decode(
        decoder(),
        [
            (1.0, tracking_record()),
            (1.1, tracking_record()),
            (1.2, tracking_record(flag=3)),
            (1.3, tracking_record(flag=2)),
            (1.4, tracking_record(slope_mm=10_050)),
        ],
    )
    seen = fixes(records)
    assert [fix.status is Status.OK for fix in seen] == [True, True, False, False, True]
    assert events(records) == [
        (EventKind.LOCK_ACQUIRED, "prism tracked"),
        (EventKind.LOCK_LOST, "prism not tracked: the station has lost the prism and waits (flag 3)"),
        (EventKind.LOCK_ACQUIRED, "prism tracked again, 0.05 m from where it was lost"),
    ]
    assert gaps(records) == [
        (GapReason.LOCK_LOST, seen[1].stamp, None),
        (GapReason.LOCK_LOST, seen[1].stamp, seen[4].stamp),
    ]


def test_a_locked_station_without_a_distance_has_lost_its_prism() -> None:
    records = decode(decoder(), [(1.0, tracking_record()), (1.1, tracking_record(slope_mm=0))])
    assert events(records)[-1] == (EventKind.LOCK_LOST, "prism not tracked: no distance")


def test_a_station_that_has_no_prism_from_the_start_says_so() -> None:
    records = decode(decoder(), [(1.0, tracking_record(flag=2)), (1.1, tracking_record())])
    assert [kind for kind, _ in events(records)] == [EventKind.LOCK_LOST, EventKind.LOCK_ACQUIRED]
    assert [end is None for _, _, end in gaps(records)] == [True, False]


def test_a_classic_station_says_nothing_of_lock() -> None:
    assert events(decode(decoder(profile="topcon_classic"), [(1, SLOPE_MM + b"\x03")])) == []


# --- silence


def test_silence_is_an_event_and_a_gap_at_the_instant_at_which_it_was_due() -> None:
    station = decoder(silence_timeout_s=5)
    (fix,) = fixes(station.feed(received(tracking_record(), 1.0)))
    assert station.tick(at(5.9)) == []
    silent = station.tick(at(60))
    assert events(silent) == [
        (EventKind.STATION_SILENT, "no record for 5 s; check the station, its power and its cable")
    ]
    event = silent[0]
    assert isinstance(event, DeviceEvent)
    assert event.stamp == fix.last_byte.shifted(5_000_000_000)
    assert gaps(silent) == [(GapReason.SILENT, fix.last_byte, None)]
    assert station.tick(at(70)) == []
    spoke = station.feed(received(tracking_record(), 80))
    assert gaps(spoke) == [(GapReason.SILENT, fix.last_byte, fixes(spoke)[0].stamp)]


def test_a_station_that_never_speaks_is_silent_from_the_start() -> None:
    station = decoder(silence_timeout_s=5)
    assert station.tick(at(0)) == []
    assert gaps(station.tick(at(6))) == [(GapReason.SILENT, at(0), None)]


def test_silence_is_not_judged_across_a_boot() -> None:
    station = decoder(silence_timeout_s=5)
    station.tick(at(0))
    assert station.tick(Stamp(START.utc_ns, 10**15, "another boot")) == []


def test_silence_of_a_station_that_speaks_when_it_is_told_to_may_be_ignored() -> None:
    station = decoder(silence_timeout_s=0)
    station.feed(received(tracking_record(), 1.0))
    assert station.tick(at(10_000)) == []


# --- what no instrument can measure


def test_a_distance_beyond_what_the_instrument_can_measure_is_refused() -> None:
    records = decode(decoder(), [(1.0, tracking_record(6_000_000)), (1.1, tracking_record(6_000_001))])
    near, far = fixes(records)
    assert near.status is Status.OK
    assert (far.status, far.reason) == (
        Status.OUT_OF_RANGE,
        "slope distance 6000.001 m exceeds max_range_m = 6000",
    )
    assert position_mm(far) is None
    assert fixes(decode(decoder(max_range_m=9), [(1.0, tracking_record(10_000))]))[0].status is Status.OUT_OF_RANGE


def test_coordinates_beyond_what_the_instrument_can_measure_are_refused() -> None:
    (fix,) = fixes(decode(decoder(profile="topcon_classic"), [(1, COORDINATES + b"\x03")]))
    assert (fix.status, fix.north_m) == (Status.OUT_OF_RANGE, pytest.approx(1234566.148))
    assert "coordinates 1234566.149 m from their origin exceed max_range_m = 6000" in fix.reason
    assert "set the station's own coordinates to 0" in fix.reason


# --- a Sokkia station without check sums


def warnings(records: Sequence[Record]) -> list[str]:
    return [text for kind, text in events(records) if kind is EventKind.WARNING]


BARE_REPLY = SET_REPLY[:-3] + b"\r\n"
FULL_REPLY = SET_REPLY + b"\r\n"


def test_a_sokkia_station_without_check_sums_is_warned_about_once() -> None:
    for profile in ({"profile": "sokkia_set"}, {"profile": "passive", "listen_to": "sokkia"}):
        records = decode(decoder(**profile), [(k / 10, BARE_REPLY) for k in range(1, 30)])
        (text,) = warnings(records)
        assert "switch Checksum on" in text
        assert [fix.status for fix in fixes(records)] == [Status.OK] * 29


def test_the_warning_of_no_check_sums_stands_until_they_come_again() -> None:
    bare, full = [(k / 10, BARE_REPLY) for k in range(1, 4)], [(k / 10, FULL_REPLY) for k in range(4, 8)]
    records = decode(decoder(profile="sokkia_set"), bare + full)
    warned, over = (r for r in records if isinstance(r, DeviceEvent) and r.kind is EventKind.WARNING)
    assert "switch Checksum on" in warned.text
    assert warned.code not in (None, 0), "a warning without a code would be forgotten when the port is opened again"
    assert (over.code, over.text) == (0, "station sends its records with checksums again")


def test_the_identity_of_a_sokkia_station_tells_that_it_sends_no_check_sums() -> None:
    assert warnings(decode(decoder(profile="sokkia_set"), [(1, b"A SET2C,123456,4100,2506\r\n")]))
    assert not warnings(decode(decoder(profile="sokkia_set"), [(1, b"A SET2C,123456,4100,2506,39\r\n")]))


def test_a_sokkia_station_with_check_sums_is_not_warned_about() -> None:
    assert warnings(decode(decoder(profile="sokkia_set"), [(k / 10, FULL_REPLY) for k in range(1, 5)])) == []


def test_a_reply_that_lost_its_check_sum_on_the_way_is_refused() -> None:
    records = decode(decoder(profile="sokkia_set"), [(1, FULL_REPLY), (2, BARE_REPLY), (3, FULL_REPLY)])
    assert len(fixes(records)) == 2
    assert [reason for reason, _ in failures(records)] == ["the line has no SUM, but the previous lines had one"]
    assert warnings(records) == []


def test_check_sums_that_are_switched_off_are_warned_about() -> None:
    records = decode(
        decoder(profile="sokkia_set"), [(1, FULL_REPLY), (2, BARE_REPLY), (3, BARE_REPLY), (4, BARE_REPLY)]
    )
    assert len(fixes(records)) == 3
    assert len(warnings(records)) == 1


# --- the target, which the decoder does not judge


def test_which_prism_is_meant_is_not_the_decoder_s_to_know() -> None:
    records = decode(decoder(), [(1.0, tracking_record(10_000)), (1.1, tracking_record(20_000))])
    assert [fix.status for fix in fixes(records)] == [Status.OK, Status.OK]
    assert [kind for kind, _ in events(records)] == [EventKind.LOCK_ACQUIRED]


def test_coordinates_and_circles_are_both_usable() -> None:
    records = decode(decoder(profile="topcon_classic"), [(1, SLOPE_MM + b"\x03"), (1.2, NEAR_COORDINATES)])
    assert [fix.status for fix in fixes(records)] == [Status.OK, Status.OK]


# --- whatever comes


records_of_all_kinds = st.one_of(
    st.binary(min_size=1, max_size=60),
    st.builds(
        tracking_record,
        st.floats(0, 99_999_999),
        st.integers(0, 400),
        st.integers(0, 9),
        st.sampled_from("t*?x"),
        st.sampled_from(["09000000", "27000000", "99999999"]),
    ),
    st.sampled_from(
        [*(framed(sample[:-3]) for sample in SAMPLES), ACK_FRAME, SET_REPLY + b"\r\n", b"E100 E100 E100\r\n"]
    ),
)


@example([(0.0, b"\x00", False), (4.0, b"\x00", False), (4.0, b"\x00", False)], "topcon_gts8")
@given(
    st.lists(st.tuples(st.floats(0, 20), records_of_all_kinds, st.booleans()), max_size=30),
    st.sampled_from(["topcon_gts8", "topcon_classic", "sokkia_set", "passive"]),
)
def test_any_captures_yield_sound_records_and_the_same_ones_again(
    captures: list[tuple[float, bytes, bool]], profile: str
) -> None:
    seconds, fed = 0.0, []
    for pause, data, transmitted in captures:
        seconds += pause
        fed.append(SerialCapture("station", at(seconds), data, transmitted))
    once, again = decoder(profile=profile), decoder(profile=profile)
    records = [record for capture in fed for record in once.feed(capture)]
    ticked: list[Record] = []
    for before, capture in zip([*fed[:1], *fed], fed, strict=False):
        # Ticks in between change nothing but the moment at which a record is known.
        pause_ns = capture.stamp.monotonic_ns - before.stamp.monotonic_ns
        for share in (0.3, 0.7, 1.0):
            ticked += again.tick(before.stamp.shifted(round(share * pause_ns)))
        ticked += again.feed(capture)
    assert ticked == records
    for fix in fixes(records):
        assert fix.slope_distance_m is None or 0 < fix.slope_distance_m < 1e5
        for angle in (fix.hz_angle_rad, fix.zenith_angle_rad):
            assert angle is None or 0 <= angle < 2 * math.pi
        position = position_mm(fix)
        assert (position is not None) == (fix.status is Status.OK)
        assert position is None or all(math.isfinite(coordinate) for coordinate in position)
        assert fix.stamp.monotonic_ns <= fix.last_byte.monotonic_ns <= at(seconds).monotonic_ns


# --- configuration


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"init": ["ZB52\x03"]}, "not a command"),
        ({"init": [""]}, "not a command"),
        ({"profile": "passive", "init": ["ZB52"]}, "sends nothing: remove init"),
        ({"profile": "leica"}, "topcon_gts8"),
        ({"poll": 1}, "Extra inputs"),
        ({"max_speed_m_s": 0}, "greater than 0"),
        ({"new_target_after_s": 30.0}, "new_target_after_s no longer exists, remove it"),
    ],
)
def test_an_impossible_configuration_is_refused(settings: dict[str, object], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        config(**settings)
