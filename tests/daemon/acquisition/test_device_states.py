"""What devices said of their own state holds until they take it back, also over a restart of the daemon."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.redecoding import redecode
from daemon.acquisition.status.present import Expected, ExpectedChannel
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from daemon.composition import decoders
from daemon.config.config import parse_config
from daemon.rig_files import load_rig
from daemon.service import declare_channels
from daemon.store import Store
from daemon.store.queries.device_states import device_states
from drivers.can_decoder import CanDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder
from drivers.canopen.node_setup import NOT_USED, PROFILE_ENCODER, NodeSetup
from drivers.canopen.pdo import TransmitPdo
from drivers.canopen.supervision import EXCHANGED, VOIDS
from drivers.clock import SystemClock
from drivers.readings import CanCapture, DeviceEvent, EventKind
from tests.bench.store_growth import CONFIG
from tests.daemon.support.acquisition import ListLink, Make
from tests.daemon.support.damage import tear
from tests.daemon.support.store import table
from tests.drivers.can_support import EDS, at, capture

PDO = "1A0 00 40 00 00"
HARDWARE, OVERRUN, TAKEN_BACK = (
    "0A0 00 50 81 00 00 00 00 00",
    "0A0 10 81 11 00 00 00 00 00",
    "0A0 00 00 00 00 00 00 00 00",
)


# The first request of a set-up that expects 16 bits, and the answers of an encoder of 13
BEGIN = "620 40 00 10 00 00 00 00 00"
WRONG_DEVICE = (
    "5A0 43 00 10 00 96 01 02 00",
    *(f"5A0 80 18 10 0{n} 00 00 02 06" for n in (1, 2, 3, 4)),
    *(f"5A0 43 0{n} 60 00 00 20 00 00" for n in (1, 2)),
    "5A0 43 00 65 00 04 00 00 00",
    *(f"5A0 80 0{n} 65 00 00 00 02 06" for n in (1, 2, 3, 5)),
)
REFUSED = DeviceEvent(
    "theta1", at(1), EventKind.ALARM, f"theta1 (node 32): units: expected 65536, found 8192; {NOT_USED}"
)
UNANSWERED = DeviceEvent("theta1", at(2), EventKind.ALARM, "theta1 (node 32): reading 1000h.0: no answer")
CONFIGURED = DeviceEvent("theta1", at(3), EventKind.CONFIGURED, "theta1 (node 32): configured and started")


def can_link(name: str, channel: str) -> CanDecoder:
    pdo = TransmitPdo.from_eds(EDS, 32, 1)
    setup = NodeSetup(
        node=32,
        name=channel,
        profile=PROFILE_ENCODER,
        pdo=pdo,
        mode="sync",
        period_ms=20,
        heartbeat_ms=1000,
        units_per_revolution=65536,
        total_units=65536,
    )
    return CanDecoder(name, [EncoderDecoder(EncoderChannel(name=channel, node=32, pdo=pdo))], [setup])


def boom() -> CanDecoder:
    return can_link("boom", "theta1")


DECODERS = {"boom": boom}


def statuses(store: Store) -> list[str]:
    return [row["status"] for row in table(store.path, "joint_samples")]


@pytest.mark.parametrize(
    ("before", "after", "status"),
    [
        ([HARDWARE], [], "device_alarm"),
        ([HARDWARE, OVERRUN], [], "device_alarm"),
        ([OVERRUN], [], "ok"),
        ([HARDWARE, TAKEN_BACK], [], "ok"),
        ([HARDWARE], [TAKEN_BACK], "ok"),
        ([HARDWARE], ["720 00"], "ok"),
        (["5A0 4B 03 65 00 01 00 00 00"], [], "device_alarm"),
    ],
    ids=["hardware", "and another", "another", "taken back", "taken back later", "booted later", "alarm of an answer"],
)
def test_values_that_were_void_before_a_restart_are_void_after_it(
    store: Store, acquire: Make, before: list[str], after: list[str], status: str
) -> None:
    acquire([], DECODERS).run_inline([capture(text, second) for second, text in enumerate(before)])
    acquire([], DECODERS).run_inline([capture(text, 50 + second) for second, text in enumerate([*after, PDO])])
    assert statuses(store) == [status]


def test_values_stay_void_if_their_channel_is_renamed_in_the_rig_file(store: Store, acquire: Make) -> None:
    store.declare_channels({"theta1": "deg", "theta4": "deg"}, {})
    acquire([], DECODERS).run_inline([capture(HARDWARE)])
    acquire([], {"boom": lambda: can_link("boom", "theta4")}).run_inline([capture(PDO, 50)])
    assert statuses(store) == ["device_alarm"]


def test_a_node_of_the_same_number_on_another_link_is_not_void(store: Store, acquire: Make) -> None:
    store.declare_channels({"theta1": "deg", "theta3": "deg"}, {})
    links = {**DECODERS, "base": lambda: can_link("base", "theta3")}
    acquire([], links).run_inline([capture(HARDWARE)])
    acquire([], links).run_inline([replace(capture(PDO, 50), link="base"), capture(PDO, 51)])
    assert statuses(store) == ["ok", "device_alarm"]


def test_frames_that_were_read_at_once_are_recalled_in_their_order(store: Store, acquire: Make) -> None:
    acquire([], DECODERS).run_inline([capture(text) for text in ("720 00", TAKEN_BACK, HARDWARE)])
    acquire([], DECODERS).run_inline([capture(PDO, 50)])
    assert statuses(store) == ["device_alarm"]


def test_a_boot_of_the_computer_begins_anew(store: Store, acquire: Make) -> None:
    def of_next_boot(one: CanCapture) -> CanCapture:
        return replace(one, stamp=replace(one.stamp, boot_id="another"))

    acquire([], DECODERS).run_inline([capture(HARDWARE), of_next_boot(capture(PDO, 90))])
    assert statuses(store) == ["ok"]


def test_an_emergency_that_stands_is_shown_after_a_restart(store: Store, acquire: Make) -> None:
    clock = SystemClock()
    told = [
        DeviceEvent("theta1", clock.now(), EventKind.EMERGENCY, f"node 32: broken; {VOIDS}", 0x5000),
        DeviceEvent("roll9", clock.now(), EventKind.EMERGENCY, "node 33: of a joint that the rig has no more", 0x5000),
    ]
    store.insert_records(told)
    expected = Expected((ExpectedChannel("theta1", "deg", "boom", "joint", 1.0),))
    acquiring = acquire([ListLink("boom", [])], DECODERS, clock=clock, expected=expected)
    acquiring.start()
    status = acquiring.status()
    assert [(event.device, event.text) for event in status.last_events] == [("theta1", told[0].text)]
    assert status.event_counts == [], "it happened in the run before"


def test_captures_that_are_decoded_again_are_as_void_as_they_were(store: Store, acquire: Make) -> None:
    acquire([], DECODERS).run_inline([capture(HARDWARE), *(capture(PDO, 200 + n / 10) for n in range(10))])
    assert set(statuses(store)) == {"device_alarm"}
    assert redecode(store, DECODERS, [(at(200), at(201))]) == 0
    assert set(statuses(store)) == {"device_alarm"}


def test_a_second_device_of_a_node_is_known_until_it_is_gone(store: Store) -> None:
    found = DeviceEvent("theta1", at(1), EventKind.DUPLICATE_NODE, "node 32: different values arrive")
    gone = DeviceEvent("theta1", at(2), EventKind.DUPLICATE_NODE_GONE, "node 32: a single value arrives")
    store.insert_records([found, gone])
    assert device_states(store, at(1.5)) == [found]
    assert device_states(store, at(3)) == [found, gone]


def test_of_a_storm_the_last_event_and_the_last_that_voids_are_told(store: Store) -> None:
    void = DeviceEvent("theta1", at(1), EventKind.EMERGENCY, f"node 32: broken; {VOIDS}", 0x5000)
    storm = [
        DeviceEvent("theta1", at(2 + n / 1000), EventKind.EMERGENCY, "node 32: overrun", 0x8110) for n in range(500)
    ]
    later = DeviceEvent("theta1", at(60), EventKind.BOOT_UP, "node 32 has booted")
    store.insert_records([void, *storm, later])
    assert device_states(store, at(50)) == [void, storm[-1]]
    assert device_states(store, at(61)) == [void, storm[-1], later]


@pytest.mark.parametrize(
    ("told", "status"),
    [
        ([REFUSED], "device_alarm"),
        ([REFUSED, UNANSWERED], "device_alarm"),
        ([REFUSED, CONFIGURED], "ok"),
        ([UNANSWERED], "ok"),
    ],
    ids=["wrong", "wrong, then no answer", "wrong, then set up", "no answer"],
)
@pytest.mark.parametrize("boot_id", ["boot", "another"])
def test_a_device_that_its_set_up_found_wrong_is_wrong_after_a_restart_of_daemon_or_computer(
    store: Store, acquire: Make, told: list[DeviceEvent], status: str, boot_id: str
) -> None:
    acquire([], DECODERS).run_inline(told)
    after = capture(PDO, 50)
    acquire([], DECODERS).run_inline([replace(after, stamp=replace(after.stamp, boot_id=boot_id))])
    assert statuses(store) == [status]


def test_a_recording_of_a_set_up_that_found_a_wrong_device_gives_no_values(store: Store, acquire: Make) -> None:
    begin = capture(BEGIN, 1, is_transmitted=True)
    heard = [capture(PDO), begin, *(capture(text, 1) for text in WRONG_DEVICE), capture(PDO, 2)]
    acquire([], DECODERS).run_inline(heard)
    assert statuses(store) == ["ok", "device_alarm"]
    assert redecode(store, DECODERS, [(at(0), at(3))]) == 0
    assert statuses(store) == ["ok", "device_alarm"]


def test_the_newest_serial_number_is_told_until_a_set_up_succeeds(store: Store) -> None:
    exchanged = [
        DeviceEvent("theta1", at(second), EventKind.PRESET_JUMP, f"node 32: {EXCHANGED} (serial number {second}h, ...")
        for second in (4, 5)
    ]
    jumped = DeviceEvent("theta1", at(6), EventKind.PRESET_JUMP, "position jumped from 1 to 2 deg", 17)
    store.insert_records([CONFIGURED, *exchanged, jumped])
    assert device_states(store, at(50)) == [CONFIGURED, exchanged[-1]]
    again = replace(CONFIGURED, stamp=at(7))
    store.insert_records([again])
    assert device_states(store, at(50)) == [again]


def test_on_a_link_that_may_not_transmit_any_more_reads_void_no_values_and_earlier_set_ups_do(
    store: Store, acquire: Make
) -> None:
    rig = load_rig("swdt82")
    listening = decoders(parse_config(CONFIG, Path.cwd()), rig)
    may_send = CONFIG.replace("[[station]]", "allow_transmit = true\ntransmit_nodes = [32]\n[[station]]")
    sending = decoders(parse_config(may_send, Path.cwd()), rig)
    declare_channels(store, rig.rig)
    acquire([], listening).run_inline([capture("5A0 43 00 10 00 92 01 02 00", 1), capture(PDO, 2)])
    assert statuses(store) == ["ok"]
    store.insert_records([replace(REFUSED, stamp=at(4))])
    for n, links in enumerate((sending, listening, sending)):
        acquire([], links).run_inline([capture(PDO, 10 + n)])
    assert statuses(store) == ["ok", *3 * ["device_alarm"]]
    unanswered = [
        replace(UNANSWERED, stamp=at(20)),
        replace(CONFIGURED, stamp=at(21)),
        replace(UNANSWERED, stamp=at(22)),
    ]
    listener = listening["boom"]()
    assert isinstance(listener, CanDecoder)
    assert listener.recall(unanswered) == [], "nothing that a set-up could not read voids a value"


@pytest.mark.parametrize("booted", [False, True])
def test_a_set_up_that_failed_is_an_alarm_after_a_restart_until_one_succeeds(
    store: Store, acquire: Make, booted: bool
) -> None:
    clock = SystemClock()
    failed = replace(UNANSWERED, stamp=clock.now())
    store.insert_records([failed])
    if booted:
        store.insert_records([DeviceEvent("theta1", clock.now(), EventKind.BOOT_UP, "node 32 has booted")])
    expected = Expected((ExpectedChannel("theta1", "deg", "boom", "joint", 1.0),))
    acquiring = acquire([ListLink("boom", [])], DECODERS, clock=clock, expected=expected)
    acquiring.start()

    def alarms() -> list[str]:
        evidence = Evidence(clock.now(), 100.0, acquisition=acquiring.status())
        return [alarm.text for rule in library() for alarm in rule(evidence) if alarm.kind == "device_alarm"]

    assert alarms() == [failed.text]
    store.insert_records([replace(CONFIGURED, stamp=clock.now())])
    again = acquire([ListLink("boom", [])], DECODERS, clock=clock, expected=expected)
    again.start()
    acquiring = again
    assert alarms() == []


def test_damage_to_what_devices_have_told_keeps_no_reading_from_being_decoded(path: Path) -> None:
    with contextlib.closing(Store(path)) as store:
        store.insert_records([DeviceEvent("theta1", at(-1), EventKind.BOOT_UP, "node 32 has booted")])
    tear(path, "device_events", "device_events_of_states")
    with contextlib.closing(Store(path)) as store:
        store.declare_channels({"theta1": "deg"}, {})
        Acquisition([], DECODERS, store, SystemClock(), on_records=lambda _: None).run_inline([capture(PDO)])
        assert statuses(store) == ["ok"]
        assert store.damage
        assert not store.knows_events
