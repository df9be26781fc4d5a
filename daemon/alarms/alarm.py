"""An alarm, and the rule that says when there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from daemon.alarms.evidence import Evidence
from daemon.host.safe_output import shown
from daemon.monitoring.notice import Severity

# Subject and text of what is wrong, and its severity where it is not the rule's usual one.
Finding = tuple[str, str] | tuple[str, str, Severity]

TEXT_MAX = 300  # instruments may say anything, at any length, and with control characters


@dataclass(frozen=True)
class Alarm:
    """Something that is wrong now.

    Attributes:
        kind: of fault: the name of its rule, `link_down`.
        subject: what has it: a link, channel, station, joint, session ...
        severity: warning: measuring goes on, and someone should look; critical: data are lost or cannot be used.
        text: what is wrong, a clause.
        remedy: what to do, a sentence.
    """

    kind: str
    subject: str
    severity: Severity
    text: str
    remedy: str

    @property
    def key(self) -> tuple[str, str]:
        """Kind and subject, which make it this alarm, whatever its text says."""
        return self.kind, self.subject


@dataclass(frozen=True)
class Rule:
    """Says from evidence alone what is wrong now: level-triggered, without memory.

    Attributes:
        kind: of its alarms.
        severity: the usual one.
        remedy: what to do; SUBJECT in it stands for the alarm's subject.
        after_s: how long a fault must stand before it is an alarm.
        hold_s: how long its evidence must be gone before the alarm is cleared.
        meaning: when it raises and clears, for docs/reference/alarms.md.
        find: its function.
    """

    kind: str
    severity: Severity
    remedy: str
    after_s: float
    hold_s: float
    meaning: str
    find: Callable[[Evidence], Iterable[Finding]]

    def __call__(self, evidence: Evidence) -> Iterator[Alarm]:
        """Yield an alarm for everything that is wrong now."""
        for subject, text, *severity in self.find(evidence):
            how = severity[0] if severity else self.severity
            plain = _cut(shown(text).removeprefix(f"{subject}: "))  # the subject is shown before it
            yield Alarm(self.kind, subject, how, plain, self.remedy.replace("SUBJECT", subject))


def _cut(text: str) -> str:
    """Return a text of at most TEXT_MAX characters, cut between words where it can be."""
    if len(text) <= TEXT_MAX:
        return text
    head, _, _ = text[:TEXT_MAX].rpartition(" ")
    return f"{head or text[: TEXT_MAX - 1]}…"


def rule(
    severity: Severity, remedy: str, *, after_s: float = 0.0, hold_s: float = 0.0
) -> Callable[[Callable[[Evidence], Iterable[Finding]]], Rule]:
    """Make a rule of a function: its name is the kind of alarm, its docstring says when the alarm is raised."""

    def made(find: Callable[[Evidence], Iterable[Finding]]) -> Rule:
        meaning = " ".join((find.__doc__ or "").split())
        return Rule(find.__name__, severity, remedy, after_s, hold_s, meaning, find)

    return made
