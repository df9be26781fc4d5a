"""Alarms are kept in memory, store, log and status alike, through faults of the store and restarts."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.acquisition.status.snapshot import AcquisitionStatus, ChannelStatus, FrameStatus, LinkStatus
from daemon.alarms.alarm import Finding, Rule, rule
from daemon.alarms.board import GRACE_S, AlarmBoard
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from daemon.store import Store
from daemon.store.queries.alarms import AlarmTable
from daemon.store.queries.jobs import FailedJob
from drivers.clock import ManualClock
from tests.daemon.support.damage import fill_up, make_room
from tests.daemon.support.store import at, table


@rule("critical", "Plug it in.", after_s=2.0, hold_s=3.0)
def unplugged(evidence: Evidence) -> Iterable[Finding]:
    """It is unplugged."""
    for job in evidence.failed_jobs:
        yield job.kind, job.error


class Rig:
    """A board whose evidence tests say: names of what is wrong, each with its text."""

    def __init__(self, path: Path, rules: list[Rule] | None = None, clock: ManualClock | None = None) -> None:
        self.path, self.clock = path, clock or ManualClock(at(0))
        self.store = Store(path)
        self.wrong: dict[str, str] = {}
        self.board = AlarmBoard(AlarmTable(self.store), self.gather, self.clock, rules or [unplugged])

    def gather(self) -> Evidence:
        return Evidence(self.clock.now(), failed_jobs=tuple(FailedJob(1, *item) for item in self.wrong.items()))

    def pass_s(self, seconds: int, **wrong: str) -> None:
        """Let seconds pass; the board looks at the end of each."""
        self.wrong = wrong
        for _ in range(seconds):
            self.clock.advance(1.0)
            self.board.evaluate()
            self.board.write()

    def active(self) -> list[str]:
        return [alarm["subject"] for alarm in self.board.status()["active"]]

    def stored(self) -> list[tuple[str, bool]]:
        return [(row["subject"], row["cleared_utc_ns"] is None) for row in table(self.path, "alarms")]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path / "rigcal.sqlite")
    yield rig
    rig.store.close()


def test_an_alarm_is_raised_once_and_cleared_once_in_store_log_and_status(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    rig.pass_s(10, boom="no such port")
    (active,) = rig.board.status()["active"]
    assert active["age_s"] == pytest.approx(7.0)  # it stood for 2 s before it was raised, at the third look
    assert (active["kind"], active["severity"], active["text"]) == ("unplugged", "critical", "no such port")
    assert active["remedy"] == "Plug it in."
    assert rig.stored() == [("boom", True)]
    rig.pass_s(10)
    assert rig.active() == []
    assert rig.stored() == [("boom", False)]
    told = [(r.levelname, r.getMessage()) for r in caplog.records if r.name == "daemon.alarms.board"]
    assert told == [
        ("ERROR", "alarm unplugged, boom: no such port. Plug it in."),
        ("INFO", "alarm unplugged, boom is over after 10 s"),
    ]
    (row,) = table(rig.path, "alarms")
    assert row["cleared_monotonic_ns"] - row["raised_monotonic_ns"] == 10_000_000_000


def test_a_fault_while_alarms_are_written_does_not_end_their_writing(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    failed = threading.Event()

    def fault(*_: object, **__: object) -> int:
        failed.set()
        raise ValueError("a fault of rigcal")

    rig.wrong = {"boom": "no such port"}
    rig.board.start()
    with monkeypatch.context() as faulty:
        faulty.setattr(AlarmTable, "add", fault)
        for _ in range(4):
            rig.clock.advance(1.0)
            rig.board.evaluate()
        assert failed.wait(10.0)
    rig.board.evaluate()
    rig.board.stop()
    assert rig.stored() == [("boom", True)]
    assert "the alarms could not be written" in caplog.text


def test_an_alarm_that_becomes_critical_is_logged_as_such(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    severity = ["warning"]

    @rule("warning", "Free space.")
    def disk(evidence: Evidence) -> Iterable[Finding]:
        """It is nearly full."""
        del evidence
        yield "store", f"{severity[0]} space", severity[0]

    rig = Rig(tmp_path / "rigcal.sqlite", [disk])
    rig.pass_s(3)
    severity[0] = "critical"
    rig.pass_s(3)
    rig.store.close()
    told = [(r.levelname, r.getMessage()) for r in caplog.records if r.name == "daemon.alarms.board"]
    assert told == [
        ("WARNING", "alarm disk, store: warning space. Free space."),
        ("ERROR", "alarm disk, store: critical space. Free space."),
    ]


def test_what_comes_and_goes_is_one_alarm(rig: Rig) -> None:
    for _ in range(5):
        rig.pass_s(1, boom="gone")
        rig.pass_s(1)
    assert rig.stored() == [], "too short to be one"
    for _ in range(5):
        rig.pass_s(3, boom="gone")
        rig.pass_s(2)
    assert rig.stored() == [("boom", True)]


def test_a_text_that_changes_is_the_same_alarm(rig: Rig) -> None:
    rig.pass_s(4, boom="no such port")
    rig.pass_s(1, boom="in use")
    assert [row["text"] for row in table(rig.path, "alarms")] == ["in use"]


def test_an_alarm_shows_although_the_store_cannot_be_written_and_is_written_later(rig: Rig) -> None:
    rig.store.boot_row(rig.clock.now())
    long = "x" * 300
    fill_up(rig.store)
    rig.pass_s(4, **{f"link{n}": long for n in range(200)})
    assert len(rig.active()) == 200
    assert len(rig.stored()) < 200
    rig.pass_s(6, boom="still")
    assert rig.active() == ["boom"]
    make_room(rig.store)
    rig.pass_s(1, boom="still")
    stored = rig.stored()
    assert len(stored) == 201
    assert [subject for subject, is_active in stored if is_active] == ["boom"]


def test_an_alarm_of_an_earlier_run_goes_on_with_its_old_time_or_ends_after_a_grace(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    path = tmp_path / "rigcal.sqlite"
    before = Rig(path)
    before.pass_s(5, boom="gone", station="gone")
    since = {a["subject"]: a["since_utc_ns"] for a in before.board.status()["active"]}
    before.store.close()
    again = Rig(path, clock=ManualClock(at(3600, "another boot")))
    assert sorted(again.active()) == ["boom", "station"], "before anything is known"
    again.pass_s(round(GRACE_S) - 1, boom="gone")
    assert sorted(again.active()) == ["boom", "station"]
    again.pass_s(2, boom="gone")
    (left,) = again.board.status()["active"]
    assert (left["subject"], left["since_utc_ns"]) == ("boom", since["boom"])
    assert again.stored() == [("boom", True), ("station", False)]
    assert "station is over after a restart of the computer" in caplog.text, "whose clock may have been wrong"
    again.store.close()


def test_a_rule_that_fails_is_an_alarm_and_its_alarms_stand_as_they_were(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    @rule("warning", "Look.")
    def faulty(evidence: Evidence) -> Iterable[Finding]:
        """It is faulty."""
        for job in evidence.failed_jobs:
            yield "first", "is there"
            if job.error == "fail":
                raise ZeroDivisionError("a defect")

    (watched,) = (one for one in library() if one.kind == "not_watched")
    rig = Rig(tmp_path / "rigcal.sqlite", [faulty, unplugged, watched])
    rig.pass_s(4, boom="gone")
    rig.wrong = {}
    rig.pass_s(5, boom="fail")
    active = {a["kind"]: a["subject"] for a in rig.board.status()["active"]}
    assert active == {"unplugged": "boom", "faulty": "first", "not_watched": "faulty"}
    assert caplog.text.count("Traceback") == 1
    rig.pass_s(10)
    assert rig.active() == []
    rig.store.close()


class FastClock(ManualClock):
    """Runs at 20 times real time."""

    def real_seconds(self, seconds: float) -> float:
        return seconds / 20.0


def test_a_board_that_cannot_look_says_how_old_its_alarms_are_in_real_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig(tmp_path / "rigcal.sqlite", clock=FastClock(at(0)))
    rig.pass_s(4, boom="gone")

    def fail() -> Evidence:
        raise OSError("no evidence")

    rig.board._gather = fail
    rig.pass_s(30)
    assert rig.active() == ["boom"]
    assert rig.board.status()["looked_age_s"] == pytest.approx(1.5)
    assert caplog.text.count("the alarms could not be evaluated") == 1
    rig.store.close()


def test_alarms_that_are_over_are_listed_newest_first(rig: Rig) -> None:
    rig.pass_s(4, one="a")
    rig.pass_s(4, two="b")
    rig.pass_s(8)
    listed: dict[str, Any] = rig.board.list_command({"all": True})
    assert listed["active"] == []
    assert [alarm["subject"] for alarm in listed["cleared"]] == ["two", "one"]
    assert rig.board.list_command({})["cleared"] == []


def test_critical_alarms_come_first_and_older_ones_before_younger(tmp_path: Path) -> None:
    @rule("warning", "Look.")
    def minor(evidence: Evidence) -> Iterable[Finding]:
        """It is minor."""
        return [("minor", "is there")]

    rig = Rig(tmp_path / "rigcal.sqlite", [minor, unplugged])
    rig.pass_s(4, one="a")
    rig.pass_s(4, one="a", two="b")
    assert rig.active() == ["one", "two", "minor"]
    rig.store.close()


def test_alarms_of_silent_devices_neither_end_nor_begin_while_the_disk_does_not_answer(tmp_path: Path) -> None:
    clock = ManualClock(at(0))
    joint = ChannelStatus("theta1", "deg", None, "silent", 9.0, "ok", "boom", "joint", is_silent=True)
    links = [LinkStatus("boom", up=True, since_s=99.0)]
    told: list[tuple[str, str]] = []
    channels = [joint, replace(joint, name="theta2", status="ok", age_s=0.1, is_silent=False)]
    frames = [FrameStatus("boom", "181", "", 5, None, 0.1, None)]
    now = AcquisitionStatus(links=links, channels=channels, frames=frames)

    def looked(seconds: int) -> list[str]:
        for _ in range(seconds):
            clock.advance(1.0)
            board.evaluate()
        return [alarm["subject"] for alarm in board.status()["active"] if alarm["kind"] == "joint_silent"]

    with contextlib.closing(Store(tmp_path / "rigcal.sqlite")) as store:
        board = AlarmBoard(
            AlarmTable(store),
            lambda: Evidence(clock.now(), acquisition=now),
            clock,
            tell=lambda notice: told.append((notice.event, notice.kind)),
        )
        assert looked(5) == ["theta1"]
        seen = now
        silent = [replace(one, status="silent") for one in seen.channels]  # none is decoded: every device seems silent
        for hindrance in ({"is_write_hung": True}, {"error": "the disk is full"}, {"undecoded_s": 9.0}):
            now = replace(seen, channels=silent, **hindrance)
            assert looked(10) == ["theta1"], hindrance
        assert ("cleared", "joint_silent") not in told
        now = replace(seen, channels=[replace(one, status="ok", is_silent=False) for one in seen.channels])
        assert looked(10) == []


def test_no_alarm_of_silence_is_raised_or_ends_by_time_in_which_nothing_is_decoded(tmp_path: Path) -> None:
    clock = ManualClock(at(0))
    heard = ChannelStatus("theta1", "deg", 1.0, "ok", 0.1, "ok", "boom", "joint")
    silent = replace(heard, value=None, status="silent", age_s=2.0, is_silent=True)
    channel, decoded_age_s = silent, 0.0

    def looked(seconds: int, *, is_decoded: bool) -> list[str]:
        nonlocal decoded_age_s
        for _ in range(seconds):
            clock.advance(1.0)
            decoded_age_s = 0.0 if is_decoded else decoded_age_s + 1.0
            board.evaluate()
        return [alarm["kind"] for alarm in board.status()["active"] if alarm["subject"] == "theta1"]

    def gather() -> Evidence:
        links = [LinkStatus("boom", up=True, since_s=99.0)]
        acquisition = AcquisitionStatus(links=links, channels=[channel], decoded_age_s=decoded_age_s)
        return Evidence(clock.now(), running_s=99.0, acquisition=acquisition)

    with contextlib.closing(Store(tmp_path / "rigcal.sqlite")) as store:
        board = AlarmBoard(AlarmTable(store), gather, clock)
        assert looked(1, is_decoded=True) == []
        assert looked(20, is_decoded=False) == []
        assert looked(1, is_decoded=True) == ["joint_silent"]
        channel = heard
        assert looked(1, is_decoded=True) == ["joint_silent"]
        assert looked(20, is_decoded=False) == ["joint_silent"]
        assert looked(3, is_decoded=True) == []


def test_a_store_that_cannot_be_written_and_closed_links_are_told_before_older_critical_alarms(tmp_path: Path) -> None:
    causes = [replace(unplugged, kind=kind) for kind in ("link_down", "not_storing")]
    rig = Rig(tmp_path / "rigcal.sqlite", [unplugged, *causes])
    with contextlib.closing(rig.store):
        rig.pass_s(3, boom="gone")
        assert [alarm["kind"] for alarm in rig.board.status()["active"]] == ["not_storing", "link_down", "unplugged"]
