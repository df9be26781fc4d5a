"""Checkpoints of a search as plain arrays, from which it resumes after an interruption.

A state contains a description of its problem, so that a search with other data, bounds or settings never resumes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.stored_arrays import read_npz, write_npz
from calibration.observations import Floats
from calibration.run_settings import Checkpoint

Arrays = dict[str, NDArray[Any]]

_FORMAT = "1"  # of the state; states of a different format cannot be resumed
_PROBES = 8  # candidates whose fitness represents the data
_SAME = 1e-9  # relative tolerance when numbers are compared
_PREFIX = "problem."


def problem(
    method: str,
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    *,
    start: Floats | None,
    seed: int,
    settings: object,
) -> Arrays:
    """Return a description of a search by named parts; two searches are the same if all parts agree.

    The data are represented by the fitness of a few candidates spread over the box. Results of an earlier fit may
    differ in their last bits between processes, so numbers are compared with a relative tolerance of 1e-9.

    Args:
        method: name of the method.
        fitness: function from (candidates, p) to costs (candidates,).
        lower: (p,) lower bounds.
        upper: (p,) upper bounds.
        start: (k, p) initial candidates, if any.
        seed: seed of the random numbers.
        settings: settings of the search; its `repr` is compared.
    """
    steps = (np.arange(_PROBES)[:, None] * (1.0 + np.arange(len(lower))) * 0.6180339887498949 + 0.5) % 1.0
    probes = lower + (upper - lower) * steps
    return {
        "method": np.array(f"{method} {_FORMAT}"),
        "seed": np.array(str(seed)),
        "settings": np.array(repr(settings)),
        "bounds": np.array([lower, upper]),
        "start": np.empty((0, len(lower))) if start is None else np.array(start),
        "data": np.array(fitness(probes)),
    }


def pack(identity: Mapping[str, NDArray[Any]], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Pack arrays and the description of their problem as an npz archive without pickled objects."""
    return write_npz({_PREFIX + word: value for word, value in identity.items()} | dict(arrays))


def unpack(state: bytes | None, identity: Mapping[str, NDArray[Any]]) -> tuple[Arrays | None, str | None]:
    """Return the arrays of a state, or None and the reason if it cannot be read or belongs to a different problem."""
    if state is None:
        return None, None
    try:
        arrays = read_npz(state)
    except ValueError:
        return None, "the checkpoint cannot be read, so the search started again"
    found = {word: arrays.pop(_PREFIX + word, np.empty(0)) for word in identity}
    other = [word for word, value in identity.items() if not _same(found[word], value)]
    if other:
        return None, f"the checkpoint is of another search ({', '.join(other)} differ), so the search started again"
    return arrays, None


class SavedSearch:
    """The state of a search in a run's checkpoint, if the run has one.

    Args:
        checkpoint: checkpoint of the run, if any.
        identity: function that returns the `problem`.

    Attributes:
        arrays: state to resume from; None to start from the beginning.
        set_aside: reason why an existing state was not resumed, or None.
        unsaved: reason why a state could not be saved, or None.
    """

    def __init__(self, checkpoint: Checkpoint | None, identity: Callable[[], Arrays]) -> None:
        self._checkpoint, self._identity = checkpoint, {} if checkpoint is None else identity()
        state = None if checkpoint is None else checkpoint.load()
        self.arrays, self.set_aside = unpack(state, self._identity)
        self.unsaved: str | None = None

    def save(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Save a state; a failure is recorded in `unsaved` and does not end the search."""
        if self._checkpoint is None:
            return
        try:
            self._checkpoint.save(pack(self._identity, arrays))
        except OSError as error:
            self.unsaved = (
                f"the search's checkpoint could not be written ({error}), so a search that is killed may start again"
            )


def _same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    if one.dtype.kind != other.dtype.kind or one.shape != other.shape:
        return False
    if one.dtype.kind == "f":
        return bool(np.allclose(one, other, rtol=_SAME, atol=0.0, equal_nan=True))
    return bool(np.all(one == other))
