"""`rigcal health`: the rig's health as an exit status, for monitoring systems.

The statuses are those of the Nagios plugin interface, which most monitoring systems understand: 0 good, 1 warning,
2 critical, 3 unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from calibration.rig.words import counted
from daemon.cli.client import STATUS_TIMEOUT_S, client_options, socket_of
from daemon.cli.command import Command, Delivered
from daemon.cli.terminal import echo
from daemon.commands import CommandError
from daemon.control.protocol import request
from daemon.host.safe_output import duration

GOOD, WARNING, CRITICAL, UNKNOWN = 0, 1, 2, 3
_WORDS = ("OK", "WARNING", "CRITICAL", "UNKNOWN")
_STATUS = {"warning": WARNING, "critical": CRITICAL}
HELD_UP_S = 30.0  # alarms are normally evaluated once a second


class _WrongUse(click.UsageError):
    """A usage error with exit status 3, because status 2 means that the rig is in a critical state."""

    exit_code = UNKNOWN


class _Probe(Command):
    """A command whose usage errors end with the status `unknown`."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        try:
            return super().make_context(info_name, args, parent, **extra)
        except click.UsageError as error:
            raise _WrongUse(error.message, error.ctx) from None


@click.command(cls=_Probe)
@client_options
def health(socket: Path | None, config: Path | None, as_json: bool) -> Delivered:
    """Report the rig's health as exit status.

    The status is 0 good, 1 warning, 2 critical, 3 if the daemon does not answer. Prints one line per finding, with its
    remedy; for monitoring systems that run a command.
    """
    status, findings = _look(socket, config)
    if not as_json:
        summary = "all is well" if not findings else counted(len(findings), "finding")
        echo(f"{_WORDS[status]}: {summary}")
        for finding in findings:
            since = "" if finding["age_s"] is None else f" (for {duration(finding['age_s'])})"
            echo(f"{finding['severity']}: {finding['subject']}: {finding['text']}{since}. {finding['remedy']}")
    return Delivered({"status": _WORDS[status], "exit_status": status, "findings": findings}, status)


def _look(socket: Path | None, config: Path | None) -> tuple[int, list[dict[str, Any]]]:
    """Return the exit status and the findings."""
    try:
        told = request(socket_of(socket, config), "status", timeout_s=STATUS_TIMEOUT_S)
    except CommandError as error:
        return UNKNOWN, [_finding("unknown", "unreachable", "rigcal", str(error), "Check `systemctl status rigcal`.")]
    findings = findings_of(told)
    return max((_STATUS[finding["severity"]] for finding in findings), default=GOOD), findings


def findings_of(status: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the faults in a status of the daemon, the critical ones first."""
    alarms = status["alarms"]
    findings = [
        {key: alarm[key] for key in ("severity", "kind", "subject", "text", "remedy", "age_s")}
        for alarm in alarms["active"]
    ]
    if alarms["looked_age_s"] > HELD_UP_S:
        text = f"the daemon is blocked: alarms were last evaluated {duration(alarms['looked_age_s'])} ago"
        remedy = "Check its log; if this persists, `systemctl restart rigcal`."
        findings.append(_finding("critical", "held_up", "rigcal", text, remedy))
    for part, why in status["unreadable"].items():
        text = f"{part} cannot be read from the store: {why}"
        findings.append(_finding("critical", "unreadable", "store", text, "Restore the store from a backup."))
    return sorted(findings, key=lambda finding: -_STATUS[finding["severity"]])


def _finding(severity: str, kind: str, subject: str, text: str, remedy: str) -> dict[str, Any]:
    return {"severity": severity, "kind": kind, "subject": subject, "text": text, "remedy": remedy, "age_s": None}
