"""What a search needs to go on after it was interrupted: the protocol of a store, and states as plain arrays.

A state names the problem that it belongs to, so that a search of other data, bounds or settings never continues it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.npz import read_npz
from calibration.observations import Floats

Arrays = dict[str, NDArray[Any]]

_FORMAT = "1"  # of the state; another one cannot be continued
_PROBES = 8
_SAME = 1e-9
_PREFIX = "problem."


class Checkpoint(Protocol):
    """Where a search keeps its state; the caller owns the file."""

    def load(self) -> bytes | None:
        """What was saved last; None where there is nothing."""

    def save(self, state: bytes) -> None:
        """Keep a state in place of the one before, whole or not at all; OSError where it cannot be kept."""


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
    """What makes two searches the same one, by the words that say what differs.

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
    """The arrays and the problem that they belong to, as an npz archive without pickle."""
    named = {_PREFIX + word: value for word, value in identity.items()}
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **named, **arrays)
    return out.getvalue()


def unpack(state: bytes | None, identity: Mapping[str, NDArray[Any]]) -> tuple[Arrays | None, str | None]:
    """The arrays of a state of this very problem, or None; a sentence where a state had to be left aside."""
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


def keep(checkpoint: Checkpoint, state: bytes) -> str | None:
    """Save a state; a sentence where it cannot be kept, which is no reason to end the search."""
    try:
        checkpoint.save(state)
    except OSError as error:
        return f"the search's checkpoint could not be written ({error}), so a search that is killed may begin anew"
    return None


def _same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    if one.dtype.kind != other.dtype.kind or one.shape != other.shape:
        return False
    if one.dtype.kind == "f":
        return bool(np.allclose(one, other, rtol=_SAME, atol=0.0, equal_nan=True))
    return bool(np.all(one == other))
