"""BLAS keeps to one thread in whatever runs a calibration, so models are the same bit by bit."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from calibration.numerics.single_thread import SingleThreaded, one_blas_thread
from calibration.pipeline.calibrate import calibrate
from calibration.run_settings import Run
from tests.calibration.conftest import Session, rig_text


def blas_threads(_: object = None) -> set[int]:
    return {int(pool["num_threads"]) for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn, initializer=threadpool_limits, initargs=(2, "blas")) as pool:
        yield pool


@pytest.mark.long
def test_tasks_have_one_blas_thread_in_a_process_of_their_own(processes: Executor) -> None:
    assert list(SingleThreaded(processes).map(blas_threads, range(4))) == [{1}] * 4


def test_the_last_to_leave_restores_what_the_first_found() -> None:
    with threadpool_limits(2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        second.__exit__(None, None, None)
        assert blas_threads() == {2}


@pytest.mark.long
def test_threads_and_spawned_processes_calibrate_the_same_model(session: Session, processes: Executor) -> None:
    few = session.training.select(np.arange(0, 250, 3))

    def model(executor: Executor) -> tuple[bytes, bytes]:
        found, evaluation = calibrate(session.rig, rig_text("swdt82"), few, residual="rbfn", run=Run(executor=executor))
        return found.values.tobytes(), evaluation.errors_mm["hybrid"].tobytes()

    with ThreadPoolExecutor(2) as threads:
        assert model(processes) == model(threads)
