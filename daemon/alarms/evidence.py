"""The evidence that the rules check, at one instant. A part that is not known raises no alarm."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from daemon.acquisition.status.snapshot import AcquisitionStatus, EventStatus, LinkStatus
from daemon.models.live_model import LiveModelHealth
from daemon.sessions.prisms.guard import Suspicion
from daemon.store.health import StoreHealth
from daemon.store.queries.jobs import FailedJob
from daemon.store.queries.sessions import OpenSessionRow
from daemon.store.queries.setups import SetupRow
from daemon.store.upkeep.housekeeping import KeepingState
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import EventKind

LATE_S = 2.0  # readings that wait longer than this to be stored and decoded are not fresh


@dataclass(frozen=True)
class Evidence:
    """A snapshot of everything that the rules may check.

    Attributes:
        now: time of the snapshot.
        running_s: time since the daemon began to collect evidence.
        acquisition: links, channels, stations, gaps and the last events.
        has_simulation_ended: the process of a simulated rig has ended.
        session: the open session; None without one.
        suspicions: stations that may follow a prism other than the session's.
        newest_excluded: why the open session's newest fix is not used, a clause; None if it is used.
        prisms_fault: why stations' prisms cannot be checked against the joints; None where they can.
        setup: the set-up that the station stands in.
        failed_jobs: failed jobs that need attention.
        model: the live model.
        store: state of the store's file and disk; None while not known.
        keeping: free space of the store, and its backups.
        is_store_new: the store has never held a job, but models of an earlier store lie beside it.
        previous_run: when the daemon's previous run was last alive, by a comparable clock.
        control_faults: control socket to which no one can connect -> why.
        metrics_fault: why the metrics cannot be read; None where they can, or are not configured.
        notice_faults: target to which notices cannot be delivered at present -> why.
        untrained_sessions: closed session that no training uses -> why; without sessions that newer ones replace.
        zeros_lost: joints whose encoder has jumped since the newest session was started or accepted, and whose
            zero has not been checked.
        ended_threads: thread of the daemon that an error has ended -> the error.
        meter_fault: why the open guide gets no answer from its gain meter, a clause; None if it does.
        clock_lost: when the computer's clock was last synchronised, if it no longer is.
        unwatched: rule or part of the evidence that has itself failed -> why.
    """

    now: Stamp
    running_s: float = 0.0
    acquisition: AcquisitionStatus = field(default_factory=AcquisitionStatus)
    has_simulation_ended: bool = False
    session: OpenSessionRow | None = None
    suspicions: Sequence[Suspicion] = ()
    newest_excluded: str | None = None
    prisms_fault: str | None = None
    setup: SetupRow | None = None
    failed_jobs: Sequence[FailedJob] = ()
    model: LiveModelHealth | None = None
    store: StoreHealth | None = None
    keeping: KeepingState = field(default_factory=KeepingState)
    is_store_new: bool = False
    previous_run: Stamp | None = None
    control_faults: Mapping[str, str] = field(default_factory=dict)
    metrics_fault: str | None = None
    notice_faults: Mapping[str, str] = field(default_factory=dict)
    untrained_sessions: Mapping[str, str] = field(default_factory=dict)
    zeros_lost: Sequence[str] = ()
    ended_threads: Mapping[str, str] = field(default_factory=dict)
    meter_fault: str | None = None
    clock_lost: Stamp | None = None
    unwatched: Mapping[str, str] = field(default_factory=dict)

    @property
    def session_age_s(self) -> float:
        """Age of the open session; 0 without one."""
        return 0.0 if self.session is None else self.now.since(self.session.started) / NS_PER_S

    @property
    def is_decoding(self) -> bool:
        """True if captures are stored and decoded as they come; if they wait, no reading is fresh."""
        acquisition = self.acquisition
        is_late = acquisition.undecoded_s is None or acquisition.undecoded_s > LATE_S
        return acquisition.error is None and not acquisition.is_write_hung and not is_late

    @property
    def decoded(self) -> Stamp:
        """The instant up to which captures have been decoded; it stands still while nothing can be stored."""
        age_s = self.acquisition.decoded_age_s
        return self.now.shifted(-round((self.running_s if age_s is None else age_s) * NS_PER_S))

    def active_events(self, kind: EventKind, *ended_by: EventKind) -> list[EventStatus]:
        """Return the last events of a kind that are still active: not of code 0, and not ended by a later event.

        Args:
            kind: kind of the events.
            ended_by: kinds of later events of the same device that end the state.
        """
        last = {(event.device, event.kind): event.number for event in self.acquisition.last_events}
        return [
            event
            for event in self.acquisition.last_events
            if event.kind == kind
            and event.code != 0
            and all(last.get((event.device, end.value), -1) < event.number for end in ended_by)
        ]

    def recent_events(self, kind: EventKind, within_s: float) -> list[EventStatus]:
        """Return the last event of a kind of each device, if its age is at most `within_s`."""
        return [event for event in self.acquisition.last_events if event.kind == kind and event.age_s <= within_s]

    def link_of(self, device: str) -> LinkStatus | None:
        """The link of a channel or station, or the link of that name; None if there is none."""
        name = next((channel.link for channel in self.acquisition.channels if channel.name == device), device)
        return next((link for link in self.acquisition.links if link.name == name), None)

    def is_cut_off(self, device: str) -> bool:
        """True if the device's link is closed, which explains any other fault of the device."""
        link = self.link_of(device)
        return link is not None and link.up is False


# Part of the evidence -> its name in the alarm `not_watched`.
_PARTS = {
    "acquisition": "acquisition",
    "has_simulation_ended": "the simulated rig",
    "session": "the open session",
    "suspicions": "the prisms",
    "newest_excluded": "the newest fix",
    "prisms_fault": "the check of prisms against the joints",
    "setup": "the set-ups",
    "failed_jobs": "the jobs",
    "model": "the live model",
    "store": "the store's files",
    "keeping": "the store's free space and backups",
    "is_store_new": "the models",
    "untrained_sessions": "the sessions",
    "zeros_lost": "the joints' zeros",
    "control_faults": "the control sockets",
    "metrics_fault": "the metrics",
    "notice_faults": "the notices",
    "ended_threads": "the daemon's threads",
    "meter_fault": "the gain meter",
    "clock_lost": "the computer's clock",
}


class Gatherer:
    """Takes snapshots of all evidence. A part that fails keeps its last known value.

    Args:
        clock: clock for the snapshots.
        previous_run: as in `Evidence`.
        parts: field of `Evidence` -> function that returns it.
    """

    def __init__(self, clock: Clock, previous_run: Stamp | None, parts: Mapping[str, Callable[[], object]]) -> None:
        self._clock, self._parts = clock, parts
        self._began = clock.now()
        self._known = Evidence(self._began, previous_run=previous_run)

    def __call__(self) -> Evidence:
        """Return the present evidence."""
        known: dict[str, Any] = {}
        failed: dict[str, str] = {}
        now = self._clock.now()
        for name, look in self._parts.items():
            try:
                known[name] = look()
            except Exception as error:  # noqa: BLE001 - a part that fails must not stop the others
                failed[_PARTS[name]] = f"{type(error).__name__}: {error}"
        running_s = now.since(self._began) / NS_PER_S
        self._known = replace(self._known, now=now, running_s=running_s, unwatched=failed, **known)
        return self._known
