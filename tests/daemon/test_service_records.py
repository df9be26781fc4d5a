"""The daemon's parts hear of what was stored, whatever one of them does with it."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.commands import CommandError
from daemon.composition import Parts, joiner
from daemon.models.live_model import JUMPED, LOADING, Loaded, Missing
from daemon.service import Daemon
from daemon.store.store import _EVENTS, Store
from drivers.can.tip_frames import TipStatus
from drivers.clock import ManualClock
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Reading, Record, Status
from tests.daemon.support.damage import tear
from tests.daemon.support.jobs import SOURCE
from tests.daemon.support.models import ModelRig, pose, wait


class RealClock(ManualClock):
    """A clock that tests turn, with seconds as long as real ones."""

    def real_seconds(self, seconds: float) -> float:
        return seconds


@contextlib.contextmanager
def daemon_after(made: ModelRig) -> Iterator[tuple[Daemon, Store, RealClock]]:
    """A daemon on the store of a rig that is closed; only its live model runs."""
    clock = RealClock(made.clock.now())
    config = made.config.model_copy(update={"socket": made.jobs.directory / "socket"})
    with contextlib.closing(Store(config.store_path)) as store:
        parts = Parts("live", SOURCE.rig, SOURCE.text, clock, [], {}, joiner(config, SOURCE.rig))
        daemon = Daemon(config, store, parts)
        try:
            daemon._live_model.start()
            yield daemon, store, clock
        finally:
            daemon.close()


def test_there_is_no_tip_from_a_jump_on_whatever_cannot_be_stored_or_is_stored_late(tmp_path: Path) -> None:
    made = ModelRig(tmp_path)
    made.accepted()
    made.close()
    with daemon_after(made) as (daemon, store, clock):

        def read(*more: Record) -> list[Record]:
            clock.advance(0.1)
            now = clock.now()
            readings = [Reading(j.name, now, pose(1)[j.name], j.unit) for j in SOURCE.rig.joints]
            fix = Fix("station", now, now, Status.OK, LockState.LOCKED, 0.1, 1.5, 8.0)
            records: list[Record] = [*more, *readings, fix]
            daemon._on_records(records)
            return records

        def keep(records: list[Record]) -> None:
            with store.transaction():
                store.insert_records(records)
                daemon._sessions.pending.store()

        def status() -> TipStatus:
            return daemon._tip.tip("r").status

        wait(lambda: status() is not TipStatus.NO_MODEL)
        daemon._setups.new_command({"id": "S1"})
        daemon._sessions.start_command({"prism": "r"})
        for _ in range(20):
            keep(read())
        assert status() is TipStatus.OK
        assert store.rows("SELECT count(*) AS n FROM observations")[0]["n"] > 0
        with store.transaction() as db:
            refuse = "BEGIN SELECT RAISE(FAIL, 'database or disk is full'); END"
            db.execute(f"CREATE TRIGGER full BEFORE INSERT ON observations {refuse}")
        jump = DeviceEvent("theta4", clock.now(), EventKind.PRESET_JUMP, "position jumped")
        records = read(jump)
        for _ in range(5):
            read()
            assert status() is TipStatus.NO_MODEL, "the jump is not in the store yet"
        keep(records)
        wait(lambda: status() is not TipStatus.NO_MODEL)
        assert status() is TipStatus.ZERO_LOST
        daemon._models.zeros_checked_command({"operator": "Ada"})
        wait(lambda: status() is TipStatus.OK)
        store._left_out.add(_EVENTS)  # as after damage of their table
        keep(read(replace(jump, stamp=clock.now())))
        assert status() is TipStatus.NO_MODEL, "the store cannot tell that a joint has jumped"
        wait(lambda: status() is TipStatus.MODEL_UNUSABLE)
        assert "the store is damaged" in daemon._tip.tip("r").reason


def test_there_is_no_tip_while_damage_of_the_store_hides_jumps_whatever_is_commanded(tmp_path: Path) -> None:
    made = ModelRig(tmp_path)
    made.accepted(30)
    made.accepted(40)
    made.close()
    tear(made.config.store_path, "device_events")
    with daemon_after(made) as (daemon, _, _):
        wait(lambda: daemon._tip.tip("r").reason != LOADING)
        assert "the store is damaged" in daemon._tip.tip("r").reason
        daemon._models.rollback_command({"operator": "Ada"})
        wait(lambda: daemon._tip.tip("r").reason != LOADING)
        assert "the store is damaged" in daemon._tip.tip("r").reason
        with pytest.raises(CommandError, match="no jump can be ignored"):
            daemon._models.zeros_checked_command({"operator": "Ada"})
        health = daemon._live_model.health()
        assert health is not None
        assert "restore a backup" in health.defect


def test_a_model_that_is_put_back_gives_no_tip_before_a_jump_is_stored(tmp_path: Path) -> None:
    made = ModelRig(tmp_path)
    try:
        made.accepted(30)
        made.accepted(40)
        wait(lambda: isinstance(made.live.now(), Loaded))
        made.live.void()
        made.registry.rollback_command({"operator": "Ada"})
        assert made.live.now() == Missing(JUMPED)
        made.live.jump_stored()
        wait(lambda: isinstance(made.live.now(), Loaded))
    finally:
        made.close()
