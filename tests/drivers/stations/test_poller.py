"""Polling as lists of what is sent and received, at instants in seconds, on no clock at all."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import Stamp
from drivers.readings import EventKind, SerialCapture
from drivers.stations.config import StationConfig
from drivers.stations.link import start_poller
from drivers.stations.poller import Poller
from tests.drivers.serial_support import ACK_FRAME, COORDINATES, SET_REPLY, SLOPE_MM, framed, tracking_record

S = 1_000_000_000
ACK = ACK_FRAME
NAK = framed(b"\x15")
T34 = b"T34083\x03\r\n"
C11 = b"C11067\x03\r\n"
C = b"C067\x03\r\n"
Z34 = b"Z34093\x03\r\n"
Q = tracking_record()
SEARCHING = tracking_record(flag=2)
RECORD = SLOPE_MM + b"\x03\r\n"

Step = tuple[float, str, bytes]

TRACKING: list[Step] = [(0, "sent", T34), (0, "received", ACK), (0, "sent", C11)]


def play(poller: Poller, steps: list[Step]) -> None:
    """Play `steps`: at each instant either "sent" (the host sends exactly this) or "received".

    Between the instants the host sends nothing: it is asked at every instant that it wants to be woken at.
    """
    now = 0
    pending: list[bytes] = []
    for seconds, what, data in steps:
        instant = round(seconds * S)
        while not pending and poller.wake_ns(now) < instant:
            now = max(now, poller.wake_ns(now))
            assert poller.step(now) is None, f"sent something at {now / S} s, before {what} {data!r}"
            assert poller.wake_ns(now) > now, "wants to be woken without an end"
        now = instant
        if what == "received":
            assert poller.step(now) is None
            feed(poller, data, now)
        else:
            assert poller.step(now) == data, f"at {seconds} s"


def feed(poller: Poller, data: bytes, now_ns: int) -> None:
    poller.feed(SerialCapture("station", Stamp(0, now_ns, "boot"), data))


def poller_of(profile: str, *init: str, **settings: object) -> Poller:
    config = {"serial": {"path": "/dev/null"}, "profile": profile, "init": init, "poll_interval_s": 0.2, **settings}
    made = start_poller(StationConfig.model_validate(config))
    assert made is not None
    return made


def tracking(*init: str, **settings: object) -> Poller:
    return poller_of("topcon_gts8", *init, **settings)


def classic(*init: str, **settings: object) -> Poller:
    return poller_of("topcon_classic", *init, **settings)


def sokkia(*init: str, **settings: object) -> Poller:
    return poller_of("sokkia_set", *init, **settings)


def kinds(poller: Poller) -> list[tuple[EventKind, str]]:
    return poller.take_notices()


def test_a_tracking_station_is_set_up_told_to_track_and_polled() -> None:
    poller = tracking("ZB52", "ZB61")
    play(
        poller,
        [
            (0.0, "sent", b"ZB52031\x03\r\n"),
            (0.05, "received", ACK),
            (0.05, "sent", b"ZB61031\x03\r\n"),
            (0.1, "received", ACK),
            (0.1, "sent", T34),
            (0.15, "received", ACK),
            (0.15, "sent", C11),
            (0.17, "received", ACK),
            (0.2, "received", Q),
            (0.35, "sent", C11),
            (0.37, "received", ACK + Q),
            (0.55, "sent", C11),
        ],
    )
    assert kinds(poller) == [(EventKind.CONFIGURED, "station acknowledged ZB52, ZB61, T34")]


def test_without_crlf_commands_end_with_etx() -> None:
    play(tracking(crlf=False), [(0.0, "sent", b"T34083\x03")])


def test_a_record_that_takes_longer_than_the_interval_is_followed_at_once() -> None:
    play(tracking(), [*TRACKING, (0.9, "received", Q), (0.9, "sent", C11)])


def test_a_command_is_sent_again_until_it_is_acknowledged() -> None:
    play(
        tracking(),
        [(0, "sent", T34), (2, "sent", T34), (4, "sent", T34), (4.1, "received", ACK), (4.1, "sent", C11)],
    )


def test_a_dropped_acknowledgement_does_not_hide_the_record() -> None:
    play(
        tracking(),
        [*TRACKING, (0.1, "received", Q), (0.2, "sent", C11)],
    )


def test_a_lost_request_is_repeated_after_the_acknowledgements_time() -> None:
    play(tracking(), [*TRACKING, (2, "sent", C11), (2.1, "received", Q)])


def test_an_acknowledged_request_without_a_record_is_repeated_after_ten_seconds() -> None:
    play(
        tracking(),
        [*TRACKING, (0.1, "received", ACK), (10.1, "sent", C11)],
    )


def test_a_record_with_a_wrong_block_check_is_asked_for_anew_in_its_turn() -> None:
    broken = Q.replace(b"0r", b"1r", 1)
    play(
        tracking(),
        [
            *TRACKING,
            (0.01, "received", ACK),
            (0.1, "received", broken),
            (0.2, "sent", C11),
        ],
    )


def test_a_sound_frame_that_is_no_record_is_no_answer_either() -> None:
    play(
        tracking(),
        [
            *TRACKING,
            (0.1, "received", framed(b"E60")),
            (0.2, "sent", C11),
        ],
    )


def test_a_damaged_acknowledgement_is_not_taken_for_a_damaged_record() -> None:
    play(
        tracking(),
        [
            *TRACKING,
            (0.01, "received", b"\x16006\x03\r\n"),
            (0.5, "received", Q),
            (0.5, "sent", C11),
        ],
    )


def test_a_record_that_stops_half_way_is_asked_for_anew_after_a_second() -> None:
    play(
        tracking(),
        [
            *TRACKING,
            (0.01, "received", ACK),
            (0.1, "received", Q[:40]),
            (1.1, "sent", C11),
        ],
    )


def test_a_lost_prism_is_left_to_the_station_first_and_then_to_another_t34() -> None:
    poller = tracking(relock_after_s=0.5)
    play(
        poller,
        [
            *TRACKING,
            (0.1, "received", SEARCHING),
            (0.2, "sent", C11),
            (0.3, "received", tracking_record(slope_mm=0)),
            (0.4, "sent", C11),
            (0.5, "received", SEARCHING),
            (0.6, "sent", T34),
            (0.65, "received", ACK),
            (0.65, "sent", C11),
            (0.7, "received", SEARCHING),
            (0.85, "sent", C11),
            (0.9, "received", Q),
            (1.05, "sent", C11),
            (1.1, "received", Q),
            (1.25, "sent", C11),
        ],
    )


def test_a_silent_station_is_asked_for_ever_and_reported_once() -> None:
    poller = tracking()
    sent, reported, now = [], [], 0
    while now < 200 * S:
        command = poller.step(now)
        if command is not None:
            sent.append(command)
        reported += kinds(poller)
        now = max(now, poller.wake_ns(now)) if command is None else now
    assert set(sent) == {T34, C11}
    assert [text.split(" within")[0] for _, text in reported] == [
        "station did not answer T34",
        "station did not answer C11",
    ]
    assert len(sent) < 200


def test_a_station_that_was_switched_off_and_on_is_set_up_again() -> None:
    poller = tracking()
    play(
        poller,
        [
            *TRACKING,
            *((2.0 * k, "sent", C11) for k in range(1, 10)),
            (20, "sent", T34),
            (20.1, "received", ACK),
            (20.1, "sent", C11),
        ],
    )
    assert [kind for kind, _ in kinds(poller)] == [
        EventKind.CONFIGURED,
        EventKind.INSTRUMENT_ERROR,
        EventKind.CONFIGURED,
    ]


def test_a_setting_that_the_station_refuses_or_does_not_know_is_passed_over() -> None:
    poller = tracking("ZD50", "ZX9")
    play(
        poller,
        [
            (0, "sent", b"ZD50027\x03\r\n"),
            (0.1, "received", NAK),
            (0.1, "sent", framed(b"ZX9")),
            *((0.1 + 2 * k, "sent", framed(b"ZX9")) for k in range(1, 10)),
            (20.1, "sent", T34),
            (20.2, "received", ACK),
            (20.2, "sent", C11),
        ],
    )
    texts = [text for _, text in kinds(poller)]
    assert texts[0].startswith("station did not answer ZX9 within 20 s: check that")
    assert texts[1:] == ["station acknowledged T34"]


def test_a_refused_request_is_repeated_in_its_time() -> None:
    play(tracking(), [*TRACKING, (0.1, "received", NAK), (2, "sent", C11)])


def test_an_acknowledgement_that_nobody_waits_for_changes_nothing() -> None:
    play(
        tracking(),
        [*TRACKING, (0.1, "received", Q + ACK), (0.2, "sent", C11)],
    )


def test_a_classic_station_is_put_into_its_mode_and_every_record_is_acknowledged() -> None:
    play(
        classic(),
        [
            (0, "sent", Z34),
            (0.1, "received", ACK),
            (0.1, "sent", C),
            (0.2, "received", ACK),
            (1.5, "received", RECORD),
            (1.5, "sent", ACK),
            (1.5, "sent", C),
            (1.6, "received", b"006" + RECORD),
            (1.6, "sent", ACK),
            (1.7, "sent", C),
        ],
    )


def test_a_classic_station_may_be_asked_for_coordinates() -> None:
    play(
        classic(measure="coordinates"),
        [
            (0, "sent", b"Z64088\x03\r\n"),
            (0.1, "received", ACK),
            (0.1, "sent", C),
            (0.2, "received", COORDINATES + b"\x03"),
            (0.2, "sent", ACK),
        ],
    )


def test_a_measurement_that_cannot_succeed_is_aborted_by_the_mode_command() -> None:
    play(
        classic(),
        [
            (0, "sent", Z34),
            (0, "received", ACK),
            (0, "sent", C),
            (0, "received", ACK),
            (10, "sent", Z34),
            (10.1, "received", ACK),
            (10.1, "sent", C),
        ],
    )


def test_a_broken_record_is_not_acknowledged() -> None:
    play(
        classic(),
        [
            (0, "sent", Z34),
            (0, "received", ACK),
            (0, "sent", C),
            (0.1, "received", RECORD.replace(b"096", b"095")),
            (0.2, "sent", C),
        ],
    )


def test_a_set_station_is_stopped_set_to_track_and_asked_once() -> None:
    poller = sokkia("Xe")
    streaming(poller, [(3, "received", SET_REPLY + b"\r\n"), (12.5, "received", SET_REPLY + b"\r\n")])
    assert list(poller.closing()) == [b"\x12\r\n"]


def streaming(poller: Poller, more: list[Step]) -> None:
    """Play a station that tracks and sends a record after 2 s, and then `more`."""
    start: list[Step] = [
        (0, "sent", b"\x12\r\n"),
        (0, "sent", b"Xe\r\n"),
        (0.1, "received", b"\x06"),
        (0.8, "sent", b"\x11\r\n"),
        (2, "received", SET_REPLY + b"\r\n"),
    ]
    play(poller, [*start, *more])


def test_a_stream_that_stops_for_ten_seconds_is_set_up_again_because_the_station_may_have_restarted() -> None:
    poller = sokkia("Xe")
    streaming(
        poller,
        [
            (12, "sent", b"Xe\r\n"),
            (12.1, "received", b"\x06"),
            (12.8, "sent", b"\x11\r\n"),
            (14, "received", SET_REPLY + b"\r\n"),
            (24, "sent", b"Xe\r\n"),
        ],
    )


def test_a_station_that_sends_nothing_while_its_prism_is_lost_is_set_up_once_and_then_only_asked() -> None:
    streaming(
        sokkia("Xe"),
        [
            (12, "sent", b"Xe\r\n"),
            (12.1, "received", b"\x06"),
            (12.8, "sent", b"\x11\r\n"),
            (22.8, "sent", b"\x11\r\n"),
            (32.8, "sent", b"Xe\r\n"),  # as before: no answer for 20 s
        ],
    )


def test_a_control_character_without_answer_is_reported_by_its_hexadecimal_code() -> None:
    poller = sokkia()
    play(poller, [(0, "sent", b"\x12\r\n"), *((10.0 * k, "sent", b"\x11\r\n") for k in range(3))])
    ((kind, text),) = kinds(poller)
    assert kind is EventKind.INSTRUMENT_ERROR
    assert text.startswith("station did not answer 11h within 20 s")


def test_a_set_station_without_a_repeating_mode_is_asked_for_every_fix() -> None:
    poller = sokkia("A", "Xa", crlf=False, poll_interval_s=1.0)
    play(
        poller,
        [
            (0, "sent", b"\x12\r"),
            (0, "sent", b"A\r"),
            (0.1, "received", b"A SET2C,123456,4100,2506,39\r\n"),
            (0.8, "sent", b"Xa\r"),
            (0.9, "received", b"\x06"),
            (1.6, "sent", b"\x11\r"),
            (1.8, "received", SET_REPLY + b"\r\n"),
            (2.6, "sent", b"\x11\r"),
            (2.7, "received", SET_REPLY[:-2] + b"98\r\n"),
            (3.6, "sent", b"\x11\r"),
            (3.7, "received", SET_REPLY[:14]),
            (4.7, "sent", b"\x11\r"),
            (4.8, "received", b"E200" + b"!" * 10 + b"\x15"),
            (5.7, "sent", b"\x11\r"),
        ],
    )
    assert list(poller.closing()) == []
    assert kinds(poller) == [(EventKind.CONFIGURED, "station acknowledged A, Xa")]


def test_a_set_station_without_settings_is_asked_at_once() -> None:
    play(sokkia(), [(0, "sent", b"\x12\r\n"), (0, "sent", b"\x11\r\n")])


@pytest.mark.parametrize(
    "start",
    [
        lambda: tracking("ZB52"),
        lambda: classic("Z12"),
        lambda: sokkia("Xe"),
    ],
)
@given(
    data=st.lists(
        st.tuples(st.floats(0, 30), st.one_of(st.binary(max_size=30), st.sampled_from([ACK, Q, RECORD, NAK, b"\x06"])))
    )
)
def test_arbitrary_answers_never_stop_a_poller_nor_make_it_flood(
    start: object, data: list[tuple[float, bytes]]
) -> None:
    assert callable(start)
    poller: Poller = start()
    now, sent = 0, 0
    for pause, received in data:
        now += round(pause * S)
        while poller.step(now) is not None:
            sent += 1
        feed(poller, received, now)
    assert sent <= 20 * (len(data) + 1)
    later = now
    for _ in range(20):
        later = max(later, poller.wake_ns(later))
        if poller.step(later) is not None:
            break
    else:
        pytest.fail("asks nothing any more")
