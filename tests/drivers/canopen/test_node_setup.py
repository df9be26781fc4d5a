"""Set-up of nodes: the state machine against a dictionary of objects, and the link against python-canopen's node."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import canopen
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.frame import Frame
from drivers.canopen.node_setup import (
    ANSWER_TIMEOUT_NS,
    ATTEMPTS,
    PROFILE_ANALOGUE,
    PROFILE_ENCODER,
    NodeSetup,
    SetupRunner,
)
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import NS_PER_S, Stamp
from drivers.errors import DeviceError, TransmitForbiddenError
from drivers.readings import DeviceEvent, EventKind
from tests.drivers.can_support import EDS, START, running, unused_channel, virtual_bus, virtual_link

OBJECTS = {
    (0x1000, 0): (0x00020196, 4),
    (0x1018, 1): (0x42, 4),
    (0x1018, 4): (0x1234, 4),
    (0x1800, 1): (0x400001A0, 4),
    (0x1800, 2): (254, 1),
    (0x1800, 5): (0, 2),
    (0x1A00, 0): (1, 1),
    (0x1A00, 1): (0x60040020, 4),
    (0x1017, 0): (0, 2),
    (0x6001, 0): (65536, 4),
    (0x6002, 0): (65536, 4),
    (0x6500, 0): (4, 2),
    (0x6501, 0): (65536, 4),
    (0x6502, 0): (1, 2),
    (0x6503, 0): (0, 2),
    (0x6505, 0): (0, 2),
    (0x6200, 0): (0, 2),
}


def setup(**settings: object) -> NodeSetup:
    values: dict[str, object] = {
        "node": 32,
        "name": "theta1",
        "profile": PROFILE_ENCODER,
        "pdo": TransmitPdo.usual(32, 1, (0x60040020,)),
        "mode": "sync",
        "period_ms": 20,
        "heartbeat_ms": 1000,
        "units_per_revolution": 65536,
        "total_units": 65536,
    }
    return NodeSetup(**(values | settings))


class Node:
    """An SDO server written for the test: objects (value, size in bytes), writes in order, NMT commands."""

    def __init__(self, changes: dict[tuple[int, int], tuple[int, int] | None] | None = None, node: int = 32) -> None:
        objects = OBJECTS | (changes or {})
        self.objects = {key: entry for key, entry in objects.items() if entry is not None}
        self.refuses: dict[tuple[int, int], int] = {}
        self.log: list[str] = []
        self.node = node

    def answer(self, frame: Frame) -> Frame | None:
        if frame.arbitration_id == 0:
            assert frame.data[1] == self.node
            self.log.append(f"nmt {frame.data[0]:02X}")
            return None
        assert frame.arbitration_id == 0x600 + self.node
        command, index, subindex = frame.data[0], int.from_bytes(frame.data[1:3], "little"), frame.data[3]
        head = frame.data[1:4]
        if command == 0x40:
            if (index, subindex) not in self.objects:
                return self._send(b"\x80" + head + (0x06020000).to_bytes(4, "little"))
            value, size = self.objects[index, subindex]
            return self._send(bytes((0x43 | (4 - size) << 2,)) + head + value.to_bytes(4, "little"))
        if (index, subindex) in self.refuses or (index, subindex) not in self.objects:
            code = self.refuses.get((index, subindex), 0x06020000)
            return self._send(b"\x80" + head + code.to_bytes(4, "little"))
        size = 4 - (command >> 2 & 3)
        assert size == self.objects[index, subindex][1], "data type does not match"
        value = int.from_bytes(frame.data[4 : 4 + size], "little")
        self.objects[index, subindex] = (value, size)
        self.log.append(f"{index:04X}.{subindex}={value:X}")
        return self._send(b"\x60" + head + bytes(4))

    def _send(self, data: bytes) -> Frame:
        return Frame(0x580 + self.node, data)


def converse(node: Node, *setups: NodeSetup) -> list[DeviceEvent]:
    """Run a conversation to its end; when nobody answers, time passes."""
    conversation = SetupRunner()
    for item in setups:
        conversation.add(item)
    now = START
    for _ in range(200):
        conversation.advance(now)
        to_node = [f for f in conversation.take_frames() if f.arbitration_id in (0, 0x600 + node.node)]
        answers = [node.answer(frame) for frame in to_node]
        for answer in answers:
            if answer is not None:
                conversation.feed(answer, now)
        if not any(answers) and conversation.deadline_ns is not None:
            now = Stamp(now.utc_ns, conversation.deadline_ns, now.boot_id)
        if not conversation.is_active:
            for frame in conversation.take_frames():
                node.answer(frame)
            return conversation.take_events()
    raise AssertionError("the conversation does not end")


def test_a_node_that_fits_is_configured_for_sync_and_started() -> None:
    node = Node()
    (event,) = converse(node, setup())
    assert node.log == ["nmt 80", "1800.1=C00001A0", "1800.2=1", "1800.5=0", "1800.1=400001A0", "1017.0=3E8", "nmt 01"]
    assert (event.kind, event.device) == (EventKind.CONFIGURED, "theta1")
    assert event.text == (
        "theta1 (node 32): configured and started, sends at every SYNC; device type 00020196h, vendor 42h, "
        "serial number 1234h; 65536 units per revolution, 65536 in total"
    )


def test_a_node_that_fits_is_configured_for_its_event_timer_and_started() -> None:
    node = Node()
    (event,) = converse(node, setup(mode="event_timer", heartbeat_ms=0))
    assert node.log == ["nmt 80", "1800.1=C00001A0", "1800.5=14", "1800.1=400001A0", "nmt 01"]
    assert "sends every 20 ms" in event.text


def test_a_synchronous_type_is_changed_for_the_event_timer() -> None:
    node = Node({(0x1800, 2): (1, 1)})
    converse(node, setup(mode="event_timer"))
    assert "1800.2=FE" in node.log


def test_the_alias_6200h_is_used_where_the_event_timer_is_refused() -> None:
    node = Node({(0x1800, 5): None})
    (event,) = converse(node, setup(mode="event_timer"))
    assert event.kind is EventKind.CONFIGURED
    assert "6200.0=14" in node.log


def test_there_is_no_alias_for_other_pdos() -> None:
    node = Node({(0x1801, 1): (0x2A0, 4), (0x1801, 2): (1, 1), (0x1A01, 0): (1, 1), (0x1A01, 1): (0x60040020, 4)})
    pdo = TransmitPdo.usual(32, 2, (0x60040020,))
    (event,) = converse(node, setup(mode="event_timer", pdo=pdo, pdo_number=2))
    assert event.kind is EventKind.ALARM
    assert "writing 14 00 to 1801h.5 was aborted by the node: 06020000h" in event.text
    assert node.log[-1] != "nmt 01"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({(0x1000, 0): (0x00020194, 4)}, "expected a device of profile 0196h, found device type 00020194h"),
        ({(0x6001, 0): (8192, 4)}, "units per revolution (6001h): expected 65536, found 8192"),
        ({(0x6002, 0): (1 << 25, 4)}, "total units (6002h): expected 65536, found 33554432"),
        (
            {(0x6500, 0): (0, 2), (0x6501, 0): (8192, 4)},
            "units per revolution (6501h, scaling off): expected 65536, found 8192",
        ),
        (
            {(0x6500, 0): (0, 2), (0x6502, 0): (4096, 2)},
            "total units (6501h x 6502h, scaling off): expected 65536, found 268435456",
        ),
        ({(0x1800, 1): (0x1A1, 4)}, "TPDO1 (1800h.1): expected COB-ID 1A0h, found 1A1h"),
        ({(0x1A00, 1): (0x60300110, 4)}, "TPDO1 mapping (1A00h): expected 60040020, found 60300110"),
        ({(0x1A00, 0): (0, 1)}, "TPDO1 mapping (1A00h): expected 60040020, found none"),
    ],
)
def test_a_node_that_does_not_fit_is_told_and_left_as_it_was(
    changes: dict[tuple[int, int], tuple[int, int] | None], text: str
) -> None:
    node = Node(changes)
    (event,) = converse(node, setup())
    assert event.kind is EventKind.ALARM
    assert text in event.text
    assert event.text.endswith("; the node was not started; its values are not used until a set-up succeeds")
    assert node.log == []


def test_all_that_a_node_does_not_tell_is_one_warning() -> None:
    node = Node({(0x6001, 0): None, (0x6500, 0): None, (0x1A00, 0): None, (0x1018, 4): None})
    warning, configured = converse(node, setup())
    assert warning.kind is EventKind.WARNING
    assert "units per revolution (6001h): the node does not report it; expected 65536, not verified" in warning.text
    assert "mapping (1A00h): the node does not report it" in warning.text
    assert configured.kind is EventKind.CONFIGURED


def test_a_node_without_6502h_is_taken_at_its_resolution() -> None:
    warnings = converse(Node({(0x6500, 0): (0, 2), (0x6502, 0): None}), setup())
    assert "total units (6501h x 6502h, scaling off): the node does not report it" in warnings[0].text


@pytest.mark.parametrize(("changes", "step"), [({(0x6005, 1): (5000, 4)}, 5000), ({(0x6501, 0): (100000, 4)}, 100000)])
def test_a_linear_transducer_is_checked_by_its_step(
    changes: dict[tuple[int, int], tuple[int, int] | None], step: int
) -> None:
    transducer = setup(units_per_revolution=None, total_units=None, step_nm=step)
    (event,) = converse(Node(changes), transducer)
    assert f"measuring step {step} nm" in event.text
    (event,) = converse(Node(changes), setup(step_nm=step + 1))
    assert f"expected {step + 1}, found {step}" in event.text


def test_an_analogue_input_is_checked_by_its_digits() -> None:
    changes: dict[tuple[int, int], tuple[int, int] | None] = {
        (0x1000, 0): (0x00020194, 4),
        (0x1A00, 1): (0x71300110, 4),
        (0x6131, 1): (0x004E0000, 4),
        (0x6132, 1): (1, 1),
    }
    pressure = setup(
        profile=PROFILE_ANALOGUE, decimal_digits=1, pdo=TransmitPdo.usual(32, 1, (0x71300110,)), mode="event_timer"
    )
    (event,) = converse(Node(changes), pressure)
    assert "physical unit bar, 1 decimal digits" in event.text
    floating = dataclasses.replace(pressure, decimal_digits=None)
    assert converse(Node(changes | {(0x6132, 1): (2, 1)}), floating)[0].kind is EventKind.CONFIGURED
    (event,) = converse(Node(changes | {(0x6132, 1): (2, 1)}), pressure)
    assert "decimal digits (6132h.1): expected 1, found 2" in event.text


def test_a_node_that_refuses_a_setting_is_not_started() -> None:
    node = Node()
    node.refuses[0x1017, 0] = 0x08000022
    (event,) = converse(node, setup())
    assert event.kind is EventKind.ALARM
    assert "writing E8 03 to 1017h.0 was aborted by the node: 08000022h" in event.text
    assert node.log[-1] == "1800.1=400001A0"


def test_a_node_that_refuses_to_be_read_is_not_started() -> None:
    class Secretive(Node):
        def answer(self, frame: Frame) -> Frame | None:
            if frame.data[:4] == bytes((0x40, 0x01, 0x60, 0)):
                return self._send(b"\x80\x01\x60\0" + (0x08000000).to_bytes(4, "little"))
            return super().answer(frame)

    (event,) = converse(Secretive(), setup())
    assert "reading 6001h.0 was aborted by the node: 08000000h, general error; the node was not started" in event.text


def test_a_node_that_does_not_answer_is_asked_again_given_up_and_the_next_goes_on() -> None:
    absent, present = converse(Node(), setup(node=99, name="theta3"), setup())
    assert (absent.device, absent.kind) == ("theta3", EventKind.ALARM)
    seconds = ATTEMPTS * ANSWER_TIMEOUT_NS / NS_PER_S
    assert f"reading 1000h.0: no answer within {seconds:g} s; check power, node number and bit rate" in absent.text
    assert present.kind is EventKind.CONFIGURED


def test_a_request_is_sent_again_when_its_time_is_up() -> None:
    conversation = SetupRunner()
    conversation.add(setup())
    sent = []
    for step in range(12):
        conversation.advance(START.shifted(step * ANSWER_TIMEOUT_NS // 2))
        sent.append(len(conversation.take_frames()))
    assert sent == [1, 0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0]
    assert not conversation.is_active


def test_frames_of_others_and_broken_answers_are_passed_over() -> None:
    conversation = SetupRunner()
    conversation.feed(Frame(0x5A0, bytes(8)), START)
    conversation.add(setup())
    conversation.advance(START)
    for frame in (
        Frame(0x5A1, bytes.fromhex("4300100096010200")),
        Frame(0x5A0, bytes.fromhex("4300100096010200"), is_extended=True),
        Frame(0x5A0, bytes.fromhex("43001000")),
    ):
        conversation.feed(frame, START)
    assert len(conversation.take_frames()) == 1
    conversation.feed(Frame(0x5A0, bytes.fromhex("4300100096010200")), START)
    assert conversation.take_frames() == [Frame(0x620, bytes.fromhex("4018100100000000"))]


def test_an_answer_in_segments_is_taken_as_well() -> None:
    conversation = SetupRunner()
    conversation.add(setup())
    conversation.advance(START)
    conversation.take_frames()
    conversation.feed(Frame(0x5A0, bytes.fromhex("4100100004000000")), START)
    assert conversation.take_frames() == [Frame(0x620, b"\x60" + bytes(7))]
    conversation.feed(Frame(0x5A0, bytes.fromhex("0796010200000000")), START)
    assert conversation.take_frames() == [Frame(0x620, bytes.fromhex("4018100100000000"))]


def test_a_lost_link_cuts_all_set_ups_short_and_says_so() -> None:
    conversation = SetupRunner()
    conversation.add(setup())
    conversation.add(setup(node=33, name="theta3"))
    conversation.advance(START)
    conversation.abort(START, "the link was lost")
    told = conversation.take_events()
    assert [(event.device, event.kind, event.text) for event in told] == [
        (
            "theta1",
            EventKind.ALARM,
            "node 32: set-up was interrupted and may be incomplete because the link was lost; request it again",
        ),
        ("theta3", EventKind.ALARM, "node 33: set-up was not started because the link was lost; request it again"),
    ]
    assert not conversation.is_active
    assert conversation.take_frames() == []


def test_a_node_whose_start_command_is_not_sent_is_not_reported_as_configured() -> None:
    node, conversation = Node(), SetupRunner()
    conversation.add(setup())
    while "1017.0=3E8" not in node.log:
        conversation.advance(START)
        for answer in [node.answer(frame) for frame in conversation.take_frames()]:
            if answer is not None:
                conversation.feed(answer, START)
    conversation.abort(START, "the link was lost")
    (event,) = conversation.take_events()
    assert (event.kind, event.device) == (EventKind.ALARM, "theta1")
    assert "set-up was interrupted and may be incomplete because the link was lost" in event.text
    assert "nmt 01" not in node.log


BOOT_UP = Frame(0x720, b"\0")


def converse_until(node: Node, conversation: SetupRunner, last: str) -> None:
    """Run a conversation until the node has logged `last`; its answer to that is fed as well."""
    conversation.add(setup())
    while last not in node.log:
        conversation.advance(START)
        for answer in [node.answer(frame) for frame in conversation.take_frames()]:
            if answer is not None:
                conversation.feed(answer, START)


@pytest.mark.parametrize("last", ["nmt 80", "1800.1=C00001A0", "1800.5=0", "1800.1=400001A0"])
def test_a_node_that_boots_during_its_set_up_is_not_reported_as_configured(last: str) -> None:
    node, conversation = Node(), SetupRunner()
    converse_until(node, conversation, last)
    conversation.feed(BOOT_UP, START)
    (event,) = conversation.take_events()
    assert (event.kind, event.device) == (EventKind.ALARM, "theta1")
    assert event.text == (
        "theta1 (node 32): set-up was interrupted because the node has booted, which discards its settings; "
        "request it again; the node was not started"
    )
    assert not conversation.is_active


def test_a_node_that_boots_before_its_start_command_is_sent_is_not_started() -> None:
    node, conversation = Node(), SetupRunner()
    converse_until(node, conversation, "1017.0=3E8")
    conversation.feed(BOOT_UP, START)
    (event,) = conversation.take_events()
    assert event.kind is EventKind.ALARM
    assert event.text.startswith("theta1 (node 32): set-up was interrupted and may be incomplete because the node has")
    assert conversation.take_frames() == []


def test_a_node_that_boots_before_anything_was_read_from_it_is_set_up() -> None:
    node, conversation = Node(), SetupRunner()
    conversation.add(setup())
    conversation.advance(START)
    conversation.feed(BOOT_UP, START)
    conversation.feed(Frame(0x721, b"\0"), START)
    assert conversation.is_active
    assert conversation.take_events() == []
    for answer in [node.answer(frame) for frame in conversation.take_frames()]:
        assert answer is not None
        conversation.feed(answer, START)
    conversation.feed(Frame(0x721, b"\0"), START)
    assert conversation.is_active, "another node's boot-up is of no interest"


@given(st.lists(st.binary(min_size=8, max_size=8), max_size=40))
def test_no_answers_make_the_conversation_raise_or_write_before_it_has_checked(answers: list[bytes]) -> None:
    conversation = SetupRunner()
    conversation.add(setup())
    conversation.advance(START)
    for answer in answers:
        for frame in conversation.take_frames():
            assert frame.data[0] in (0x40, 0x60, 0x70), "only reads"
        conversation.feed(Frame(0x5A0, answer), START)


# The link, with a node of python-canopen's on a virtual bus


@contextmanager
def canopen_node(channel: str) -> Iterator[canopen.LocalNode]:
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel, ignore_config=True)
    try:
        yield network.create_node(32, str(EDS))
    finally:
        network.disconnect()


def test_a_link_sets_a_node_up_on_request() -> None:
    channel = unused_channel()
    wanted = setup(units_per_revolution=8192, total_units=1 << 25, mode="event_timer", period_ms=50)
    link = virtual_link(channel, allow_transmit=True, transmit_nodes=(32,), setups=[wanted])
    with canopen_node(channel) as node, running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        assert heard.sent == []
        link.request_setup()
        event = heard.wait_for(EventKind.CONFIGURED)
        assert "device type 00020196h, vendor 42h" in event.text
        assert node.sdo[0x1800][5].raw == 50
        assert node.sdo[0x1800][1].raw == 0x1A0
        assert node.sdo[0x1017].raw == 1000
        heard.wait(lambda: node.nmt.state == "OPERATIONAL", "NMT start")
        assert not heard.events(EventKind.ALARM)
        # What was sent is told in the order of its instants among what was received, so after the next read.
        heard.wait(
            lambda: [c.data for c in heard.sent if c.arbitration_id == 0] == [b"\x80\x20", b"\x01\x20"],
            "the node's reset and its start",
        )
        assert {capture.arbitration_id for capture in heard.sent} == {0x000, 0x620}


def test_a_link_goes_on_receiving_while_it_sets_up() -> None:
    channel = unused_channel()
    link = virtual_link(channel, allow_transmit=True, transmit_nodes=(32,), setups=[setup()])
    with canopen_node(channel), virtual_bus(channel) as bus, running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        link.request_setup([32])
        for number in range(500):
            bus.send(
                canopen.network.can.Message(
                    arbitration_id=0x333, data=number.to_bytes(2, "little"), is_extended_id=False
                )
            )
        heard.wait_for(EventKind.ALARM)
        assert "expected 65536, found 8192" in heard.events(EventKind.ALARM)[0].text
        heard.wait(lambda: sum(c.arbitration_id == 0x333 for c in heard.received) == 500, "500 frames")


def test_a_set_up_is_refused_where_it_is_not_allowed() -> None:
    link = virtual_link(unused_channel(), setups=[setup()])
    with pytest.raises(TransmitForbiddenError, match="listen-only"):
        link.request_setup()
    link = virtual_link(unused_channel(), allow_transmit=True, transmit_nodes=(33,), setups=[setup()])
    with pytest.raises(TransmitForbiddenError, match="node 32 is not listed"):
        link.request_setup()
    link = virtual_link(unused_channel(), allow_transmit=True, transmit_nodes=(33,), setups=[setup()])
    with pytest.raises(DeviceError, match="the rig file has no channel on node 33"):
        link.request_setup([33])
