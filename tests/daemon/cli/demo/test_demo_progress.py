"""While the demonstration's jobs run, its progress goes on and says what is awaited."""

from __future__ import annotations

from typing import Any

import pytest

from daemon.cli.commands.demo import awaited


def job(kind: str, state: str, progress: float = 0.0, message: str = "") -> dict[str, Any]:
    return {"kind": kind, "state": state, "progress": progress, "message": message}


@pytest.mark.parametrize(
    ("jobs", "share", "text"),
    [
        ([], 0.0, "waiting for identification and missing effects"),
        ([job("gap", "running", 0.5, "solving")], 1 / 8, "identification and missing effects: solving"),
        (
            [job("gap", "done", 1.0), job("residual", "running"), job("report", "queued")],
            1 / 4,
            "training of the residual model: starting",
        ),
        ([job("gap", "done", 1.0), job("residual", "done", 1.0)], 1 / 2, "waiting for the report"),
        ([job(kind, "done") for kind in ("gap", "residual", "report")], 3 / 4, "waiting for the comparison of models"),
        (
            [*(job(kind, "done") for kind in ("gap", "residual", "report")), job("comparison", "done")],
            1.0,
            "waiting for the jobs to end",
        ),
        ([job("gap", "failed", 0.4), job("gap", "queued")], 0.0, "waiting for identification and missing effects"),
    ],
)
def test_the_progress_of_the_jobs_is_told(jobs: list[dict[str, Any]], share: float, text: str) -> None:
    assert awaited(jobs) == (pytest.approx(share), text)
