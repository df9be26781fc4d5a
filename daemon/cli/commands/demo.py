"""`rigcal demo`: a calibration with a simulated boom, real CANopen and serial traffic, daemon, and operator."""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.demo.operator import PRISMS, Advance, DemoError, Operator
from daemon.cli.offline import show_stages
from daemon.cli.terminal import echo

EFFECTS = (  # hidden effects of the machine, in addition to its build errors
    "boom_droop@boom",
    "encoder_harmonic@theta1:k=2:cosk_rad=4e-3:sink_rad=3e-3",
    "encoder_harmonic@theta4:k=2:cosk_rad=3e-3:sink_rad=3e-3",
)
TRAINING_POSES = 22
CHECK_POSES = 4
JOB_STEPS = 60  # progress steps of the jobs, in addition to one for each pose
_JOBS = {
    "gap": "identification and missing effects",
    "residual": "training of the residual model",
    "report": "the report",
    "comparison": "the comparison of models",
}
SEED = 1
_SEEDS = 100_000


@click.command(cls=Command)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("rigcal-demo"),
    show_default=True,
    help="Directory for store, models and report; it must be new, empty, or from an earlier demo.",
)
@click.option(
    "--rate", type=click.FloatRange(1, 100), default=20.0, show_default=True, help="Simulated seconds per second."
)
@click.option(
    "--seed", type=click.IntRange(0), help=f"Seed of the simulated machine.  [default: {SEED}; random with --hidden]"
)
@click.option(
    "--hidden",
    "is_hidden",
    is_flag=True,
    help="Let the simulated machine draw a hidden effect, let the gap workflow search for it, then show the truth.",
)
@json_option
def demo(out: Path, rate: float, seed: int | None, *, is_hidden: bool, as_json: bool) -> dict[str, Any]:
    """Run a whole calibration without hardware.

    It includes a simulated boom, real protocols, sessions, jobs and a report. With --hidden, the gap workflow searches
    for an unknown effect of the simulated boom.
    """
    from daemon.cli.demo import hidden

    started = time.monotonic()
    _make_room(out)
    total, done = hidden.steps() if is_hidden else _steps(), 0
    with _ended_by_sigterm(), progress_display(as_json=as_json) as progress:

        def advance(text: str, n: int) -> None:
            nonlocal done
            done += n
            progress(done / total, text)

        advance("starting the simulated rig and the daemon", 0)
        if is_hidden:
            seed = secrets.randbelow(_SEEDS) if seed is None else seed
            result = hidden.play(out.resolve(), rate, seed, advance)
        else:
            result = _calibrate(out.resolve(), rate, SEED if seed is None else seed, advance)
    result |= {"seconds": round(time.monotonic() - started, 1), "directory": str(out)}
    if not as_json:
        (hidden.show if is_hidden else _show)(result)
    return result


@contextlib.contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Raise SystemExit on SIGTERM, so that the daemon and its simulated rig end too."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _calibrate(out: Path, rate: float, seed: int, advance: Advance) -> dict[str, Any]:
    operator = Operator(out, rate, seed, [word for effect in EFFECTS for word in ("--effect", effect)])
    try:
        operator.begin()
        for kind, poses in (("static_poses", TRAINING_POSES), ("check", CHECK_POSES)):
            for prism in PRISMS:
                operator.record(prism, kind, poses, advance)
        _wait_for_jobs(operator, advance)
        report = [job for job in operator.say("jobs.list") if job["kind"] == "report"][-1]
        if report["state"] != "done":
            failed = next(job for job in operator.say("jobs.list") if job["state"] == "failed")
            raise DemoError(f"job {failed['id']} ({failed['kind']}) failed: {failed['error']}")
        return dict(report["result"])
    finally:
        operator.close()


def _wait_for_jobs(operator: Operator, advance: Advance) -> None:
    told = 0

    def ended() -> bool:
        nonlocal told
        jobs = operator.say("jobs.list")
        share, text = awaited(jobs)
        now = max(told, int(JOB_STEPS * share))  # sessions closed later queue further jobs
        advance(text, now - told)
        told = now
        reports = [job for job in jobs if job["kind"] == "report"]
        return bool(reports) and all(job["state"] not in {"queued", "running"} for job in jobs)

    operator.wait("the jobs", ended)


def awaited(jobs: Sequence[Mapping[str, Any]]) -> tuple[float, str]:
    """Return the share of the jobs' work that is done, and a text on what is awaited.

    Args:
        jobs: of the demonstration so far, oldest first, as returned by `jobs.list`.
    """
    newest = {job["kind"]: job for job in jobs}
    shares = {kind: _share(newest.get(kind)) for kind in _JOBS}
    running = next((job for job in jobs if job["state"] == "running"), None)
    if running is not None:
        text = f"{_JOBS.get(running['kind'], running['kind'])}: {running['message'] or 'starting'}"
    else:
        text = f"waiting for {next((_JOBS[kind] for kind in _JOBS if shares[kind] < 1.0), 'the jobs to end')}"
    return sum(shares.values()) / len(shares), text


def _share(job: Mapping[str, Any] | None) -> float:
    if job is None or job["state"] == "queued":
        return 0.0
    return float(job["progress"]) if job["state"] == "running" else 1.0


def _steps() -> int:
    return len(PRISMS) * (TRAINING_POSES + CHECK_POSES) + JOB_STEPS


def _make_room(out: Path) -> None:
    """Empty the directory of an earlier demo; UsageError for any other directory that is not empty."""
    if out.exists() and any(out.iterdir()):
        config = out / "rigcal.toml"
        if not (config.is_file() and (out / "daemon.log").is_file()):
            raise click.UsageError(
                f"{out} is neither empty nor from an earlier demo; name a different directory with --out"
            )
        import shutil

        from daemon.store.errors import StoreBusyError
        from daemon.store.files import WriterLock

        try:
            WriterLock(out / "rigcal.sqlite").release()
        except StoreBusyError as error:
            holder = "" if error.pid is None else f" (process {error.pid})"
            raise click.UsageError(
                f"a demo is running in {out}{holder}; wait for its end, or name a different directory with --out"
            ) from error
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)


def _show(result: Mapping[str, Any]) -> None:
    evaluation = result["evaluation"]
    show_stages(evaluation, f"Position error in mm on {evaluation['n']} held-out fixes")
    echo(f"report: {os.path.relpath(result['report'])}   ({result['seconds']:.0f} s)")
