"""Settings of a run that are not part of its data: seed, workers, progress, stop and checkpoint."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

from calibration.numerics.single_thread import SingleThreaded, one_blas_thread

Progress = Callable[[float, str], None]
"""Callback that receives the share of the work done, 0 to 1, and a message about the current step."""

_MOST_WORKERS = 4


class Checkpoint(Protocol):
    """Storage in which a search saves its state; the caller owns the file."""

    def load(self) -> bytes | None:
        """Return the state that was saved last, or None."""

    def save(self, state: bytes) -> None:
        """Replace the saved state atomically.

        Raises:
            OSError: the state cannot be saved.
        """


def _silent(share: float, message: str) -> None:
    """Discard a progress report."""


def _never() -> bool:
    """Never stop the run early."""
    return False


@dataclass(frozen=True)
class Run:
    """Seed, workers, progress, stop and checkpoint of a computation.

    The result depends on the seed only: neither on the executor nor on an interruption that a checkpoint resumes.

    Attributes:
        seed: seed of all random numbers.
        executor: runs independent tasks; by default the run makes a thread pool of its own.
        progress: called with the share done, 0 to 1, and a message; an exception that it raises ends the run.
        should_stop: called during a global search; once it returns True, the search returns its best candidate so far.
        checkpoint: where a global search saves its state and resumes from.
    """

    seed: int = 0
    executor: Executor | None = None
    progress: Progress = _silent
    should_stop: Callable[[], bool] = _never
    checkpoint: Checkpoint | None = None

    def part(self, begin: float, end: float, message: str = "{}") -> Run:
        """Return this run with its progress scaled to a part of the work.

        Args:
            begin: share of the whole work that is done when the part begins.
            end: share of the whole work that is done when the part ends.
            message: message that is reported for the part; `{}` stands for the part's own message.
        """
        progress = self.progress
        return replace(
            self,
            progress=lambda share, own: progress(begin + (end - begin) * share, message.format(own)),
        )

    def quiet(self, seed: int | None = None) -> Run:
        """Return a run with the same workers that reports no progress, saves no state and never stops early.

        Args:
            seed: seed of the returned run; this run's seed by default.
        """
        return Run(self.seed if seed is None else seed, self.executor)

    @contextmanager
    def workers(self) -> Iterator[Executor]:
        """Yield the executor, or a thread pool that lives as long as the context.

        Within the context each BLAS call uses one thread, in the caller and in the workers.
        """
        with one_blas_thread():
            if isinstance(self.executor, SingleThreaded):
                yield self.executor
            elif self.executor is not None:
                yield SingleThreaded(self.executor)
            else:
                with ThreadPoolExecutor(max_workers=min(_MOST_WORKERS, os.cpu_count() or 1)) as pool:
                    yield SingleThreaded(pool)


DEFAULT_RUN = Run()
"""Seed 0, a thread pool of its own, no progress reports, no early stop and no checkpoint."""
