"""Identification from far off: `python -m tests.bench.far_starts [--seeds 20] [--first 1000]`.

Booms whose rows are uniformly wrong within +-400 mm and +-6 or +-30 deg of the rig file, 200 poses x 4 prisms, 3 mm of
noise, two threads. With base and prisms known, the 38 parameters of the rows are found; else everything, as
`calibrate --prior as-built` does it, from fixes of the simulator's machine in any place. A seed counts as found where
the RMS is within 0.1 % of that of the refinement that starts at the truth.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from threadpoolctl import threadpool_limits

from calibration.errors import CalibrationError
from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import refine
from calibration.identification.samples import averaged
from calibration.identification.solve import solve
from calibration.identification.start import PRIOR_SCALE, approach
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import parse_observations
from calibration.rig.description import Rig, shipped_rig
from calibration.run_settings import Run
from simulators.rig.truth import RigTruth
from tests.bench.boom import NOISE_MM, boom
from tests.calibration.conftest import rms
from tests.simulated.observations import simulate_observations

POSES, REACH_MM = 200, 400.0
WITHIN = 1.001


@dataclass(frozen=True)
class Outcome:
    """RMS found and at the optimum, mm, and seconds; infinity where the data were refused."""

    found_mm: float
    optimum_mm: float
    seconds: float

    @property
    def is_there(self) -> bool:
        return self.found_mm < WITHIN * self.optimum_mm


def moved(rig: Rig, seed: int, reach_deg: float) -> tuple[Rig, dict[str, float]]:
    """A rig with other row constants, and by how much, rad and mm, under the names of the parameters."""
    rng = np.random.default_rng([seed, 77])
    rows, deviation = [], {}
    for number, row in enumerate(rig.rows, 1):
        changed: dict[str, float] = {}
        for name in row.identify:
            angle = f"{name}_deg" in type(row).model_fields
            key, reach = (f"{name}_deg", reach_deg) if angle else (f"{name}_mm", REACH_MM)
            change = float(rng.uniform(-reach, reach))
            changed[key] = getattr(row, key) + change
            deviation[f"row{number}.{name}"] = np.radians(change) if angle else change
        rows.append(row.model_copy(update=changed))
    return rig.model_copy(update={"rows": tuple(rows)}), deviation


def known_base(seed: int, reach_deg: float) -> Outcome:
    """The 38 parameters of the rows, base and prisms known."""
    drawn = boom(seed, POSES, REACH_MM, reach_deg)
    chain, samples = drawn.chain, drawn.samples
    began = time.perf_counter()
    precision = prior_precision(chain, PRIOR_SCALE["as-built"])
    near = approach(chain, samples, np.zeros(len(chain)), precision=precision, free=drawn.free)
    fit = refine(chain, samples, near, free=drawn.free, prior="as-built")
    seconds = time.perf_counter() - began
    found = rms(samples.position_mm - chain.positions_mm(fit.x, samples.data))
    return Outcome(found, drawn.rms_mm(drawn.optimum), seconds)


def all_unknown(seed: int, reach_deg: float) -> Outcome:
    """Base, rows and prisms."""
    rig = shipped_rig("swdt82")
    true_rig, deviation = moved(rig, seed, reach_deg)
    truth = RigTruth(true_rig, seed, perturbation=0.0)
    simulated = simulate_observations(truth, POSES, seed, noise_mm=NOISE_MM)
    observations = parse_observations(simulated.csv_text().encode(), rig, "simulated.csv")
    place = truth.placement()
    chain = Chain(rig, {"": Placement(place.rotation, place.position_mm)})
    samples = averaged(chain, observations)
    start = np.array([deviation.get(p.name, 0.0) for p in chain.parameters])
    best = refine(chain, samples, start, prior="as-built")
    optimum = rms(samples.position_mm - chain.positions_mm(best.x, samples.data))
    with ThreadPoolExecutor(2) as pool:
        began = time.perf_counter()
        try:
            found = solve(rig, observations, prior="as-built", run=Run(0, pool))
        except CalibrationError as error:
            print(f"    seed {seed}: {error}")
            return Outcome(np.inf, optimum, time.perf_counter() - began)
        seconds = time.perf_counter() - began
    error_mm = found.samples.position_mm - found.chain.positions_mm(found.fit.x, found.samples.data)
    return Outcome(rms(error_mm), optimum, seconds)


def main() -> None:
    """Print a line for each problem."""
    parser = argparse.ArgumentParser(description="Identification from far off.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    options = parser.parse_args()
    problems: tuple[tuple[str, Callable[[int, float], Outcome]], ...] = (
        ("base and prisms known", known_base),
        ("everything unknown", all_unknown),
    )
    print(f"Python {platform.python_version()}, numpy {np.__version__}, numba {numba.__version__}")
    with threadpool_limits(1, user_api="blas"):
        for name, run in problems:
            run(0, 6.0)  # compiles
            for reach_deg in (6.0, 30.0):
                outcomes = [run(seed, reach_deg) for seed in range(options.first, options.first + options.seeds)]
                seconds = [o.seconds for o in outcomes]
                print(
                    f"{name}, +-{REACH_MM:.0f} mm, +-{reach_deg:.0f} deg: {sum(o.is_there for o in outcomes)} of "
                    f"{len(outcomes)} found; seconds median {np.median(seconds):.2f}, greatest {max(seconds):.2f}; "
                    f"RMS over the optimum's at most {max(o.found_mm / o.optimum_mm for o in outcomes):.5f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
