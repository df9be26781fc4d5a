"""What set-ups show about a node holds for its readings: a wrong device has none, an exchanged one lost its zero."""

from __future__ import annotations

import pytest

from drivers.can.frame import Frame
from drivers.can_decoder import CanDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.node_setup import DEVICE_TYPE, SetupRunner
from drivers.canopen.pdo import TransmitPdo
from drivers.canopen.sdo import encode_upload
from drivers.clock import Stamp
from drivers.readings import CanCapture, DeviceEvent, EventKind, Record, Status
from tests.drivers.can_support import START, at, capture, events, running, the_reading, unused_channel, virtual_link
from tests.drivers.canopen.test_node_setup import Node, canopen_node, setup

PDO = "1A0 00 40 00 00"
WRONG: dict[tuple[int, int], tuple[int, int] | None] = {(0x6001, 0): (8192, 4)}
SERIAL = 0x1018, 4


def decoder(name: str = "theta1") -> CanDecoder:
    channel = EncoderChannel(name=name, node=32, pdo=TransmitPdo.usual(32, 1, (0x60040020,)), max_rate_per_s=20.0)
    return CanDecoder("boom", [EncoderDecoder(channel)], [setup(name=name)])


OTHER_PROFILE = "5A0 43 00 10 00 92 01 02 00"


class Bus:
    """A node, its set-up, and the decoder that receives what rigcal sends and the node answers."""

    def __init__(self, boom: CanDecoder | None = None) -> None:
        self.boom = boom or decoder()
        self.now = START

    def set_up(self, node: Node, plc_after: int = 0, second: Node | None = None) -> list[DeviceEvent]:
        """Return the events of a set-up and then those that the decoder made of its frames.

        Another master reads object 1000h after the request of number `plc_after`. A second device with the node's
        number answers after the node.
        """
        runner = SetupRunner()
        runner.add(setup())
        made: list[Record] = []
        requests = 0
        while True:
            runner.advance(self.now)
            for frame in runner.take_frames():
                made += self.boom.feed(self._captured(frame, is_transmitted=True))
                answers = [one.answer(frame) for one in (node, second) if one is not None]
                requests += frame.arbitration_id == 0x620
                if requests == plc_after:
                    answers.append(node.answer(Frame(0x620, encode_upload(DEVICE_TYPE, 0))))
                for answer in answers:
                    if answer is not None:
                        made += self.boom.feed(self._captured(answer))
                        runner.feed(answer, self.now)
            if not runner.is_active:
                break
            self.now = Stamp(self.now.utc_ns, self.now.monotonic_ns + 1_000_000_000, self.now.boot_id)
        return [*runner.take_events(), *events(made)]

    def status(self) -> Status:
        return the_reading(self.boom.feed(self._captured(Frame(0x1A0, bytes.fromhex("00400000"))))).status

    def _captured(self, frame: Frame, *, is_transmitted: bool = False) -> CanCapture:
        return CanCapture("boom", self.now, frame.arbitration_id, frame.data, is_transmitted=is_transmitted)


class Mute(Node):
    """A node that answers nothing, or nothing more after some answers."""

    answers = 0

    def answer(self, frame: Frame) -> Frame | None:
        self.answers -= 1
        return super().answer(frame) if self.answers >= 0 else None


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


def test_a_wrong_device_that_is_taken_out_again_loses_the_zero_twice_also_over_a_restart() -> None:
    bus = Bus()
    told = bus.set_up(Node())
    told += bus.set_up(Node({SERIAL: (0x2222, 4), **WRONG}))
    assert [event.kind for event in told[1:]] == [EventKind.ALARM, EventKind.PRESET_JUMP]
    after = Bus()
    after.boom.recall(told)
    for one in (bus, after):
        assert [event.kind for event in one.set_up(Node())] == [EventKind.CONFIGURED, EventKind.PRESET_JUMP]
        assert one.status() is Status.OK


def test_another_device_whose_set_up_breaks_off_has_lost_the_zero_at_once() -> None:
    bus, another = Bus(), Mute({SERIAL: (0x2222, 4)})
    bus.set_up(Node())
    another.answers = 8  # its serial number is the 5th
    assert [event.kind for event in bus.set_up(another)] == [EventKind.ALARM, EventKind.PRESET_JUMP]
    assert [event.kind for event in bus.set_up(Node({SERIAL: (0x2222, 4)}))] == [EventKind.CONFIGURED]


def test_a_device_whose_set_ups_always_fail_does_not_lose_its_zero_again_after_each_restart() -> None:
    other = Node({SERIAL: (0x2222, 4)})
    other.refuses[0x1017, 0] = 0x08000022
    bus = Bus()
    told = bus.set_up(Node()) + bus.set_up(other)
    assert told[-1].kind is EventKind.PRESET_JUMP
    after = Bus(decoder("slew"))
    assert [event.kind for event in after.boom.recall(told)] == [EventKind.CONFIGURED, EventKind.ALARM]
    assert [event.kind for event in after.set_up(other)] == [EventKind.ALARM]
    assert after.status() is Status.OK


def test_another_master_s_read_during_a_set_up_does_not_keep_the_set_up_from_its_end() -> None:
    bus = Bus()
    assert bus.set_up(Node())[0].kind is EventKind.CONFIGURED
    bus.set_up(Node(WRONG))
    assert bus.status() is Status.DEVICE_ALARM
    for number in range(1, 15):
        exchanged = Node({SERIAL: (0x2222 + number, 4)})
        made = [event.kind for event in bus.set_up(exchanged, plc_after=number)]
        assert made == [EventKind.CONFIGURED, EventKind.PRESET_JUMP]
        assert bus.status() is Status.OK


@pytest.mark.parametrize("is_after_set_up", [False, True])
def test_what_another_master_reads_shows_no_wrong_device(is_after_set_up: bool) -> None:
    bus = Bus()
    if is_after_set_up:
        bus.set_up(Mute())
    bus.now = bus.now.shifted(3_600_000_000_000)
    bus.boom.feed(capture(OTHER_PROFILE, 3610))
    assert bus.status() is Status.OK


def test_a_set_up_is_followed_that_a_boot_up_precedes_before_anything_was_read() -> None:
    bus = Bus()
    bus.boom.feed(capture("620 40 00 10 00 00 00 00 00", is_transmitted=True))
    bus.boom.feed(capture("720 00"))
    bus.boom.feed(capture(OTHER_PROFILE))
    assert bus.status() is Status.DEVICE_ALARM


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
    bus.boom.feed(capture("620 40 00 10 00 00 00 00 00", is_transmitted=True))
    bus.boom.feed(capture("5A0 43 00 10 00 96 01 02 00"))
    bus.boom.feed(capture("720 00"))
    for answer in ("18 10 01", "18 10 02", "18 10 03", "18 10 04", "01 60 00"):
        bus.boom.feed(capture(f"5A0 43 {answer} 11 00 00 00"))
    assert bus.status() is Status.OK


def test_what_a_link_sent_and_received_shows_a_wrong_device() -> None:
    channel, boom = unused_channel(), decoder()
    link = virtual_link(channel, allow_transmit=True, transmit_nodes=(32,), setups=[setup()])
    with canopen_node(channel), running(link) as heard:  # of 13 bits, by its EDS
        heard.wait_for(EventKind.LINK_UP)
        link.request_setup()
        heard.wait_for(EventKind.ALARM)
    for one in heard.captures:
        boom.feed(one)
    assert the_reading(boom.feed(capture(PDO))).status is Status.DEVICE_ALARM
