"""Held-out error of identified models on simulated sessions, in units of the noise floor.

    python -m tests.calibration.simulated_sessions [--seeds 20] [--first 1000] [--prisms-per-pose one|all]

Each session is its own machine, built within its tolerances and without hidden effects: 250 fixes over the four
prisms, 3 mm of noise on each coordinate, encoder noise and steps. The noise floor is the distance of the measured
held-out fixes from where the true machine has the prism for the joints as read.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.evaluation.evaluation import evaluate
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, shipped_rig
from calibration.run_settings import Run
from simulators.rig.dataset import SimulatedObservations
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text
from tests.simulated.observations import simulate_observations

FIXES, HELD_OUT, NOISE_MM = 250, 1000, 3.0


@dataclass(frozen=True)
class Outcome:
    """One session: held-out RMS and noise, chi-square of errors in predicted sigma, share within 2 sigma, seconds."""

    seed: int
    nominal_mm: float
    geometric_mm: float
    noise_mm: float
    chi_square: float
    inside: float
    estimated_noise_mm: float
    seconds: float

    @property
    def ratio(self) -> float:
        return self.geometric_mm / self.noise_mm


def observations(simulated: SimulatedObservations, rig: Rig, fixes: int) -> Observations:
    return parse_observations(simulated.csv_text().encode(), rig, "simulated.csv").select(np.arange(fixes))


def session(seed: int, prisms_per_pose: Literal["all", "one"] = "one") -> Outcome:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, seed)
    poses = FIXES if prisms_per_pose == "one" else -(-FIXES // len(rig.prisms))
    training = simulate_observations(truth, poses, seed, prisms_per_pose=prisms_per_pose, noise_mm=NOISE_MM)
    held_out = simulate_observations(truth, HELD_OUT, seed + 500_000, prisms_per_pose="one", noise_mm=NOISE_MM)
    began = time.perf_counter()
    model = identify(rig, rig_text("swdt82"), observations(training, rig, FIXES), run=Run(seed))
    seconds = time.perf_counter() - began
    evaluation = evaluate(model, observations(held_out, rig, HELD_OUT))
    stages = {str(s["stage"]): float(s["rms_mm"]) for s in evaluation.stages()}
    deviation = evaluation.errors_mm["geometric"] / evaluation.sigma_mm
    return Outcome(
        seed,
        stages["nominal"],
        stages["geometric"],
        held_out.noise_rms_mm,
        float((deviation**2).mean()),
        float((np.abs(deviation) < 2.0).mean()),
        model.noise_mm,
        seconds,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Held-out error over noise on simulated sessions.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--prisms-per-pose", choices=["one", "all"], default="one")
    options = parser.parse_args()
    print("seed  nominal  geometric  noise   ratio  chi2   in 2 sigma  noise est.  seconds")
    outcomes: list[Outcome] = []
    for seed in range(options.first, options.first + options.seeds):
        o = session(seed, options.prisms_per_pose)
        outcomes.append(o)
        print(
            f"{o.seed:5d} {o.nominal_mm:7.1f} {o.geometric_mm:8.3f} {o.noise_mm:8.3f} {o.ratio:8.4f}"
            f" {o.chi_square:6.3f} {o.inside:8.3f} {o.estimated_noise_mm:11.3f} {o.seconds:9.2f}",
            flush=True,
        )
    ratios = np.array([o.ratio for o in outcomes])
    chi_square = np.mean([o.chi_square for o in outcomes])
    seconds = np.median([o.seconds for o in outcomes])
    print(
        f"ratio mean {ratios.mean():.4f}, greatest {ratios.max():.4f}; "
        f"chi2 mean {chi_square:.3f}; seconds median {seconds:.2f}"
    )


if __name__ == "__main__":
    main()
