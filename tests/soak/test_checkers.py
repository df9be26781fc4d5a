"""The soak finds what it looks for: a lost frame, growing memory, a fault that nobody is told of, a wrong name."""

from __future__ import annotations

import random
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from calibration.rig.description import shipped_rig
from daemon.store.reader import Reader
from daemon.store.store import Store
from drivers.clock import NS_PER_S, ScaledClock, Stamp, SystemClock
from drivers.readings import CanCapture
from simulators.devices.can.bus import Frame
from simulators.faults import KINDS
from simulators.wire_log import WireLog
from tests.soak.__main__ import main
from tests.soak.consistency import inconsistencies, untruths
from tests.soak.daemon_process import Usage
from tests.soak.evidence import SESSION, Blackout, Case, Fact, judge, without_session
from tests.soak.faults import ALARMS, EVIDENCE
from tests.soak.losses import Gap, Item, Wire, account, read_wire_log, stored_items
from tests.soak.memory import growth
from tests.soak.rig_process import RigProcess

RATE = 4.0


def items(numbers: Sequence[int], delay_ns: int = 0) -> list[Item]:
    """A frame every 10 ms, of a few kinds that come again and again."""
    kinds = [random.Random(number).randrange(31) for number in numbers]
    return [Item(n * NS_PER_S // 100 + delay_ns, str(kind)) for n, kind in zip(numbers, kinds, strict=True)]


def gap(first: float, last: float | None, missed: int | None = None, channel: str = "boom") -> Gap:
    end_ns = None if last is None else round(last * NS_PER_S)
    return Gap(channel, "link_down", round(first * NS_PER_S), end_ns, missed)


SENT = items(range(2000))
UNTIL_NS = 19 * NS_PER_S


def test_all_that_was_sent_and_stored_is_accounted_for() -> None:
    result = account("boom", SENT, items(range(2000), 1_000_000), [], UNTIL_NS)
    assert (result.lost, result.untold, result.foreign, result.backwards) == (0, [], [], 0)


def test_one_lost_frame_without_a_gap_is_found() -> None:
    stored = [item for number, item in enumerate(items(range(2000), 1_000_000)) if number != 777]
    result = account("boom", SENT, stored, [], UNTIL_NS)
    assert result.untold == [SENT[777]]
    assert account("boom", SENT, stored, [gap(7.76, 7.78)], UNTIL_NS).untold == []
    assert account("boom", SENT, stored, [gap(7.76, None)], UNTIL_NS).untold == []
    assert account("boom", SENT, stored, [gap(7.76, 7.78, channel="daemon")], UNTIL_NS).untold == []
    assert len(account("boom", SENT, stored, [gap(7.76, 7.78, channel="station")], UNTIL_NS).untold) == 1
    assert len(account("boom", SENT, stored, [gap(12.0, 13.0)], UNTIL_NS).untold) == 1


def test_which_of_many_equal_items_was_lost_is_left_open() -> None:
    sent = [Item(n * NS_PER_S // 100, "same" if n < 1500 else str(n)) for n in range(2000)]
    stored = [Item(item.at_ns + 1_000_000, item.what) for n, item in enumerate(sent) if not 700 <= n < 710]
    assert account("boom", sent, stored, [gap(7.0, 7.1)], UNTIL_NS).untold == []
    assert len(account("boom", sent, stored, [gap(6.0, 6.5)], UNTIL_NS).untold) > 0  # they were stored after that
    assert len(account("boom", sent, stored, [gap(16.0, 16.5)], UNTIL_NS).untold) == 10


def test_a_gap_that_says_too_few_is_found() -> None:
    stored = [item for number, item in enumerate(items(range(2000), 1_000_000)) if not 700 <= number < 800]
    result = account("boom", SENT, stored, [gap(7.0, 8.0, 50)], UNTIL_NS)
    assert (result.lost, result.told, result.untold) == (100, 100, [])
    assert len(result.understated) == 1
    assert account("boom", SENT, stored, [gap(7.0, 8.0, 100)], UNTIL_NS).understated == []


def test_a_frame_that_nobody_sent_and_stamps_that_run_backwards_are_found() -> None:
    stored = items(range(2000), 1_000_000)
    stored[900:900] = [Item(stored[900].at_ns - NS_PER_S, "99")]
    result = account("boom", SENT, stored, [], UNTIL_NS)
    assert [item.what for item in result.foreign] == ["99"]
    assert (result.lost, result.backwards) == (0, 1)


def test_frames_of_the_log_and_of_the_store_compare(tmp_path: Path) -> None:
    frames = [Frame(0x1A0, b"\x01\x02"), Frame(0x18FF0021, b"", is_extended=True), Frame(4, bytes(8), is_error=True)]
    with WireLog(tmp_path / "wire") as log:
        log.frames(5, frames)
        log.station(7, b"\x06\x30")
    wire = read_wire_log(tmp_path / "wire")
    captures = [
        CanCapture("boom", Stamp(0, 5, ""), f.arbitration_id, f.data, f.is_extended, f.is_remote, f.is_error)
        for f in frames
    ]
    assert stored_items(captures) == wire.frames
    assert wire.station == [Item(7, "06"), Item(7, "30")]


def usage(at_s: float, kib: float, life: int = 1, descriptors: int = 20, hanging: int = 0) -> Usage:
    return Usage(life, at_s, round(kib), round(kib), descriptors + hanging, 10 + hanging, hanging)


def test_memory_that_grows_is_found() -> None:
    flat = growth([usage(5.0 * n, 60_000 + 500 * (n % 3)) for n in range(300)], 300.0)
    assert flat is not None
    assert flat.faults() == []
    leaky = growth([usage(5.0 * n, 60_000 + 15 * n) for n in range(300)], 300.0)
    assert leaky is not None
    assert len(leaky.faults()) == 2
    open_files = growth([usage(5.0 * n, 60_000, descriptors=20 + n // 30) for n in range(300)], 300.0)
    assert open_files is not None
    assert open_files.faults() == ["descriptors grew from 22 to 29"]
    clients = growth([usage(5.0 * n, 60_000, hanging=10 * (n > 280 and n % 12 > 0)) for n in range(300)], 300.0)
    assert clients is not None
    assert clients.faults() == []


def test_what_a_process_uses_before_its_warm_up_and_before_a_kill_is_not_growth() -> None:
    samples = [usage(5.0 * n, 40_000, life=1) for n in range(40)]
    samples += [usage(5.0 * n, 50_000 + min(n, 50) * 200, life=2) for n in range(300)]
    result = growth(samples, 300.0)
    assert result is not None
    assert result.faults() == []
    assert growth(samples[:60], 300.0) is None


def node_silent(at_s: float) -> Case:
    return Case("node_silent", ("theta1",), "boom", round(at_s * NS_PER_S), EVIDENCE["node_silent"])


def told(case: Case, kind: str, subject: str, detail: str, stamp_s: float, seen_s: float) -> None:
    fact = Fact(kind, subject, detail, round(seen_s * NS_PER_S), round(stamp_s * NS_PER_S))
    if case.shows(fact):
        case.found = fact


def test_a_fault_that_nobody_is_told_of_is_found() -> None:
    case = node_silent(100.0)
    told(case, "event", "theta3", "heartbeat_lost", 102.0, 102.4)  # another node
    told(case, "event", "theta1", "boot_up", 102.0, 102.4)  # another fault
    told(case, "event", "theta1", "heartbeat_lost", 90.0, 90.4)  # an earlier one
    verdict = judge([case], [], RATE, 200 * NS_PER_S)["node_silent"]
    assert (verdict.injected, verdict.masked, verdict.late, verdict.never, verdict.worst_s) == (1, 0, 0, 1, None)


def test_program_time_counts_on_the_clock_of_the_rig_and_computing_time_on_the_wall() -> None:
    case = node_silent(100.0)
    told(case, "event", "theta1", "heartbeat_lost", 102.5, 106.5)
    verdict = judge([case], [], RATE, 200 * NS_PER_S)["node_silent"]
    assert (verdict.late, verdict.never) == (0, 0)
    assert verdict.worst_s == pytest.approx(3.5)
    late = node_silent(100.0)
    told(late, "event", "theta1", "heartbeat_lost", 105.5, 106.0)
    assert judge([late], [], RATE, 200 * NS_PER_S)["node_silent"].late == 1


def test_a_fault_behind_a_lost_link_is_not_judged() -> None:
    blackout = Blackout("boom", 99 * NS_PER_S, 110 * NS_PER_S)
    assert judge([node_silent(100.0)], [blackout], RATE, 200 * NS_PER_S)["node_silent"].masked == 1
    elsewhere = Blackout("station", 99 * NS_PER_S, 110 * NS_PER_S)
    assert judge([node_silent(100.0)], [elsewhere], RATE, 200 * NS_PER_S)["node_silent"].never == 1


POSE = {"theta1": 1.0, "theta3": 90.0, "theta4": 5.0, "theta5": 0.0, "theta6": -90.0, "theta7": -90.0, "theta8": 0.0}
VALUES = {f"{joint}_deg": value for joint, value in POSE.items()} | {"L2_mm": 100.0, "L3_mm": 200.0}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "rigcal.sqlite")
    instant = store.instant(Stamp(0, 0, "soak"), "created_")
    setup = {"id": "one", "instrument": "", "serial": "", "state": "ok", **instant}
    store.insert("station_setups", setup)
    return store


def add_session(store: Store, name: str, begin_s: float, end_s: float | None) -> None:
    ended = {} if end_s is None else store.instant(Stamp(0, round(end_s * NS_PER_S), "soak"), "ended_")
    row = {"id": name, "rig": "swdt82", "setup_id": "one", "prism": "r"}
    row |= {"operator": "", "kind": "static_poses", "state": "open" if end_s is None else "closed"}
    begin = store.instant(Stamp(0, round(begin_s * NS_PER_S), "soak"), "started_")
    store.insert("calibration_sessions", row | begin | ended)


def add_observation(store: Store, session: str, at_s: float, **changes: object) -> None:
    row = {"session_id": session, "prism": "r", "x_mm": 1000.0, "y_mm": 2000.0, "z_mm": 3000.0, "moving": 0}
    row |= {"values_json": VALUES, **store.instant(Stamp(0, round(at_s * NS_PER_S), "soak"))}
    store.insert("observations", row | changes)


def test_observations_that_are_not_true_are_found(store: Store, tmp_path: Path) -> None:
    with WireLog(tmp_path / "wire") as log:
        pose = POSE | {"L2": 100.0, "L3": 200.0}
        log.measured(10 * NS_PER_S, "r", [1001.0, 2000.0, 3000.0], pose)  # type: ignore[arg-type]
        log.measured(20 * NS_PER_S, "s", [1000.0, 2002.0, 3000.0], pose)  # type: ignore[arg-type]
    add_session(store, "s1", 0.0, 100.0)
    add_observation(store, "s1", 10.0)
    add_observation(store, "s1", 10.0, x_mm=1100.0)
    add_observation(store, "s1", 10.0, values_json=VALUES | {"theta4_deg": 40.0})
    add_observation(store, "s1", 20.0)
    add_observation(store, "s1", 20.0, excluded="of another prism")
    add_observation(store, "s1", 30.0)
    store.close()
    with Reader(store.path) as reader:
        counts, _ = untruths(reader, shipped_rig("swdt82"), read_wire_log(tmp_path / "wire"), RATE)
    wrong = {"wrong place": 1, "wrong pose": 1, "wrong name": 1, "never measured": 1}
    assert counts == {"observations": 5, **wrong}


def test_sessions_and_observations_that_do_not_fit_together_are_found(store: Store) -> None:
    add_session(store, "s1", 0.0, 100.0)
    add_session(store, "s2", 90.0, 95.0)
    add_session(store, "s3", 200.0, None)
    add_observation(store, "s1", 150.0)
    add_observation(store, "s3", 210.0, prism="b")
    store.close()
    with Reader(store.path) as reader:
        found = inconsistencies(reader)
    assert found == [
        "session s2 begins before the one before has ended",
        "1 observations of session s1: outside its time",
        "1 observations of session s3: of prism b",
        "the last run has not ended in order",
    ]


def test_what_only_a_session_shows_is_judged_while_one_is_open(store: Store) -> None:
    add_session(store, "s1", 100.0, 150.0)
    store.close()
    with Reader(store.path) as reader:
        unwatched = without_session(reader, 200 * NS_PER_S)
    turn = [Blackout(SESSION, 130 * NS_PER_S, 133 * NS_PER_S)]

    def never(at_s: float, blackouts: Sequence[Blackout]) -> int:
        case = replace(node_silent(at_s), name="prism_jump")
        return judge([case], blackouts, RATE, 200 * NS_PER_S)["prism_jump"].never

    assert [never(at_s, unwatched) for at_s in (80.0, 120.0, 148.0, 170.0)] == [0, 1, 0, 0]
    assert [never(at_s, unwatched + turn) for at_s in (120.0, 128.0, 132.0, 140.0)] == [1, 0, 0, 1]
    assert judge([node_silent(80.0)], unwatched, RATE, 200 * NS_PER_S)["node_silent"].never == 1


def test_a_rig_that_nobody_measured_has_no_observations(store: Store) -> None:
    store.close()
    with Reader(store.path) as reader:
        assert untruths(reader, shipped_rig("swdt82"), Wire(), RATE) == ({}, [])


def test_every_fault_of_the_simulators_is_in_the_table() -> None:
    tabled = {name.split(" ")[0] for name in EVIDENCE}
    assert set(KINDS) <= tabled
    assert set(ALARMS) <= set(EVIDENCE)


def test_wrong_use_of_the_soak_is_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["soak", "--minutes", "long"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "invalid float value: 'long'" in capsys.readouterr().err


class ToldToAim(RigProcess):
    """A rig that is told to aim elsewhere while it is told to aim again."""

    def __init__(self) -> None:
        self.aimed, self._aiming = "r", threading.Lock()
        self.clock = ScaledClock(RATE, SystemClock().now())
        self.told: list[str] = []
        self.turns_ns: list[int] = []
        self.other = threading.Thread(target=self.aim, args=("s",))

    def do(self, what: str, **arguments: object) -> dict[str, object]:
        self.told.append(str(arguments["target"]))
        if len(self.told) == 1:
            self.other.start()
            self.other.join(0.1)
        return {}

    def now_ns(self) -> int:
        return 0


def test_aiming_again_never_takes_the_station_from_what_the_daemon_aimed_it_at_meanwhile() -> None:
    rig = ToldToAim()
    rig.aim_again()
    rig.other.join(10)
    assert rig.told == ["r", "s"]
    assert rig.aimed == "s"
