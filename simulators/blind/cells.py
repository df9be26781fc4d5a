"""The cells of the benchmark: kind of case, hidden effects, visible size, pose plan, encoder noise and seed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, get_args

Kind = Literal[
    "single", "null", "decoy", "pair", "triple", "outside", "left_out", "alias", "beside", "machine", "regime", "path"
]
Poses = Literal["wide", "face", "sparse", "many", "path"]
Noise = Literal["fine", "stepped", "coarse"]

ALIASES = (
    "base_settlement|base_step",
    "load_hysteresis|joint_compliance",
    "cylinder_compression|transducer_scale",
    "latency|clock_drift",
    "backlash|zero_step",
)
KINDS: tuple[Kind, ...] = get_args(Kind)
LEAST_IN_MACHINE = 3.0  # visible size of each of its effects
SIZES = (0.25, 0.5, 1.0, 3.0)
POSES: tuple[Poses, ...] = get_args(Poses)
NOISES: tuple[Noise, ...] = ("fine", "stepped", "coarse")

REPORTED_FROM = 1_000_000  # seeds below are for tuning
_COMMON: tuple[Poses, ...] = ("wide", "face")
_PLANS: tuple[Poses, ...] = ("wide", "face", "sparse")


@dataclass(frozen=True)
class Cell:
    """One case to draw.

    Attributes:
        kind: purpose of the case.
        families: hidden effects. For `alias`, one of `ALIASES`: two families that the data is designed to confuse. For
            `beside`, one outside the library and one of the library. Empty if the seed also draws the effects.
        size: visible RMS of each effect in units of the noise; for a machine, of its smallest effect; 0 without
            effects.
        poses: `wide`, `face` (feed held parallel to the tunnel axis), `sparse` (few, in clusters), `many` (twice as
            many as `wide`) or `path` (one after another along a continuous path).
        noise: resolution of the encoders: as in the rig file (`fine`), or 0.02 deg (`stepped`) or 0.1 deg (`coarse`),
            which the rig file does not state.
        seed: seed for everything else.
    """

    kind: Kind
    families: tuple[str, ...]
    size: float
    poses: Poses
    noise: Noise
    seed: int


def full_plan(families: Sequence[str], outside: Sequence[str], first: int, repeats: int) -> tuple[Cell, ...]:
    """Return the cells of the whole benchmark.

    Args:
        families: families of the library for which the rig has a place.
        outside: effects that are not in the library.
        first: seed of the first case; the others follow consecutively.
        repeats: number of cases per cell.
    """
    return _numbered((cell for cell in _full(families, outside) for _ in range(repeats)), first)


def short_plan(families: Sequence[str], outside: Sequence[str], first: int) -> tuple[Cell, ...]:
    """Return a few cells of every kind; see `full_plan` for the arguments."""
    return _numbered(_short(families, outside), first)


_Open = tuple[Kind, tuple[str, ...], float, Poses, Noise]

_NULLS, _DECOYS, _PAIRS, _TRIPLES, _CASES_PER_ALIAS, _BESIDE = 600, 60, 60, 30, 10, 80
_MACHINES, _REGIMES, _PATHS = 20, 36, 20
_REGIME_SIZES = (3.0, 6.0)


def _full(families: Sequence[str], outside: Sequence[str]) -> Iterator[_Open]:
    for family, size, poses, noise in product(families, SIZES, _PLANS, NOISES):
        yield "single", (family,), size, poses, noise
    yield from _without_effect("null", _NULLS)
    yield from _without_effect("decoy", _DECOYS)
    yield from _together("pair", families, 2, _PAIRS)
    yield from _together("triple", families, 3, _TRIPLES)
    for name, size, poses, noise in product(outside, (1.0, 3.0), _COMMON, NOISES):
        yield "outside", (name,), size, poses, noise
    for family, size, poses in product(families, (1.0, 3.0), _COMMON):
        yield "left_out", (family,), size, poses, "fine"
    for name, _ in product(ALIASES, range(_CASES_PER_ALIAS)):
        yield "alias", (name,), 1.0, "wide", "fine"
    yield from _beside(families, outside, _BESIDE)
    yield from _machines(_MACHINES)
    yield from _regimes(_REGIMES)
    yield from _paths(_PATHS)


def _short(families: Sequence[str], outside: Sequence[str]) -> Iterator[_Open]:
    for family in families:
        yield "single", (family,), 1.0, "wide", "fine"
    yield from _without_effect("null", 24)
    yield from _without_effect("decoy", 4)
    yield from _together("pair", families, 2, 4)
    yield from _together("triple", families, 3, 2)
    for name in outside:
        yield "outside", (name,), 1.0, "wide", "fine"
    for family in families[::6]:
        yield "left_out", (family,), 1.0, "wide", "fine"
    for name in ALIASES:
        yield "alias", (name,), 1.0, "wide", "fine"
    yield from _beside(families, outside, 4)
    yield from _machines(1)
    yield from _regimes(1)
    yield from _paths(1)


def _without_effect(kind: Kind, number: int) -> Iterator[_Open]:
    for index in range(number):
        yield kind, (), 0.0, _PLANS[index % len(_PLANS)], NOISES[index // len(_PLANS) % len(NOISES)]


def _together(kind: Kind, families: Sequence[str], effects: int, number: int) -> Iterator[_Open]:
    """Yield every family in turn, with partners farther along the list in each round."""
    for index in range(number):
        step = 1 + index // len(families) + index % 3
        chosen = tuple(families[(index * effects + step * i) % len(families)] for i in range(effects))
        yield kind, tuple(dict.fromkeys(chosen)), 1.0, "wide", "fine"


def _beside(families: Sequence[str], outside: Sequence[str], number: int) -> Iterator[_Open]:
    """Yield every effect outside the library, with library families farther along the list in each round."""
    for index in range(number):
        turn, at = divmod(index, len(outside))
        family = families[(at * len(families) // len(outside) + turn) % len(families)]
        yield "beside", (outside[at], family), (1.0, 3.0)[turn % 2], _COMMON[turn // 2 % len(_COMMON)], "fine"


def _machines(number: int) -> Iterator[_Open]:
    for index in range(number):
        yield "machine", (), LEAST_IN_MACHINE, ("wide", "many")[index % 2], "fine"


def _regimes(number: int) -> Iterator[_Open]:
    for index in range(number):
        yield "regime", (), _REGIME_SIZES[index % len(_REGIME_SIZES)], "wide", "fine"


def _paths(number: int) -> Iterator[_Open]:
    for index in range(number):
        yield "path", (), 0.0, "path", NOISES[index % len(NOISES)]


def _numbered(cells: Iterator[_Open], first: int) -> tuple[Cell, ...]:
    return tuple(Cell(*cell, seed=first + number) for number, cell in enumerate(cells))
