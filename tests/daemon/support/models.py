"""A store with models of a simulated boom, the commands about them, and a clock that tests turn."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.observations import parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig
from daemon.commands import WRONG_USE, CommandError
from daemon.composition import joiner
from daemon.config.config import Config
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Outcome
from daemon.jobs.process import perform
from daemon.models.live_model import LiveModel, Loaded, Missing
from daemon.models.live_tip import FRESH_S, LiveTip
from daemon.models.model_files import model_sha256, write_model
from daemon.models.registry import ModelRegistry
from daemon.store.errors import NotInStoreError
from daemon.store.queries.models import ModelTable
from drivers.clock import Stamp
from drivers.readings import Reading, Record, Status
from tests.daemon.support.jobs import SOURCE, TRUTH, JobRig
from tests.simulated.observations import simulate_observations

PRISMS = ("r", "s")
DEADLINE_S = 60.0


@functools.cache
def written(poses: int) -> Path:
    """A model of the simulated boom that was trained on so many poses at set-up S1, made once."""
    scratch = tempfile.mkdtemp(prefix="rigcal-test-")
    atexit.register(shutil.rmtree, scratch)
    directory = Path(scratch) / f"trained-on-{poses}"
    data = simulate_observations(TRUTH, poses, 20, setup="S1", prisms=PRISMS)
    observations = parse_observations(data.csv_text().encode(), SOURCE.rig, "simulated.csv")
    write_model(directory, identify(SOURCE.rig, SOURCE.text, observations))
    return directory


class ModelRig:
    """A daemon's store with jobs and models, the live model and the tip, without links and sockets.

    Args:
        directory: for the store and the models.
        rig: as the rig file in use describes the machine.
    """

    def __init__(self, directory: Path, rig: Rig = SOURCE.rig) -> None:
        self.jobs = JobRig(directory)
        self.store, self.clock, self.config = self.jobs.store, self.jobs.clock, self.jobs.config
        self.models = ModelTable(self.store, "swdt82", self.clock)
        self.job_table = JobQueue(self.store, "swdt82", self.clock)
        self.live = LiveModel(self.models, rig)
        self.registry = ModelRegistry(
            self.models,
            "swdt82",
            self.live,
            compare=self.job_table.compare,
            comparison_job=self.job_table.table.comparison_of,
            comparison_after=self.job_table.table.comparison_after,
        )
        self.joiner = joiner(Config(rig="swdt82"), rig)
        self.setup: str | None = None
        self.tip = LiveTip(rig, self.joiner, self.live, lambda: self.setup, self.clock, "r", FRESH_S)
        self.live.start()

    def close(self) -> None:
        self.live.stop()
        self.jobs.close()

    def candidate(self, poses: int = 30, sessions: tuple[str, ...] = ("a",), trained: Path | None = None) -> int:
        """A candidate in the store, as a job that was trained on these sessions leaves it; by default `written`."""
        if not self.store.rows("SELECT 1 FROM calibration_sessions WHERE id = ?", (sessions[0],)):
            self.jobs.session(sessions[0])
        with self.store.transaction():
            row = {"kind": "residual", "session_id": sessions[0], "through_session_id": sessions[0], "state": "running"}
            job = self.store.insert("jobs", row | self.store.instant(self.clock.now(), "created_"))
        directory = Path(shutil.copytree(trained or written(poses), self.config.models_directory / f"{job:05d}-hybrid"))
        result = {
            "model": str(directory),
            "manifest_sha256": model_sha256(directory),
            "stage": "hybrid",
            "sessions": list(sessions),
            "metrics": {"noise_mm": 1.0},
        }
        self.job_table.end(job, Outcome("done", result=result))
        return int(self.store.rows("SELECT max(id) AS id FROM models")[0]["id"])

    def compared(self, model: int, *, live: int | None, is_better: bool = True) -> int:
        """What a comparison found, written down as its job does."""
        path = str(self.models.get(model).path)
        self.models.note_comparison(path, {"live": live, "is_better": is_better, "sentence": "it errs by 1 mm"})
        return model

    def accepted(self, poses: int = 30) -> int:
        """A new candidate that is live now."""
        live = self.models.live()
        model = self.compared(self.candidate(poses), live=live and live.id)
        self.registry.accept_command({"id": model, "operator": "Ada"})
        return model

    def compare(self) -> dict[str, Any]:
        """Carry out the comparison that was queued last, as a job's process does."""
        job = next(job for job in self.job_table.state().jobs if job.kind == "comparison")
        assert self.job_table.begin(job, 60.0)
        result = perform(self.job_table.order(job, self.config), lambda share, text: None)
        self.job_table.end(job.id, Outcome("done", result=result))
        return dict(result["comparison"])

    def settled(self) -> Loaded | Missing:
        """The live model, once it is loaded or is known not to be."""
        wait(lambda: "being loaded" not in str(getattr(self.live.now(), "reason", "")))
        return self.live.now()

    # ---- the machine -------------------------------------------------------------------------------------------------

    def drive(self, joints: dict[str, float], seconds: float = 3.0, unread: str = "") -> None:
        """Stand still for a while; every joint but one is read ten times a second, and the tip looks on."""
        for _ in range(round(seconds * 10)):
            self.clock.advance(0.1)
            self.read({name: value for name, value in joints.items() if name != unread}, self.clock.now())

    def read(self, joints: dict[str, float], now: Stamp, status: Status = Status.OK) -> None:
        units = {joint.name: joint.unit for joint in SOURCE.rig.joints}
        self.take(
            [
                Reading(name, now, value if status is Status.OK else None, units[name], status)
                for name, value in joints.items()
            ]
        )

    def take(self, records: Sequence[Record]) -> None:
        """Hand records on and store them, as the writer does."""
        self.joiner.feed(records)
        has_jumped = self.tip.on_records(records)
        self.store.insert_records(records)
        if has_jumped:
            self.live.jump_stored()


def wait(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not done():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)


def pose(seed: int) -> dict[str, float]:
    """Joint values well inside the limits."""
    rng = np.random.default_rng(seed)
    return {j.name: float(j.limits[0] + rng.uniform(0.2, 0.8) * (j.limits[1] - j.limits[0])) for j in SOURCE.rig.joints}


def states(rig: ModelRig) -> dict[int, str]:
    """The state of each model by its number."""
    return {model.id: model.state for model in rig.models.all()}


def refusal(command: Callable[[dict[str, Any]], object], status: int, **arguments: object) -> str:
    """What a command says that refuses with an exit status."""
    with pytest.raises((CommandError, NotInStoreError)) as caught:
        command(arguments)
    assert getattr(caught.value, "status", WRONG_USE) == status
    return str(caught.value)


def measured(rig: ModelRig, name: str, poses: int, kind: str = "static_poses") -> None:
    """Store a session of so many poses at which all prisms of the model were measured."""
    rig.jobs.measured(name, poses, kind, prisms=PRISMS)
