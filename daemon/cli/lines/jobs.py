"""Text for people about jobs: state, progress, duration, result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from daemon.cli.terminal import Coloured, echo, echo_table, percent
from daemon.host.safe_output import duration
from daemon.report.words import number

_COLOURS = {"done": "green", "failed": "red", "interrupted": "yellow", "cancelled": "yellow"}


def job_lines(status: Mapping[str, Any]) -> list[str]:
    """Return a line for each unfinished job of the daemon's status, the running one first."""
    jobs = sorted(status["jobs"], key=lambda job: job["state"] != "running")
    waits = waiting_for(status["session"])
    return [_line(job) + (f", {waits}" if waits and job["state"] == "queued" else "") for job in jobs]


def waiting_for(session: Mapping[str, Any] | None) -> str:
    """Return what queued jobs wait for while a session is open; "" while none is."""
    return f"begins when session {session['id']} has ended" if session is not None else ""


def _line(job: Mapping[str, Any]) -> str:
    name = f"job {job['id']} {job['kind']}" + (f" of {job['session_id']}" if job.get("session_id") else "")
    told = outcome(job)
    return f"{name}: {job['state']}" + (f", {told}" if told else "")


def outcome(job: Mapping[str, Any]) -> str:
    """Return the progress, error or result of a job."""
    if job["state"] == "running":
        return f"{percent(job['progress'])}: {job['message'] or 'starting'}"
    if job["error"]:
        return str(job["error"])
    result = job.get("result") or {}
    words = {"gap": _gap, "residual": _residual, "report": _report, "comparison": _comparison, "drift": _drift}
    return words[job["kind"]](result) if result else ""


def report_of(job: Mapping[str, Any]) -> str | None:
    """Return the path of a job's report; None if it has none."""
    return (job.get("result") or {}).get("report")


def show_jobs(jobs: Sequence[Mapping[str, Any]], without: Sequence[Mapping[str, Any]] = ()) -> None:
    """Print jobs with their results, and the reasons why sessions have no job.

    Args:
        jobs: oldest first.
        without: sessions without a job, each with the reason under `no_job`.
    """
    if jobs:
        echo_table(("job", "kind", "session", "state", "took", "result"), _rows(jobs))
    for session in without:
        echo(f"session {session['id']} has no job of its own: {session['no_job']}")


def _rows(jobs: Sequence[Mapping[str, Any]]) -> Iterator[list[str | Coloured]]:
    for job in jobs:
        state = Coloured(job["state"], _COLOURS.get(job["state"], ""))
        took = "" if job.get("duration_s") is None else duration(job["duration_s"])
        yield [str(job["id"]), job["kind"], job["session_id"] or "", state, took, outcome(job)]
        if (report := report_of(job)) is not None:
            yield ["", "", "", "", "", f"report: {report}"]


# ---- results by kind -------------------------------------------------------------------------------------------------


def _gap(result: Mapping[str, Any]) -> str:
    gap = result.get("gap") or {}
    held_out = gap.get("holdout")
    told = str(result.get("sentence", ""))
    if not held_out:
        return told
    before, after = number(held_out["rms_before_mm"]), number(held_out["rms_after_mm"])
    if not gap.get("effects"):
        return f"{told} Held-out error of the calibrated kinematics: {before} mm RMS."
    return f"{told} Held-out error: calibrated kinematics {before} mm RMS, with the effects {after} mm."


def _residual(result: Mapping[str, Any]) -> str:
    stages = (result.get("metrics") or {}).get("training")
    if not stages:
        return "model trained"
    return f"model trained: {number(stages[-1]['rms_mm'])} mm RMS on the fixes it was fitted to"


def _report(result: Mapping[str, Any]) -> str:
    evaluation = result.get("evaluation")
    if not evaluation:
        return "report written"
    rms_mm = number(evaluation["stages"][-1]["rms_mm"])
    if result.get("held_out"):
        return f"{rms_mm} mm RMS on {evaluation['n']} held-out fixes"
    return f"{rms_mm} mm RMS on the fixes it was fitted to; a check session gives the held-out error"


def _comparison(result: Mapping[str, Any]) -> str:
    return str((result.get("comparison") or {}).get("sentence", ""))


def _drift(result: Mapping[str, Any]) -> str:
    checks = (result.get("drift") or {}).get("checks") or []
    told = []
    for check in checks:
        ratio = check["ratio"]
        what = check["reason"] if ratio is None else f"errors are {number(ratio, 2)} times the predicted ones"
        told.append(f"{check['session']}: {what}")
    return "; ".join(told) or "no check session to compare with the live model"
