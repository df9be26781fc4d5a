"""Two devices with one node number are noticed, by what a set-up reads and by their values, and neither is used."""

from __future__ import annotations

from random import Random

import pytest

from drivers.can_decoder import CanDecoder
from drivers.canopen.cia404 import AnalogueChannel, AnalogueDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.pdo import TransmitPdo
from drivers.readings import DeviceEvent, EventKind, Reading, Record, Status
from tests.drivers.can_support import at, capture, events, running, unused_channel, virtual_link
from tests.drivers.canopen.test_node_setup import Node, canopen_node, setup
from tests.drivers.canopen.test_setup_watch import SERIAL, Bus

BOTH = "1A0 00 40 00 00", "1A0 40 40 00 00"  # 90 and 90.35 deg: less than a joint moves in the margin of a jump
ONE = BOTH[:1]
SYNC_PERIOD_S = 0.01


def encoder(name: str = "theta1", pdo: int = 1, *, is_synchronous: bool = True) -> EncoderChannel:
    return EncoderChannel(
        name=name,
        node=32,
        pdo=TransmitPdo.usual(32, pdo, (0x60040020,)),
        max_rate_per_s=20.0,
        is_synchronous=is_synchronous,
    )


def decoder(*, is_synchronous: bool = True) -> CanDecoder:
    pump = AnalogueChannel(name="pump", unit="bar", node=32, pdo=TransmitPdo.usual(32, 2, (0x71300110,)))
    return CanDecoder("boom", [EncoderDecoder(encoder(is_synchronous=is_synchronous)), AnalogueDecoder(pump)])


class Syncs:
    """SYNCs on a bus, and what arrives after each."""

    def __init__(self, boom: CanDecoder, period_s: float = SYNC_PERIOD_S) -> None:
        self.boom = boom
        self.period_s = period_s
        self.number = 0

    def send(self, *frames: str, is_lost: bool = False, apart_s: float = 0.0004) -> list[Record]:
        """Return the records of the frames that arrive after a SYNC."""
        second = self.number * self.period_s
        self.number += 1
        if not is_lost:
            self.boom.feed(capture("080", second, is_transmitted=True))
        made: list[Record] = []
        for place, frame in enumerate(frames):
            made += self.boom.feed(capture(frame, second + 0.0005 + place * apart_s))
        return made

    def count(self, count: int, *frames: str) -> list[Record]:
        return [record for _ in range(count) for record in self.send(*frames)]


def kinds(records: list[Record]) -> list[EventKind]:
    return [event.kind for event in events(records)]


def statuses(records: list[Record]) -> set[Status]:
    return {record.status for record in records if isinstance(record, Reading)}


def test_two_devices_that_answer_the_same_syncs_have_no_values_until_one_is_gone() -> None:
    syncs = Syncs(decoder())
    assert statuses(syncs.count(60, *ONE)) == {Status.OK}
    made = syncs.count(31, *BOTH)
    (event,) = events(made)
    assert (event.device, event.kind) == ("theta1", EventKind.DUPLICATE_NODE)
    assert event.text.startswith("node 32: different values arrive after the same SYNC")
    assert statuses(syncs.count(50, *BOTH)) == {Status.DEVICE_ALARM}
    assert statuses(list(syncs.boom.feed(capture("2A0 01 00", 1.42)))) == {Status.DEVICE_ALARM}, "of the same node"
    made = syncs.count(110, *ONE)
    assert kinds(made) == [EventKind.DUPLICATE_NODE_GONE]
    assert statuses(syncs.count(20, *ONE)) == {Status.OK}, "and no jump"


@pytest.mark.parametrize("period_s", [0.005, 0.01, 0.02, 0.05, 1.0])
def test_a_second_device_is_found_within_eight_syncs_or_three_tenths_of_a_second(period_s: float) -> None:
    syncs = Syncs(decoder(), period_s)
    syncs.count(round(max(1.0 / period_s, 2)), *ONE)
    assert kinds(syncs.count(max(8, round(0.31 / period_s)), *BOTH)) == [EventKind.DUPLICATE_NODE]


def test_a_second_device_that_answers_every_third_sync_is_found() -> None:
    syncs = Syncs(decoder())
    made = [record for _ in range(60) for record in (*syncs.send(*BOTH), *syncs.count(2, *ONE))]
    assert kinds(made) == [EventKind.DUPLICATE_NODE]


@pytest.mark.parametrize("apart_s", [0.0001, 0.0035, 0.004, 0.006, 0.009])
def test_a_second_device_is_found_however_long_it_takes_to_answer(apart_s: float) -> None:
    syncs = Syncs(decoder())
    made = [record for _ in range(100) for record in syncs.send(*BOTH, apart_s=apart_s)]
    assert kinds(made) == [EventKind.DUPLICATE_NODE]
    assert kinds(syncs.count(110, *ONE)) == [EventKind.DUPLICATE_NODE_GONE]


def test_two_devices_at_the_same_position_are_not_told_apart() -> None:
    syncs = Syncs(decoder())
    assert kinds(syncs.count(100, *ONE, *ONE)) == []
    assert kinds(syncs.count(100, *BOTH)) == [EventKind.DUPLICATE_NODE]
    assert kinds(syncs.count(110, *ONE, *ONE)) == [EventKind.DUPLICATE_NODE_GONE]


def test_a_pdo_that_is_no_longer_sent_keeps_no_values_of_its_node_invalid() -> None:
    boom = CanDecoder(
        "boom", [EncoderDecoder(encoder(name, number)) for number, name in ((1, "theta1"), (2, "theta2"))]
    )
    syncs = Syncs(boom)
    assert kinds(syncs.count(70, *BOTH, "2A0 00 40 00 00", "2A0 40 40 00 00")) == [EventKind.DUPLICATE_NODE]
    made = syncs.count(200, *ONE)
    assert kinds(made) == [EventKind.DUPLICATE_NODE_GONE]
    assert statuses(made[-1:]) == {Status.OK}


@pytest.mark.parametrize("batch_s", [0.016, 0.05])
@pytest.mark.parametrize("period_s", [0.002, 0.005, 0.01, 0.012, 0.02])
@pytest.mark.parametrize("is_own", [True, False], ids=["rigcal sends SYNC", "SYNC is received"])
def test_frames_that_are_read_in_batches_show_a_second_device_and_its_end_and_none_else(
    batch_s: float, period_s: float, *, is_own: bool
) -> None:
    """An own SYNC is captured when it is sent, all other frames when the adapter delivers them, a few of them lost."""
    random, boom = Random(5), decoder()
    stages: list[list[EventKind]] = []
    number, read_s = 0, 0.0
    for count, until_s in ((1, 20.0), (2, 22.0), (1, 40.0)):
        made: list[Record] = []
        while read_s < until_s:
            read_s += batch_s
            waiting = []
            while number * period_s < read_s:
                sent_s, values = number * period_s, [f"1A0 {number % 64:02X} {4 + n:02X} 00 00" for n in range(count)]
                if is_own:
                    boom.feed(capture("080", sent_s, is_transmitted=True))
                waiting += values if is_own else ["080", *values]
                number += 1
            for frame in waiting:
                if random.random() > 0.03:
                    made += boom.feed(capture(frame, read_s))
        stages.append([kind for kind in kinds(made) if "duplicate" in kind])
    assert stages == [[], [EventKind.DUPLICATE_NODE], [EventKind.DUPLICATE_NODE_GONE]]


def test_devices_that_pause_are_not_taken_for_gone() -> None:
    syncs = Syncs(decoder())
    assert kinds(syncs.count(100, *BOTH)) == [EventKind.DUPLICATE_NODE]
    for pause in (20, 30, 40, 100, 1000):
        syncs.count(pause)
        made = syncs.count(37, *BOTH)
        assert [kind for kind in kinds(made) if "duplicate" in kind] == []
        assert statuses(made) == {Status.DEVICE_ALARM}


@pytest.mark.parametrize("batch_s", [0.016, 0.1])
@pytest.mark.parametrize("pause_s", [0.3, 1.0, 60.0])
def test_a_pause_of_sync_shows_no_second_device(batch_s: float, pause_s: float) -> None:
    boom, made = decoder(), list[Record]()
    second = 0.0
    for number in range(4000):
        second += SYNC_PERIOD_S + (pause_s if number % 1000 == 777 else 0.0)
        boom.feed(capture("080", second, is_transmitted=True))
        if (number + 1) % round(batch_s / SYNC_PERIOD_S) == 0:
            sent = range(number + 1 - round(batch_s / SYNC_PERIOD_S), number + 1)
            made += [r for n in sent for r in boom.feed(capture(f"1A0 {n % 64:02X} 04 00 00", second + 0.001))]
    assert [kind for kind in kinds(made) if "duplicate" in kind] == []


def test_lost_syncs_are_no_second_device() -> None:
    syncs = Syncs(decoder())
    made: list[Record] = []
    for number in range(4000):
        made += syncs.send(f"1A0 {number % 200:02X} 40 00 00", is_lost=number % 10 == 0 or number % 100 in (51, 52, 53))
    assert kinds(made) == []


def test_a_value_that_comes_after_the_next_sync_is_no_second_device() -> None:
    syncs = Syncs(decoder())
    made: list[Record] = []
    for number in range(0, 200, 2):
        made += syncs.send()
        made += syncs.send(f"1A0 {number:02X} 40 00 00", f"1A0 {number + 1:02X} 40 00 00")
    assert kinds(made) == []


def test_values_without_a_sync_show_no_second_device() -> None:
    boom = decoder()
    made: list[Record] = []
    for number in range(200):
        if number == 20:
            boom.feed(capture("080", 0.2))
        made += [record for frame in BOTH for record in boom.feed(capture(frame, number * 0.01))]
    assert kinds(made) == []


def test_a_node_that_sends_by_a_timer_may_send_as_often_as_it_likes() -> None:
    assert kinds(Syncs(decoder(is_synchronous=False)).count(50, *BOTH)) == []


def test_a_second_device_is_known_over_a_restart_until_it_is_gone() -> None:
    told = events(Syncs(decoder()).count(70, *BOTH))
    after = decoder()
    assert [event.kind for event in after.recall(told)] == [EventKind.DUPLICATE_NODE]
    syncs = Syncs(after)
    made = syncs.count(40, *ONE)
    assert (kinds(made), statuses(made)) == ([], {Status.DEVICE_ALARM})
    assert kinds(syncs.count(20, *ONE)) == [EventKind.DUPLICATE_NODE_GONE]
    assert decoder(is_synchronous=False).recall(told) == [], "nothing would show that it is gone"
    other = [DeviceEvent("theta1", at(0), EventKind.DUPLICATE_NODE, told[0].text.replace("32", "33"))]
    assert decoder().recall(other) == []


@pytest.mark.parametrize(
    ("second", "answers"),
    [
        (Node({SERIAL: (0x2222, 4)}), "1018h.4: different answers, 1234h and 2222h"),
        (Node({(0x1018, 3): (7, 4)}), "1018h.3: different answers, no such object and 7h"),
        (Node({SERIAL: None}), "1018h.4: different answers, 1234h and no such object"),
        (Node({(0x1000, 0): (0x00020194, 4)}), "1000h.0: different answers, 20196h and 20194h"),
    ],
)
def test_a_set_up_that_two_devices_answer_finds_both_and_their_values_are_not_used(second: Node, answers: str) -> None:
    bus, node = Bus(), Node()
    (event,) = bus.set_up(node, second=second)
    assert event.kind is EventKind.ALARM
    assert answers in event.text
    assert "two devices have this node number" in event.text
    assert "nmt 01" not in node.log, "not started"
    assert bus.status() is Status.DEVICE_ALARM
    assert [event.kind for event in bus.set_up(Node())] == [EventKind.CONFIGURED]
    assert bus.status() is Status.OK


def test_a_link_finds_two_nodes_of_one_number_on_its_bus() -> None:
    channel = unused_channel()
    wanted = setup(units_per_revolution=8192, total_units=1 << 25)  # nothing else ends it before both have answered
    link = virtual_link(channel, allow_transmit=True, transmit_nodes=(32,), setups=[wanted])
    with canopen_node(channel), canopen_node(channel) as second, running(link) as heard:
        second.sdo[0x1000].raw = 0x00030196
        heard.wait_for(EventKind.LINK_UP)
        link.request_setup()
        event = heard.wait_for(EventKind.ALARM)
        assert "two devices have this node number" in event.text
        assert second.nmt.state != "OPERATIONAL"


def test_two_devices_whose_identity_is_the_same_are_set_up_together() -> None:
    bus = Bus()
    assert [event.kind for event in bus.set_up(Node(), second=Node())] == [EventKind.CONFIGURED]
