"""Metrics and notices for people who are not at the machine."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence


@rule(
    "warning",
    "Correct what the alarm names: give `[metrics]` a port that no other program listens on, or end the program that "
    "takes all descriptors, threads or connections. If the alarm stays, restart rigcal.",
    after_s=10.0,
)
def metrics_unserved(evidence: Evidence) -> Iterator[Finding]:
    """Nobody has been able to read the metrics for 10 s.

    Their port cannot be opened, which is retried every 5 s, or the last client could not be served. Cleared when the
    metrics can be read.
    """
    if evidence.metrics_fault is not None:
        yield "metrics", evidence.metrics_fault


@rule(
    "warning",
    "Check the network and the section `[notify]` of the configuration; `rigcal alarms --send-test` sends a test "
    "notice. Undelivered notices are kept.",
    after_s=900.0,
)
def notices_undelivered(evidence: Evidence) -> Iterator[Finding]:
    """Notices of alarms could not be delivered for 15 minutes, by a webhook or a command.

    The notices are kept, and delivery is retried at least every 15 minutes.
    """
    for target, why in evidence.notice_faults.items():
        yield target, f"notices of alarms cannot be delivered: {why}"
