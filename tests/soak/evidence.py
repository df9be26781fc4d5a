"""What the daemon shows of each fault, and how soon.

A fault's time to evidence is what it would be on a real rig: the time-outs of the program run on the rig's clock, which
runs faster here, and what the computer itself takes runs in real time. So it is the rig's seconds from the fault to
the stamp of what shows it, and the real seconds from that stamp until it could be read. Alarms are raised, and
`status` is asked for, once a real second each; what these are more than seconds of the rig is taken off.
"""

from __future__ import annotations

import contextlib
import sqlite3
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from daemon.commands import CommandError
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S
from tests.soak.daemon_process import DaemonProcess
from tests.soak.rig_process import SETTLED_S, RigProcess

DEADLINE_S = 5.0
LOOK_REAL_S = 0.15  # how often the store is looked at
ASK_REAL_S = 1.0  # how often `status` is asked for
ALARMS_REAL_S = 1.0  # how often the daemon looks for alarms
WAIT_NS = 40 * NS_PER_S  # how long evidence is looked for, to tell late from never
JUST_BEFORE_NS = NS_PER_S // 5
SESSION = "session"  # in place of a link's name
OF_SESSION = ("lock_loss: alarm", "prism_jump", "prism_jump: alarm")  # only a session has a prism that can be left


@dataclass(frozen=True)
class Fact:
    """Something that the daemon shows.

    Attributes:
        kind: `event`, `gap`, `failure`, `fix`, `reading`, `missed`, `alarm`, `error`, `well`, `answer`.
        subject: device, channel, station or link.
        detail: event's kind, gap's reason, status, alarm's kind.
        seen_ns: when it was read, on the rig's clock.
        stamp_ns: the stamp that it carries; None if it carries none.
    """

    kind: str
    subject: str
    detail: str
    seen_ns: int
    stamp_ns: int | None = None


@dataclass(frozen=True)
class Expected:
    """One kind of evidence.

    Attributes:
        kind: of the facts.
        details: which of them; any if there are none.
        subject: of the facts, in place of the fault's.
        after_s: it must be stamped so much later than the fault, rig seconds.
    """

    kind: str
    details: tuple[str, ...] = ()
    subject: str | None = None
    after_s: float = 0.0

    def __str__(self) -> str:
        return f"{self.kind} {' | '.join(self.details)}".strip()


@dataclass
class Case:
    """A fault that must be shown.

    Attributes:
        name: of the fault.
        subjects: devices, channels and links that it concerns.
        link: whose loss would hide it.
        at_ns: when it began.
        expected: any of these will do.
        found: what has shown it.
    """

    name: str
    subjects: tuple[str, ...]
    link: str
    at_ns: int
    expected: tuple[Expected, ...]
    found: Fact | None = None

    @property
    def of_session(self) -> bool:
        """Whether it is shown only while a session is open and the station stands on its prism."""
        return self.name in OF_SESSION

    def shows(self, fact: Fact) -> bool:
        """Whether a fact is evidence of it."""
        return any(self._is(expected, fact) for expected in self.expected)

    def _is(self, expected: Expected, fact: Fact) -> bool:
        if fact.kind != expected.kind or (expected.details and fact.detail not in expected.details):
            return False
        if fact.subject not in (self.subjects if expected.subject is None else (expected.subject,)):
            return False
        at_ns = fact.seen_ns if fact.stamp_ns is None else fact.stamp_ns
        earliest_ns = self.at_ns + round(expected.after_s * NS_PER_S) - (0 if expected.after_s else JUST_BEFORE_NS)
        # A gap opens with the last good instant, which lies before the fault.
        return fact.seen_ns >= self.at_ns and (fact.kind == "gap" or at_ns >= earliest_ns)

    def took_s(self, rate: float) -> float | None:
        """Time to evidence, see the module's head."""
        if self.found is None:
            return None
        stamp_ns = self.found.stamp_ns
        if self.found.kind == "answer":  # nothing but the computer makes it wait
            return (self.found.seen_ns - self.at_ns) / NS_PER_S / rate
        if self.found.kind in ("alarm", "error", "well", "missed"):
            beats_s = (ALARMS_REAL_S if self.found.kind == "alarm" else 0.0) + (ASK_REAL_S if stamp_ns is None else 0.0)
            shown_ns = self.found.seen_ns if stamp_ns is None else stamp_ns
            return max(0.0, (shown_ns - self.at_ns) / NS_PER_S - (rate - 1) * beats_s)
        if stamp_ns is None or stamp_ns < self.at_ns:
            return (self.found.seen_ns - self.at_ns) / NS_PER_S
        return (stamp_ns - self.at_ns) / NS_PER_S + (self.found.seen_ns - stamp_ns) / NS_PER_S / rate


@dataclass
class Watch:
    """Looks at the daemon's store and status, and tells which faults they show.

    Attributes:
        daemon, rig: who is watched, whose clock counts.
        cases: all faults so far.
        answers_s: how long each answer to `status` took, real seconds.
        alarms: whether the daemon has shown that it knows alarms.
        has_session: whether a session was open when it was last asked.
        channels: name -> status of its last reading, likewise.
    """

    daemon: DaemonProcess
    rig: RigProcess
    cases: list[Case] = field(default_factory=list)
    answers_s: list[float] = field(default_factory=list)
    alarms: bool = False
    has_session: bool = False
    channels: dict[str, str] = field(default_factory=dict)
    _open: list[Case] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _missed: dict[str, int] = field(default_factory=dict)

    def expect(self, case: Case) -> None:
        """One more fault."""
        with self._lock:
            self.cases.append(case)
            self._open.append(case)

    def look(self, stop: threading.Event) -> None:
        """Follow the store until `stop`."""
        last: dict[str, int] = {}
        while not stop.wait(LOOK_REAL_S):
            with contextlib.suppress(sqlite3.Error), self._connection() as db:
                if not last:
                    known = {row[0] for row in db.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
                    last = {table: _newest(db, table) for table in _TABLES if table in known}
                for table, (columns, kind) in _TABLES.items():
                    if table not in last:
                        continue
                    for row in db.execute(
                        f"SELECT id, {columns} FROM {table} WHERE id > ? ORDER BY id", (last[table],)
                    ):
                        last[table] = row[0]
                        self._take(Fact(kind, row[1], row[2], self.rig.now_ns(), row[3]))
                for channel, reason in db.execute(_OPEN_GAPS):  # they show a fault for as long as they are open
                    self._take(Fact("gap", channel, reason, self.rig.now_ns()))

    def ask(self, stop: threading.Event) -> None:
        """Ask for `status` until `stop`."""
        while not stop.wait(ASK_REAL_S):
            asked_ns = self.rig.now_ns()
            try:
                status = self.daemon.say("status", timeout_s=10.0)
            except (CommandError, ValueError):
                continue
            seen_ns = self.rig.now_ns()
            self.answers_s.append((seen_ns - asked_ns) / NS_PER_S / self.rig.clock.rate)
            for fact in self._facts(status, seen_ns):
                self._take(fact)

    def _facts(self, status: dict[str, Any], seen_ns: int) -> list[Fact]:
        facts = [Fact("answer", "daemon", "", seen_ns)]
        acquisition = status["acquisition"]
        facts.append(Fact("error" if acquisition["error"] else "well", "store", "", seen_ns))
        for frame in acquisition["frames"]:
            missed, key = frame["missed"] or 0, frame["identifier"]
            if missed > self._missed.get(key, missed):
                facts += [Fact("missed", name, "", seen_ns) for name in frame["names"].split(", ")]
            self._missed[key] = missed
        self.channels = {channel["name"]: channel["status"] for channel in acquisition["channels"]}
        self.has_session = status["session"] is not None
        if "alarms" in status:
            self.alarms = True
            facts += [Fact("alarm", one["subject"], one["kind"], seen_ns) for one in status["alarms"]["active"]]
        return facts

    def _take(self, fact: Fact) -> None:
        with self._lock:
            for case in self._open:
                if case.shows(fact):
                    case.found = fact
            self._open = [c for c in self._open if c.found is None and fact.seen_ns - c.at_ns < WAIT_NS]

    @contextlib.contextmanager
    def _connection(self) -> Any:
        with contextlib.closing(sqlite3.connect(f"{self.daemon.store.as_uri()}?mode=ro", uri=True, timeout=0.5)) as db:
            yield db


# table -> subject, detail, stamp; and the facts' kind
_TABLES = {
    "device_events": ("device, kind, monotonic_ns", "event"),
    "gaps": ("channel, reason, start_monotonic_ns", "gap"),
    "alarms": ("subject, kind, raised_monotonic_ns", "alarm"),
    "decode_failures": ("device, reason, monotonic_ns", "failure"),
    "fixes": ("station, status, monotonic_ns", "fix"),
    "signals": ("(SELECT name FROM channels WHERE channels.id = channel_id), status, monotonic_ns", "reading"),
    "joint_samples": ("(SELECT name FROM channels WHERE channels.id = channel_id), status, monotonic_ns", "reading"),
}
_OPEN_GAPS = "SELECT channel, reason FROM gaps WHERE end_utc_ns IS NULL"


def _newest(db: sqlite3.Connection, table: str) -> int:
    return int(db.execute(f"SELECT coalesce(max(id), 0) FROM {table}").fetchone()[0])


@dataclass(frozen=True)
class Blackout:
    """A stretch in which faults on a link could not be seen, because the link or the daemon was away.

    Of the link `*` it is for faults on any, of `SESSION` for those that only a station shows that stands on the prism
    of an open session: none was open, or the station was turning.
    """

    link: str
    from_ns: int
    to_ns: int


@dataclass(frozen=True)
class Verdict:
    """How often a fault was shown.

    Attributes:
        injected, masked: how many there were, and how many of them coincided with a blackout and are not judged.
        worst_s: longest time to evidence of those that were judged; None if there is none.
        late, never: judged faults that were shown after the deadline, or not at all.
    """

    injected: int
    masked: int
    worst_s: float | None
    late: int
    never: int


def without_session(reader: Reader, end_ns: int) -> list[Blackout]:
    """The stretches until `end_ns` in which no session was open."""
    sessions = reader.rows("SELECT started_monotonic_ns, ended_monotonic_ns FROM calibration_sessions ORDER BY rowid")
    found, since_ns = [], 0
    for session in sessions:
        found.append(Blackout(SESSION, since_ns, session["started_monotonic_ns"]))
        since_ns = end_ns if session["ended_monotonic_ns"] is None else session["ended_monotonic_ns"]
    return [*found, Blackout(SESSION, since_ns, end_ns)]


def turning(turns_ns: Sequence[int]) -> list[Blackout]:
    """The stretches in which the station turned: it had no lock to lose, or would soon find another."""
    return [Blackout(SESSION, at_ns, at_ns + round(SETTLED_S * NS_PER_S)) for at_ns in turns_ns]


def judge(cases: Sequence[Case], blackouts: Sequence[Blackout], rate: float, end_ns: int) -> dict[str, Verdict]:
    """Fault's name -> verdict. Faults of the last seconds before `end_ns` are not judged."""
    margin_ns = round(DEADLINE_S * NS_PER_S)

    def is_masked(case: Case) -> bool:
        return case.at_ns > end_ns - 2 * margin_ns or any(
            (b.link in ("*", case.link) or (b.link == SESSION and case.of_session))
            and b.from_ns <= case.at_ns + margin_ns
            and b.to_ns >= case.at_ns - NS_PER_S
            for b in blackouts
        )

    verdicts = {}
    for name in sorted({case.name for case in cases}):
        of_name = [case for case in cases if case.name == name]
        in_time = [c for c in of_name if (c.took_s(rate) or 0.0) <= DEADLINE_S and c.found is not None]
        rest = [c for c in of_name if c not in in_time]
        judged = [c for c in rest if not is_masked(c)]
        took = [t for c in (*in_time, *judged) if (t := c.took_s(rate)) is not None]
        verdicts[name] = Verdict(
            injected=len(of_name),
            masked=len(rest) - len(judged),
            worst_s=max(took, default=None),
            late=sum(c.found is not None for c in judged),
            never=sum(c.found is None for c in judged),
        )
    return verdicts
