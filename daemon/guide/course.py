"""The course of the open guide: stores every event before it takes effect, then carries out its consequences.

Events come from the operator's commands (`manager`), the guide's thread (`worker`) and the gain meter's answers.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from daemon.guide.record import GuideRecord, GuideStep
from daemon.guide.times_away import is_on_prism, times_away
from daemon.sessions.manager import SessionManager
from daemon.store.queries.guides import Standstill
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import control_points
from daemon.store.store import Store
from drivers.clock import Clock, Stamp

log = logging.getLogger(__name__)

_WITHOUT_SESSION = "its session was closed when rigcal restarted, as happens if the rig file has changed"
RETRY_S = 5.0  # pause before an automatic retry


class Course:
    """The open guide, its poses and their expected gain.

    Args:
        rig: the machine.
        store: the database.
        sessions: session manager, notified when the station leaves the prism and when it is back.
        joiner: source of joint readings.
        clock: time.
        meter_place: returns the locations of the gain meter's input.

    Attributes:
        record: the newest guide in the store.
        watch: positions of boom and station.
        advisor: estimates of the remaining gain.
        standstill: newest standstill of this pose whose observations count.
        is_choosing: True while requested poses have not arrived.
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
        """Store all changes that the block makes to guide, sessions and set-ups in one transaction, or none."""
        with self.record.turn, self._sessions.turn, self._store.transaction():
            yield

    def begin(self) -> None:
        """Start work on a newly opened guide."""
        self.standstill, self._try_again = None, 0.0
        self.watch.begin()
        self.advisor.forget()
        self.start_advisor()

    def restore(self) -> None:
        """Resume the guide that an earlier run left open, unless its session has ended."""
        self.record.restore()
        guide = self.record.opened()
        if guide is not None and self._is_without_session(guide[1]):
            log.warning("guide %d is abandoned: %s", guide[0].id, _WITHOUT_SESSION)
            self.abandon(_WITHOUT_SESSION)
        # Fixes that were captured but not decoded yet must not count if the station was on no prism.
        self._sessions.was_away(self._times_away)
        if self.record.is_open:
            self.start_advisor()

    def _times_away(self, session_id: str) -> Sequence[tuple[Stamp, Stamp | None]]:
        guide, opened = self.record.opened(), self._sessions.open_session()
        if guide is not None and not guide[1].run.session and opened is not None and opened["id"] == session_id:
            return [(guide[0].started, None)]  # the last run opened it, and ended before it could store so
        return [*times_away(self._store, session_id)]

    def _is_without_session(self, job: Job) -> bool:
        """Return True if the session of the current run ended before the last step, in which the daemon closes it."""
        if not job.run.session or job.step is None or job.step.kind == "close":
            return False
        opened = self._sessions.open_session()
        return opened is None or opened["id"] != job.run.session

    @property
    def is_waiting(self) -> bool:
        """Return True during the pause before a retry."""
        return time.monotonic() < self._try_again

    def wait(self) -> None:
        """Pause automatic work before the next retry."""
        self._try_again = time.monotonic() + RETRY_S

    # ---- events ------------------------------------------------------------------------------------------------------

    def happen(self, kind: str, details: Mapping[str, Any], *, only_at: GuideStep | None = None) -> bool:
        """Store an event and carry out its consequences after the commit.

        Args:
            kind: kind of the event, as in `job`.
            details: details of the event, as in `job`.
            only_at: step at which the event must happen; None for any.

        Returns:
            False if the guide is at a step other than `only_at`; the event is then not stored.
        """
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

    def aimed(self, *, only_at: GuideStep | None = None) -> None:
        """Count fixes from now on: the station is on the prism. Does nothing at a step other than `only_at`."""
        with self.at_once():
            if only_at not in (None, self.record.step):
                return
            self._store.once_committed(self.watch.forget_fixes)
            self._sessions.look_back(self.record.row.operator if self.record.row else "")
            self.happen("aimed", {})

    def _followed(self, before: Job, job: Job) -> None:
        """Carry out the consequences of an event."""
        if job.state != "open":
            self.advisor.close()
            return
        on_prism, was_on_prism = is_on_prism(job), is_on_prism(before)
        if was_on_prism and not on_prism:
            self._sessions.look_away()
        if (job.at, job.run.label) != (before.at, before.run.label):  # a standstill counts for one pose
            self.standstill = None
        if on_prism and (job.run.done != before.run.done or job.run.poses != before.run.poses or not was_on_prism):
            self._assess()

    # ---- control points ----------------------------------------------------------------------------------------------

    def point_mm(self, name: str) -> tuple[float, float, float] | None:
        """Return the place of a control point of the set-up in mm; None if it is unknown."""
        if self.record.row is None:
            return None
        known = control_points(self._store, self.record.row.setup_id)
        return next(((p["x_mm"], p["y_mm"], p["z_mm"]) for p in known if p["name"] == name), None)

    @staticmethod
    def point(job: Job) -> str:
        """Return the control point to shoot now, or next if there are enough poses; "" at other steps."""
        step, following = job.step, job.run.following
        if step is None or step.kind != "poses":
            return "" if step is None else step.point
        return following.point if job.is_enough and following is not None else ""

    # ---- remaining gain ----------------------------------------------------------------------------------------------

    def start_advisor(self) -> None:
        """Start or restart the gain meter's process."""
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
        """Store that the stop rule found enough poses, if poses of that session are still being measured."""
        with self.record.turn:
            job = self.record.job
            if job is None or job.run.session != session or job.step is None:
                return
            if job.step.kind == "poses" and not job.is_enough and job.run.done >= job.run.least:
                self.happen("enough", {"reason": reason})

    def choose(self, count: int, *, as_more: bool = False) -> None:
        """Request poses of the run, unless its first poses are already requested.

        Args:
            count: number of poses.
            as_more: True for poses in addition to those chosen before.
        """
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
