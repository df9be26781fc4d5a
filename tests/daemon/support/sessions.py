"""A machine and a station for tests of sessions, which stand and move as they are told."""

from __future__ import annotations

import contextlib
import math
import resource
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.commands import CommandError
from daemon.config.sections import SessionsSection
from daemon.host.time_service import ClockState
from daemon.rig_files import load_rig
from daemon.sessions.manager import SessionManager
from daemon.sessions.prisms.guard import MotionLimit
from daemon.sessions.station_setups import StationSetups
from daemon.store.store import Store
from drivers.clock import NS_PER_S, ManualClock
from drivers.readings import Fix, LockState, Reading, Record, Status

SOURCE = load_rig("swdt82")
STEP_S = 0.05


class SharedClock(ManualClock):
    """A manual clock that one thread moves while another waits on it."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        deadline_ns = self.monotonic_ns() + round(seconds * NS_PER_S)
        while self.monotonic_ns() < deadline_ns and not event.wait(0.001):
            pass
        return event.is_set()


class Rig:
    """A machine and a station that can be stood still and moved, on a clock that only moves when told to.

    Attributes:
        stations: names of the configured stations; the first one measures.
        steps_of_fix: the station gives a fix in every so many steps.
        link_delay_s: station -> how long before its fix arrives it was measured.
        machine: what a new keeper takes for the machine.
        runs: how many keepers there have been; each is of a new run of the daemon.
        observing: surrounds the making of observations from records that are stored.
    """

    steps_of_fix = 1
    link_delay_s: Mapping[str, float] = {}
    stations: Sequence[str] = ("station",)
    machine = SOURCE.rig
    runs = 0
    observing: Callable[[], contextlib.AbstractContextManager[object]] = staticmethod(contextlib.nullcontext)

    def __init__(self, path: Path) -> None:
        self.clock, self._steps = SharedClock(), 0
        self.values = {j.name: sum(j.limits) / 2 for j in SOURCE.rig.joints}
        self.target_mm = (3000.0, 8000.0, 1000.0)
        self.aimed: list[str] = []
        self.clock_state: ClockState | None = None  # of the computer
        self.open_store(path)

    def open_store(self, path: Path) -> None:
        """Begin a run of the daemon on a store."""
        self.store = Store(path)
        self.store.begin_run(self.clock.now())
        self.store.declare_channels({j.name: j.unit for j in SOURCE.rig.joints}, {})
        self.setups = StationSetups(SOURCE.rig, self.store, self.clock, SessionsSection().control_tolerance_mm)
        self.keeper = self.new_keeper()

    def new_keeper(self, aim: Callable[[str], None] | None = None) -> SessionManager:
        self.runs += 1
        joiner = ObservationJoiner(
            joint_inputs(self.machine), signal_inputs(self.machine), link_delay_s=self.link_delay_s, settle_s=0.5
        )
        return SessionManager(
            self.machine,
            self.machine.text,
            self.store,
            self.setups,
            joiner,
            SessionsSection(fixes_per_shot=3),
            self.clock,
            run_id=self.runs,
            limits={name: MotionLimit() for name in self.stations},
            aim=aim,
            clock_state=lambda: self.clock_state,
        )

    def live(self, seconds: float, **rates: float) -> None:
        """Let time pass: every joint sampled and the station shooting at its steps, as acquisition would tell it."""
        for _ in range(round(seconds / STEP_S)):
            self.clock.advance(STEP_S)
            self._steps += 1
            for name, rate in rates.items():
                self.values[name] += rate * STEP_S
            records: list[Record] = [
                Reading(j.name, self.clock.now(), self.values[j.name], j.unit) for j in SOURCE.rig.joints
            ]
            if self._steps % self.steps_of_fix == 0:
                records.append(self.fix())
            self.store.insert_records(records)
            with self.observing():
                self.tell(records)

    def tell(self, records: Sequence[Record]) -> None:
        """Tell records to whoever takes them; what comes of them is stored, or is pending while the disk fails."""
        self.keeper.on_records(records)
        with contextlib.suppress(sqlite3.OperationalError):
            self.keeper.pending.store()

    def fix(self) -> Fix:
        east, north, up = (v / 1000 for v in self.target_mm)
        return Fix(
            self.stations[0],
            self.clock.now(),
            self.clock.now(),
            Status.OK,
            LockState.LOCKED,
            hz_angle_rad=math.atan2(east, north) % (2 * math.pi),
            zenith_angle_rad=math.atan2(math.hypot(east, north), up),
            slope_distance_m=math.sqrt(east**2 + north**2 + up**2),
        )

    def say(self, command: str, **arguments: Any) -> Any:
        owner, name = (self.setups, command[6:]) if command.startswith("setup_") else (self.keeper, command)
        return getattr(owner, f"{name}_command")(arguments)

    def shoot(self, point: str, place_mm: tuple[float, float, float]) -> Any:
        """Aim at a control point, shoot it, and aim back, with time passing meanwhile."""
        before, self.target_mm = self.target_mm, place_mm
        answer: list[Any] = []
        failure: list[CommandError] = []

        def ask() -> None:
            try:
                answer.append(self.say("shoot", point=point))
            except CommandError as error:
                failure.append(error)

        asking = threading.Thread(target=ask)
        asking.start()
        while asking.is_alive():
            self.live(STEP_S)
        asking.join()
        self.target_mm = before
        if failure:
            raise failure[0]
        return answer[0]


@contextlib.contextmanager
def disk_fails() -> Iterator[None]:
    """No byte that this process writes reaches a file: the kernel refuses it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextlib.contextmanager
def another_program_writes(path: Path) -> Iterator[None]:
    """Another program holds the write lock of a store, as a `sqlite3` shell does in a transaction."""
    with contextlib.closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.rollback()


def controlled(rig: Rig, prism: str = "r", kind: str = "static_poses", seconds: float = 2.0) -> str:
    """A closed session whose control point held from its start to its end."""
    name = str(rig.say("start", prism=prism, kind=kind)["id"])
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.live(seconds)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.say("stop")
    return name


def closed_afterwards(make: Callable[[Path], Rig]) -> Any:
    """Make a fixture: a rig on a new store, which is closed after the test."""

    @pytest.fixture
    def rig(tmp_path: Path) -> Iterator[Rig]:
        made = make(tmp_path / "rigcal.sqlite")
        yield made
        made.store.close()

    return rig


def start(rig: Rig, **more: Any) -> None:
    """Describe the set-up S1 and start a session there."""
    rig.say("setup_new", id="S1", instrument="GTS-905A")
    rig.say("start", prism="r", operator="Ada", **more)
