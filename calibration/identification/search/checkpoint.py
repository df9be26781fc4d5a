"""States of a search as plain arrays, with which it goes on after an interruption.

A state names the problem that it belongs to, so that a search of other data, bounds or settings never continues it.
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

_FORMAT = "1"  # of the state; another one cannot be continued
_PROBES = 8
_SAME = 1e-9
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
    """Describe a search such that two are the same if all parts agree; the names of the parts say what differs.

    Data are known by their effect: the fitness of a few candidates spread over the box. Numbers that an earlier fit
    found may differ in their last bits from one process to the next, so they are compared to a billionth.
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
    """Pack arrays and the problem that they belong to, as an npz archive without pickled objects."""
    return write_npz({_PREFIX + word: value for word, value in identity.items()} | dict(arrays))


def unpack(state: bytes | None, identity: Mapping[str, NDArray[Any]]) -> tuple[Arrays | None, str | None]:
    """Read the arrays of a state of this very problem, or None; a sentence where a state had to be left aside."""
    if state is None:
        return None, None
    try:
        arrays = read_npz(state)
    except ValueError:
        return None, "the checkpoint cannot be read, so the search began anew"
    found = {word: arrays.pop(_PREFIX + word, np.empty(0)) for word in identity}
    other = [word for word, value in identity.items() if not _same(found[word], value)]
    if other:
        return None, f"the checkpoint is of another search ({', '.join(other)} differ), so the search began anew"
    return arrays, None


class SavedSearch:
    """The state of a search in a run's checkpoint, if the run has one.

    Args:
        checkpoint: of the run.
        identity: function that returns the `problem`.

    Attributes:
        arrays: state to go on from; None to begin anew.
        set_aside: reason why a state was not continued; None where there was none or it was.
        unsaved: reason why a state was not saved; None where each was.
    """

    def __init__(self, checkpoint: Checkpoint | None, identity: Callable[[], Arrays]) -> None:
        self._checkpoint, self._identity = checkpoint, {} if checkpoint is None else identity()
        state = None if checkpoint is None else checkpoint.load()
        self.arrays, self.set_aside = unpack(state, self._identity)
        self.unsaved: str | None = None

    def save(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Save a state; that it cannot be saved is no reason to end the search."""
        if self._checkpoint is None:
            return
        try:
            self._checkpoint.save(pack(self._identity, arrays))
        except OSError as error:
            self.unsaved = (
                f"the search's checkpoint could not be written ({error}), so a search that is killed may begin anew"
            )


def _same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    if one.dtype.kind != other.dtype.kind or one.shape != other.shape:
        return False
    if one.dtype.kind == "f":
        return bool(np.allclose(one, other, rtol=_SAME, atol=0.0, equal_nan=True))
    return bool(np.all(one == other))
