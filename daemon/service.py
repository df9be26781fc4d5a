"""The daemon itself: starts its parts in order, keeps the service manager informed, and stops the parts cleanly."""

from __future__ import annotations

import logging
import os
import signal
import sqlite3
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.clock_watch import ClockWatch
from daemon.acquisition.status.present import expected_of
from daemon.acquisition.thinning import Thinning
from daemon.alarms.board import AlarmBoard
from daemon.alarms.evidence import Gatherer
from daemon.composition import Parts, motion_limits
from daemon.config.config import Config
from daemon.control.server import ControlServer
from daemon.control_commands import Commands, control_servers
from daemon.guide.manager import GuideManager
from daemon.guide.meter_link import Place
from daemon.host.ended_threads import EndedThreads
from daemon.host.systemd import Notifier
from daemon.host.time_service import CLOCK_SOCKET, clock_state
from daemon.jobs.job_processes import JOBS_SOCKET
from daemon.jobs.runner import JobRunner
from daemon.models.live_model import LiveModel
from daemon.models.live_tip import FRESH_S, LiveTip
from daemon.models.registry import ModelRegistry
from daemon.models.tip_sender import TipSender
from daemon.monitoring.metrics_server import MetricsServer
from daemon.monitoring.notices import Notices
from daemon.monitoring.time_watch import TimeWatch
from daemon.overview import Overview
from daemon.sessions.manager import SessionManager
from daemon.sessions.station_setups import StationSetups
from daemon.store.errors import storage_errors, storage_sentence
from daemon.store.health import StoreHealth, StoreWatch
from daemon.store.queries.alarms import AlarmTable
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.models import ModelTable
from daemon.store.queries.notices import NoticeTable
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import SetupTable
from daemon.store.store import Store
from daemon.store.upkeep.housekeeping import Housekeeping, Keeping
from daemon.store.upkeep.model_places import follow_moved_models
from drivers.clock import NS_PER_S, TimeBudget
from drivers.readings import Record

log = logging.getLogger(__name__)

BEAT_S = 1.0
STOP_S = 20.0  # real seconds to stop all parts, well within the unit's TimeoutStopSec
STORE_END_S = 3.0  # part of STOP_S that is reserved for the store's last commits


class Daemon:
    """Acquisition, sessions, jobs and the control socket, on one store.

    Args:
        config: the checked configuration.
        store: open for writing; the caller closes it.
        parts: links, decoders, clock and actuators, composed for a real, a simulated or a replayed rig.

    Raises:
        StoreError: the store cannot be written to; the message gives the reason and the remedy.
        CommandError: the control socket cannot be created.
    """

    def __init__(self, config: Config, store: Store, parts: Parts) -> None:
        self._config, self._store, self._parts = config, store, parts
        with storage_errors(store.path):
            store.begin_run(parts.clock.now())
            try:
                self._compose(config, store, parts)
            except BaseException:
                # After an unclean shutdown the store still has to be checked for damage, so the run stays open.
                if store.ended_in_order:
                    self._end_run()  # a clean end, as nothing was captured
                raise

    def _compose(self, config: Config, store: Store, parts: Parts) -> None:
        self._ended_threads = EndedThreads()
        declare_channels(store, parts.rig)
        store.try_events(parts.clock.now(), parts.rig.joint_names)
        store.unless_damaged(partial(follow_moved_models, store, config.models_directory), None)
        self._watch = StoreWatch(store, parts.clock)
        self._housekeeping = Housekeeping(store, parts.clock, keeping_of(config))
        # Simulated and replayed rigs have their own clocks.
        read_clock = partial(clock_state, os.environ.get(CLOCK_SOCKET) or None)
        self._time = TimeWatch(read_clock, parts.clock) if parts.mode == "live" else None
        self._setups = StationSetups(parts.rig, store, parts.clock, config.sessions.control_tolerance_mm)
        self._sessions = SessionManager(
            parts.rig,
            parts.rig_text,
            store,
            self._setups,
            parts.joiner,
            config.sessions,
            parts.clock,
            run_id=store.run_id or parts.clock.now().utc_ns // NS_PER_S,  # unique even if the table of runs is damaged
            limits=motion_limits(config),
            aim=parts.aim,
            are_jobs_enabled=config.jobs.enabled,
            clock_state=lambda: None if self._time is None else self._time.state,
            why_no_fix=lambda: self._acquisition.status().why_no_fix(),
        )
        models = ModelTable(store, parts.rig.name, parts.clock)
        self._live_model = LiveModel(models, parts.rig, lambda: store.knows_events)
        prism = config.tip.prism if config.tip is not None else None
        self._tip = LiveTip(
            parts.rig,
            parts.joiner,
            self._live_model,
            self._setups.current,
            parts.clock,
            prism,
            fresh_s=FRESH_S / parts.clock.real_seconds(1.0),  # computers cause the delay, so it is in real time
        )
        self._sender = tip_sender(config, parts, self._tip)
        before = store.previous_end if parts.mode == "live" else None  # only a live rig uses the host's clock
        self._acquisition = Acquisition(
            parts.links,
            parts.decoders,
            store,
            parts.clock,
            on_records=self._on_records,
            also_store=self._sessions.pending.store,
            expected=expected_of(config, parts.rig),
            clock_watch=ClockWatch(before) if parts.mode == "live" else None,
            thinning=None if parts.mode == "replayed" else Thinning(self._sessions.is_of_session),
        )
        self._jobs = JobRunner(
            store,
            config,
            parts.rig.name,
            parts.clock,
            jobs_socket=os.environ.get(JOBS_SOCKET) or None,
            is_held=self._are_jobs_held,
        )
        self._job_table, self._model_table = JobTable(store, parts.rig.name), models
        self._servers: list[ControlServer] = []
        self._unserved: dict[str, str] = {}  # sockets that could not be created -> reason
        alarms = AlarmTable(store)
        notify = config.notify if parts.mode != "replayed" else None  # events of a replayed log are old
        self._notices = Notices(notify, NoticeTable(store), alarms.active(), parts.rig.name, parts.clock)
        evidence = Gatherer(parts.clock, before, self._evidence())
        self._alarms = AlarmBoard(alarms, evidence, parts.clock, tell=self._notices.take)
        self._models = ModelRegistry(
            models,
            parts.rig.name,
            self._live_model,
            compare=self._jobs.compare,
            comparison_job=self._job_table.comparison_of,
            comparison_after=self._job_table.comparison_after,
            zeros_checked=self._sessions.zeros_checked,
        )
        self._guide = GuideManager(
            parts.rig,
            store,
            self._sessions,
            self._setups,
            parts.joiner,
            parts.clock,
            meter_place=lambda: Place.of(store, parts.rig_text, models.live()),
            model=self._awaiting_model,
            settle_s=config.sessions.settle_s,
            has_aim=parts.aim is not None,
            drive=parts.visit if parts.aim is not None else None,  # with --by-hand, commands move boom and station
        )
        self._overview = Overview(
            parts,
            store,
            lambda: self._watch.health,
            self._acquisition.status,
            lambda: None if self._time is None else self._time.status(),
            self._alarms,
            self._notices,
            self._sessions,
            self._guide,
            self._jobs,
            self._job_table,
            self._models,
            self._model_table,
        )
        commands = Commands(
            parts,
            store,
            lambda: self._watch.health,
            self._housekeeping,
            self._setups,
            self._sessions,
            self._jobs,
            self._models,
            self._tip,
            self._alarms,
            self._notices,
            self._guide,
            self._overview,
        )
        self._servers, self._unserved = control_servers(config, commands.handlers())
        metrics = config.metrics
        self._metrics = None if metrics is None else MetricsServer(metrics.port, lambda: self._overview.command({}))

    def _evidence(self) -> dict[str, Callable[[], object]]:
        """Return part of the alarms' evidence -> function that supplies it."""
        sessions = SessionTable(self._store, self._parts.rig.name)
        return {
            "acquisition": self._acquisition.status,
            "has_simulation_ended": self._parts.has_simulation_ended,
            "session": sessions.open_session,
            "suspicions": self._sessions.prism_suspicions,
            "newest_excluded": self._sessions.not_counting,
            "prisms_fault": self._sessions.prisms_fault,
            "setup": SetupTable(self._store, self._parts.rig.name).current,
            "failed_jobs": self._job_table.failed,
            "model": self._live_model.health,
            "store": lambda: self._watch.health,
            "keeping": lambda: self._housekeeping.state,
            "is_store_new": lambda: is_store_new(self._job_table, self._config.models_directory),
            "untrained_sessions": sessions.untrained,
            "zeros_lost": sessions.zeros_lost,
            "control_faults": self._control_faults,
            "ended_threads": self._ended_threads.found,
            "meter_fault": lambda: self._guide.meter_fault,
            "clock_lost": lambda: None if self._time is None else self._time.lost(),
            "notice_faults": self._notices.faults,
            "metrics_fault": lambda: None if self._metrics is None else self._metrics.trouble(),
        }

    def _control_faults(self) -> dict[str, str]:
        """Return control sockets that nobody can connect to -> reason."""
        found = {server.path.name: server.trouble() for server in self._servers}
        return self._unserved | {name: trouble for name, trouble in found.items() if trouble is not None}

    @property
    def store_health(self) -> StoreHealth:
        """Health of the store; may be read from any thread."""
        return self._watch.health

    def _are_jobs_held(self) -> bool:
        """Return True while the store cannot be trusted or captures are waiting to be decoded."""
        return self._watch.health.state != "ok" or self._acquisition.is_behind

    def run(self, stop: threading.Event, notifier: Notifier) -> None:
        """Acquire until `stop` is set or the replay has ended, then stop all parts cleanly.

        Raises:
            AcquisitionError: nothing is stored any more, so the process should be restarted; or captures could not be
                stored before the end.
        """
        with self._ended_threads:
            self._run(stop, notifier)

    def _run(self, stop: threading.Event, notifier: Notifier) -> None:
        beat_s = min(BEAT_S, (notifier.watchdog_s or BEAT_S) / 2)
        try:
            self._live_model.start()
            self._acquisition.start()
            self._watch.start()
            self._alarms.start()
            self._housekeeping.start()
            self._notices.start()
            if self._time is not None:
                self._time.start()
            if self._sender is not None:
                self._sender.start()
            if self._config.jobs.enabled:
                self._jobs.start()
            self._guide.start()
            notifier.send("READY=1", f"STATUS=acquiring rig {self._parts.rig.name}")
            log.info("acquiring rig %s; control socket %s", self._parts.rig.name, self._config.socket_path)
            while not stop.wait(beat_s):
                self._acquisition.check()
                self._watch.look()
                if self._metrics is not None:
                    self._metrics.look()
                self._alarms.evaluate()
                self._sessions.aim_again()  # after the alarm that asks somebody to aim
                # The watchdog monitors the writer and the control sockets rather than this loop: a hung disk must
                # restart the service, and so must a control socket that does not answer.
                within_s = notifier.watchdog_s or 60.0
                if self._acquisition.alive(within_s) and all(server.alive(within_s) for server in self._servers):
                    notifier.send("WATCHDOG=1")
                if self._parts.is_over():
                    log.info("the replay has ended")
                    break
        finally:
            notifier.send("STOPPING=1")
            self.close()
        self._acquisition.check()

    def close(self) -> None:
        """Stop all parts within `STOP_S`, in parallel, so that no part delays storing what was captured."""
        budget = TimeBudget(STOP_S)
        stops = [server.close for server in self._servers]
        stops += [
            self._guide.stop,
            self._live_model.stop,
            self._jobs.stop,
            self._watch.stop,
            self._alarms.stop,
            self._notices.stop,
            self._housekeeping.stop,
        ]
        stops += [part.stop for part in (self._sender, self._metrics, self._time) if part is not None]
        others = [threading.Thread(target=_stop_part, args=(stop,), daemon=True) for stop in stops]
        for thread in others:
            thread.start()
        is_store_free = self._acquisition.stop(TimeBudget(budget.left_s - STORE_END_S))
        for thread, stop in zip(others, stops, strict=True):
            thread.join(budget.left_s)
            if thread.is_alive():
                log.error("%s did not end within %g s; stopping without it", _name(stop), STOP_S)
        if is_store_free and self._acquisition.has_stored_all and not self._store.damage:
            self._end_run()
        log.info("stopped")

    def _end_run(self) -> None:
        try:
            self._store.end_run(self._parts.clock.now())
        except sqlite3.Error as error:
            log.error("the end of this run could not be stored: %s", storage_sentence(self._store.path, error))

    def _awaiting_model(self) -> dict[str, Any]:
        """Return, for a finished guide, the pending candidate model and the number of jobs that are still to run."""
        waiting = self._models.status()["candidate"]
        about = dict.fromkeys(("id", "is_acceptable", "refused_because", "sentence"))
        if waiting is not None:
            compared = waiting["comparison"]
            about = {key: waiting[key] for key in ("id", "is_acceptable", "refused_because")}
            about["sentence"] = compared and compared["sentence"]
        # The jobs of the last session are queued shortly after its end.
        return about | {"jobs": len(self._job_table.unfinished()) or int(self._jobs.awaited_session() is not None)}

    def _on_records(self, records: Sequence[Record]) -> None:
        try:
            self._sessions.on_records(records)  # feeds the joiner, which the tip reads
        finally:
            if self._tip.on_records(records):  # also where no observation can be made: an encoder may have jumped
                self._sessions.pending.once_stored(self._live_model.jump_stored)
            self._guide.on_records(records)


def _stop_part(stop: Callable[[], None]) -> None:
    try:
        stop()
    except Exception:
        # An error while stopping one part must not keep the others from stopping.
        log.exception("%s failed", _name(stop))


def _name(stop: Callable[[], None]) -> str:
    return getattr(stop, "__qualname__", repr(stop))


def tip_sender(config: Config, parts: Parts, tip: LiveTip) -> TipSender | None:
    """Return the sender of tip frames; None if none is configured or there is no bus, as in a replay."""
    if config.tip is None or config.tip.can is None:
        return None
    link = next((link for link in parts.can_links if link.name == config.tip.can.link), None)
    return None if link is None else TipSender(tip, config.tip, config.tip.can, link)


def is_store_new(jobs: JobTable, models: Path) -> bool:
    """Return True if the store has never had a job although its models directory is not empty."""
    return models.is_dir() and any(models.iterdir()) and jobs.newest_id() == 0


def declare_channels(store: Store, rig: Rig) -> None:
    """Declare in the store which channels are the rig's joints and which are signals."""
    joints = {joint.name: joint.unit for joint in rig.joints}
    store.declare_channels(joints, {c.name: c.unit for c in rig.channels if c.name not in joints})


def keeping_of(config: Config) -> Keeping:
    """Return the configured retention of the store."""
    return Keeping(
        keep_days=config.store.keep_days,
        free_bytes=config.store.free_bytes,
        models=config.models_directory,
        backup_directory=config.store.backup_directory,
        backups=config.store.backups,
    )


def stop_on_signals(stop: threading.Event) -> Callable[[], None]:
    """Set `stop` on SIGTERM and SIGINT; return a function that restores the previous handlers."""
    before = {s: signal.signal(s, lambda *_: stop.set()) for s in (signal.SIGTERM, signal.SIGINT)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    return restore
