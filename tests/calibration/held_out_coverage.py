"""How often 90 % intervals of predictions cover fixes that no part of the model was fitted to.

    python -m tests.calibration.held_out_coverage [--first 1000] [--seeds 10] [--fixes 250] [--data simulated|ur10]

Simulated: each seed is a machine of its own with one of three sets of hidden effects or none, 3 mm of noise on each
coordinate, calibrated without named effects so that the residual has something to learn; 600 held-out fixes in poses of
their own. `one` has one prism a pose, `all` four, whose readings err together. Measured: the UR10 data, 70/30 by 100 mm
cells. Printed are the mean shares over the seeds and their standard error: of x, y, z, of the balls, and of what the
formal standard deviation of normal errors would cover (x, y, z together).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.residual.conformal import Intervals, coverage
from calibration.rig.description import shipped_rig
from calibration.run_settings import Run
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import DATA, rig_text, split_by_cells
from tests.simulated.observations import simulate_observations

EFFECTS = (
    "",
    "boom_droop@boom,joint_compliance@theta4:compliance_rad_per_Nm=2e-8",
    "encoder_harmonic@theta1:k=2:cosk_rad=4e-3:sink_rad=3e-3,encoder_harmonic@theta4:k=2:cosk_rad=3e-3:sink_rad=3e-3",
    "backlash@theta1:width_rad=4e-3,backlash@theta4:width_rad=3e-3,boom_droop@boom",
)
HELD_OUT = 600
PrismsPerPose = Literal["one", "all"]


@dataclass(frozen=True)
class Case:
    """Training and held-out rows of one rig."""

    rig: str
    training: Observations
    held_out: Observations


def simulated_case(effects: str, prisms_per_pose: PrismsPerPose, fixes: int, seed: int) -> Case:
    """A machine with hidden effects and what was measured of it."""
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, seed, effects=parse_effects(effects) if effects else ())
    turns = 1 if prisms_per_pose == "one" else len(rig.prisms)
    training, held_out = (
        parse_observations(
            simulate_observations(truth, count // turns, number, prisms_per_pose=prisms_per_pose, noise_mm=3.0)
            .csv_text()
            .encode(),
            rig,
            "simulated.csv",
        )
        for count, number in ((fixes, seed), (HELD_OUT, seed + 500_000))
    )
    return Case(rig.name, training, held_out)


def measured_case(name: str, seed: int) -> Case:
    """The measured data, whole cells held out."""
    table = parse_observations((DATA / f"{name}.csv").read_bytes(), shipped_rig("ur10"), name)
    return Case("ur10", *split_by_cells(table, 0.7, seed))


def models(case: Case, seed: int) -> Iterator[CalibratedModel]:
    """Kinematics alone, and with what the residual's gate makes of the rest."""
    model = identify(shipped_rig(case.rig), rig_text(case.rig), case.training, effects="none", run=Run(seed))
    yield model
    yield train_residual(model, case.training, run=Run(seed))


def shares(model: CalibratedModel, held_out: Observations) -> Floats:
    """(5,) covered shares of x, y, z, of the balls, and of the axes if errors were normal."""
    prediction = Predictor.of(model).predict(held_out)
    error = held_out.position_mm - prediction.position_mm
    found = prediction.coverage(error)
    normal = coverage(error, Intervals().half_mm(prediction.formal_mm), prediction.radius_mm)
    return np.array([*found.axes, found.radius, np.mean(normal.axes)])


def report(title: str, cases: Sequence[Case]) -> None:
    """Print a line for kinematics alone and one with the residual."""
    found = [[(shares(m, case.held_out), m.residual is not None) for m in models(case, 0)] for case in cases]
    print(title)
    for stage, results in zip(("kinematics", "hybrid"), zip(*found, strict=True), strict=True):
        table = np.array([share for share, _ in results])
        error = table.std(axis=0, ddof=1) / np.sqrt(len(table)) if len(table) > 1 else np.full(5, np.nan)
        kept = sum(is_kept for _, is_kept in results)
        cells = "  ".join(f"{m:6.1%} +- {e:.1%}" for m, e in zip(table.mean(axis=0), error, strict=True))
        print(f"    {stage:10s} residual in {kept:2d} of {len(table)}   x, y, z, ball, normal: {cells}", flush=True)


def main() -> None:
    """Print the coverage of every kind of data."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--fixes", type=int, default=250)
    parser.add_argument("--data", choices=("simulated", "ur10"), default="simulated")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    if options.data == "ur10":
        for name in ("ur10_random_poses", "ur10_iso_cubes"):
            report(name, [measured_case(name, seed) for seed in seeds])
        return
    prisms: tuple[PrismsPerPose, ...] = ("one", "all")
    for per_pose in prisms:
        for effects in EFFECTS:
            title = f"{options.fixes} fixes, {per_pose} a pose, {effects or 'nothing hidden'}"
            report(title, [simulated_case(effects, per_pose, options.fixes, seed) for seed in seeds])


if __name__ == "__main__":
    with threadpool_limits(1, user_api="blas"):
        main()
