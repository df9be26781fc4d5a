"""The active alarms: raised and cleared by the rules, kept in the store and logged.

Active alarms are held in memory first: an alarm is shown even while the store cannot be written, and is written once it
can be. Alarms left by an earlier run stay active, with their original time, if the rules still find their faults.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from daemon.alarms.alarm import Alarm, Rule
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from daemon.host.safe_output import duration
from daemon.host.worker_thread import WokenThread
from daemon.monitoring.notice import Notice, Severity
from daemon.store.errors import StoreError
from daemon.store.queries.alarms import AlarmTable
from drivers.clock import NS_PER_S, Clock, Stamp

log = logging.getLogger(__name__)

GRACE_S = 15.0  # after this time links are open and devices have been received, or there is a fault
CLEARED_SHOWN = 200
STOP_S = 5.0
UNWRITTEN_MAX = 1000  # cleared alarms kept in memory while the store cannot be written

# Causes, the most general first: while they stand, the evidence for other alarms is old.
_FIRST = ("not_storing", "store_hangs", "simulated_rig_ended", "link_down")
_LEVELS: Mapping[Severity, int] = {"warning": logging.WARNING, "critical": logging.ERROR}


@dataclass
class _Active:
    """An alarm from when it is raised until it is cleared and written.

    Attributes:
        alarm: as last returned by its rule.
        raised: when the alarm was raised.
        seen: when its rule last found the fault, by the instant of the evidence.
        hold_s: how long the fault must be absent before the alarm is cleared.
        row: its row in the store; None while it is not written.
        written: the alarm as it was last written to the store.
        cleared: when the alarm was cleared; None while it is active.
    """

    alarm: Alarm
    raised: Stamp
    seen: Stamp
    hold_s: float
    row: int | None = None
    written: Alarm | None = None
    cleared: Stamp | None = None


def _rank(kind: str) -> int:
    return _FIRST.index(kind) if kind in _FIRST else len(_FIRST)


def _nobody(notice: Notice) -> None:
    del notice


def _notice(event: Literal["raised", "cleared"], active: _Active, at: Stamp) -> Notice:
    return Notice(event, **vars(active.alarm), raised=active.raised, at=at)


class AlarmBoard(WokenThread):
    """Keeps the alarms. One thread calls `evaluate` once a second; any thread may call the other methods.

    Args:
        table: the store's alarms.
        gather: returns the present evidence.
        clock: clock for ages.
        rules: rules that raise and clear alarms; the whole library by default.
        tell: called with each alarm that is raised, becomes critical or is cleared; must return at once.
    """

    def __init__(
        self,
        table: AlarmTable,
        gather: Callable[[], Evidence],
        clock: Clock,
        rules: Sequence[Rule] | None = None,
        *,
        tell: Callable[[Notice], None] = _nobody,
    ) -> None:
        super().__init__("alarms", STOP_S)
        self._tell = tell
        self._table, self._gather, self._clock = table, gather, clock
        self._rules = library() if rules is None else rules
        self._turn = threading.Lock()
        self._looked = clock.now()
        self._active = {(row["kind"], row["subject"]): self._carried(row) for row in self._table.active()}
        self._sighted: dict[tuple[str, str], Stamp] = {}  # when each present fault was first found
        self._unwritten: deque[_Active] = deque(maxlen=UNWRITTEN_MAX)  # cleared ones
        self._failed_rules: dict[str, str] = {}
        self._paused_rules: set[str] = set()
        self._told: dict[str, str] = {}  # what failed -> the error that was logged last

    def evaluate(self) -> None:
        """Apply all rules to the present evidence; never raises and never waits for the disk."""
        try:
            evidence = self._gather()
            found = self._found(replace(evidence, unwatched={**evidence.unwatched, **self._failed_rules}))
            with self._turn:
                self._raise(found, evidence)
                self._clear(found, evidence)
                self._looked = evidence.now
            self.wake()
        except Exception as error:  # noqa: BLE001 - logged; alarms must go on
            self._log_once("the alarms could not be evaluated", error)

    def status(self) -> dict[str, Any]:
        """Return the active alarms and the age of the last evaluation.

        Critical alarms come first, among them a store that cannot be written and links that are closed, which may cause
        others, then the oldest.

        Returns:
            `active`: kind, subject, severity, text, remedy, since_utc_ns and age_s of each alarm; `looked_age_s`: real
            seconds since the last evaluation.
        """
        now = self._clock.now()
        with self._turn:
            active, looked = list(self._active.values()), self._looked
        active.sort(key=lambda one: (one.alarm.severity != "critical", _rank(one.alarm.kind), -now.since(one.raised)))
        shown = [
            {
                **asdict(one.alarm),
                "since_utc_ns": one.raised.utc_ns,
                "age_s": max(now.since(one.raised) / NS_PER_S, 0.0),
            }
            for one in active
        ]
        return {"active": shown, "looked_age_s": self._clock.real_seconds(now.since(looked) / NS_PER_S)}

    def list_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the active alarms as `status` does; with `all` also the newest cleared ones, newest first."""
        cleared = self._table.cleared(CLEARED_SHOWN) if arguments.get("all") is True else []
        return {**self.status(), "cleared": cleared}

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _carried(self, row: Mapping[str, Any]) -> _Active:
        """Restore an alarm of an earlier run."""
        alarm = Alarm(row["kind"], row["subject"], row["severity"], row["text"], row["remedy"])
        return _Active(alarm, row["raised"], self._looked, GRACE_S, row["id"], alarm)

    def _found(self, evidence: Evidence) -> dict[tuple[str, str], tuple[Alarm, Rule]]:
        """Apply the rules; note those that fail or are paused."""
        found: dict[tuple[str, str], tuple[Alarm, Rule]] = {}
        failed: dict[str, str] = {}
        self._paused_rules = {rule.kind for rule in self._rules if rule.is_paused(evidence)}
        for rule in self._rules:
            try:
                for alarm in rule(evidence):
                    found.setdefault(alarm.key, (alarm, rule))
            except Exception as error:
                failed[rule.kind] = f"{type(error).__name__}: {error}"
                if rule.kind not in self._failed_rules:
                    log.exception("the alarm rule %s has failed", rule.kind)
        self._failed_rules = failed
        return found

    def _raise(self, found: Mapping[tuple[str, str], tuple[Alarm, Rule]], evidence: Evidence) -> None:
        now = evidence.now
        self._sighted = {key: self._sighted.get(key, rule.instant(evidence)) for key, (_, rule) in found.items()}
        for key, (alarm, rule) in found.items():
            active, seen = self._active.get(key), rule.instant(evidence)
            if active is not None:
                is_worse = alarm.severity == "critical" != active.alarm.severity
                active.alarm, active.seen, active.hold_s = alarm, seen, rule.hold_s
                if is_worse:
                    self._report_raised(active, now)
            elif seen.since(self._sighted[key]) >= rule.after_s * NS_PER_S:
                self._active[key] = _Active(alarm, now, seen, rule.hold_s)
                self._report_raised(self._active[key], now)

    def _report_raised(self, active: _Active, now: Stamp) -> None:
        """Send and log an alarm that is raised, or that has become critical."""
        self._tell(_notice("raised", active, now))
        alarm = active.alarm
        said = alarm.kind, alarm.subject, alarm.text, alarm.remedy
        log.log(_LEVELS[alarm.severity], "alarm %s, %s: %s. %s", *said)

    def _clear(self, found: Mapping[tuple[str, str], object], evidence: Evidence) -> None:
        now, instants = evidence.now, {rule.kind: rule.instant(evidence) for rule in self._rules}
        for key, active in list(self._active.items()):
            if active.alarm.kind in self._failed_rules or active.alarm.kind in self._paused_rules:
                active.seen = now
            if key in found:
                continue
            if instants.get(active.alarm.kind, now).since(active.seen) >= active.hold_s * NS_PER_S:
                del self._active[key]
                active.cleared = now
                self._unwritten.append(active)
                self._tell(_notice("cleared", active, now))
                is_same_boot = now.boot_id == active.raised.boot_id
                lasted_s = max(now.since(active.raised) / NS_PER_S, 0.0)
                lasted = duration(lasted_s) if is_same_boot else "a restart of the computer"
                log.info("alarm %s, %s is over after %s", active.alarm.kind, active.alarm.subject, lasted)

    def _work(self) -> None:
        try:
            self.write()
        except Exception as error:  # noqa: BLE001 - logged; a fault must not end the writing of alarms
            self._log_once("the alarms could not be written", error)

    def _log_once(self, what: str, error: Exception) -> None:
        if str(error) != self._told.get(what):
            log.error("%s", what, exc_info=error)
        self._told[what] = str(error)

    def write(self) -> None:
        """Write all changes to the store; what cannot be written now is retried after the next evaluation."""
        with self._turn:
            cleared, active = list(self._unwritten), list(self._active.values())
        try:
            for one in cleared:
                self._write_one(one)
                with self._turn:
                    if self._unwritten and self._unwritten[0] is one:  # a full queue drops its oldest by itself
                        self._unwritten.popleft()
            for one in active:
                self._write_one(one)
        except (sqlite3.Error, StoreError):
            log.debug("alarms cannot be written", exc_info=True)  # the alarm not_storing reports it

    def _write_one(self, active: _Active) -> None:
        alarm = active.alarm
        if active.row is None:
            active.row = self._table.add(active.raised, **asdict(alarm))
        elif alarm != active.written:
            self._table.change(active.row, severity=alarm.severity, text=alarm.text, remedy=alarm.remedy)
        active.written = alarm
        if active.cleared is not None:
            self._table.clear(active.row, active.cleared)
