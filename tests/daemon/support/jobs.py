"""A store with sessions for jobs to work on, and processes that speak a job's protocol and do as they are told."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from daemon.commands import CHECK
from daemon.config.config import Config
from daemon.config.sections import JobsSection
from daemon.jobs.child import JOB_COMMAND
from daemon.jobs.runner import JobRunner
from daemon.rig_files import load_rig
from daemon.store.store import Store
from drivers.clock import NS_PER_S, ManualClock, Stamp, SystemClock
from simulators.rig.dataset import SimulatedObservations
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
TRUTH = RigTruth(SOURCE.rig, 1)
DEADLINE_S = 180.0
START = Stamp(1_700_000_000 * NS_PER_S, 1000 * NS_PER_S, "boot-a")
LABELS = {"prism", "setup", "session", "pose", "time_s", "dwell_s", "x_mm", "y_mm", "z_mm"}

# Writes down each order, then does what the file `plan.json` says for the order's kind; `scores 1 2` for a drift job is
# done as well, with a check of two standstills that score 1 and 2.
SCRIPT = """
import json, os, pathlib, subprocess, sys, time
directory = pathlib.Path(sys.argv[1])
order = json.loads(sys.stdin.readline())
print(json.dumps({"pid": os.getpid()}), flush=True)
with (directory / "orders.jsonl").open("a") as file:
    file.write(json.dumps(order) + "\\n")
say = lambda message: print(json.dumps(message), flush=True)
sessions = order["train_ids"] if order["kind"] == "residual" else order["session_ids"]
result = {"model": str(directory / str(order["job_id"])), "sessions": sessions}
what = json.loads((directory / "plan.json").read_text()).get(order["kind"], "done")
if order["kind"] in ("report", "comparison"):
    result |= {"model": order["model"]}
    found = {"live": order["live_id"], "is_better": True, "sentence": "it errs by 1 mm"}
    result |= {"comparison": found} if order["kind"] == "comparison" else {}
if order["kind"] == "gap":
    result |= {"gap": {"verdict": "none", "effects": [], "experiments": []}, "sentence": "they agree", "report": "r"}
if order["kind"] == "drift":
    scores = [float(word) for word in what.split()[1:]] or [0.0]
    check = {"fixes": 8, "scores": scores, "ratio": 1.0, "reason": ""}
    checks = [{"session": name, **check} for name in order["session_ids"]]
    result = {"drift": {"live": order["live_id"], "live_since": order["live_since"], "checks": checks}}
if order["kind"] in ("gap", "residual"):
    result |= {"manifest_sha256": "ab" * 32, "stage": "geometric", "metrics": {"noise_mm": 1.5}}
say({"progress": 0.25, "message": what})
if what == "hang":
    sys.stdin.read()
elif what == "deaf":
    child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(600)"])
    (directory / "child").write_text(str(child.pid))
    say({"progress": 0.5, "message": "has a child"})
    time.sleep(600)
elif what == "fail":
    say({"error": "the data are too poor"})
elif what == "garbage":
    print("Segmentation fault", flush=True)
    time.sleep(600)
elif what == "mute":
    sys.exit(7)
elif what == "killed":
    os.kill(os.getpid(), 9)
elif what == "closed":
    os.close(1)
    time.sleep(600)
else:
    say({"result": result})
"""


class CountingClock(ManualClock):
    """A manual clock that knows how often it was asked: the scheduler asks once each time it looks what is due."""

    def __init__(self, start: Stamp) -> None:
        super().__init__(start)
        self.asked = 0

    def now(self) -> Stamp:
        self.asked += 1
        return super().now()


class BootClock(SystemClock):
    """The computer's clock in a boot of that name."""

    def __init__(self, boot: str) -> None:
        super().__init__()
        self._boot_id = boot


class JobRig:
    """A daemon's store and its job runner, without the rest of the daemon."""

    def __init__(self, directory: Path, **jobs: Any) -> None:
        self.directory = directory
        self.config = Config(rig="swdt82", state_directory=directory, jobs=JobsSection(**jobs))
        self.clock = CountingClock(START)
        self.store = Store(self.config.store_path)
        self.runner: JobRunner | None = None
        self.plan()

    def close(self) -> None:
        self.stop()
        self.store.close()

    # ---- sessions ----------------------------------------------------------------------------------------------------

    def session(self, name: str, kind: str = "static_poses", state: str = "closed", rig: str = "swdt82") -> None:
        """A session, as it stands in the store; a closed one ended just now."""
        self.clock.advance(10.0)
        ended = self.store.instant(self.clock.now(), "ended_") if state != "open" else {}
        row = {
            "id": name,
            "rig": rig,
            "rig_sha256": self.store.rig_file(rig, SOURCE.text),
            "prism": "r",
            "operator": "Ada",
            "kind": kind,
            "state": state,
            **self.store.instant(self.clock.now().shifted(-NS_PER_S), "started_"),
        }
        self.store.insert("calibration_sessions", {**row, **ended})

    def close_session(self, name: str) -> None:
        ended = self.store.instant(self.clock.now(), "ended_")
        self.store.update("calibration_sessions", {"id": name}, {"state": "closed", **ended})

    def measured(
        self,
        name: str,
        poses: int,
        kind: str = "static_poses",
        prisms: Sequence[str] | None = None,
        truth: RigTruth = TRUTH,
    ) -> None:
        """A closed session with observations of one and the same simulated machine and set-up."""
        self.session(name, kind)
        if not self.store.rows("SELECT id FROM station_setups"):
            setup = {"id": "S1", "instrument": "simulated", "serial": "", "state": "ok"}
            self.store.insert("station_setups", {**setup, **self.store.instant(self.clock.now(), "created_")})
        self.store.update("calibration_sessions", {"id": name}, {"setup_id": "S1"})
        seed = 20 + kind.count(CHECK)
        self.observed(name, simulate_observations(truth, poses, seed, setup="S1", prisms=prisms))

    def observed(self, session: str, data: SimulatedObservations, *, moving: bool = False) -> None:
        """Observations of a session; those of a moving boom are left out of one of standing poses."""
        columns = {name: values.tolist() for name, values in data.columns.items()}
        numeric = [name for name in columns if name not in LABELS]
        with self.store.transaction():
            for i in range(len(data)):
                row = {
                    "session_id": session,
                    "setup_id": "S1",
                    "moving": moving,
                    "excluded": "moving" if moving else None,
                    **self.store.instant(START.shifted(round(columns["time_s"][i] * NS_PER_S))),
                    **{name: columns[name][i] for name in ("prism", "x_mm", "y_mm", "z_mm", "dwell_s")},
                    "pose": None if moving else columns["pose"][i],
                    "values_json": {name: columns[name][i] for name in numeric},
                }
                self.store.insert("observations", row)

    # ---- the runner --------------------------------------------------------------------------------------------------

    def plan(self, **kinds: str) -> None:
        """What processes of each kind of job do from now on; those not named get done."""
        (self.directory / "plan.json").write_text(json.dumps(kinds), encoding="utf-8")

    @property
    def scripted(self) -> tuple[str, ...]:
        """Command of a process that follows the plan."""
        return (sys.executable, "-I", "-S", "-c", SCRIPT, str(self.directory))

    def start(
        self,
        *,
        real: bool = False,
        command: Sequence[str] | None = None,
        rig: str = "swdt82",
        is_held: Callable[[], bool] = lambda: False,
        boot: str = "boot-a",
        jobs_socket: Path | None = None,
    ) -> JobRunner:
        """A new runner, as after a start of the daemon in a boot of the computer; all waits have passed."""
        self.clock.advance(100.0)
        command = JOB_COMMAND if real else command or self.scripted
        self.runner = JobRunner(
            self.store,
            self.config,
            rig,
            self.clock,
            command=command,
            jobs_socket=None if jobs_socket is None else str(jobs_socket),
            is_held=is_held,
            work_clock=BootClock(boot),
        )
        self.runner.start()
        return self.runner

    def stop(self) -> None:
        if self.runner is not None:
            self.runner.stop()
            self.runner = None

    def look_on(self, times: int = 3) -> None:
        """Wait until the scheduler has looked at what is due that many times."""
        wanted = self.clock.asked + times
        self.wait(lambda: self.clock.asked >= wanted)

    def wait(self, done: Callable[[], Any], what: str = "") -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, f"waited for {what}: {self.jobs()}"
            time.sleep(0.01)

    def wait_for(self, *states: str) -> None:
        """Wait until the jobs, in the order they were queued, are in these states."""
        self.wait(lambda: self.states() == [*states], " ".join(states))

    def jobs(self) -> list[dict[str, Any]]:
        return self.store.rows("SELECT * FROM jobs ORDER BY id")

    def states(self) -> list[str]:
        return [job["state"] for job in self.jobs()]

    def job(self, number: int) -> dict[str, Any]:
        return self.jobs()[number - 1]

    def running(self, number: int) -> dict[str, Any]:
        """The job, once its process has said what it does."""
        rows: list[dict[str, Any]] = []

        def told() -> bool:
            rows[:] = self.store.rows("SELECT * FROM jobs WHERE id = ? AND state = 'running'", (number,))
            return bool(rows) and rows[0]["message"] != ""

        self.wait(told, f"job {number} to run")
        return rows[0]

    def orders(self) -> list[dict[str, Any]]:
        """What the processes were asked to do, oldest first."""
        return [json.loads(line) for line in (self.directory / "orders.jsonl").read_text("utf-8").splitlines()]


def is_gone(pid: int) -> bool:
    """Whether a process has ended (one that nobody waits for stays on as a zombie)."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return True
    return stat.rpartition(")")[2].split()[0] in {"Z", "X"}
