"""Refinement alone, 250 poses x 4 prisms of the boom: `python -m tests.bench.refinement [--repetitions 20] [--json]`.

Timed side by side, on one BLAS thread each: `refine` from the nominal model, with noise, outliers and covariance
estimated; and scipy's `least_squares` on the same residuals (errors whitened with the noise that `refine` found, and
the priors) with the analytic Jacobian of the NumPy reference, which estimates nothing beside the parameters. Below it,
the same with the compiled Jacobian, and one linearisation each. Nothing here has a second thread, so the processor's
time is what the clock would say on a machine that has nothing else to do.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import refine
from calibration.identification.samples import Samples, averaged
from calibration.identification.start import rough_start
from calibration.kinematics.chain import Chain, Linearisation, Placement
from calibration.observations import Floats, parse_observations
from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.kinematics.numpy_chain import NumpyChain
from tests.simulated.observations import simulate_observations

POSES, NOISE_MM, TARGET_MS = 250, 3.0, 50.0


def problem(seed: int) -> tuple[Chain, Samples, Floats]:
    """Chain, samples and the nominal model's parameters."""
    rig = shipped_rig("swdt82")
    data = simulate_observations(RigTruth(rig, seed), POSES, seed, noise_mm=NOISE_MM)
    table = parse_observations(data.csv_text().encode(), rig, "simulated.csv")
    blank = Chain(rig, {"": Placement.identity()})
    samples = averaged(blank, table)
    start = rough_start(blank, samples, np.zeros(len(blank)))
    chain = Chain(rig, start.placements)
    return chain, samples, refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma)).x


class Residuals:
    """Whitened errors and priors with their Jacobian, as `least_squares` wants them."""

    def __init__(
        self, chain: Chain, samples: Samples, x: Floats, excess: float, linearise: Callable[..., Linearisation]
    ) -> None:
        self._samples, self._linearise = samples, linearise
        lin = linearise(x, samples.data)
        covariance = samples.covariance(chain.rig, lin.joint_jacobian)
        self._whiten = np.linalg.inv(np.linalg.cholesky(covariance + excess * np.eye(3)))
        self._prior = np.sqrt(prior_precision(chain, 1.0))

    def __call__(self, x: Floats) -> Floats:
        error = self._linearise(x, self._samples.data).position_mm - self._samples.position_mm
        return np.concatenate([(self._whiten @ error[:, :, None]).ravel(), self._prior * x])

    def jacobian(self, x: Floats) -> Floats:
        rows = (self._whiten @ self._linearise(x, self._samples.data).jacobian).reshape(-1, len(x))
        return np.concatenate([rows, np.diag(self._prior)])


def main() -> None:
    parser = argparse.ArgumentParser(description="Refinement alone, beside scipy's least_squares.")
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    chain, samples, nominal = problem(options.seed)
    fit = refine(chain, samples, nominal)
    in_numpy = NumpyChain(chain)
    peers = {
        "least_squares": Residuals(chain, samples, fit.x, fit.excess_variance, in_numpy.linearise),
        "least_squares_compiled": Residuals(chain, samples, fit.x, fit.excess_variance, chain.linearise),
    }
    runs: dict[str, Callable[[], object]] = {"refine": lambda: refine(chain, samples, nominal)}
    for name, residuals in peers.items():
        runs[name] = partial(least_squares, residuals, nominal, jac=residuals.jacobian, x_scale="jac")
    runs["linearise_numpy"] = lambda: in_numpy.linearise(nominal, samples.data)
    runs["linearise_compiled"] = lambda: chain.linearise(nominal, samples.data)
    times: dict[str, list[float]] = {name: [] for name in runs}
    processor: dict[str, list[float]] = {name: [] for name in runs}
    with threadpool_limits(1, user_api="blas"):
        for _ in range(options.repetitions):
            for name, run in runs.items():
                began, began_processor = time.perf_counter(), time.thread_time()
                run()
                processor[name].append(1e3 * (time.thread_time() - began_processor))
                times[name].append(1e3 * (time.perf_counter() - began))
        peer: Any = least_squares(peers["least_squares"], nominal, jac=peers["least_squares"].jacobian, x_scale="jac")
    result = {
        "rows": len(samples),
        "parameters": len(chain),
        "milliseconds": {n: {"least": min(t), "median": statistics.median(t)} for n, t in times.items()},
        "processor_milliseconds": {n: min(t) for n, t in processor.items()},
        "rounds": fit.rounds,
        "processor_milliseconds_per_round": min(processor["refine"]) / fit.rounds,
        "times_faster": min(processor["least_squares"]) / min(processor["refine"]),
        "scipy": scipy.__version__,
        "scipy_evaluations": int(peer.nfev),
        "target_milliseconds": TARGET_MS,
    }
    if options.json:
        print(json.dumps(result))
        return
    print(f"{len(samples)} fixes, {len(chain)} parameters; ms by the clock, least and median of {options.repetitions}")
    for name, t in times.items():
        print(f"{name:24s} {min(t):8.2f} {statistics.median(t):8.2f}   processor, least {min(processor[name]):8.2f}")
    print(
        f"refine: {fit.rounds} rounds, {result['processor_milliseconds_per_round']:.2f} ms each; "
        f"target {TARGET_MS:g} ms; "
        f"{result['times_faster']:.1f} times as fast as least_squares of scipy {scipy.__version__} "
        f"({peer.nfev} evaluations, parameters alone)"
    )


if __name__ == "__main__":
    main()
