"""Keeps the one open guide: takes the operator's commands, sees what is done, opens, shoots in and closes sessions.

What the job is and what comes next is `job`; this module makes its events. One thread looks ten times a second at boom,
fixes and observations, and carries out what takes time (a shot). Every event is stored before it counts. Methods named
`*_command` are called by the control socket's threads, `on_records` by the writer's.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import ObservationJoiner
from daemon.commands import (
    CHECK,
    REFUSED,
    Caller,
    CommandError,
    Handler,
    acting_for,
    current_caller,
    mapping_argument,
    text_argument,
)
from daemon.guide.advisor import Advisor, accuracy_view
from daemon.guide.job import Job, Pose
from daemon.guide.meter_link import Place
from daemon.guide.position import PositionWatch, is_there
from daemon.guide.record import GuideRecord, is_on_prism
from daemon.guide.request import misfit, request_of, whole_argument
from daemon.guide.view import Around, headline, state_of
from daemon.sessions.manager import SessionKeeper
from daemon.sessions.open_session import CONTROL_POINT_RADIUS_MM
from daemon.sessions.station_setups import SetupBook
from daemon.store.queries.guides import Standstill
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import control_points
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock
from drivers.readings import Record

log = logging.getLogger(__name__)

TICK_S = 0.1
RETRY_S = 5.0  # after something failed that is tried again by itself
NEEDED_FIXES = 5  # at a pose
MORE_POSES = 5
_CANCEL_S = 5.0
_STANDS_S = 20.0  # of a simulated boom at a pose that it was sent to
_SENT_AGAIN_S = 120.0
_MOVED = "the station has moved, its control points no longer fit: the next guide needs a new set-up"


class GuideKeeper:
    """Keeps the one open guide of a rig.

    Args:
        rig: the machine.
        store: where everything is kept.
        sessions: opens, shoots in and closes sessions.
        setups: the station set-ups.
        joiner: what is known of the joints.
        clock: time.
        meter_place: tells where the gain meter finds everything.
        model: the candidate that awaits, for a guide that is finished.
        settle_s: how long the boom must stand at a pose.
        has_aim: something turns the station without an operator.
        drive: has the boom go to the rows of a pose plan, where something can without an operator; None where nothing
            can.
    """

    def __init__(
        self,
        rig: Rig,
        store: Store,
        sessions: SessionKeeper,
        setups: SetupBook,
        joiner: ObservationJoiner,
        clock: Clock,
        *,
        meter_place: Callable[[], Place],
        model: Callable[[], Mapping[str, Any]],
        settle_s: float,
        has_aim: bool,
        drive: Callable[[Sequence[Mapping[str, Any]]], int] | None = None,
    ) -> None:
        self._drive, self._driven = drive, ("", 0)  # step whose pose the boom was sent to, and when
        self._rig, self._store, self._sessions, self._setups, self._clock = rig, store, sessions, setups, clock
        self._model, self._settle_s, self._has_aim = model, settle_s, has_aim
        self._record, self._session_table = GuideRecord(store, rig.name, clock), SessionTable(store, rig.name)
        self._watch = PositionWatch(rig, joiner, clock)
        self._wanted = ""  # step whose button was pressed, to be carried out by the thread
        self._busy = ""  # step that is carried out
        self._cancelled = threading.Event()
        self._standstill: Standstill | None = None
        self._advisor = Advisor(meter_place, self._training, clock, self._take_enough)
        self._is_choosing = False
        self._try_again = 0.0  # real monotonic seconds
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="guide", daemon=True)
        store.unless_damaged(self._restore, None)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """Look no more; an open guide goes on with the next start of the daemon."""
        self._stopping.set()
        self._cancelled.set()
        if self._thread.is_alive():
            self._thread.join(timeout=_CANCEL_S)
        self._advisor.close()

    def on_records(self, records: Sequence[Record]) -> None:
        """Note where boom and station are; costs nothing while no guide is open."""
        if self._record.is_open:
            self._watch.on_records(records)

    def open_step(self) -> str | None:
        """Return the step of the open guide in a few words; None without one."""
        opened = self._record.opened()
        return None if opened is None else headline(opened[1])

    def guarding(self, name: str, handler: Handler) -> Handler:
        """Return a command that is refused while a guide is open, which holds its sessions itself."""

        def guarded(arguments: Mapping[str, Any]) -> Any:
            with self._record.turn:
                opened = self._record.opened()
                if opened is not None:
                    row, job = opened
                    raise CommandError(
                        f"{name} is not carried out: guide {row.id} is open and opens, shoots in and closes its "
                        f"sessions itself; next: {headline(job)} (`rigcal session guide` leads, and "
                        "`rigcal session guide --stop REASON` abandons it)",
                        REFUSED,
                    )
            return handler(arguments)

        return guarded

    # ---- commands ----------------------------------------------------------------------------------------------------

    def start_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Open a guide."""
        with self._record.turn:
            guide = self._record.opened()
            if guide is not None:
                raise CommandError(
                    f"guide {guide[0].id} is open: {headline(guide[1])}; `rigcal session guide` goes on with it, and "
                    "`rigcal session guide --stop REASON` abandons it",
                    REFUSED,
                )
            opened = self._sessions.open_session()
            if opened is not None:
                raise CommandError(f"session {opened['id']!r} is open; stop or abort it first", REFUSED)
            described = mapping_argument(arguments, "new_setup")
            operator = text_argument(arguments, "operator")
            if described and arguments.get("setup") is not None:
                raise CommandError("give a set-up that exists or describe a new one, not both")
            if described:
                request = request_of(arguments, self._rig, list(mapping_argument(described, "control_points")))
                setup_id = str(self._setups.new_command(described)["id"])
            else:
                setup_id = self._setups.usable(arguments.get("setup"))
                request = request_of(arguments, self._rig, self._setups.control_point_names(setup_id))
            self._record.open(request, setup_id, operator)
            self._standstill, self._wanted, self._try_again = None, "", 0.0
            self._watch.forget_fixes()
            self._advisor.forget()
            self._start_advisor()
            return self._state()

    def state_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The newest guide, open or not."""
        return self._state()

    def done_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Take the operator's word that the step is carried out."""
        with self._record.turn:
            job, step_id = self._record.needs_step(arguments)
            step, run = job.step, job.run
            assert step is not None
            if self._busy == step_id or not run.session:
                raise CommandError(f"the daemon is at work on it: {headline(job)}", REFUSED)
            if step.kind == "shoot_control_point":
                self._wanted = step_id  # measured by the guide's own thread: the state shows how it goes
            elif step.kind == "change_prism":
                self._aimed()
            elif step.kind == "poses" and job.is_enough:
                self._happen("left", {})
            elif step.kind == "poses" and run.next_pose is not None:
                self._measured_here()
            else:
                raise CommandError(f"this step ends by itself: {headline(job)}", REFUSED)
            self._record.tapped()
            return self._state()

    def skip_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Leave out the step, or all poses of the prism that are left, for a reason that is kept."""
        reason, rest = _reason(arguments), arguments.get("rest", False)
        if not isinstance(rest, bool):
            raise CommandError(f"rest must be true or false, not {rest!r:.80}")
        self._record.needs_step(arguments)
        self._give_up_work()
        with self._record.turn:
            job, _ = self._record.needs_step(arguments)
            step = job.step
            assert step is not None
            if step.kind == "close" or (rest and step.kind != "poses"):
                raise CommandError(f"this step cannot be skipped: {headline(job)}", REFUSED)
            self._record.tapped()
            if step.kind == "change_prism" and self._sessions.open_session() is not None:
                self._sessions.abort_command({})
            self._happen("skipped", {"reason": reason, "rest": rest})
            return self._state()

    def more_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Measure more poses of this prism although it is enough."""
        count = whole_argument(arguments, "poses", MORE_POSES, 1, 100)
        with self._record.turn:
            job, _ = self._record.needs_step(arguments)
            step, run = job.step, job.run
            if step is None or step.kind != "poses" or not job.is_enough:
                raise CommandError(f"more poses are for when there are enough; now: {headline(job)}", REFUSED)
            if self._is_choosing:
                raise CommandError("more poses are being chosen already", REFUSED)
            self._record.tapped()
            left = len(run.upcoming(count))
            if left < count:
                self._choose(count - left, as_more=True)
            else:
                self._happen("more", {"poses": []})
            return self._state()

    def stop_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Abandon the guide; its open session is closed if it has poses, else aborted."""
        reason = _reason(arguments)
        self._record.needs_step({})
        self._give_up_work()
        with self._record.turn:
            self._record.needs_step({})
            self._record.tapped()
            self._abandon(reason)
            return self._state()

    def _abandon(self, reason: str) -> None:
        """Close the open session if it has poses, else abort it, and end the guide."""
        opened = self._sessions.open_session()
        if opened is not None and opened["poses"]:
            self._sessions.stop_command({})
        elif opened is not None:
            self._sessions.abort_command({})
        self._happen("stopped", {"reason": reason})

    def _measured_here(self) -> None:
        """Take the standstill at which the boom is for the pose, wherever that is."""
        found, boom = self._standstill, self._watch.boom()
        here = (
            found is not None
            and boom.stands_s is not None
            and is_there(self._rig, boom.values, _pose(self._rig, found))
        )
        if found is None or not here or found.fixes < NEEDED_FIXES:
            raise CommandError(
                f"{found.fixes if found is not None and here else 0} of {NEEDED_FIXES} fixes count at this standstill; "
                "let the boom stand, with the station on the prism",
                REFUSED,
            )
        self._happen("measured", {"pose": found.pose, "last": found.last})

    # ---- events ------------------------------------------------------------------------------------------------------

    def _happen(self, kind: str, details: Mapping[str, Any], *, only_at: str = "") -> bool:
        """Store an event and go on; False where another step than `only_at` is on by now."""
        with self._record.turn:
            changed = self._record.happen(kind, details, only_at)
            if changed is not None:
                self._followed(*changed)
            return changed is not None

    def _followed(self, before: Job, job: Job) -> None:
        """Do what follows from an event by itself."""
        if job.state != "open":
            self._advisor.close()
            return
        on_prism, was_on_prism = is_on_prism(job), is_on_prism(before)
        if was_on_prism and not on_prism:
            self._sessions.look_away()
        if job.at != before.at:
            self._standstill = None
        if on_prism and (job.run.done != before.run.done or job.run.poses != before.run.poses or not was_on_prism):
            self._assess()

    def _aimed(self) -> None:
        with self._record.turn:
            self._watch.forget_fixes()
            self._sessions.look_back(self._record.row.operator if self._record.row else "")
            self._happen("aimed", {})

    # ---- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        told = ""
        while not self._stopping.wait(TICK_S):
            try:
                if self._record.is_open and time.monotonic() >= self._try_again:
                    self._look()
                told = ""
            except Exception as error:
                self._try_again = time.monotonic() + RETRY_S
                if str(error) != told:
                    log.exception("the guide has failed; it goes on")
                told = str(error)

    def _look(self) -> None:
        with self._record.turn:
            job = self._record.job
            if job is None or job.step is None:
                return
            if not self._advisor.is_alive:
                self._start_advisor()
            run, step, step_id = job.run, job.step, job.step_id
            if unfit := misfit(job, self._rig):
                self._abandon(unfit)
                return
            if run.session and run.poses is None and not self._is_choosing:
                self._choose(run.most)
            point_mm = self._point_mm(step.point or self._next_point(job))
            is_at_point = not self._has_aim and self._watch.is_at(point_mm)
        with acting_for(None, self._cancelled.is_set):
            if not run.session:
                self._try(self._open_session)
            elif step.kind == "close":
                self._try(self._close_session)
            elif step.kind == "shoot_control_point":
                if self._has_aim or is_at_point or self._wanted == step_id:
                    self._try(partial(self._shoot, step.point, step_id), step_id)
            elif step.kind == "change_prism":
                if self._has_aim:
                    self._aimed()
            elif job.is_enough and (self._has_aim or is_at_point or run.kind == CHECK):
                self._happen("left", {}, only_at=step_id)
            elif not job.is_enough:
                self._send_boom(job)
                self._look_at_pose(job)

    def _send_boom(self, job: Job) -> None:
        """Have the boom go to the next pose where no operator is at its levers, and again if it was not measured."""
        run, number, now_ns = job.run, job.run.next_pose, self._clock.now().monotonic_ns
        step_id, sent_ns = self._driven
        if self._drive is None or number is None or run.poses is None:
            return
        if step_id == job.step_id and now_ns - sent_ns < _SENT_AGAIN_S * NS_PER_S:
            return
        self._driven = job.step_id, now_ns
        joints = run.poses[number].joints
        self._drive([{"dwell_s": _STANDS_S} | {joint.column: joints[joint.name] for joint in self._rig.joints}])

    def _look_at_pose(self, job: Job) -> None:
        """See whether the pose is reached and measured."""
        run, number = job.run, job.run.next_pose
        found = self._record.table.standstill(run.session, run.last)
        self._standstill = found = None if found is None or found.pose == run.label else found
        if number is None or run.poses is None or found is None or found.fixes < NEEDED_FIXES:
            return
        if is_there(self._rig, _pose(self._rig, found), run.poses[number].joints):
            self._happen("measured", {"pose": found.pose, "last": found.last}, only_at=job.step_id)

    def _try(self, work: Callable[[], None], step_id: str = "") -> None:
        """Do something that an operator may have to put right; it is tried again after a while, a shot when asked."""
        self._busy = step_id or "session"
        try:
            work()
        except CommandError as error:
            if not self._cancelled.is_set():
                job = self._record.job
                if job is not None and job.trouble != str(error):  # it is tried again and again
                    self._happen("failed", {"text": str(error)})
                self._try_again = time.monotonic() + RETRY_S
        finally:
            if step_id:
                self._wanted = ""
            self._busy = ""

    def _open_session(self) -> None:
        job, row = self._record.job, self._record.row
        if job is None or row is None:
            return
        if self._setups.has_moved(row.setup_id):  # no session can be held there any more
            self._abandon(_MOVED)
            return
        last, opened = self._record.table.newest_observation(), self._sessions.open_session()
        if opened is None or opened["prism"] != job.run.prism:  # else it was opened just before the daemon ended
            arguments = {
                "prism": job.run.prism,
                "kind": job.run.kind,
                "setup": row.setup_id,
                "operator": row.operator,
                "note": f"guide {row.id}",
            }
            opened = self._sessions.start_command(arguments, is_aimed=False)
        self._happen("opened", {"session": opened["id"], "last": last})

    def _close_session(self) -> None:
        job = self._record.job
        if job is None:
            return
        opened = self._sessions.open_session()
        if opened is not None and opened["id"] == job.run.session:
            self._sessions.stop_command({})
        self._happen("closed", {"session": job.run.session})

    def _shoot(self, point: str, step_id: str) -> None:
        shot = self._sessions.shoot_command({"point": point}, most_off_mm=CONTROL_POINT_RADIUS_MM)
        self._happen("shot", {"point": point, "misclosure_mm": shot["misclosure_mm"]}, only_at=step_id)
        if shot["moved"] and shot["phase"] == "start":  # nothing that is measured from here on could be used
            self._abandon(_MOVED)

    def _give_up_work(self) -> None:
        """End a shot that is being measured."""
        if not self._busy:
            return
        self._cancelled.set()
        deadline = time.monotonic() + _CANCEL_S
        while self._busy and time.monotonic() < deadline:
            time.sleep(TICK_S / 2)
        self._cancelled.clear()

    def _point_mm(self, name: str) -> tuple[float, float, float] | None:
        """Where a control point of the set-up is; None where that is not known."""
        if self._record.row is None:
            return None
        known = control_points(self._store, self._record.row.setup_id)
        return next(((p["x_mm"], p["y_mm"], p["z_mm"]) for p in known if p["name"] == name), None)

    def _next_point(self, job: Job) -> str:
        """The control point that comes after the poses; "" where it is another step's turn."""
        if job.step is None or job.step.kind != "poses" or not job.is_enough:
            return ""
        return "" if job.run.following is None else job.run.following.point

    # ---- what is still to gain ---------------------------------------------------------------------------------------

    def _start_advisor(self) -> None:
        self._advisor.start()
        self._is_choosing = False
        if not self._advisor.is_alive:
            self._try_again = time.monotonic() + RETRY_S
        self._assess()

    def _training(self) -> list[str]:
        """Sessions that the next model will be trained on, without the open one."""
        return [session["id"] for session in self._session_table.used() if session["kind"] != CHECK]

    def _assess(self) -> None:
        if self._record.job is not None and self._record.row is not None:
            self._advisor.assess(self._record.job, self._record.row.setup_id)

    def _take_enough(self, session: str, reason: str) -> None:
        """The stop rule says stop: it counts while poses of that session are measured."""
        with self._record.turn:
            job = self._record.job
            if job is None or job.run.session != session or job.step is None:
                return
            if job.step.kind == "poses" and not job.is_enough and job.run.done >= job.run.least:
                self._happen("enough", {"reason": reason})

    def _choose(self, count: int, *, as_more: bool = False) -> None:
        """Ask for poses of the run."""
        job, row = self._record.job, self._record.row
        if job is None or row is None:
            return
        seed = 1000 * row.id + 100 * job.at + len(job.run.poses or ())
        caller = current_caller() if as_more else None
        take = partial(self._take_poses, caller, as_more=as_more)
        self._is_choosing = self._advisor.choose(job, row.setup_id, count, seed, take)

    def _take_poses(
        self, caller: Caller | None, session: str, poses: list[Pose], trouble: str, *, as_more: bool
    ) -> None:
        with self._record.turn, acting_for(caller):
            self._is_choosing = False
            self._advisor.trouble = trouble
            job = self._record.job
            if job is None or job.state != "open" or job.run.session != session:
                return
            if trouble:
                self._try_again = time.monotonic() + RETRY_S
            elif as_more and job.step is not None and job.step.kind == "poses":
                self._happen("more", {"poses": poses})
            elif not as_more and job.run.poses is None:
                self._happen("planned", {"poses": poses})

    # ---- state -------------------------------------------------------------------------------------------------------

    def _state(self) -> dict[str, Any]:
        with self._record.turn:
            row, job = self._record.row, self._record.job
            if row is None or job is None:
                return {"guide": None}
            step = job.step
            point = "" if step is None else step.point or self._next_point(job)
            around = Around(
                boom=self._watch.boom(),
                standstill=self._standstill,
                accuracy=accuracy_view(job, self._advisor.accuracy),
                coverage=self._advisor.coverage,
                taps=self._record.taps,
                is_busy=self._is_busy(job),
                is_detected=self._has_aim or (bool(point) and self._point_mm(point) is not None),
                has_aim=self._has_aim,
                settle_s=self._settle_s,
                needed_fixes=NEEDED_FIXES,
                warnings=self._warnings(job),
                model=self._model() if job.state == "finished" else None,
            )
            return {"guide": state_of(self._rig, row, job, around)}

    def _is_busy(self, job: Job) -> bool:
        if job.state != "open":
            return False
        return job.step_id in (self._busy, self._wanted) or not job.run.session

    def _warnings(self, job: Job) -> list[str]:
        found = [job.trouble] if job.trouble else []
        if job.state == "open":
            found += [f"{s.reason}; {s.remedy}" for s in self._sessions.prism_suspicions()]
        if self._advisor.trouble and job.state == "open":
            found.append(self._advisor.trouble)
        return found

    def _restore(self) -> None:
        """Go on with the guide that an earlier run left."""
        self._record.restore()
        # Fixes that were captured and are not decoded yet must not count where the station was on no prism.
        for since, until in self._record.times_away():
            self._sessions.look_away(since, until)
        guide = self._record.opened()
        if guide is not None and not guide[1].run.session:  # one that the last run had just opened, if any
            self._sessions.look_away(guide[0].started)
        if self._record.is_open:
            self._start_advisor()


def _reason(arguments: Mapping[str, Any]) -> str:
    reason = text_argument(arguments, "reason").strip()
    if not reason:
        raise CommandError("say why: a reason is kept with what is left out")
    return reason


def _pose(rig: Rig, standstill: Standstill) -> dict[str, float]:
    return {joint.name: float(standstill.values[joint.column]) for joint in rig.joints}
