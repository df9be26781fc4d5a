"""Compiled fitness against NumPy and against the machine's matrix multiply: `python -m tests.bench.kernels`.

All on simulated observations of the swdt82: every prism from every pose, 38 parameters searched. NumPy computes the
same sums in three ways: as the reference beside the kernel does, with 4 x 4 matrices for one candidate at a time, and
with the same matrices for a block of candidates. All are vectorised over poses; the bars are ratios to the faster one
that sees one candidate at a time, which is how an optimiser calls its objective, and those to blocks of candidates
stand beside them. "Points" is NumPy's answer to the kernel's own order of work (points carried from the prisms to the
base, for blocks of candidates), which is nobody's usual code. Times are the least of many repetitions, spread over the
run; on a busy machine they are too long all the same, so the load is printed.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import cast

import numba
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.kinematics.fitness import Fitness, evaluate
from calibration.observations import Floats
from calibration.published.paper_evolution import PaperSettings
from calibration.rig.description import shipped_rig
from calibration.rig.parts import Driven, Row
from tests.calibration.kinematics.numpy_chain import NumpyChain

POSES = 200
CANDIDATES = 8192  # a small part of the published search's population; a call takes some milliseconds
REFERENCE_CANDIDATES = 16
BARS = {"float64": 200.0, "float32": 400.0}
EFFICIENCY_BAR = 0.85
TURN_S = 0.08  # of multiplications, like a turn of the kernel
PUBLISHED = PaperSettings()
PIECES = PUBLISHED.subpopulations
POINTS = "points, blocks of 16"
PRECISIONS = ("float64", "float32")


class Problem:
    """Observations of the swdt82 and candidates of its 38 row parameters."""

    def __init__(self, poses: int, candidates: int) -> None:
        rng = np.random.default_rng(0)
        rig = shipped_rig("swdt82")
        self.chain = chain = Chain(rig, {"": Placement.identity()})
        self.poses, self.prisms = poses, len(rig.prisms)
        readings = np.column_stack([rng.uniform(*j.limits, poses) for j in rig.joints])
        self.data = ChainData(
            np.repeat(readings, self.prisms, axis=0),
            np.tile(np.arange(self.prisms), poses),
            np.zeros(poses * self.prisms, dtype=np.intp),
        )
        self.readings = readings
        self.free: NDArray[np.bool_] = np.array([p.kind == "row" for p in chain.parameters])
        width = np.where([p.unit == "mm" for p in chain.parameters], 200.0, np.radians(6.0))
        self.full = np.where(self.free, rng.uniform(-1, 1, (candidates, len(chain))) * width, 0.0)
        self.population = np.ascontiguousarray(self.full[:, self.free])
        truth = np.where(self.free, rng.uniform(-0.5, 0.5, len(chain)) * width, 0.0)
        self.reference = NumpyChain(chain)
        self.measured = chain.positions_mm(truth, self.data) + rng.normal(0, 3, (len(self.data), 3))

    def fitness(self, precision: str) -> Fitness:
        weight = np.ones(len(self.data))
        return Fitness.build(
            self.chain,
            self.data,
            self.measured,
            weight,
            free=self.free,
            precision="float32" if precision == "float32" else "float64",
        )

    @property
    def flops(self) -> float:
        """Floating-point operations of a candidate by the usual count, an addition or multiplication each: 26 for each
        row on a prism's path, 6 for each beta, 8 for the square. The kernel needs fewer; the count is the same work's.
        """
        rows = sum(prism.frame for prism in self.chain.rig.prisms)
        betas = sum(
            "beta" in self.chain.rig.rows[row - 1].identify
            for prism in self.chain.rig.prisms
            for row in self.chain.rig.path(prism.frame)
        )
        return self.poses * (26.0 * rows + 6.0 * betas + 8.0 * self.prisms)

    # -- the same sums in NumPy --------------------------------------------------------------------------------------

    def by_reference(self, candidates: Floats) -> Floats:
        """Transform by transform, one candidate at a time."""
        return np.array([((self.reference.positions_mm(x, self.data) - self.measured) ** 2).sum() for x in candidates])

    def by_matrices(self, candidates: Floats) -> Floats:
        """One 4 x 4 matrix for each row, for all candidates and poses at once."""
        chain, rig = self.chain, self.chain.rig
        measured = self.measured.reshape(self.poses, self.prisms, 3)
        value = {p.name: candidates[:, [i]] for i, p in enumerate(chain.parameters)}
        joint = dict(zip(rig.joint_names, self.readings.T, strict=True))
        zero = np.zeros((len(candidates), 1))
        total = np.zeros(len(candidates))
        transform = np.eye(4)
        for number, row in enumerate(rig.rows, 1):

            def size(constant: str, unit: float, number: int = number, row: Row = row) -> Floats:
                nominal = float(getattr(row, f"{constant}_{'deg' if unit != 1.0 else 'mm'}"))
                drive = row.drive.get(cast("Driven", constant), {})  # of alpha and beta there is none
                driven = sum((c * joint[name] for name, c in drive.items()), np.zeros(1))
                own: Floats = (nominal + driven) * unit + value.get(f"row{number}.{constant}", zero)
                return own

            degree = np.radians(1.0)
            a, d = size("a", 1.0), size("d", 1.0)
            alpha, theta, beta = size("alpha", degree), size("theta", degree), size("beta", degree)
            ca, sa, ct, st, cb, sb = (f(angle) for angle in (alpha, theta, beta) for f in (np.cos, np.sin))
            own = np.zeros((len(candidates), self.poses, 4, 4))
            own[..., 0, 0], own[..., 0, 1], own[..., 0, 2], own[..., 0, 3] = ct * cb, -st, ct * sb, a
            own[..., 1, 0], own[..., 1, 1] = st * ca * cb + sa * sb, ct * ca
            own[..., 1, 2], own[..., 1, 3] = st * ca * sb - sa * cb, -d * sa
            own[..., 2, 0], own[..., 2, 1] = st * sa * cb - ca * sb, ct * sa
            own[..., 2, 2], own[..., 2, 3] = st * sa * sb + ca * cb, d * ca
            own[..., 3, 3] = 1.0
            transform = transform @ own
            for i, prism in enumerate(rig.prisms):
                if prism.frame == number:
                    at = transform[..., :3, :3] @ np.array(prism.offset_mm) + transform[..., :3, 3]
                    total += ((at - measured[:, i]) ** 2).sum(axis=(1, 2))
        return total

    def by_points(self, candidates: Floats) -> Floats:
        """The prisms' points carried back to the base, for all candidates and poses at once."""
        total = np.zeros(len(candidates))
        measured = self.measured.reshape(self.poses, self.prisms, 3)
        for prism in range(self.prisms):
            point = [np.zeros((len(candidates), self.poses)) for _ in range(3)]
            for op in reversed(self.chain.prism_chain(prism)):
                size = op.driven(self.readings) if op.drive else np.array([op.constant])
                if op.parameter >= 0:
                    size = size + candidates[:, [op.parameter]]
                if op.rotates:
                    c, s = np.cos(size), np.sin(size)
                    u, v = point[(op.axis + 1) % 3], point[(op.axis + 2) % 3]
                    point[(op.axis + 1) % 3], point[(op.axis + 2) % 3] = c * u - s * v, s * u + c * v
                else:
                    point[op.axis] = point[op.axis] + size
            for axis in range(3):
                total += ((point[axis] - measured[:, prism, axis]) ** 2).sum(axis=1)
        return total


class Stopwatch:
    """Least times of named pieces of work, taken in turn so that a disturbance meets them all.

    Args:
        work: name -> what is timed.
        seconds: how long the measurement lasts at least, after each was done once without; three repetitions at least.
    """

    def __init__(self, work: dict[str, Callable[[], object]], seconds: float) -> None:
        self._all: dict[str, list[float]] = {name: [] for name in work}
        for do in work.values():
            do()
        begun = time.perf_counter()
        while len(self._all[next(iter(work))]) < 3 or time.perf_counter() - begun < seconds:
            for name, do in work.items():
                started = time.perf_counter()
                do()
                self._all[name].append(time.perf_counter() - started)

    @property
    def seconds(self) -> dict[str, float]:
        """Name -> least time."""
        return {name: min(times) for name, times in self._all.items()}

    def within_a_tenth(self, name: str) -> float:
        """Share of the repetitions that took no more than a tenth longer than the least."""
        times = self._all[name]
        return sum(t <= 1.1 * min(times) for t in times) / len(times)


def multiply(precision: str, size: int = 512) -> Callable[[], object]:
    """The machine's own matrix multiply."""
    matrix = np.random.default_rng(0).normal(size=(size, size)).astype(precision)
    return lambda: matrix @ matrix


def compare_with_numpy(executor: ThreadPoolExecutor, duration_s: float) -> None:
    """The first table."""
    problem = Problem(POSES, CANDIDATES)
    fitness = {p: problem.fitness(p) for p in PRECISIONS}
    for precision in PRECISIONS:
        started = time.perf_counter()
        fitness[precision](problem.population[:1])
        print(f"first call {precision}: {time.perf_counter() - started:.2f} s (compiles unless numba's cache has it)")
    few = problem.full[:REFERENCE_CANDIDATES]
    expected = problem.by_reference(few)
    for form in (problem.by_matrices, problem.by_points):
        np.testing.assert_allclose(form(few), expected, rtol=1e-9)
    for precision in PRECISIONS:
        error = np.abs(fitness[precision](problem.population[: len(few)]) / expected - 1.0).max()
        print(f"largest relative error {precision}: {error:.1e}")
    numpy_forms: dict[str, Callable[[], object]] = {
        "reference, one candidate at a time": lambda: problem.by_reference(few[:4]),
        "matrices, one candidate at a time": lambda: [problem.by_matrices(x[None]) for x in few[:4]],
        "matrices, blocks of 4": lambda: problem.by_matrices(few[:4]),
        "matrices, blocks of 16": lambda: problem.by_matrices(few),
        POINTS: lambda: problem.by_points(few),
    }
    count = {name: 16 if name.endswith("16") else 4 for name in numpy_forms}
    kernels: dict[str, Callable[[], object]] = {}
    for precision in PRECISIONS:
        kernels[f"{precision} 1"] = partial(fitness[precision], problem.population)
        kernels[f"{precision} 2"] = partial(evaluate, fitness[precision], problem.population, executor, PIECES)
    products = {f"multiply {precision}": multiply(precision) for precision in PRECISIONS}
    seconds = Stopwatch({**numpy_forms, **kernels, **products}, duration_s).seconds
    numpy_us = {name: seconds[name] / count[name] * 1e6 for name in numpy_forms}
    single = min(us for name, us in numpy_us.items() if name.endswith("at a time"))
    blocks = min(us for name, us in numpy_us.items() if name.startswith("matrices, blocks"))
    print(f"\n{POSES} poses x {problem.prisms} prisms, {problem.population.shape[1]} parameters, us for each candidate")
    for name, us in numpy_us.items():
        print(f"  NumPy {name:36} {us:8.1f}")
    for precision in PRECISIONS:
        peak = 2.0 * 512**3 / seconds[f"multiply {precision}"] / 1e9
        for threads in (1, 2):
            us = seconds[f"{precision} {threads}"] / CANDIDATES * 1e6
            rate = f"{problem.flops / us / 1e3:5.1f} GFLOP/s (matrix multiply, one thread: {peak:.0f})"
            print(f"  {precision}, {threads} thread(s) {us:8.3f}  {rate}  NumPy / {single / us:.0f}")
        verdict = "met" if single / us >= BARS[precision] else "MISSED"
        print(f"  bar {precision}: NumPy / {BARS[precision]:.0f} on two threads: {verdict}")
        print(f"    blocks of candidates / {blocks / us:.0f}; points / {numpy_us[POINTS] / us:.0f}")


def scale_with_poses(executor: ThreadPoolExecutor, duration_s: float, all_poses: Sequence[int]) -> None:
    """The second table, for as many observations as the published population has at 200 poses.

    Efficiency is that of the least times. A virtual machine's neighbours slow one of its cores, or both, for seconds at
    a time: by a quarter where they use the other half of a core, to a half where both of its own are halves of one. How
    often the least times were met within a tenth is printed beside them, and what two threads reach where nothing is
    shared: matrix multiplications that take as long, measured in the same way.
    """
    product = multiply("float64")
    product_s = Stopwatch({"": product}, 0.2).seconds[""]
    work: dict[str, Callable[[], object]] = {}
    for poses in all_poses:
        problem = Problem(poses, PUBLISHED.population * POSES // poses)
        for precision in PRECISIONS:
            fitness = problem.fitness(precision)
            work[f"{poses} {precision} 1"] = partial(fitness, problem.population)
            work[f"{poses} {precision} 2"] = partial(evaluate, fitness, problem.population, executor, PIECES)
    products = [product] * 2 * math.ceil(TURN_S / product_s / 2.0)
    work["products 1"] = lambda: [do() for do in products]
    work["products 2"] = lambda: list(executor.map(lambda do: do(), products))
    watch = Stopwatch(work, duration_s)
    print("\n poses  precision  us/candidate  ns/candidate/pose  2 threads  efficiency  within a tenth")
    worst = np.inf
    for poses in all_poses:
        candidates = PUBLISHED.population * POSES // poses
        for precision in PRECISIONS:
            one, two = (watch.seconds[f"{poses} {precision} {threads}"] / candidates * 1e6 for threads in (1, 2))
            worst = min(worst, one / two / 2.0)
            often = watch.within_a_tenth(f"{poses} {precision} 2")
            print(
                f"{poses:6}  {precision}  {one:12.2f}  {one / poses * 1e3:17.2f}  {two:9.2f}  {one / two / 2.0:10.2f}  "
                f"{often:14.0%}"
            )
    reached = watch.seconds["products 1"] / watch.seconds["products 2"] / 2.0
    print(f"multiplications: {reached:.2f}, {watch.within_a_tenth('products 2'):.0%} of the time within a tenth")
    verdict = "met" if worst >= EFFICIENCY_BAR else "MISSED"
    print(f"bar: efficiency on two threads >= {EFFICIENCY_BAR}: {verdict} (least {worst:.2f})")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="how long each group of figures is measured")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"numpy {np.__version__}, numba {numba.__version__}, Python {sys.version.split()[0]}; load {load:.1f}")
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(2) as executor:
        compare_with_numpy(executor, options.seconds)
        scale_with_poses(executor, 45.0 * options.seconds, (200, 2_000, 20_000))


if __name__ == "__main__":
    main()
