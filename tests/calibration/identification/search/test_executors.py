"""The same seed gives the same answer, bit by bit, wherever a search runs and whatever interrupts it."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from calibration.identification.search.islands import Evolved
from calibration.model.files import model_to_files
from calibration.observations import parse_observations
from calibration.pipeline.calibrate import calibrate
from calibration.rig.description import shipped_rig
from calibration.run_settings import Run
from simulators.effects.families.encoders import EncoderHarmonic
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text
from tests.calibration.searches import SEARCHES, File, assert_same, search_until_killed
from tests.simulated.observations import simulate_observations

SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture(scope="module", params=SEARCHES)
def search(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture(scope="module")
def reference(search: str) -> Evolved:
    with ThreadPoolExecutor(1) as pool:
        return SEARCHES[search](pool)


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    with ProcessPoolExecutor(2, mp_context=SPAWN) as pool:
        yield pool


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with (
        LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            local_directory=str(tmp_path_factory.mktemp("dask")),
        ) as workers,
        Client(workers) as client,
    ):
        yield client


@pytest.mark.parametrize("workers", [2, 3])
def test_threads(search: str, reference: Evolved, workers: int) -> None:
    with ThreadPoolExecutor(workers) as pool:
        assert_same(SEARCHES[search](pool), reference)


def test_spawned_processes(search: str, reference: Evolved, processes: Executor) -> None:
    assert_same(SEARCHES[search](processes), reference)


@pytest.mark.long
def test_a_dask_cluster(search: str, reference: Evolved, cluster: Client) -> None:
    assert_same(SEARCHES[search](cluster.get_executor()), reference)


@pytest.mark.long
def test_a_whole_calibration_on_a_dask_cluster_is_that_of_threads_byte_by_byte(cluster: Client) -> None:
    rig = shipped_rig("ys100")
    harmonic = EncoderHarmonic("theta2", 4e-3, 3e-3, 2)  # beyond the kinematics: it is searched for, and then learnt
    table = simulate_observations(RigTruth(rig, 3, effects=(harmonic,)), 80, 3, noise_mm=0.1).csv_text()
    observations = parse_observations(table.encode(), rig, "simulated.csv")

    def files(executor: Executor) -> dict[str, bytes]:
        model, _ = calibrate(rig, rig_text("ys100"), observations, effects="none", run=Run(executor=executor))
        assert "global search found" in str(model.provenance["search"])
        assert model.residual is not None
        return model_to_files(model)

    with ThreadPoolExecutor(2) as pool:
        assert files(pool) == files(cluster.get_executor())


class Reversed(Executor):
    """Runs tasks only when one is waited for, the last first."""

    def __init__(self) -> None:
        self._tasks: list[tuple[Future, object]] = []  # type: ignore[type-arg]  # of anything

    def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]  # as the base class
        future = _Lazy(self)
        self._tasks.append((future, lambda: fn(*args, **kwargs)))
        return future

    def run(self) -> None:
        while self._tasks:
            future, task = self._tasks.pop()
            future.set_result(task())  # type: ignore[operator]  # a closure


class _Lazy(Future):  # type: ignore[type-arg]  # of anything
    def __init__(self, executor: Reversed) -> None:
        super().__init__()
        self._executor = executor

    def result(self, timeout=None):  # type: ignore[no-untyped-def]  # as the base class
        self._executor.run()
        return super().result(timeout)


def test_tasks_that_end_in_another_order(search: str, reference: Evolved) -> None:
    assert_same(SEARCHES[search](Reversed()), reference)


def test_a_killed_process_goes_on_where_it_was(search: str, reference: Evolved, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    process = SPAWN.Process(target=search_until_killed, args=(search, str(path), 2))
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    with ThreadPoolExecutor(2) as pool:
        continued = File(path)
        assert_same(SEARCHES[search](pool, continued), reference)
    assert 0 < continued.count < 5
