"""What decoders and set-ups of devices report reaches the alarms, through the board."""

from __future__ import annotations

from collections.abc import Iterable

from daemon.acquisition.status.board import StatusBoard
from daemon.acquisition.status.present import Expected, ExpectedChannel
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from drivers.can.raw_signal import BitField, SignalChannel, SignalDecoder
from drivers.can_decoder import CanDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.node_setup import PROFILE_ENCODER, NodeSetup, SetupRunner
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import ManualClock
from drivers.readings import CanCapture, DeviceEvent, EventKind, Record
from tests.daemon.support.store import at

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
        self._board = StatusBoard(self.clock, Expected((ExpectedChannel("theta1", "deg", "boom", "joint", 1.0),)))

    def record(self, records: Iterable[Record]) -> None:
        self._board.recorded([*records], self.clock.now())

    def hear(self, data: bytes) -> None:
        self.record(self._decoder.feed(CanCapture("boom", self.clock.now(), self._arbitration_id, data)))

    def alarms(self) -> set[str]:
        evidence = Evidence(self.clock.now(), 100.0, acquisition=self._board.snapshot([], []))
        return {alarm.kind for rule in library() for alarm in rule(evidence) if alarm.subject == "theta1"}


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
