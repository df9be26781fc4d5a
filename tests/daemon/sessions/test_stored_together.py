"""Records and the observations that are made of them are stored together, or neither is."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence

import pytest

from daemon.acquisition import acquisition as acquisition_module
from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.link_decoders import LinkDecoders
from daemon.acquisition.thinning import Thinning
from drivers.readings import CanCapture, Capture, Reading, Record
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.damage import fill_up, make_room, tear
from tests.daemon.support.sessions import SOURCE, STEP_S, Rig
from tests.daemon.support.store import table

POINT_MM = (9000.0, 500.0, 2000.0)
WAITED = range(10, 20)  # the last half second of the first batch: its fixes waited for readings of the second one


def test_a_session_whose_end_is_decoded_with_what_came_a_minute_later_keeps_its_fixes(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    measured: list[list[Record]] = []
    capture(session_rig, measured, 100)
    session_rig.say("stop")
    capture(session_rig, measured, 1400)
    session_rig.keeper = session_rig.new_keeper()
    acquisition = Acquisition(
        [],
        {"boom": lambda: Measured(measured)},
        session_rig.store,
        session_rig.clock,
        batch_seconds=0.01,
        on_records=session_rig.keeper.on_records,
        also_store=session_rig.keeper.pending.store,
        thinning=Thinning(session_rig.keeper.is_of_session),
    )
    acquisition.start()
    wait_until(lambda: not session_rig.store.undecoded_chunks())
    assert acquisition.stop()
    observed = table(session_rig.store.path, "observations")
    assert len(observed) >= 99
    assert all(row["fix_id"] is not None for row in observed)


class Measured:
    """Decodes each capture into the records of one instant."""

    def __init__(self, records: Sequence[Sequence[Record]]) -> None:
        self._records = records

    def feed(self, capture: Capture) -> Sequence[Record]:
        return self._records[int.from_bytes(capture.data, "little")]

    def tick(self, now: object) -> Sequence[Record]:
        return []


def capture(rig: Rig, measured: list[list[Record]], instants: int) -> None:
    """Capture what is measured at so many instants, and add the records that it stands for."""
    for _ in range(instants):
        rig.clock.advance(STEP_S)
        now = rig.clock.now()
        rig.store.append_captures([CanCapture("boom", now, 0x181, len(measured).to_bytes(2, "little"))])
        measured.append([*(Reading(j.name, now, rig.values[j.name], j.unit) for j in SOURCE.rig.joints), rig.fix()])


def left_by_a_killed_run(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> list[list[Record]]:
    """Four seconds of a session that were captured, and are to be decoded one second at a time."""
    monkeypatch.setattr("daemon.acquisition.backlog.BATCH_CAPTURES", 20)
    rig.say("start", prism="r")
    measured: list[list[Record]] = []
    capture(rig, measured, 80)
    rig.clock.advance(STEP_S)
    return measured


def decoding(
    rig: Rig,
    measured: Sequence[Sequence[Record]],
    *,
    before_second: Callable[[], object] = lambda: None,
    in_second: Callable[[], object] = lambda: None,
) -> Acquisition:
    """A run of the daemon that decodes what is left; what happens before the second batch, and while it is stored."""
    rig.keeper = rig.new_keeper()
    batches: list[Sequence[Record]] = []

    def on_records(records: Sequence[Record]) -> None:
        if records:
            batches.append(records)
            if len(batches) == 2:
                before_second()
        rig.keeper.on_records(records)

    def also_store() -> None:
        rig.keeper.pending.store()
        if len(batches) == 2:
            in_second()

    decoders = {"boom": lambda: Measured(measured)}
    acquisition = Acquisition(
        [], decoders, rig.store, rig.clock, batch_seconds=0.01, on_records=on_records, also_store=also_store
    )
    acquisition.start()
    return acquisition


def decoded_by_the_next_run(rig: Rig, measured: Sequence[Sequence[Record]]) -> None:
    acquisition = decoding(rig, measured)
    wait_until(lambda: not rig.store.undecoded_chunks())
    assert acquisition.stop()


def unobserved(rig: Rig) -> list[int]:
    """Which of the fixes, in order, have no observation; the last ten wait for readings that follow them."""
    fixes = [row["id"] for row in table(rig.store.path, "fixes")]
    assert len(fixes) == 80
    observed = [row["fix_id"] for row in table(rig.store.path, "observations")]
    assert len(set(observed)) == len(observed)
    return [number for number, fix_id in enumerate(fixes[:-10]) if fix_id not in observed]


def test_damage_of_the_observations_keeps_neither_readings_nor_fixes_from_being_stored(session_rig: Rig) -> None:
    path = session_rig.store.path
    session_rig.say("start", prism="r")
    session_rig.live(3.0)
    session_rig.store.close()
    tear(path, "observations_by_fix")
    session_rig.open_store(path)
    fixes = len(table(path, "fixes"))
    measured: list[list[Record]] = []
    capture(session_rig, measured, 80)
    acquisition = decoding(session_rig, measured)
    wait_until(lambda: not session_rig.store.undecoded_chunks())
    assert acquisition.stop()
    assert len(table(path, "fixes")) == fixes + 80
    assert not session_rig.keeper.pending._writes
    assert session_rig.store.damage


def test_a_batch_that_cannot_be_decoded_because_of_the_disk_is_decoded_a_moment_later(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    measured: list[list[Record]] = []
    capture(session_rig, measured, 80)
    faults = iter([sqlite3.OperationalError("disk I/O error")])

    class Failing(LinkDecoders):
        def feed(self, captures: Sequence[Capture]) -> list[Record]:
            for fault in faults:
                raise fault
            return super().feed(captures)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(acquisition_module, "LinkDecoders", Failing)
        patch.setattr(acquisition_module, "RETRY_S", 0.05)
        acquisition = decoding(session_rig, measured)
        wait_until(lambda: not session_rig.store.undecoded_chunks())
        assert acquisition.stop()
    assert len(table(session_rig.store.path, "fixes")) == 80
    assert next(faults, None) is None


def a_full_disk(rig: Rig, measured: Sequence[Sequence[Record]]) -> Acquisition:
    """A run of the daemon whose disk is full before the second batch is stored."""
    acquisition = decoding(rig, measured, before_second=lambda: fill_up(rig.store))
    wait_until(lambda: acquisition.status().error is not None)
    return acquisition


def test_observations_that_a_full_disk_refuses_until_the_end_are_made_at_the_next_start(
    session_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acquisition_module, "RETRY_S", 0.02)
    measured = left_by_a_killed_run(session_rig, monkeypatch)
    acquisition = a_full_disk(session_rig, measured)
    assert acquisition.stop()
    assert acquisition.has_stored_all, "its captures wait to be decoded"
    assert session_rig.store.undecoded_chunks()
    make_room(session_rig.store)
    decoded_by_the_next_run(session_rig, measured)
    assert set(unobserved(session_rig)) <= {*WAITED}


def test_a_disk_that_has_room_again_while_the_daemon_stops_takes_the_observations_too(
    session_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = left_by_a_killed_run(session_rig, monkeypatch)
    acquisition = a_full_disk(session_rig, measured)
    room = threading.Timer(0.5, make_room, [session_rig.store])
    room.start()
    assert acquisition.stop()
    room.join()
    assert session_rig.store.undecoded_chunks() == []
    assert unobserved(session_rig) == []


def test_a_kill_while_a_backlog_is_decoded_loses_no_observation(
    session_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill() -> None:
        raise RuntimeError("killed before the commit")

    measured = left_by_a_killed_run(session_rig, monkeypatch)
    acquisition = decoding(session_rig, measured, in_second=kill)
    wait_until(lambda: not acquisition.has_stored_all)
    assert len(session_rig.store.undecoded_chunks()) == 60, "nothing of the second batch is stored"
    assert len(table(session_rig.store.path, "fixes")) == 20
    decoded_by_the_next_run(session_rig, measured)
    assert set(unobserved(session_rig)) <= {*WAITED}


def test_a_shot_is_complete_only_once_its_fixes_are_stored_so_it_names_them(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.target_mm = POINT_MM
    asking = threading.Thread(target=session_rig.say, args=("shoot",), kwargs={"point": "cp1"})
    asking.start()
    while asking.is_alive():
        session_rig.clock.advance(STEP_S)
        fix = session_rig.fix()
        session_rig.keeper.on_records([fix])
        time.sleep(0.01)  # the disk is slow
        with session_rig.store.transaction():
            session_rig.store.insert_records([fix])
            session_rig.keeper.pending.store()
    asking.join()
    (shot,) = table(session_rig.store.path, "control_shots")
    assert set(json.loads(shot["fix_ids_json"])) <= {row["id"] for row in table(session_rig.store.path, "fixes")}
