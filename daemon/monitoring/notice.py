"""A notice of an alarm, and the message that carries one or more notices."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from daemon.host.safe_output import duration, shown
from drivers.clock import NS_PER_S, Stamp

Severity = Literal["warning", "critical"]
LISTED = 30  # notices in one message; older ones are only counted


@dataclass(frozen=True)
class Notice:
    """An event of an alarm.

    Attributes:
        event: raised, cleared, or test, which an operator requests to see whether notices arrive.
        kind, subject, severity, text, remedy: of the alarm.
        raised: when the alarm was raised.
        at: time of the event.
    """

    event: Literal["raised", "cleared", "test"]
    kind: str
    subject: str
    severity: Severity
    text: str
    remedy: str
    raised: Stamp
    at: Stamp

    @property
    def key(self) -> tuple[str, str]:
        """Kind and subject, which identify the alarm."""
        return self.kind, self.subject

    @property
    def title(self) -> str:
        """The event and its alarm, in a few words."""
        first = {"raised": self.severity.upper(), "cleared": "over:", "test": "test:"}[self.event]
        return shown(f"{first} {self.kind} {self.subject}")

    def line(self) -> str:
        """Return the whole notice in one line, for people."""
        at = datetime.fromtimestamp(self.at.utc_ns / NS_PER_S, UTC)
        if self.event == "cleared":
            what = f"{self.text} (over after {duration(self.at.since(self.raised) / NS_PER_S)})"
        else:
            what = f"{self.text}. {self.remedy}"
        return shown(f"{at:%Y-%m-%d %H:%M:%S} UTC {self.title}: {what}")

    def as_dict(self) -> dict[str, Any]:
        """Return the notice as a JSON object, as sent to webhooks."""
        return {
            "event": self.event,
            "kind": self.kind,
            "subject": self.subject,
            "severity": self.severity,
            "text": self.text,
            "remedy": self.remedy,
            "raised_utc_ns": self.raised.utc_ns,
            "at_utc_ns": self.at.utc_ns,
        }


@dataclass(frozen=True)
class Message:
    """Notices that are delivered together.

    Attributes:
        subject: one line.
        text: the notices, one per line.
        data: the same for programs, with the keys `text` and `notices` among others.
    """

    subject: str
    text: str
    data: dict[str, Any]


def message_of(rig: str, notices: Sequence[Notice], unlisted: int = 0) -> Message:
    """Return the message about notices.

    Args:
        rig: name of the machine.
        notices: at least one, oldest first; the newest `LISTED` are listed.
        unlisted: number of additional, older notices.
    """
    host = socket.gethostname()
    listed, total = notices[-LISTED:], len(notices) + unlisted
    unlisted = total - len(listed)
    if total == 1:
        title = notices[0].title
    else:
        has_critical = any(notice.event == "raised" and notice.severity == "critical" for notice in notices)
        title = f"{total} notices" + (", CRITICAL" if has_critical else "")
    subject = shown(f"rigcal {rig} on {host}: {title}")
    lines = [notice.line() for notice in listed]
    if unlisted:
        lines.insert(
            0, f"{unlisted} earlier notices are not listed; `rigcal alarms --all` on {shown(host)} shows them."
        )
    text = "\n".join([subject, "", *lines]) + "\n"
    told = [notice.as_dict() for notice in listed]
    data = {"text": text, "subject": subject, "rig": rig, "host": host, "notices": told, "unlisted": unlisted}
    return Message(subject, text, data)
