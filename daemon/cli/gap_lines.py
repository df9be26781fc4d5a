"""What `status` says of the gap between simulation and machine, for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from daemon.report.markup import number

_EXPERIMENTS_SHOWN = 3


def gap_lines(gap: Mapping[str, Any]) -> Iterator[str]:
    """The newest verdict with what to measure next, and how the live model holds against its checks."""
    found, failed, drift = gap["verdict"], gap["failed"], gap["drift"]
    if failed is not None:
        yield f"gap: the job of session {failed['session']} failed (job {failed['job']}): {failed['error']}"
    if found is not None:
        yield f"gap ({found['verdict']}, after session {found['session']}): {found['sentence']}"
        for text in found["experiments"][:_EXPERIMENTS_SHOWN]:
            yield f"  next: {text}"
        yield f"  report: {found['report']}"
    if drift is not None:
        yield _drift_line(drift)


def _drift_line(drift: Mapping[str, Any]) -> str:
    start = f"drift of model {drift['model']}"
    if drift["newest"] is None:
        return f"{start}: no check session since it went live"
    if drift["ratio"] is None:
        last = f"the last, {drift['newest']}, could not be used: {drift['reason']}"
    else:
        last = f"in the last, {drift['newest']}, errors are {number(drift['ratio'], 2)} times the predicted"
    sums = f"sums {number(drift['upper'], 2)} and {number(drift['lower'], 2)} of {number(drift['decision'], 2)}"
    checks = f"{drift['checks']} check session{'s' if drift['checks'] != 1 else ''}"
    verdict = {
        "none": "none",
        "worse": f"the machine has left the model (since check session {drift['drifted_with']})",
        "better": "none; the machine is truer than the model says, which a new calibration would show",
    }[drift["alarm"]]
    return f"{start}: {verdict}; {checks}, {last} ({sums})"
