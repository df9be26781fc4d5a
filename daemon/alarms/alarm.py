"""Alarms, and the rules that raise them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from daemon.alarms.evidence import Evidence
from daemon.host.safe_output import shown
from daemon.monitoring.notice import Severity
from drivers.clock import Stamp

# Subject and text of a fault, and its severity and remedy where these differ from the rule's usual ones (None: usual).
Finding = tuple[str, str] | tuple[str, str, Severity] | tuple[str, str, Severity | None, str]

TEXT_MAX = 300  # an instrument may send any text of any length, control characters included


@dataclass(frozen=True)
class Alarm:
    """Something that is wrong now.

    Attributes:
        kind: kind of fault: the name of its rule, such as `link_down`.
        subject: what has the fault: a link, channel, station, joint, session ...
        severity: warning: measuring continues, but someone should check; critical: data are lost or cannot be used.
        text: what is wrong, in a clause.
        remedy: what to do, in one or two sentences.
    """

    kind: str
    subject: str
    severity: Severity
    text: str
    remedy: str

    @property
    def key(self) -> tuple[str, str]:
        """Kind and subject, which identify the alarm; its text may change."""
        return self.kind, self.subject


@dataclass(frozen=True)
class Rule:
    """Finds faults in the present evidence alone: level-triggered, without memory of earlier evidence.

    Attributes:
        kind: kind of its alarms.
        severity: usual severity of its alarms.
        remedy: what usually to do; SUBJECT in it stands for the alarm's subject.
        after_s: how long a fault must last before an alarm is raised.
        hold_s: how long the fault must be absent before the alarm is cleared.
        needs_decoding: the evidence is that of fresh readings. While captures wait to be stored or decoded, the rule is
            paused: its alarms stay as they are.
        is_of_decoded: the evidence is that of the newest capture that has been decoded, and `after_s` and `hold_s` are
            counted by its time. While none is decoded, no time passes for the rule.
        meaning: when the alarm is raised and cleared, for docs/reference/alarms.md.
        find: function that yields the faults in the evidence.
    """

    kind: str
    severity: Severity
    remedy: str
    after_s: float
    hold_s: float
    needs_decoding: bool
    is_of_decoded: bool
    meaning: str
    find: Callable[[Evidence], Iterable[Finding]]

    def is_paused(self, evidence: Evidence) -> bool:
        """Return True if the evidence is not up to date: it shows neither a fault nor that one is over."""
        return self.needs_decoding and not evidence.is_decoding

    def instant(self, evidence: Evidence) -> Stamp:
        """Return the instant at which the faults in the evidence were present."""
        return evidence.decoded if self.is_of_decoded else evidence.now

    def __call__(self, evidence: Evidence) -> Iterator[Alarm]:
        """Yield an alarm for every fault in the evidence; none while the rule is paused."""
        if self.is_paused(evidence):
            return
        for finding in self.find(evidence):
            subject, text = finding[:2]
            severity = (finding[2] if len(finding) > 2 else None) or self.severity
            remedy = finding[3] if len(finding) > 3 else self.remedy
            plain = _cut(shown(text).removeprefix(f"{subject}: "))  # shown after the subject
            yield Alarm(self.kind, subject, severity, plain, remedy.replace("SUBJECT", subject))


def _cut(text: str) -> str:
    """Shorten a text to at most TEXT_MAX characters, between words where possible."""
    if len(text) <= TEXT_MAX:
        return text
    head, _, _ = text[:TEXT_MAX].rpartition(" ")
    return f"{head or text[: TEXT_MAX - 1]}…"


def rule(
    severity: Severity,
    remedy: str,
    *,
    after_s: float = 0.0,
    hold_s: float = 0.0,
    needs_decoding: bool = False,
    is_of_decoded: bool = False,
) -> Callable[[Callable[[Evidence], Iterable[Finding]]], Rule]:
    """Turn a function into a rule: its name is the kind of alarm, its docstring states when the alarm is raised.

    Args:
        severity: usual severity of the alarms.
        remedy: what to do; SUBJECT in it stands for the alarm's subject.
        after_s: how long a fault must last before an alarm is raised.
        hold_s: how long the fault must be absent before the alarm is cleared.
        needs_decoding: whether its alarms stay as they are while captures wait to be stored or decoded.
        is_of_decoded: whether the evidence is that of the newest capture that has been decoded.
    """

    def made(find: Callable[[Evidence], Iterable[Finding]]) -> Rule:
        meaning = " ".join((find.__doc__ or "").split())
        return Rule(find.__name__, severity, remedy, after_s, hold_s, needs_decoding, is_of_decoded, meaning, find)

    return made
