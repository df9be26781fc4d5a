"""Metrics and notices for people who are elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence


@rule(
    "warning",
    "Put right what the text says: give `[metrics]` a port that no other program listens on, or end what takes all "
    "descriptors, threads or connections; restart rigcal if the alarm stays.",
    after_s=10.0,
)
def metrics_unserved(evidence: Evidence) -> Iterator[Finding]:
    """Nobody has been able to read the metrics for 10 s.

    Their port cannot be opened, which is tried again every 5 s, or whoever asked last could not be taken. Cleared when
    they are read.
    """
    if evidence.metrics_fault is not None:
        yield "metrics", evidence.metrics_fault


@rule(
    "warning",
    "Check the network and the section `[notify]`; `rigcal alarms --send-test` tries it. Nothing is lost meanwhile.",
    after_s=900.0,
)
def notices_undelivered(evidence: Evidence) -> Iterator[Finding]:
    """Notices of alarms have not been delivered for 15 minutes, by a webhook or a command.

    They are kept and tried again, at least every 15 minutes.
    """
    for target, why in evidence.notice_faults.items():
        yield target, f"notices of alarms do not leave the machine: {why}"
