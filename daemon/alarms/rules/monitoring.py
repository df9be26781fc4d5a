"""What leaves the daemon for people who are elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence


@rule("warning", "Give `[metrics]` a port that no other program listens on, and restart rigcal.", after_s=10.0)
def metrics_unserved(evidence: Evidence) -> Iterator[Finding]:
    """The port of the metrics cannot be opened for 10 s; it is tried again every 5 s."""
    if evidence.metrics_fault is not None:
        yield "metrics", evidence.metrics_fault
