"""The simulated station: conversations as lists of (what the host sends, what it gets)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.rig.description import Station
from simulators.devices.stations.serial_line import Line
from simulators.devices.stations.sokkia import SokkiaStation
from simulators.devices.stations.topcon import TopconStation
from simulators.devices.stations.topcon_text import (
    Sight,
    angle_record,
    checked,
    coarse_record,
    coordinate_record,
    dms,
    fine_record,
    frame,
    from_dms,
    set_line,
    set_record,
    tracking_record,
)
from simulators.devices.stations.total_station import StationSettings, TotalStation
from simulators.devices.stations.tracker import Flag, Tracker, TrackerSettings

ACK = b"\x06006\x03\r\n"
EXACT = Station(
    angle_sigma_arcsec=1e-6, distance_sigma_mm=1e-6, distance_sigma_ppm=0, target_sigma_mm=0, timing_sigma_s=0
)
# r is 10 m east and 1 m up; s is near it; far is on the other side.
PLACES = {"r": [10000.0, 0.0, 1000.0], "s": [10000.0, 200.0, 1000.0], "far": [-8000.0, -3000.0, 0.0]}
R_RANGE_MM = float(np.linalg.norm(PLACES["r"]))


def tracker(**settings: float) -> Tracker:
    return Tracker(
        tuple(PLACES),
        lambda name, _: np.array(PLACES[name]),
        EXACT,
        np.random.default_rng(0),
        TrackerSettings(**settings),
    )


def topcon(profile: str = "topcon_gts8", **settings: object) -> TopconStation:
    return TopconStation(StationSettings(profile=profile, **settings), tracker(), np.random.default_rng(1))


def sokkia(**settings: object) -> SokkiaStation:
    return SokkiaStation(StationSettings(profile="sokkia_set", **settings), tracker(), np.random.default_rng(1))


class Host:
    """Lives with a station: advances from deadline to deadline."""

    def __init__(self, station: TotalStation) -> None:
        self.station, self.now = station, 0.0
        self.chunks: list[tuple[float, bytes]] = []

    def say(self, data: bytes, for_s: float = 3.0) -> bytes:
        self.station.receive(data, self.now)
        return self.listen(for_s)

    def command(self, text: str, for_s: float = 3.0) -> bytes:
        return self.say(frame(text.encode(), crlf=True), for_s)

    def listen(self, for_s: float) -> bytes:
        end, got = self.now + for_s, b""
        while self.station.next_deadline() <= end:
            self.now = max(self.now, self.station.next_deadline())
            chunk = self.station.poll(self.now)
            if chunk:
                self.chunks.append((self.now, chunk))
            got += chunk
        self.now = end
        return got


class TestText:
    @pytest.mark.parametrize(
        ("data", "check"),
        [
            (b"C", b"067"),
            (b"Z12", b"089"),
            (b"Z20", b"088"),
            (b"Z32", b"091"),
            (b"Z34", b"093"),
            (b"Z64", b"088"),
            (b"J", b"074"),
            (b"\x06", b"006"),
            (b"J+1234500d", b"052"),
            (b"T13+0000000+0900000d", b"059"),
            (b"C11", b"067"),
        ],
    )
    def test_block_checks_are_those_of_the_worked_examples(self, data: bytes, check: bytes) -> None:
        assert frame(data, crlf=False) == data + check + b"\x03"
        assert frame(data, crlf=True).endswith(b"\x03\r\n")
        assert checked(data + check) == data
        assert checked(data + b"999") is None

    def test_the_coarse_record_of_a_real_reply_is_reproduced(self) -> None:
        sight = Sight(from_dms("3545105"), from_dms("0905356"), 1.060, edm_level=60)
        assert frame(coarse_record(sight), crlf=False)[:-1] == b"?+00001060m0905356+3545105d+00001060t60+00+00096"

    def test_the_tracking_record_of_a_real_reply_is_reproduced_but_for_its_own_rounding_of_the_distance(self) -> None:
        sight = Sight(from_dms("12030400"), from_dms("08520300"), 1178.4812, prism_mm=2.5)
        got, want = tracking_record(sight), b"Q+011784812m08520300+12030400d+011745724t15+0000+025000r"
        assert got[:30] == want[:30]
        assert got[40:] == want[40:]
        assert abs(int(got[30:40]) - int(want[30:40])) <= 1

    def test_the_fine_record_of_a_real_reply_has_this_layout(self) -> None:
        sight = Sight(from_dms("34706355"), from_dms("26822425"), 2.1760)
        want = b"(+000021760m26822425+34706355d+000021751t00+0000+000**"
        got = fine_record(sight)
        assert len(got) == len(want)
        assert got[:30] == want[:30]
        assert got[43:] == want[43:]

    def test_angles_and_coordinates_have_their_layout(self) -> None:
        sight = Sight(90.0, 90.0, 12.3456)
        assert angle_record(sight) == b"<0900000+0900000+0000d"
        assert coordinate_record(sight) == b"U+00000000+00012346+00000000m+0900000d"

    def test_the_checksum_of_the_real_set_line_is_reproduced(self) -> None:
        sight = Sight(from_dms("0394324"), from_dms("0804806"), 6.662)
        assert set_record(sight, checksum=True) == b"0006662 0804806 0394324 97\r\n"
        assert set_line(b"A SET2C,123456,4100,2506,", checksum=True) == b"A SET2C,123456,4100,2506,39\r\n"

    @given(st.floats(0, 359.9999))
    def test_angles_survive_being_written(self, degrees: float) -> None:
        turn = abs(from_dms(dms(degrees, tenths=True)) - degrees)
        assert min(turn, 360 - turn) <= 0.05 / 3600 + 1e-9
        assert from_dms("-" + dms(10.5, tenths=False)) == pytest.approx(-10.5)


class TestLine:
    def test_bytes_leave_at_the_baud_rate(self) -> None:
        line = Line(9600)
        assert line.send(1.0, b"x" * 62) == pytest.approx(1.0 + 62 * 10 / 9600)
        assert line.poll(1.0) == b""
        assert len(line.poll(1.0 + 31.5 * 10 / 9600)) == 31
        assert len(line.poll(2.0)) == 31
        assert line.next_deadline() == float("inf")

    def test_what_is_queued_waits_for_the_line(self) -> None:
        line = Line(1200)
        line.send(0.0, b"ab")
        line.send(0.0, b"c")
        assert line.poll(2.5 * 10 / 1200) == b"ab"
        assert line.poll(3 * 10 / 1200 + 1e-9) == b"c"


class TestTracker:
    def test_a_blocked_sight_coasts_waits_searches_and_locks_again(self) -> None:
        t = tracker(prediction_s=1.0, wait_s=2.0, search_s=3.0)
        t.aim_at("r", -10.0, track=True)
        t.block(10.0, 14.0)
        seen = [(now, t.flag(now)) for now in (9.9, 10.5, 11.5, 13.5, 15.9, 16.1)]
        assert [flag for _, flag in seen] == [
            Flag.LOCKED,
            Flag.LOCKED,
            Flag.WAITING,
            Flag.SEARCHING,
            Flag.SEARCHING,
            Flag.LOCKED,
        ]
        assert t.target(20.0) == "r"

    def test_while_it_coasts_there_is_no_distance(self) -> None:
        t = tracker()
        t.aim_at("r", -10.0, track=True)
        assert t.point(0.5).range_mm == pytest.approx(R_RANGE_MM)
        t.block(1.0, 1.5)
        assert t.point(1.2).range_mm is None
        assert t.flag(1.2) is Flag.LOCKED
        assert t.point(1.6).range_mm == pytest.approx(R_RANGE_MM)

    def test_a_sight_that_stays_blocked_is_searched_again_and_again(self) -> None:
        t = tracker(prediction_s=1.0, wait_s=2.0, search_s=2.0)
        t.aim_at("r", -10.0, track=True)
        t.block(0.0, 100.0)
        assert t.flag(50.0) in (Flag.WAITING, Flag.SEARCHING)
        assert t.flag(110.0) is Flag.LOCKED

    def test_a_lock_taken_while_the_sight_is_blocked_does_not_last(self) -> None:
        t = tracker(prediction_s=1.0)
        t.block(0.0, 100.0)
        t.aim_at("r", 1.0, track=True)  # 90 degrees at 60 deg/s and a second and a half: there at 4.0
        assert t.flag(4.5) is Flag.LOCKED
        assert t.flag(5.5) is Flag.WAITING

    def test_aiming_takes_the_time_to_turn_and_then_locks(self) -> None:
        t = tracker()
        t.aim_at("r", 0.0, track=True)
        assert t.flag(2.9) is Flag.ROTATING
        assert t.point(2.9).range_mm is None
        assert t.flag(3.1) is Flag.LOCKED
        assert t.target(3.1) == "r"

    def test_a_search_takes_the_nearest_prism_within_its_range(self) -> None:
        t = tracker(search_range_deg=5.0)
        t.turn(92.0, 84.0, 0.0, search=True)
        assert t.flag(20.0) is Flag.LOCKED
        assert t.target(20.0) == "r"
        t.turn(180.0, 90.0, 20.0, search=True)
        assert t.flag(40.0) is not Flag.LOCKED

    def test_in_standby_the_servo_stands_and_measures_only_what_is_in_its_beam(self) -> None:
        t = tracker()
        t.aim_at("far", 0.0, track=False)
        assert t.flag(100.0) is Flag.STANDBY
        assert t.point(100.0).range_mm == pytest.approx(np.linalg.norm(PLACES["far"]))
        t.turn(250.0, 90.0, 100.0, search=False)
        assert t.flag(100.1) is Flag.ROTATING
        assert t.flag(110.0) is Flag.STANDBY
        assert t.point(110.0).range_mm is None

    def test_a_jump_follows_another_prism_without_a_word(self) -> None:
        t = tracker()
        t.aim_at("r", -10.0, track=True)
        t.jump("s", 1.0)
        assert t.flag(1.1) is Flag.LOCKED
        assert t.point(1.1).range_mm == pytest.approx(np.linalg.norm(PLACES["s"]))

    def test_unknown_targets_are_refused(self) -> None:
        for act in (lambda: tracker().aim_at("q", 0.0, track=True), lambda: tracker().jump("q", 0.0)):
            with pytest.raises(ValueError, match="no target 'q'; there are r, s, far"):
                act()


def r_record(**more: object) -> bytes:
    fields = {"tracking": 1, "battery": 4} | more
    hz, zenith = 90.0, float(np.degrees(np.arctan2(10000.0, 1000.0)))
    return frame(tracking_record(Sight(hz, zenith, R_RANGE_MM / 1e3, **fields)), crlf=True)


class TestTopconGts8:
    def host(self, **settings: object) -> Host:
        station = topcon(**settings)
        station.aim_at("r", -10.0)
        return Host(station)

    def test_a_poll_is_acknowledged_and_answered_with_a_record(self) -> None:
        host = self.host()
        assert host.command("T34") == ACK
        assert host.command("C11") == ACK + r_record()
        assert host.say(b"\x06006\x03\r\n") == b""  # the host's acknowledgement

    def test_the_answer_keeps_the_pace_of_the_line(self) -> None:
        host = self.host(baud=1200)
        host.command("C11")
        byte = 10 / 1200
        heard = 7 * byte  # C11067 ETX; CR LF do not count
        first = host.chunks[0][0]
        assert first == pytest.approx(heard + 0.02 + 9 * byte - 2 * byte, abs=3 * byte)
        assert host.chunks[-1][0] - first >= 62 * byte
        assert len(host.chunks) >= 4  # handed over piece by piece

    def test_without_crlf_frames_end_with_etx(self) -> None:
        assert self.host(crlf=False).say(b"C11067\x03").count(b"\r") == 0

    @pytest.mark.parametrize(
        "command", ["ZB23", "ZB4+", "ZB52", "ZB61", "ZC2010010d", "ZD30010", "ZD50", "Z12", "T30", "G8SW1"]
    )
    def test_settings_are_acknowledged(self, command: str) -> None:
        assert self.host().command(command) == ACK

    @pytest.mark.parametrize("data", [b"C11066\x03\r\n", b"XYZ\x03", b"\x03\x03", frame(b"HELLO", crlf=True)])
    def test_a_wrong_check_and_what_it_does_not_know_are_met_with_silence(self, data: bytes) -> None:
        host = self.host()
        assert host.say(data) == b""
        assert host.command("T34") == ACK

    def test_a_wrong_check_may_be_answered_with_nak(self) -> None:
        assert self.host(nak_bad_check=True).say(b"C11066\x03") == b"\x15021\x03\r\n"

    def test_angles_alone(self) -> None:
        assert self.host().command("C31").startswith(ACK + b"Q08417219+09000000d")

    def test_flags_tell_of_standby_and_of_a_loss_of_lock(self) -> None:
        host = self.host()
        host.station.tracker.block(0.5, 9.0)
        flags = []
        for _ in range(14):
            host.listen(1.0)
            record = host.command("C11", 0.5)[len(ACK) :]
            flags.append(record[54:55])
            if flags[-1] != b"1":
                assert record[1:11] == b"+000000000"
        assert b"".join(dict.fromkeys(flags)) == b"132"
        assert flags[-1] == b"1"
        host.command("T30")
        assert host.command("C11")[len(ACK) :][54:55] == b"0"

    def test_while_coasting_the_distance_may_be_repeated(self) -> None:
        host = self.host(stale_distance=True)
        host.command("C11")
        host.station.tracker.block(host.now, host.now + 0.9)
        assert host.command("C11", 0.5)[len(ACK) :][:11] == r_record()[:11]

    def test_a_relative_rotation_goes_where_it_is_told_and_searches_there(self) -> None:
        host = self.host()
        # From r (hz 90) to far: hz +159.444 deg, zenith from 84.289 down to 90: argument now - target = -5.711.
        assert host.command("T13-0054238+1592638d") == ACK
        host.listen(8.0)
        assert host.station.tracker.target(host.now) == "far"
        assert host.command("C11")[len(ACK) :][54:55] == b"1"
        assert host.command("T10+0000000+0900000d", 0.5) == ACK
        assert host.command("C11", 1.0)[len(ACK) :][54:55] == b"4"
        host.listen(9.0)
        assert host.command("C11")[len(ACK) :][54:55] == b"0"

    def test_the_circle_is_set_where_it_points(self) -> None:
        host = self.host()
        assert host.command("ZB1+0100000d") == ACK
        assert b"+01000000d" in host.command("C11")
        assert host.station.circle_zero_deg == pytest.approx(80.0)

    def test_face_two_reads_over_the_top(self) -> None:
        host = self.host()
        assert host.command("T200") == ACK
        record = host.command("C11")[len(ACK) :]
        assert record[12:20] == dms(360 - np.degrees(np.arctan2(10000.0, 1000.0)), tenths=True).encode()
        assert record[20:29] == b"+27000000"
        assert record[55:56] == b"l"

    def test_switched_off_it_hears_only_its_switch(self) -> None:
        host = self.host()
        assert host.command("G8SW0") == ACK
        assert host.command("C11") == b""
        assert host.command("G8SW1") == ACK
        assert host.command("C11") == ACK + r_record()

    def test_corrections_are_shown_and_applied(self) -> None:
        host = self.host(prism_mm=30.0, prism_true_mm=34.4, ppm=10.0)
        record = host.command("C11")[len(ACK) :]
        assert int(record[1:11]) / 10 == pytest.approx(R_RANGE_MM * (1 + 1e-5) - 4.4, abs=0.06)
        assert record[43:48] == b"+0100"
        assert record[48:52] == b"+300"

    def test_a_new_command_stops_a_measurement(self) -> None:
        host = self.host()
        host.command("Z34", 0.5)
        assert host.command("C", 0.5) == ACK
        assert host.command("Z12", 5.0) == ACK
        assert host.station.poll(host.now + 60) == b""

    def test_two_requests_in_a_row_yield_one_record(self) -> None:
        assert self.host().say(frame(b"C11", crlf=True) * 2) == ACK + ACK + r_record()


class TestStationFaults:
    def host(self, **settings: object) -> Host:
        return TestTopconGts8().host(**settings)

    def test_a_bad_check_spoils_one_record(self) -> None:
        host = self.host()
        host.station.faults.bad_checks = 1
        spoilt = host.command("C11")[len(ACK) :]
        assert checked(spoilt.rstrip(b"\r\n\x03")) is None
        assert len(spoilt) == len(r_record())
        assert host.command("C11") == ACK + r_record()

    def test_a_dropped_acknowledgement(self) -> None:
        host = self.host()
        host.station.faults.dropped_acks = 1
        assert host.command("C11") == r_record()
        assert host.command("T34") == ACK

    def test_joined_buffers_lose_the_first_byte_and_arrive_in_one_piece(self) -> None:
        host = self.host()
        host.station.faults.joined = 1
        assert host.command("C11") == b"006" + r_record()
        assert len(host.chunks) == 1

    def test_clutter_comes_before_the_record(self) -> None:
        host = self.host()
        host.station.faults.clutter = 12
        got = host.command("C11")[len(ACK) :]
        assert got[12:] == r_record()
        assert len(got) == 12 + len(r_record())

    def test_a_silent_station_neither_hears_nor_speaks(self) -> None:
        host = self.host()
        host.station.faults.silent_until = 5.0
        assert host.command("C11") == b""
        host.now = 6.0
        assert host.command("C11") == ACK + r_record()

    def test_a_record_that_is_not_acknowledged_may_be_repeated(self) -> None:
        host = self.host(retransmissions=2)
        assert host.command("C11") == ACK + r_record() * 3
        got = host.command("C11", 0.3)
        assert (got + host.say(b"\x06006\x03")) == ACK + r_record()


class TestTopconClassic:
    def host(self, target: str | None = "r") -> Host:
        station = topcon("topcon_classic")
        if target:
            station.aim_at(target, -10.0)
        return Host(station)

    @pytest.mark.parametrize(
        ("mode", "start"),
        [("Z12", b"<0841722+0900000"), ("Z20", b"<"), ("Z32", b"?+00010050m0841722"), ("Z34", b"(+000100499m"),
         ("Z64", b"U")],
    )  # fmt: skip
    def test_each_mode_has_its_record(self, mode: str, start: bytes) -> None:
        host = self.host()
        assert host.command(mode) == ACK
        assert host.command("C").startswith(ACK + start)

    def test_coordinates_are_north_east_up(self) -> None:
        host = self.host()
        host.command("Z64")
        assert b"U+00000000+00010000+00001000m+0900000d" in host.command("C")

    def test_a_shot_without_a_prism_goes_on_until_there_is_one(self) -> None:
        host = self.host(None)
        host.command("Z34")
        assert host.command("C", 5.0) == ACK
        host.station.aim_at("r", host.now)
        assert host.listen(1.0).startswith(b"(+000100499m")

    def test_the_circle_is_set_in_two_steps(self) -> None:
        host = self.host()
        assert host.command("J") == ACK
        assert host.command("J+1234500d") == ACK
        host.command("Z12")
        assert b"+1234500+" in host.command("C")

    def test_the_robotic_commands_mean_nothing_to_it(self) -> None:
        assert self.host().command("T34") == b""


class TestSokkia:
    def host(self, **settings: object) -> Host:
        station = sokkia(**settings)
        station.aim_at("r", -10.0)
        return Host(station)

    LINE = b"0010050 0841722 0900000 "

    @pytest.mark.parametrize("request_", [b"\x11", b"\x11\r", b"\x11\r\n"])
    def test_a_request_is_answered_with_distance_and_angles(self, request_: bytes) -> None:
        assert self.host().say(request_) == set_line(self.LINE, checksum=True)

    def test_without_the_sum_the_line_ends_after_the_angle(self) -> None:
        assert self.host(checksum=False).say(b"\x11") == self.LINE[:-1] + b"\r\n"

    def test_tracking_repeats_until_it_is_stopped(self) -> None:
        host = self.host()
        assert host.say(b"Xe\r", 0.5) == b"\x06"
        assert host.say(b"\x11", 2.0).count(b"\r\n") >= 10
        host.say(b"\x12", 0.5)
        assert host.listen(5.0) == b""

    @pytest.mark.parametrize("request_", [b"\x00", b"\x13", b"\x00\r"])
    def test_angles_come_at_once(self, request_: bytes) -> None:
        assert self.host().say(request_, 0.2) == set_line(self.LINE, checksum=True)

    def test_without_a_prism_the_distance_is_an_error_code(self) -> None:
        host = self.host()
        host.station.tracker.block(0.0, 100.0)
        assert host.say(b"\x11").startswith(b"E200 0841722 ")

    def test_settings_are_acknowledged_or_refused(self) -> None:
        host = self.host()
        conversation = [
            (b"Xa\r\n", b"\x06"),
            (b"Xh\r", b"\x06"),
            (b"Xl\r", b"\x15"),
            (b"Xq\r", b"\x15"),
            (b"/Dc 123.4500\r", b"\x06"),
            (b"/Dc 359.5959,00\r", b"\x15"),
            (b"/Dq 1\r", b"\x15"),
            (b"A\r", set_line(b"A SET-SIM,123456,4100,2506,", checksum=True)),
        ]
        for sent, received in conversation:
            assert host.say(sent) == received, sent
        assert host.say(b"\x13").startswith(b"0010050 0841722 1234500")

    def test_the_sum_of_an_input_counts(self) -> None:
        total = sum(b"/Dc 359.5959,") % 256
        assert self.host().say(b"/Dc 359.5959,%02X\r" % total) == b"\x06"

    def test_a_dropped_acknowledgement(self) -> None:
        host = self.host()
        host.station.faults.dropped_acks = 1
        assert host.say(b"Xe\r") == b""
        assert host.say(b"Xe\r") == b"\x06"


@pytest.mark.parametrize("profile", ["topcon_gts8", "topcon_classic", "sokkia_set"])
def test_a_station_may_send_records_unasked(profile: str) -> None:
    settings = StationSettings(profile=profile, push_interval_s=0.5)
    make = SokkiaStation if profile == "sokkia_set" else TopconStation
    station = make(settings, tracker(), np.random.default_rng(1))
    station.aim_at("r", -10.0)
    assert Host(station).listen(5.2).count(b"\r\n") >= 10


@given(st.lists(st.binary(max_size=40), max_size=8), st.sampled_from(["topcon_gts8", "topcon_classic", "sokkia_set"]))
def test_no_bytes_upset_a_station(pieces: list[bytes], profile: str) -> None:
    host = Host(sokkia() if profile == "sokkia_set" else topcon(profile))
    for piece in pieces:
        host.say(piece, 0.2)
        host.say(frame(piece, crlf=True), 0.2)
