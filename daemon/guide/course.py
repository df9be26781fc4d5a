"""The course of the open guide: every event is stored before it counts, and what follows from it by itself is done.

The operator's commands (`manager`) and the guide's own thread (`worker`) make the events, and the gain meter's answers.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import ObservationJoiner
from daemon.commands import CHECK, Caller, acting_for, current_caller
from daemon.guide.advisor import Advisor
from daemon.guide.job import Job, Pose
from daemon.guide.meter_link import Place
from daemon.guide.position import PositionWatch
from daemon.guide.record import GuideRecord, is_on_prism
from daemon.sessions.manager import SessionManager
from daemon.store.queries.guides import Standstill
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import control_points
from daemon.store.store import Store
from drivers.clock import Clock

log = logging.getLogger(__name__)

_WITHOUT_SESSION = "its session was closed when rigcal started again, as it is where the rig file has changed"
RETRY_S = 5.0  # after something failed that is tried again by itself


class Course:
    """The open guide, its poses and what is expected of them.

    Args:
        rig: the machine.
        store: where everything is kept.
        sessions: told when the station leaves the prism and when it is back.
        joiner: what is known of the joints.
        clock: time.
        meter_place: tells where the gain meter finds everything.

    Attributes:
        record: the newest guide as it is stored.
        watch: boom and station.
        advisor: what is still to gain.
        standstill: the newest one of this pose whose observations count.
        is_choosing: poses are asked for, and have not come yet.
    """

    def __init__(
        self,
        rig: Rig,
        store: Store,
        sessions: SessionManager,
        joiner: ObservationJoiner,
        clock: Clock,
        meter_place: Callable[[], Place],
    ) -> None:
        self.record, self.watch = GuideRecord(store, rig.name, clock), PositionWatch(rig, joiner, clock)
        self.advisor = Advisor(meter_place, self._training, clock, self._take_enough)
        self.standstill: Standstill | None = None
        self._store, self._sessions, self._session_table = store, sessions, SessionTable(store, rig.name)
        self.is_choosing = False
        self._try_again = 0.0  # real monotonic seconds

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """All that the block changes of guide, sessions and set-ups is stored together, or nothing of it happens."""
        with self.record.turn, self._sessions.turn, self._store.transaction():
            yield

    def begin(self) -> None:
        """Begin to look: a guide was opened."""
        self.standstill, self._try_again = None, 0.0
        self.watch.begin()
        self.advisor.forget()
        self.start_advisor()

    def restore(self) -> None:
        """Go on with the guide that an earlier run left, unless that is without its session."""
        self.record.restore()
        guide = self.record.opened()
        if guide is not None and self._is_without_session(guide[1]):
            log.warning("guide %d is abandoned: %s", guide[0].id, _WITHOUT_SESSION)
            self.abandon(_WITHOUT_SESSION)
        # Fixes that were captured and are not decoded yet must not count where the station was on no prism.
        for since, until in self.record.times_away():
            self._sessions.look_away(since, until)
        guide = self.record.opened()
        if guide is not None and not guide[1].run.session:  # one that the last run had just opened, if any
            self._sessions.look_away(guide[0].started)
        if self.record.is_open:
            self.start_advisor()

    def _is_without_session(self, job: Job) -> bool:
        """Return True if the run's session has ended before the run; the daemon closes it in the last step."""
        if not job.run.session or job.step is None or job.step.kind == "close":
            return False
        opened = self._sessions.open_session()
        return opened is None or opened["id"] != job.run.session

    @property
    def is_waiting(self) -> bool:
        """Return True for a while after something failed that is tried again."""
        return time.monotonic() < self._try_again

    def wait(self) -> None:
        """Try nothing by itself for a while."""
        self._try_again = time.monotonic() + RETRY_S

    # ---- events ------------------------------------------------------------------------------------------------------

    def happen(self, kind: str, details: Mapping[str, Any], *, only_at: str = "") -> bool:
        """Store an event and go on once it is committed; False where another step than `only_at` is on by now."""
        with self.record.turn:
            changed = self.record.happen(kind, details, only_at)
            if changed is not None:
                self._store.once_committed(partial(self._followed, *changed))
            return changed is not None

    def abandon(self, reason: str) -> None:
        """Close the open session if it has poses, else abort it, and end the guide."""
        with self.at_once():
            opened = self._sessions.open_session()
            if opened is not None and opened["poses"]:
                self._sessions.stop_command({})
            elif opened is not None:
                self._sessions.abort_command({})
            self.happen("stopped", {"reason": reason})

    def aimed(self) -> None:
        """Count fixes from now on: the station is on the prism."""
        with self.at_once():
            self._store.once_committed(self.watch.forget_fixes)
            self._sessions.look_back(self.record.row.operator if self.record.row else "")
            self.happen("aimed", {})

    def _followed(self, before: Job, job: Job) -> None:
        """Do what follows from an event by itself."""
        if job.state != "open":
            self.advisor.close()
            return
        on_prism, was_on_prism = is_on_prism(job), is_on_prism(before)
        if was_on_prism and not on_prism:
            self._sessions.look_away()
        if job.at != before.at:
            self.standstill = None
        if on_prism and (job.run.done != before.run.done or job.run.poses != before.run.poses or not was_on_prism):
            self._assess()

    # ---- control points ----------------------------------------------------------------------------------------------

    def point_mm(self, name: str) -> tuple[float, float, float] | None:
        """Return the place of a control point of the set-up; None where it is not known."""
        if self.record.row is None:
            return None
        known = control_points(self._store, self.record.row.setup_id)
        return next(((p["x_mm"], p["y_mm"], p["z_mm"]) for p in known if p["name"] == name), None)

    @staticmethod
    def point(job: Job) -> str:
        """Return the control point to shoot now, or after the poses where they are enough; "" for another step."""
        step, following = job.step, job.run.following
        if step is None or step.kind != "poses":
            return "" if step is None else step.point
        return following.point if job.is_enough and following is not None else ""

    # ---- what is still to gain ---------------------------------------------------------------------------------------

    def start_advisor(self) -> None:
        """Start the gain meter's process, or another one."""
        self.advisor.start()
        self.is_choosing = False
        if not self.advisor.is_alive:
            self.wait()
        self._assess()

    def _training(self) -> list[str]:
        """Sessions that the next model will be trained on, without the open one."""
        return [session["id"] for session in self._session_table.used() if session["kind"] != CHECK]

    def _assess(self) -> None:
        if self.record.job is not None and self.record.row is not None:
            self.advisor.assess(self.record.job, self.record.row.setup_id)

    def _take_enough(self, session: str, reason: str) -> None:
        """The stop rule says stop: it counts while poses of that session are measured."""
        with self.record.turn:
            job = self.record.job
            if job is None or job.run.session != session or job.step is None:
                return
            if job.step.kind == "poses" and not job.is_enough and job.run.done >= job.run.least:
                self.happen("enough", {"reason": reason})

    def choose(self, count: int, *, as_more: bool = False) -> None:
        """Ask for poses of the run, unless the first ones are asked for already."""
        job, row = self.record.job, self.record.row
        if job is None or row is None or (self.is_choosing and not as_more):
            return
        seed = 1000 * row.id + 100 * job.at + len(job.run.poses or ())
        caller = current_caller() if as_more else None
        take = partial(self._take_poses, caller, as_more=as_more)
        self.is_choosing = self.advisor.choose(job, row.setup_id, count, seed, take)

    def _take_poses(
        self, caller: Caller | None, session: str, poses: list[Pose], trouble: str, *, as_more: bool
    ) -> None:
        with self.record.turn, acting_for(caller):
            self.is_choosing = False
            self.advisor.trouble = trouble
            job = self.record.job
            if job is None or job.state != "open" or job.run.session != session:
                return
            if trouble:
                self.wait()
            elif as_more and job.step is not None and job.step.kind == "poses":
                self.happen("more", {"poses": poses})
            elif not as_more and job.run.poses is None:
                self.happen("planned", {"poses": poses})
