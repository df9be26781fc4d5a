"""Limit of one BLAS thread for each call, in any executor.

BLAS threads started by worker threads wait for each other in busy loops, which is several times slower on two cores.
The order of summation also depends on their number, so results would depend on the machine and on the executor.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
T = TypeVar("T")

# The limit applies to the whole process: the first call that needs it sets it, and the last one lifts it.
_lock = threading.Lock()
_running: list[threadpool_limits] = []


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS calls in this process to one thread each; usable as context manager and decorator."""
    with _lock:
        # Only the first one reads the previous limit, which is restored at the end.
        _running.append(_running[0] if _running else threadpool_limits(1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _running.pop()
            if not _running:
                limit.restore_original_limits()


class SingleThreaded(Executor):
    """An executor whose tasks run with one BLAS thread each, in any process or machine.

    Args:
        executor: runs the tasks; its creator shuts it down.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Submit a task, as `Executor.submit`."""
        return self._executor.submit(_alone, fn, *args, **kwargs)


def _alone(fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    with one_blas_thread():
        return fn(*args, **kwargs)
