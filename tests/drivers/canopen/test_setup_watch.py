"""What set-ups show about a node holds for its readings: a wrong device has none, an exchanged one lost its zero."""

from __future__ import annotations

import pytest

from drivers.can.frame import Frame
from drivers.can_decoder import CanDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.node_setup import SetupRunner
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import Stamp
from drivers.readings import CanCapture, DeviceEvent, EventKind, Record, Status
from tests.drivers.can_support import START, at, capture, events, the_reading
from tests.drivers.canopen.test_node_setup import Node, setup

PDO = "1A0 00 40 00 00"
WRONG: dict[tuple[int, int], tuple[int, int] | None] = {(0x6001, 0): (8192, 4)}
SERIAL = 0x1018, 4


def decoder(name: str = "theta1") -> CanDecoder:
    channel = EncoderChannel(name=name, node=32, pdo=TransmitPdo.usual(32, 1, (0x60040020,)), max_rate_per_s=20.0)
    return CanDecoder("boom", [EncoderDecoder(channel)], [setup(name=name)])


class Bus:
    """A node, its set-up, and the decoder that receives what the node answers."""

    def __init__(self, boom: CanDecoder | None = None) -> None:
        self.boom = boom or decoder()
        self.now = START

    def set_up(self, node: Node) -> list[DeviceEvent]:
        """Return the events of a set-up and then those that the decoder made of its frames."""
        runner = SetupRunner()
        runner.add(setup())
        made: list[Record] = []
        while True:
            runner.advance(self.now)
            for frame in runner.take_frames():
                answer = node.answer(frame)
                if answer is not None:
                    made += self.boom.feed(CanCapture("boom", self.now, answer.arbitration_id, answer.data))
                    runner.feed(answer, self.now)
            if not runner.is_active:
                break
            self.now = Stamp(self.now.utc_ns, self.now.monotonic_ns + 1_000_000_000, self.now.boot_id)
        return [*runner.take_events(), *events(made)]

    def status(self) -> Status:
        return the_reading(self.boom.feed(CanCapture("boom", self.now, 0x1A0, bytes.fromhex("00400000")))).status


class Mute(Node):
    """A node that answers nothing."""

    def answer(self, frame: Frame) -> Frame | None:
        return None


def refusing(index: int) -> Node:
    node = Node()
    node.refuses[index, 0] = 0x08000022
    return node


@pytest.mark.parametrize(
    "changes",
    [
        {(0x1000, 0): (0x00020194, 4)},
        WRONG,
        {(0x6002, 0): (1 << 25, 4)},
        {(0x6500, 0): (0, 2), (0x6501, 0): (8192, 4)},
        {(0x1800, 1): (0x1A1, 4)},
        {(0x1A00, 1): (0x60300110, 4)},
    ],
    ids=["type", "units", "total", "resolution", "COB-ID", "mapping"],
)
def test_a_node_that_its_set_up_finds_wrong_has_no_values_until_a_set_up_succeeds(
    changes: dict[tuple[int, int], tuple[int, int] | None],
) -> None:
    bus = Bus()
    assert bus.status() is Status.OK
    assert [event.kind for event in bus.set_up(Node(changes))] == [EventKind.ALARM]
    assert bus.status() is Status.DEVICE_ALARM
    bus.set_up(Mute())
    bus.boom.feed(capture("720 00"))
    bus.boom.feed(capture("0A0 00 00 00 00 00 00 00 00"))
    assert bus.status() is Status.DEVICE_ALARM, "it is still the wrong one"
    bus.set_up(refusing(0x1017))
    assert bus.status() is Status.DEVICE_ALARM, "the set-up has not succeeded"
    assert [event.kind for event in bus.set_up(Node())] == [EventKind.CONFIGURED]
    assert bus.status() is Status.OK


@pytest.mark.parametrize("node", [Mute(), refusing(0x1017)], ids=["no answer", "refused"])
def test_a_set_up_that_fails_without_showing_a_wrong_device_leaves_the_values_valid(node: Node) -> None:
    bus = Bus()
    assert [event.kind for event in bus.set_up(node)] == [EventKind.ALARM]
    assert bus.status() is Status.OK


def test_a_wrong_device_is_still_wrong_after_a_restart_of_the_daemon() -> None:
    wrong = Bus().set_up(Node(WRONG))
    unanswered = Bus().set_up(Mute())
    after = Bus(decoder("slew"))
    assert [event.device for event in after.boom.recall([*wrong, *unanswered])] == ["slew", "slew"]
    assert after.status() is Status.DEVICE_ALARM
    after = Bus()
    after.boom.recall([*wrong, *Bus().set_up(Node())])
    assert after.status() is Status.OK


def test_set_ups_of_other_nodes_and_of_stations_are_theirs() -> None:
    (alarm,) = Bus().set_up(Node(WRONG))
    text = alarm.text.replace("node 32", "node 33")
    station = DeviceEvent("station", at(0), EventKind.CONFIGURED, "station acknowledged T34")
    assert decoder().recall([DeviceEvent("theta1", at(0), EventKind.ALARM, text), station]) == []


def test_another_device_under_the_same_node_number_has_lost_the_joint_s_zero() -> None:
    bus = Bus()
    assert [event.kind for event in bus.set_up(Node())] == [EventKind.CONFIGURED]
    assert [event.kind for event in bus.set_up(Node())] == [EventKind.CONFIGURED], "it is the same device"
    _, lost = bus.set_up(Node({SERIAL: (0x2222, 4)}))
    assert (lost.device, lost.kind) == ("theta1", EventKind.PRESET_JUMP)
    assert "serial number 2222h, before 1234h" in lost.text
    assert "`rigcal model zeros-checked`" in lost.text
    assert len(bus.set_up(Node({SERIAL: (0x2222, 4)}))) == 1, "once is enough"


def test_a_device_that_refuses_its_set_up_has_lost_the_zero_all_the_same() -> None:
    bus = Bus()
    bus.set_up(Node())
    other = Node({SERIAL: (0x2222, 4)})
    other.refuses[0x1017, 0] = 0x08000022
    assert [event.kind for event in bus.set_up(other)] == [EventKind.ALARM, EventKind.PRESET_JUMP]


def test_a_wrong_device_that_is_taken_out_again_loses_no_zero() -> None:
    bus = Bus()
    bus.set_up(Node())
    assert [event.kind for event in bus.set_up(Node({SERIAL: (0x2222, 4), **WRONG}))] == [EventKind.ALARM]
    assert [event.kind for event in bus.set_up(Node())] == [EventKind.CONFIGURED]


def test_another_device_than_before_the_restart_has_lost_the_joint_s_zero() -> None:
    before = Bus().set_up(Node())
    after = Bus()
    after.boom.recall(before)
    assert after.set_up(Node({SERIAL: (0x2222, 4)}))[-1].kind is EventKind.PRESET_JUMP


@pytest.mark.parametrize("serial", [(0, 4), None], ids=["zero", "none"])
def test_an_unknown_serial_number_shows_no_other_device(serial: tuple[int, int] | None) -> None:
    bus = Bus()
    for known in (Node(), Node({SERIAL: serial}), Node({SERIAL: (0x2222, 4)})):
        before = bus.set_up(known)
        assert [event.kind for event in before] == [EventKind.CONFIGURED]
    unknown, after = Bus().set_up(Node({SERIAL: serial})), Bus()
    after.boom.recall(unknown)
    assert len(after.set_up(Node())) == 1


def test_a_boot_up_ends_what_was_read_of_a_set_up() -> None:
    bus = Bus()
    bus.boom.feed(capture("5A0 43 00 10 00 96 01 02 00"))
    bus.boom.feed(capture("720 00"))
    for answer in ("18 10 01", "18 10 02", "18 10 03", "18 10 04", "01 60 00"):
        bus.boom.feed(capture(f"5A0 43 {answer} 11 00 00 00"))
    assert bus.status() is Status.OK
