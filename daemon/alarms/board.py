"""The alarms that are active: raised and cleared by what the rules say, kept in the store, told to the log.

What is active is known in memory first: an alarm shows although the store cannot be written, and is written once it
can be. Alarms that an earlier run has left go on, with the time they were raised at, if their evidence is still there.
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
from daemon.monitoring.notice import Notice, Severity
from daemon.store.errors import StoreError
from daemon.store.queries.alarms import AlarmTable
from drivers.clock import NS_PER_S, Clock, Stamp

log = logging.getLogger(__name__)

GRACE_S = 15.0  # links have opened by then, and devices have been heard, or have not
CLEARED_SHOWN = 200
STOP_S = 5.0
UNWRITTEN_MAX = 1000  # cleared alarms that wait for a store that cannot be written

_LEVELS: Mapping[Severity, int] = {"warning": logging.WARNING, "critical": logging.ERROR}


@dataclass
class _Active:
    """An alarm from its raising to its clearing.

    Attributes:
        alarm: as its rule has said it last.
        raised: when it was noticed.
        seen: when its evidence was there last.
        hold_s: how long its evidence must be gone before it is cleared.
        row: its number in the store; None while it is not written.
        written: what the store has of it.
        cleared: when it was; None while it is active.
    """

    alarm: Alarm
    raised: Stamp
    seen: Stamp
    hold_s: float
    row: int | None = None
    written: Alarm | None = None
    cleared: Stamp | None = None


def _nobody(notice: Notice) -> None:
    del notice


def _notice(event: Literal["raised", "cleared"], active: _Active, at: Stamp) -> Notice:
    return Notice(event, **vars(active.alarm), raised=active.raised, at=at)


class AlarmBoard:
    """Keeps the alarms. `evaluate` belongs to one thread, once a second; everything else may be called from any.

    Args:
        table: the store's alarms.
        gather: what is known now.
        clock: for ages.
        rules: what raises and clears alarms; all that there are by default.
        tell: takes each alarm that is raised, becomes critical or is cleared; returns at once.
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
        self._tell = tell
        self._table, self._gather, self._clock = table, gather, clock
        self._rules = library() if rules is None else rules
        self._turn = threading.Lock()
        self._looked = clock.now()
        self._active = {(row["kind"], row["subject"]): self._carried(row) for row in self._table.active()}
        self._sighted: dict[tuple[str, str], Stamp] = {}  # since when a fault has stood that is no alarm yet
        self._unwritten: deque[_Active] = deque(maxlen=UNWRITTEN_MAX)  # cleared ones
        self._failed_rules: dict[str, str] = {}
        self._told = ""  # the fault of this board that the log has last
        self._to_write, self._stopping = threading.Event(), False
        self._writer = threading.Thread(target=self._run, name="alarms", daemon=True)

    def start(self) -> None:
        """Begin to write alarms to the store, in a thread of its own: a disk may not answer for long."""
        self._writer.start()

    def stop(self) -> None:
        """Write what is not written yet and end the thread. Harmless when not started."""
        self._stopping = True
        self._to_write.set()
        if self._writer.is_alive():
            self._writer.join(STOP_S)

    def evaluate(self) -> None:
        """Look at everything that is known now; never raises, and waits for no disk."""
        try:
            evidence = self._gather()
            found = self._found(replace(evidence, unwatched={**evidence.unwatched, **self._failed_rules}))
            with self._turn:
                self._raise(found, evidence.now)
                self._clear(found, evidence.now)
                self._looked = evidence.now
            self._to_write.set()
        except Exception as error:
            if str(error) != self._told:
                log.exception("the alarms could not be looked at")
            self._told = str(error)

    def status(self) -> dict[str, Any]:
        """Return the active alarms, the critical and then the oldest first, and when they were looked at.

        Returns:
            `active`: kind, subject, severity, text, remedy, since_utc_ns and age_s of each; `looked_age_s`.
        """
        now = self._clock.now()
        with self._turn:
            active, looked_age_s = list(self._active.values()), now.since(self._looked) / NS_PER_S
        active.sort(key=lambda one: (one.alarm.severity != "critical", -now.since(one.raised)))
        shown = [
            {
                **asdict(one.alarm),
                "since_utc_ns": one.raised.utc_ns,
                "age_s": max(now.since(one.raised) / NS_PER_S, 0.0),
            }
            for one in active
        ]
        return {"active": shown, "looked_age_s": looked_age_s}

    def list_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The active alarms, as `status` shows them; with `all` those that were cleared too, newest first."""
        cleared = self._table.cleared(CLEARED_SHOWN) if arguments.get("all") is True else []
        return {**self.status(), "cleared": cleared}

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _carried(self, row: Mapping[str, Any]) -> _Active:
        """Go on with an alarm of an earlier run."""
        alarm = Alarm(row["kind"], row["subject"], row["severity"], row["text"], row["remedy"])
        return _Active(alarm, row["raised"], self._looked, GRACE_S, row["id"], alarm)

    def _found(self, evidence: Evidence) -> dict[tuple[str, str], tuple[Alarm, Rule]]:
        """Apply the rules; one that fails is left out."""
        found: dict[tuple[str, str], tuple[Alarm, Rule]] = {}
        failed: dict[str, str] = {}
        for rule in self._rules:
            try:
                for alarm in rule(evidence):
                    found.setdefault(alarm.key, (alarm, rule))
            except Exception as error:
                failed[rule.kind] = f"{type(error).__name__}: {error}"
                if rule.kind not in self._failed_rules:
                    log.exception("the rule of alarms %s has failed", rule.kind)
        self._failed_rules = failed
        return found

    def _raise(self, found: Mapping[tuple[str, str], tuple[Alarm, Rule]], now: Stamp) -> None:
        self._sighted = {key: self._sighted.get(key, now) for key in found}
        for key, (alarm, rule) in found.items():
            active = self._active.get(key)
            if active is not None:
                is_worse = alarm.severity == "critical" != active.alarm.severity
                active.alarm, active.seen, active.hold_s = alarm, now, rule.hold_s
                if is_worse:
                    self._report_raised(active, now)
            elif now.since(self._sighted[key]) >= rule.after_s * NS_PER_S:
                self._active[key] = _Active(alarm, now, now, rule.hold_s)
                self._report_raised(self._active[key], now)

    def _report_raised(self, active: _Active, now: Stamp) -> None:
        """Send and log an alarm that is raised, or that has become critical."""
        self._tell(_notice("raised", active, now))
        alarm = active.alarm
        said = alarm.kind, alarm.subject, alarm.text, alarm.remedy
        log.log(_LEVELS[alarm.severity], "alarm %s, %s: %s. %s", *said)

    def _clear(self, found: Mapping[tuple[str, str], object], now: Stamp) -> None:
        for key, active in list(self._active.items()):
            if key in found or active.alarm.kind in self._failed_rules:
                continue
            if now.since(active.seen) >= active.hold_s * NS_PER_S:
                del self._active[key]
                active.cleared = now
                self._unwritten.append(active)
                self._tell(_notice("cleared", active, now))
                lasted = duration(max(now.since(active.raised) / NS_PER_S, 0.0))
                log.info("alarm %s, %s is over after %s", active.alarm.kind, active.alarm.subject, lasted)

    def _run(self) -> None:
        while not self._stopping:
            self._to_write.wait()
            self._to_write.clear()
            self.write()

    def write(self) -> None:
        """Bring the store up to date; what cannot be written now is written the next time."""
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
            log.debug("alarms cannot be written", exc_info=True)  # there is an alarm about that

    def _write_one(self, active: _Active) -> None:
        alarm = active.alarm
        if active.row is None:
            active.row = self._table.add(active.raised, **asdict(alarm))
        elif alarm != active.written:
            self._table.change(active.row, severity=alarm.severity, text=alarm.text, remedy=alarm.remedy)
        active.written = alarm
        if active.cleared is not None:
            self._table.clear(active.row, active.cleared)
