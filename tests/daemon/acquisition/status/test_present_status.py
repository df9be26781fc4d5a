"""What is shown of channels, stations, links, gaps and failed decodes is how they are now."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from daemon.acquisition import link_intake
from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.status.decode_failures import KINDS_MAX, FailureCounter
from daemon.acquisition.status.present import Expected, ExpectedChannel, ExpectedStation, expected_of
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from daemon.cli.lines.state import decoding_lines, gap_state_lines, station_line
from daemon.config.config import Config
from daemon.host.safe_output import duration
from daemon.rig_files import load_rig
from daemon.store import Store
from drivers.clock import NS_PER_S, ManualClock, Stamp
from drivers.readings import Capture, DecodeFailure, DeviceEvent, EventKind, Gap, GapReason, LinkItem, Record
from tests.daemon.support.acquisition import DEADLINE_S, ListLink, NumberDecoder, wait_until
from tests.daemon.support.store import at, frame, serial_bytes

EXPECTED = Expected(
    (
        ExpectedChannel("theta1", "deg", "boom", "joint", 1.0),
        ExpectedChannel("theta3", "deg", "boom", "joint", 1.0),
    ),
    (ExpectedStation("ts1", 5.0),),
)
UP = DeviceEvent("boom", at(0), EventKind.LINK_UP, "boom: the bus is open")


class Rig:
    """An acquisition with one CAN link, told its time and its items by tests."""

    def __init__(self, path: Path) -> None:
        self.clock = ManualClock(at(0))
        self.store = Store(path)
        self._more: list[LinkItem] = []
        self._come = threading.Event()
        self._heard = 0
        self.acquisition = Acquisition(
            [self, ListLink("station", [serial_bytes(b"Q", 0.0)])],
            {"boom": NumberDecoder, "station": NumberDecoder},
            self.store,
            self.clock,
            batch_seconds=0.01,
            on_records=lambda _: None,
            expected=EXPECTED,
        )

    name = "boom"
    read_until: Stamp | None = None

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        while not stop.wait(0.005):
            if self._come.is_set():
                self._come.clear()
                for item in self._more:
                    emit(item)

    def hear(self, *items: LinkItem) -> None:
        """Let the link bring items, and wait until the status has them."""
        self._heard += 1
        marker = DeviceEvent("marker", self.clock.now(), EventKind.CONFIGURED, str(self._heard))
        self._more = [*items, marker]
        self._come.set()
        wait_until(lambda: any(e.text == marker.text for e in self.status().last_events))

    def status(self) -> AcquisitionStatus:
        return self.acquisition.status()

    def channel(self, name: str = "theta1") -> tuple[str, float | None]:
        (channel,) = (c for c in self.status().channels if c.name == name)
        return channel.status, channel.value


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path / "rigcal.sqlite")
    rig.acquisition.start()
    yield rig
    rig.acquisition.stop()
    rig.store.close()


def test_a_channel_that_falls_silent_is_silent_and_shows_no_old_value(rig: Rig) -> None:
    rig.hear(UP, frame(7, 0.0))
    assert rig.channel() == ("ok", 7.0)
    rig.clock.advance(0.9)
    assert rig.channel() == ("ok", 7.0)
    rig.clock.advance(40.0)
    assert rig.channel() == ("silent", None)
    (channel, _) = rig.status().channels
    assert (channel.last_status, channel.age_s) == ("ok", pytest.approx(40.9))


def test_a_channel_that_was_never_heard_is_there_and_silent(rig: Rig) -> None:
    assert rig.channel("theta3") == ("starting", None)
    rig.hear(UP, frame(7, 0.0))
    assert rig.channel("theta3") == ("starting", None)
    rig.clock.advance(2.0)
    assert rig.channel("theta3") == ("silent", None)


def test_a_device_is_silent_only_once_nothing_of_it_can_wait_for_the_disk(rig: Rig) -> None:
    def silent() -> list[str]:
        status = rig.status()
        return [device.name for device in (*status.channels, *status.stations) if device.is_silent]

    rig.hear(UP, frame(7, 0.0))
    wait_until(lambda: rig.status().stations[0].fixes == 1)
    with rig.store.transaction():  # the disk writes nothing of acquisition meanwhile
        rig.clock.advance(40.0)
        assert [device.status for device in (*rig.status().channels, *rig.status().stations)] == ["silent"] * 3
        assert silent() == []
    wait_until(lambda: silent() == ["theta1", "theta3", "ts1"])
    rig.hear(frame(8, 40.0))
    assert silent() == ["theta3", "ts1"]


def test_devices_that_are_still_starting_when_the_disk_hangs_raise_no_alarm_of_silence(rig: Rig) -> None:
    def found() -> list[str]:
        evidence = Evidence(rig.clock.now(), running_s=100.0, acquisition=rig.status())
        return [alarm.subject for rule in library() for alarm in rule(evidence) if "silent" in alarm.kind]

    rig.hear(UP, frame(7, 0.0))
    rig.clock.advance(3.0)
    rig.hear(frame(7, 3.0))  # theta3 starts later
    assert found() == []
    with rig.store.transaction():
        rig.clock.advance(10.0)
        assert found() == []
    wait_until(lambda: found() == ["boom", "ts1"])


def test_a_station_whose_records_wait_for_the_disk_is_called_late_and_not_silent(rig: Rig) -> None:
    rig.hear(UP)
    wait_until(lambda: rig.status().stations[0].fixes == 1)
    with rig.store.transaction():
        rig.clock.advance(40.0)
        assert rig.status().stations[0].sentence == "late, nothing decoded for 40 s (last: locked, ok)"
    wait_until(lambda: rig.status().stations[0].sentence.startswith("silent, nothing received for 40 s"))


def test_channels_of_an_unplugged_bus_are_not_ok(rig: Rig) -> None:
    rig.hear(UP, frame(7, 0.0))
    rig.clock.advance(0.1)
    lost = DeviceEvent("boom", at(0.1), EventKind.LINK_LOST, "boom: the adapter was unplugged")
    rig.hear(Gap("boom", GapReason.LINK_DOWN, at(0.0)), lost)
    assert rig.channel() == ("link_down", None)
    link = rig.status().links[0]
    assert (link.up, link.reason) == (False, lost.text)
    rig.clock.advance(9.9)
    back = DeviceEvent("boom", at(10), EventKind.LINK_UP, "boom: the bus is open")
    rig.hear(Gap("boom", GapReason.LINK_DOWN, at(0.0), at(10)), back)
    assert rig.channel() == ("starting", None), "it has had no time to be heard"
    rig.hear(frame(8, 10.0))
    assert rig.channel() == ("ok", 8.0)
    assert rig.status().links[0].reason == ""


def test_a_silent_station_is_not_locked_and_its_last_fix_not_ok(rig: Rig) -> None:
    wait_until(lambda: rig.status().stations[0].fixes == 1)
    (station,) = rig.status().stations
    assert (station.status, station.lock) == ("ok", "locked")
    assert station_line({"name": "ts1", "fixes": 1, "sentence": station.sentence}) == (
        "station ts1: locked, ok, 0 s ago; 1 fixes"
    )
    rig.clock.advance(40.0)
    wait_until(lambda: rig.status().stations[0].is_silent)
    (station,) = rig.status().stations
    assert (station.status, station.lock, station.good_age_s) == ("silent", "unknown", pytest.approx(40.0))
    assert station.sentence == "silent, nothing received for 40 s (last: locked, ok)"


def test_why_no_fix_can_arrive_is_known(rig: Rig) -> None:
    rig.hear(UP, frame(7, 0.0))
    wait_until(lambda: rig.status().stations[0].fixes == 1)
    assert rig.status().why_no_fix() is None
    rig.clock.advance(40.0)
    wait_until(lambda: rig.status().stations[0].is_silent)
    assert rig.status().why_no_fix() == "ts1: silent, nothing received for 40 s (last: locked, ok)"
    assert AcquisitionStatus(error="the disk is full").why_no_fix() == "nothing can be stored: the disk is full"
    assert AcquisitionStatus(is_write_hung=True).why_no_fix() == "a write to the store does not end"
    assert AcquisitionStatus(is_behind=True).why_no_fix() == "earlier captures are still being decoded"
    assert AcquisitionStatus().why_no_fix() == "there is no station"


def test_open_gaps_are_in_the_status_until_they_close_and_one_line_for_all_channels_of_a_link(rig: Rig) -> None:
    starts = [Gap(name, GapReason.SILENT, at(0)) for name in ("theta1", "theta3")]
    rig.hear(UP, *starts, Gap("ts1", GapReason.LOCK_LOST, at(0)))
    rig.clock.advance(40.0)
    status = rig.status()
    shown = {
        "channels": [{"name": c.name, "link": c.link} for c in status.channels],
        "gaps": [{"channel": g.channel, "reason": g.reason, "age_s": g.age_s} for g in status.gaps],
    }
    assert [*gap_state_lines(shown)] == ["gap: silent for 40 s: theta1, theta3", "gap: lock lost for 40 s: ts1"]
    rig.hear(*(Gap(gap.channel, gap.reason, gap.start, at(40)) for gap in starts))
    assert [gap.channel for gap in rig.status().gaps] == ["ts1"]


def test_what_a_killed_run_left_behind_says_nothing_of_how_things_are(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "rigcal.sqlite")
    rig.store.append_captures([frame(7, 0.0)])
    rig.acquisition.start()
    assert rig.channel() == ("starting", None)
    rig.acquisition.stop()
    rig.store.close()


def test_losses_and_failing_loops_have_an_age(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_intake, "RESTART_S", 0.01)
    busy, go_on = threading.Event(), threading.Event()
    clock = ManualClock(at(0))

    class Flood(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            busy.wait(DEADLINE_S)
            for n in range(100):
                emit(frame(n))
            if not self.done.is_set():
                self.done.set()
                raise RuntimeError("a defect")
            stop.wait()

    def block(_: Sequence[Record]) -> None:
        busy.set()
        go_on.wait(DEADLINE_S)

    store = Store(tmp_path / "rigcal.sqlite")
    acquisition = Acquisition([Flood("boom", [])], {}, store, clock, queue_captures=10, on_records=block)
    acquisition.start()
    wait_until(lambda: acquisition.status().links[0].restarts == 1)
    link = acquisition.status().links[0]
    assert link.dropped_age_s is not None
    assert link.restarted_age_s is not None
    clock.advance(60.0)
    wait_until(lambda: (acquisition.status().links[0].restarted_age_s or 0) >= 60.0)
    go_on.set()
    acquisition.stop()
    store.close()


def test_a_decoder_that_shows_a_defect_is_told_of(rig: Rig, tmp_path: Path) -> None:
    class Defective(NumberDecoder):
        def feed(self, capture: Capture) -> Sequence[Record]:
            raise ValueError("a defect")

    store = Store(tmp_path / "other.sqlite")
    link = ListLink("boom", [frame(1)])
    acquisition = Acquisition([link], {"boom": Defective}, store, ManualClock(at(3)), on_records=lambda _: None)
    acquisition.start()
    wait_until(lambda: acquisition.status().links[0].decoder_failed_age_s is not None)
    acquisition.stop()
    store.close()


# ---- failed decodes --------------------------------------------------------------------------------------------------


def test_the_commonest_reason_stands_beside_the_number_of_failed_decodes(rig: Rig) -> None:
    failures = FailureCounter()
    for n in range(70):
        failures.add("station", f"record does not follow the layout of 'Q' records: 'Q+{n:09d}'")
    for _ in range(60):
        failures.add("station", "checksum 12 found, 34 expected")
    (status,) = failures.status()
    assert (status.count, status.reason_count, status.reason[:6]) == (130, 70, "record")
    (line,) = decoding_lines([vars(status)])
    assert line == (
        "130 captures of station could not be decoded (130 in the last minute): 70 of them: record does not follow "
        "the layout of 'Q' records: 'Q+000000069'"
    )


def test_failures_of_late_are_a_share_of_what_came_and_are_forgotten() -> None:
    failures = FailureCounter()
    failures.tell_time(100 * NS_PER_S)
    for _ in range(10):
        failures.add("theta1", "too short")
    failures.decoded.add("theta1", 90)
    (status,) = failures.status()
    assert (status.lately, status.lately_share) == (10, pytest.approx(0.1))
    failures.tell_time(131 * NS_PER_S)
    assert failures.status()[0].lately == 10
    failures.tell_time(162 * NS_PER_S)
    (status,) = failures.status()
    assert (status.count, status.lately, status.lately_share) == (10, 0, 0.0)
    failures.add("theta1", "too short")
    failures.tell_time(1000 * NS_PER_S)
    assert failures.status()[0].lately == 0, "a long pause is no time of late"


def test_noise_fills_no_memory() -> None:
    failures = FailureCounter()
    for n in range(10_000):
        failures.add("station", "z" * (n % 5000) + "y")
    assert len(failures._examples) <= KINDS_MAX + 1
    assert failures.totals() == {"station": 10_000}


def test_the_failures_of_a_link_reach_the_status(rig: Rig) -> None:
    class Odd(NumberDecoder):
        def feed(self, capture: Capture) -> Sequence[Record]:
            return [DecodeFailure("theta1", capture.stamp, "the frame has 3 bytes, the value needs 4", b"")]

    rig.acquisition._decoding._decoders["boom"] = Odd()
    rig.acquisition._decoding._boots["boom"] = at(0).boot_id
    rig.hear(frame(1, 0.0), frame(2, 0.1))
    (device,) = rig.status().decoding
    assert (device.device, device.count, device.lately_share) == ("theta1", 2, 1.0)
    assert rig.status().decode_failures == {"theta1": 2}


# ---- small parts -----------------------------------------------------------------------------------------------------


def test_all_channels_and_stations_of_a_rig_are_expected() -> None:
    rig = load_rig("swdt82").rig
    expected = expected_of(Config(rig="swdt82"), rig)
    kinds = {channel.name: channel.kind for channel in expected.channels}
    assert {name for name, kind in kinds.items() if kind == "joint"} == set(rig.joint_names)
    assert kinds["boom_valve"] == "signal"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(-1.0, "0 s"), (40.4, "40 s"), (720.0, "12 min"), (11_520.0, "3.2 h"), (432_000.0, "5 days")],
)
def test_a_length_of_time_reads_as_people_say_it(seconds: float, words: str) -> None:
    assert duration(seconds) == words
