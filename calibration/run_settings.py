"""Settings of a run that are no part of its data: seed, workers, progress, stop and checkpoint."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

from calibration.numerics.single_thread import SingleThreaded, one_blas_thread

Progress = Callable[[float, str], None]
"""Told the share of the work that is done, 0 to 1, and what is going on."""

_MOST_WORKERS = 4


class Checkpoint(Protocol):
    """A place where a search saves its state; the caller owns the file."""

    def load(self) -> bytes | None:
        """Return what was saved last; None where there is nothing."""

    def save(self, state: bytes) -> None:
        """Replace the saved state, whole or not at all.

        Raises:
            OSError: the state cannot be saved.
        """


def _silent(share: float, message: str) -> None:
    """Report to nobody."""


def _never() -> bool:
    """Let the run go on to its end."""
    return False


@dataclass(frozen=True)
class Run:
    """Seed, workers, progress, stop and checkpoint of a computation.

    The result depends on the seed alone: not on the executor, and not on an interruption that a checkpoint bridges.

    Attributes:
        seed: of everything random.
        executor: runs what is independent; threads of the run's own by default.
        progress: told the share done, 0 to 1, and what is going on; an exception that it raises ends the run.
        should_stop: asked during a global search; once it returns True, the best candidate so far is taken.
        checkpoint: where a global search saves its state, and from where it goes on.
    """

    seed: int = 0
    executor: Executor | None = None
    progress: Progress = _silent
    should_stop: Callable[[], bool] = _never
    checkpoint: Checkpoint | None = None

    def part(self, begin: float, end: float, message: str = "{}") -> Run:
        """Return this run for a part of the work.

        Args:
            begin: share of the whole that is done when the part begins.
            end: share that is done when it ends.
            message: reported by the part; `{}` stands for its own message.
        """
        progress = self.progress
        return replace(
            self,
            progress=lambda share, own: progress(begin + (end - begin) * share, message.format(own)),
        )

    def quiet(self, seed: int | None = None) -> Run:
        """Return a run with the same workers that goes on to its end and neither reports nor saves.

        Args:
            seed: this run's by default.
        """
        return Run(self.seed if seed is None else seed, self.executor)

    @contextmanager
    def workers(self) -> Iterator[Executor]:
        """Yield the executor, or threads for as long as the context lasts.

        Meanwhile each call into BLAS keeps to one thread, here and in the workers.
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
"""Seed 0, threads of its own, to the end, and no reports."""
