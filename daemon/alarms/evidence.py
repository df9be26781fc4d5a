"""Everything that rules may look at, at one instant. What nobody has told is "nothing known", and raises nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from daemon.acquisition_status import AcquisitionStatus, EventStatus, LinkStatus
from daemon.prism_guard import Suspicion
from drivers.clock import Stamp
from drivers.readings import EventKind


@dataclass(frozen=True)
class SessionEvidence:
    """The open calibration session.

    Attributes:
        id: of the session.
        age_s: since it was opened.
        jumped: joints whose encoder has jumped in it.
        suspicions: stations that may be on another prism than its own.
    """

    id: str
    age_s: float
    jumped: tuple[str, ...] = ()
    suspicions: tuple[Suspicion, ...] = ()


@dataclass(frozen=True)
class SetupEvidence:
    """The newest station set-up.

    Attributes:
        id: of the set-up.
        is_moved: its control points no longer fit.
    """

    id: str
    is_moved: bool


@dataclass(frozen=True)
class FailedJob:
    """The newest failed job of its kind, with no later one done.

    Attributes:
        id, kind: of the job.
        error: why it failed.
    """

    id: int
    kind: str
    error: str


@dataclass(frozen=True)
class ModelEvidence:
    """The live model.

    Attributes:
        id: its number.
        jumped: joints whose encoder has jumped since it was trained, their zeros not being checked.
        defect: why it cannot be used; "" if it can.
        drifted_with: the check session with which it was found to have drifted; None before.
    """

    id: int
    jumped: tuple[str, ...] = ()
    defect: str = ""
    drifted_with: str | None = None


@dataclass(frozen=True)
class StoreEvidence:
    """The store and its disk.

    Attributes:
        fault: what is wrong with its files (damaged, replaced, missing), and what to do; "" if nothing is known to be.
        free_bytes: on its disk; None while not known.
        is_low: little of the disk is free, as `daemon.store.health` has it.
        is_new_beside_models: it has never seen a job, and yet models lie beside it.
    """

    fault: str = ""
    free_bytes: int | None = None
    is_low: bool = False
    is_new_beside_models: bool = False


@dataclass(frozen=True)
class Evidence:
    """A snapshot of everything that rules may look at.

    Attributes:
        now: when it was taken.
        running_s: since the daemon began to watch.
        acquisition: links, channels, stations, gaps and the last events.
        session: the open one.
        setup: the newest one.
        failed_jobs: those that somebody should look at.
        model: the live one.
        store: its file and its disk.
        previous_run: when the daemon's run before this one was last alive, by a clock that can be compared.
        control_faults: control socket on which no one can connect -> why.
        untrained_sessions: closed sessions that nothing trains on -> why; those that newer ones make up for are not
            there.
        unwatched: rule or part of the evidence that has failed itself -> why.
    """

    now: Stamp
    running_s: float = 0.0
    acquisition: AcquisitionStatus = field(default_factory=AcquisitionStatus)
    session: SessionEvidence | None = None
    setup: SetupEvidence | None = None
    failed_jobs: tuple[FailedJob, ...] = ()
    model: ModelEvidence | None = None
    store: StoreEvidence = StoreEvidence()
    previous_run: Stamp | None = None
    control_faults: Mapping[str, str] = field(default_factory=dict)
    untrained_sessions: Mapping[str, str] = field(default_factory=dict)
    unwatched: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_storing(self) -> bool:
        """Whether captures are stored, and so decoded: until they are, every device looks silent and may not be."""
        return self.acquisition.error is None

    def standing(self, kind: EventKind, *ended_by: EventKind) -> list[EventStatus]:
        """Events of a kind that their device has not taken back: by a later one of `ended_by`, or by code 0."""
        last = {(event.device, event.kind): event.number for event in self.acquisition.last_events}
        return [
            event
            for event in self.acquisition.last_events
            if event.kind == kind
            and event.code != 0
            and all(last.get((event.device, end.value), -1) < event.number for end in ended_by)
        ]

    def lately(self, kind: EventKind, within_s: float) -> list[EventStatus]:
        """The last event of a kind of each device, where it is not older than that."""
        return [event for event in self.acquisition.last_events if event.kind == kind and event.age_s <= within_s]

    def link_of(self, device: str) -> LinkStatus | None:
        """The link that a channel is read from, a station's own, or the link of that name; None if there is none."""
        name = next((channel.link for channel in self.acquisition.channels if channel.name == device), device)
        return next((link for link in self.acquisition.links if link.name == name), None)

    def is_cut_off(self, device: str) -> bool:
        """Whether the device's link is closed, which explains whatever else is wrong with it."""
        link = self.link_of(device)
        return link is not None and link.up is False
