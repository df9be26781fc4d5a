"""Assesses all rigs of a fleet, one after another or on a dask cluster; an interrupted run can be resumed.

Each rig's answer is written atomically to a file as soon as it is complete. A repeated run reuses answers with the same
data, settings and format, and works on the other rigs. Only as many tasks are in flight as keep the workers busy, so
memory does not grow with the fleet.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from calibration.errors import CalibrationError
from daemon.fleet.assess import FleetSettings, RigTask, assess
from daemon.fleet.sources import RigSource
from daemon.host.safe_output import write_file
from daemon.store.errors import StoreError
from drivers.errors import DriverError

if TYPE_CHECKING:
    from distributed import Client

RESULTS = "rigs"
_AHEAD = 2  # tasks in flight for each thread of a worker
_TRIES = 3  # submissions of a rig whose workers die; dask itself allows several deaths per submission (3 by default)

Answer = dict[str, Any]
Told = Callable[[int, int, str], None]
"""Called with the number of finished rigs, the number of all rigs, and the name of the last one."""


class Engine(Protocol):
    """What carries out the work: this process, worker processes, or a cluster."""

    def answers(self, tasks: Iterator[RigTask]) -> Iterator[Answer]:
        """Yield the answer to each task, in any order."""


class Here:
    """This process, one rig after another."""

    def answers(self, tasks: Iterator[RigTask]) -> Iterator[Answer]:
        """Yield the answers in the order of the tasks; an error of one rig does not stop the others."""
        for task in tasks:
            try:
                yield assess(task)
            except Exception as error:  # noqa: BLE001 - the error is the rig's answer
                yield _failed(task.name, task.source, error)


class Cluster:
    """The workers of a dask scheduler; the task of a worker that dies is repeated by another worker.

    Args:
        client: connected to the scheduler.
    """

    def __init__(self, client: Client) -> None:
        self._client = client

    def answers(self, tasks: Iterator[RigTask]) -> Iterator[Answer]:
        """Yield the answers in the order of completion."""
        from distributed import KilledWorker, as_completed

        running = as_completed()
        known: dict[object, tuple[RigTask, int]] = {}

        def submit(task: RigTask, attempt: int) -> None:
            key = f"{task.name}-{task.sha256}-{attempt}"
            future = self._client.submit(assess, task, key=key, pure=False)
            known[future.key] = task, attempt
            running.add(future)

        def fill() -> None:
            width = _AHEAD * max(1, sum(self._client.nthreads().values()))
            while len(known) < width and (task := next(tasks, None)) is not None:
                submit(task, 1)

        fill()
        for future in running:
            task, attempt = known.pop(future.key)
            error = future.exception()
            if isinstance(error, KilledWorker) and attempt < _TRIES:
                submit(task, attempt + 1)
                continue
            fill()
            yield future.result() if error is None else _failed(task.name, task.source, error)


@contextmanager
def local_workers(count: int) -> Iterator[Client]:
    """Yield a client of `count` worker processes on this computer; workers that die are restarted.

    Raises:
        ImportError: `distributed` is not installed.
    """
    from distributed import Client, LocalCluster

    with (
        tempfile.TemporaryDirectory() as scratch,
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            local_directory=scratch,
        ) as cluster,
        Client(cluster) as client,
    ):
        # A worker's nanny stops trying if the worker does not start in time: without this the cluster stays empty.
        cluster.adapt(minimum=count, maximum=count)
        yield client


def assess_all(
    sources: Sequence[RigSource], settings: FleetSettings, out: Path, engine: Engine, told: Told
) -> list[Answer]:
    """Assess every rig, and return the answers in the order of the sources.

    Args:
        sources: the rigs.
        settings: of the work on each rig.
        out: directory of the result; answers are kept in `rigs/`.
        engine: carries out the work.
        told: called after each rig, for progress.

    Raises:
        OSError: an answer cannot be written.
    """
    directory = out / RESULTS
    directory.mkdir(parents=True, exist_ok=True)
    answers: dict[str, Answer] = {}

    def note(answer: Answer) -> None:
        answers[answer["name"]] = answer
        told(len(answers), len(sources), answer["name"])

    def waiting() -> Iterator[RigTask]:
        for source in sources:
            try:
                task = source.task(settings)
            except (CalibrationError, DriverError, StoreError, OSError) as error:
                note(_failed(source.name, str(source.path), error))
                continue
            kept = _kept(directory / f"{source.name}.json", task.sha256)
            if kept is None:
                yield task
            else:
                note(kept)

    for answer in engine.answers(waiting()):
        if "kind" not in answer or answer["kind"] != "KilledWorker":
            write_file(directory / f"{answer['name']}.json", json.dumps(answer, allow_nan=False).encode() + b"\n")
        note(answer)
    return [answers[source.name] for source in sources]


def _kept(path: Path, sha256: str) -> Answer | None:
    """Return the answer of an earlier run if it is for the same task, else None."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("sha256") == sha256 else None


def _failed(name: str, source: str, error: BaseException) -> Answer:
    return {"name": name, "source": source, "error": str(error), "kind": type(error).__name__}
