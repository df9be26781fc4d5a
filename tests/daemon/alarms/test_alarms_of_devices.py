"""What decoders and set-ups of devices report reaches the alarms, through the board."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace

import pytest

from daemon.acquisition.link_intake import LinkIntake
from daemon.acquisition.status.board import StatusBoard
from daemon.acquisition.status.present import Expected, ExpectedChannel
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.alarms.alarm import Alarm
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from daemon.cli.diagnosis import channel_findings
from drivers.can.raw_signal import BitField, SignalChannel, SignalDecoder
from drivers.can_decoder import CanDecoder
from drivers.can_link import QUEUE_FULL
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.node_setup import PROFILE_ENCODER, NodeSetup, SetupRunner
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import ManualClock
from drivers.readings import CanCapture, DeviceEvent, EventKind, Record
from tests.daemon.support.acquisition import ListLink
from tests.daemon.support.store import at
from tests.drivers.can_support import capture

PDO = TransmitPdo.usual(5, 1, [0x60040020, 0x65030010])
SETUP = NodeSetup(
    node=5,
    name="theta1",
    profile=PROFILE_ENCODER,
    pdo=PDO,
    mode="sync",
    period_ms=10,
    heartbeat_ms=0,
    units_per_revolution=65536,
    total_units=65536,
)


class Joint:
    """A joint theta1 on link boom, its decoder, and the board that is read for alarms."""

    def __init__(self, decoder: SignalDecoder | EncoderDecoder) -> None:
        self.clock = ManualClock(at(0))
        self._decoder = CanDecoder("boom", [decoder])
        self._arbitration_id = decoder.arbitration_id
        theta1 = ExpectedChannel("theta1", "deg", "boom", "joint", 1.0, 5)
        theta2 = ExpectedChannel("theta2", "deg", "boom", "joint", 1.0, 6)
        self._board = StatusBoard(self.clock, Expected((theta1, theta2)))
        self._intakes: list[LinkIntake] = []

    def record(self, records: Iterable[Record]) -> None:
        self._board.recorded([*records], self.clock.now())

    def hear(self, data: bytes) -> None:
        self.record(self._decoder.feed(CanCapture("boom", self.clock.now(), self._arbitration_id, data)))

    def open_link(self) -> None:
        self._intakes = [LinkIntake(ListLink("boom", []), self.clock, 10, self.clock.now())]
        self.record([DeviceEvent("boom", self.clock.now(), EventKind.LINK_UP, "boom: the bus is open")])

    def hear_frame(self, text: str) -> None:
        """Receive a frame, and let 0.5 s pass after it."""
        self.record(self._decoder.feed(replace(capture(text), stamp=self.clock.now())))
        self.clock.advance(0.5)
        self.record(self._decoder.tick(self.clock.now()))

    def status(self) -> AcquisitionStatus:
        return self._board.snapshot(self._intakes, [self._decoder.summary(self.clock.now())])

    def found(self, subject: str = "theta1") -> list[Alarm]:
        evidence = Evidence(self.clock.now(), 100.0, acquisition=self.status())
        return [alarm for rule in library() for alarm in rule(evidence) if alarm.subject == subject]

    def alarms(self, subject: str = "theta1") -> set[str]:
        return {alarm.kind for alarm in self.found(subject)}


def test_a_set_up_that_failed_and_was_repeated_hides_no_alarm_of_the_device() -> None:
    joint = Joint(EncoderDecoder(EncoderChannel(name="theta1", node=5, pdo=PDO, heartbeat_ms=0)))

    def hear(flags: int) -> None:
        joint.clock.advance(0.1)
        joint.hear((1000).to_bytes(4, "little") + flags.to_bytes(2, "little"))

    hear(0)
    assert joint.alarms() == set()
    hear(1)
    assert joint.alarms() == {"device_alarm"}
    runner = SetupRunner()
    runner.add(SETUP)
    runner.advance(joint.clock.now())
    runner.take_frames()
    runner.abort(joint.clock.now(), "the transmit queue was full")
    joint.record(runner.take_events())
    hear(1)
    assert joint.alarms() == {"device_alarm"}
    joint.record([DeviceEvent("theta1", joint.clock.now(), EventKind.CONFIGURED, "theta1: configured and started")])
    hear(1)
    assert joint.alarms() == {"device_alarm"}
    hear(0)
    assert joint.alarms() == set()


def test_the_warning_of_a_full_transmit_queue_ends_when_the_link_withdraws_it() -> None:
    joint = Joint(EncoderDecoder(EncoderChannel(name="theta1", node=5, pdo=PDO, heartbeat_ms=0)))
    joint.open_link()
    for _ in range(2):
        joint.clock.advance(1.0)
        joint.record([DeviceEvent("boom", joint.clock.now(), EventKind.WARNING, f"boom: {QUEUE_FULL}")])
        assert "device_warning" in joint.alarms("boom")
        joint.clock.advance(1.0)
        joint.record([DeviceEvent("boom", joint.clock.now(), EventKind.WARNING, "boom: 5 frames were not sent", 0)])
        assert "device_warning" not in joint.alarms("boom")


POSITION = "185 00 40 00 00 00 00"


@pytest.mark.parametrize(
    ("heard", "why"),
    [
        (["705 00", "706 05", "706 05"], "its node has booted, and sends no values until it is started"),
        (["705 00", "705 7F", "705 7F"], "its node has booted, and sends no values until it is started"),
        (["705 7F"] * 4, "its node lives but is pre-operational, and sends no values until it is started"),
        (["705 05"] * 4, "its node lives, as its heartbeat shows, but sends no values: SYNC or its set-up is missing"),
        (["706 05"] * 4, ""),
        (["705 05", *["706 05"] * 12], ""),
        (["705 00", "705 7F", *["706 05"] * 12], ""),
    ],
    ids=["booted", "booted, lives", "pre-operational", "no SYNC", "dead", "died", "booted and died"],
)
def test_a_silent_joint_whose_node_lives_asks_to_start_it_and_not_to_check_its_cable(
    heard: list[str], why: str
) -> None:
    joint = Joint(EncoderDecoder(EncoderChannel(name="theta1", node=5, pdo=PDO)))
    for frame in ["705 05", POSITION, POSITION, *heard, "706 05"]:
        joint.hear_frame(frame)
    (alarm,) = joint.found()
    assert alarm.kind == "joint_silent"
    assert alarm.severity == "critical"
    assert alarm.text == f"theta1 is no longer received (last: ok){f': {why}' if why else ''}"
    assert ("`rigcal devices configure`" in alarm.remedy) is bool(why)
    assert ("where the link may transmit" in alarm.remedy) is bool(why)
    assert ("cable" in alarm.remedy) is (not why)
    status = asdict(joint.status())
    (found, *_) = [one for one in channel_findings(status["channels"], "") if "theta1" in one.text]
    assert why in found.text
    assert (found.remedy == alarm.remedy) is bool(why)


def test_a_joint_that_was_never_received_is_told_by_the_heartbeat_of_its_node() -> None:
    joint = Joint(EncoderDecoder(EncoderChannel(name="theta1", node=5, pdo=PDO)))
    joint.open_link()
    for frame in ["705 7F"] * 12:
        joint.hear_frame(frame)
    (alarm,) = joint.found()
    assert alarm.text.startswith("theta1 is not received since the start: its node lives but is pre-operational")


def test_frames_that_are_missing_by_their_message_counter_are_an_alarm_until_they_come_again() -> None:
    channel = SignalChannel(
        name="theta1", unit="deg", arbitration_id=0x100, field=BitField(0, 16), counter=BitField(16, 8)
    )
    joint = Joint(SignalDecoder(channel))

    def hear(numbers: Iterable[int]) -> None:
        for number in numbers:
            joint.clock.advance(0.1)
            joint.hear((100).to_bytes(2, "little") + bytes([number % 256]))

    hear(range(600))
    assert joint.alarms() == set()
    hear(range(600, 800, 2))
    assert joint.alarms() == {"frames_missing"}
    hear(range(800, 1500))
    assert joint.alarms() == set()
