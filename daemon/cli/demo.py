"""`rigcal demo`: a simulated boom, real CANopen and serial traffic, the daemon, and an operator's commands."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from daemon.cli.output import Command, json_option
from daemon.cli.tables import stage_table
from daemon.control import CommandError, request

CONFIG = """# Written by rigcal demo. The simulated rig takes the place of the two ports.
rig = "swdt82"
state_directory = "."

[[can]]
channel = "can0"

[[station]]
serial.path = "/dev/rigcal-station"
poll_interval_s = 0.25

[sessions]
settle_s = 2.0  # simulated time runs fast: the computer's own delays are this much longer in it
"""
EFFECTS = (  # what the machine hides from its model, beside its build tolerances
    "boom_droop@boom",
    "encoder_harmonic@theta1:k=2:cosk_rad=4e-3:sink_rad=3e-3",
    "encoder_harmonic@theta4:k=2:cosk_rad=3e-3:sink_rad=3e-3",
)
PRISMS = ("r", "s", "b", "w")
CONTROL_POINTS = ("cp1", "cp2")
TRAINING_POSES = 22
CHECK_POSES = 4
DWELL_S = 3.5
DEADLINE_S = 600.0


class DemoError(Exception):
    """The demonstration did not come to its end; the message says where it stopped."""


class _Operator:
    """Talks to the demonstration's daemon as an operator would, with the same commands.

    Args:
        directory: where configuration, store, models and report go.
        rate: simulated seconds per second.
        seed: of the simulated machine.
    """

    def __init__(self, directory: Path, rate: float, seed: int) -> None:
        self._directory = directory
        self._socket = directory / "control.sock"
        config = directory / "rigcal.toml"
        config.write_text(CONFIG, encoding="utf-8")
        command = [sys.executable, "-m", "daemon.cli.main", "run", "--sim", "--config", str(config)]
        command += ["--rate", str(rate), "--seed", str(seed), "--dwell", str(DWELL_S)]
        for effect in EFFECTS:
            command += ["--effect", effect]
        self._log = (directory / "daemon.log").open("w", encoding="utf-8")
        self._daemon = subprocess.Popen(command, stdout=self._log, stderr=self._log)

    def say(self, command: str, **arguments: Any) -> Any:
        """Send a command to the daemon."""
        return request(self._socket, command, arguments)

    def wait(self, what: str, done: Callable[[], bool]) -> None:
        """Wait until `done`, looking five times a second."""
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            if self._daemon.poll() is not None:
                raise DemoError(f"the daemon ended while waiting for {what}; see {self._log.name}")
            if time.monotonic() > deadline:
                raise DemoError(f"waited {DEADLINE_S:g} s for {what}; see {self._log.name}")
            time.sleep(0.2)

    def is_ready(self) -> bool:
        """Whether the daemon answers and the station is locked to a prism."""
        try:
            stations = self.say("status")["acquisition"]["stations"]
        except CommandError:
            return False
        return any(station["fixes"] > 0 for station in stations)

    def close(self) -> None:
        """Stop the daemon, which stops the simulated rig."""
        self._daemon.terminate()
        try:
            self._daemon.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self._daemon.kill()
            self._daemon.wait()
        self._log.close()


@click.command(cls=Command)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("rigcal-demo"),
    show_default=True,
    help="Directory for store, models and report; it must be new, empty, or of an earlier demo.",
)
@click.option("--rate", type=click.FloatRange(1, 100), default=20.0, show_default=True, help="Simulated s per second.")
@click.option("--seed", type=int, default=1, show_default=True, help="Which simulated machine.")
@json_option
def demo(out: Path, rate: float, seed: int, *, as_json: bool) -> dict[str, Any]:
    """A whole calibration without hardware: simulated boom, real protocols, sessions, jobs, report."""
    started = time.monotonic()
    _make_room(out)
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=as_json) as display:
        task = display.add_task("starting the simulated rig and the daemon", total=_steps())
        operator = _Operator(out.resolve(), rate, seed)
        try:
            result = _calibrate(operator, lambda text, n=1: _advance(display, task, text, n))
        finally:
            operator.close()
    result |= {"seconds": round(time.monotonic() - started, 1), "directory": str(out)}
    if not as_json:
        _show(Console(), result)
    return result


def _calibrate(operator: _Operator, advance: Callable[..., None]) -> dict[str, Any]:
    operator.wait("the first fix", operator.is_ready)
    operator.say("setup.new", id="demo", instrument="simulated Topcon GTS-800A", tilt_arcsec=3.0, ppm=0.0)
    for kind, poses in (("static_poses", TRAINING_POSES), ("check", CHECK_POSES)):
        for prism in PRISMS:
            _record(operator, prism, kind, poses, advance)
    advance("identification, residual and report", 0)
    operator.wait("the jobs", lambda: _jobs_ended(operator))
    report = [job for job in operator.say("jobs.list") if job["kind"] == "report"][-1]
    if report["state"] != "done":
        failed = next(job for job in operator.say("jobs.list") if job["state"] == "failed")
        raise DemoError(f"job {failed['id']} ({failed['kind']}) failed: {failed['error']}")
    return dict(report["result"])


def _record(operator: _Operator, prism: str, kind: str, poses: int, advance: Callable[..., None]) -> None:
    """One session, as an operator holds it: control points first and last, poses in between."""
    name = operator.say("session.start", prism=prism, kind=kind, operator="demo")["id"]
    for point in CONTROL_POINTS:
        operator.say("session.shoot", point=point)
    seen = 0

    def enough() -> bool:
        nonlocal seen
        now = min(int(operator.say("session.show", id=name)["poses"]), poses)
        if now > seen:
            advance(f"{kind.replace('_', ' ')} of prism {prism}: {now} of {poses}", now - seen)
            seen = now
        return now >= poses

    operator.wait(f"{poses} poses of prism {prism}", enough)
    for point in CONTROL_POINTS:
        operator.say("session.shoot", point=point)
    operator.say("session.stop")


def _jobs_ended(operator: _Operator) -> bool:
    jobs = operator.say("jobs.list")
    reports = [job for job in jobs if job["kind"] == "report"]
    return bool(reports) and all(job["state"] not in {"queued", "running"} for job in jobs)


def _steps() -> int:
    return len(PRISMS) * (TRAINING_POSES + CHECK_POSES)


def _advance(display: Progress, task: TaskID, text: str, n: int) -> None:
    display.update(task, description=text, advance=n)


def _make_room(out: Path) -> None:
    """Empty the directory of an earlier demo; anything else is left alone."""
    if out.exists() and any(out.iterdir()):
        config = out / "rigcal.toml"
        if not (config.is_file() and (out / "daemon.log").is_file()):
            raise click.UsageError(f"{out} is not empty and holds no earlier demo; name another directory with --out")
        import shutil

        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)


def _show(console: Console, result: Mapping[str, Any]) -> None:
    evaluation = result["evaluation"]
    console.print(stage_table(evaluation, f"Position error in mm on {evaluation['n']} held-out fixes"))
    console.print(f"report: {os.path.relpath(result['report'])}   ({result['seconds']:.0f} s)", highlight=False)


COMMANDS = {"demo": demo}
