"""The second paper's Table 4 on simulated YS100s, rigcal's default as its last row: `python -m tests.bench.table4`.

Each seed is a robot of its own (tests/calibration/simulated_ys100.py), with reducers that stiffen under load or, with
`--reducers linear`, springs. Every method sees the same 50 poses and is judged on 50 others. Which way the robot faces
is no matter of its torques, so RBF-TCM needs poses in which joint 1 hardly turns: `--swing 20` gives it those.
"""

from __future__ import annotations

import argparse

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.effects.context import EffectContext
from calibration.effects.fitted import coefficient_values, corrected, fitted_columns
from calibration.evaluation.evaluation import evaluate
from calibration.gap.adoption import Adopted
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations
from calibration.pipeline.calibrate import calibrate
from calibration.published.second_paper import km, skcm
from calibration.residual.features import usable_torques
from calibration.residual.folds import group_labels, standstill_labels
from calibration.residual.selection import torque_compensation
from calibration.rig.description import Rig
from calibration.run_settings import Run
from tests.calibration.conftest import features, rig_text
from tests.calibration.simulated_ys100 import linear, robot, stiffening

METHODS = ("nominal", "KM", "SKCM", "RBF-TCM", "rigcal")
COLUMNS = ("mean", "max", "std")
PAPER = {
    "nominal": (14.1106, 32.3303, 5.9835),
    "KM": (0.7245, 1.7584, 0.3814),
    "SKCM": (0.6398, 1.7031, 0.3214),
    "RBF-TCM": (0.2802, 0.7846, 0.2084),
}


def table(rig: Rig, training: Observations, held_out: Observations, seed: int) -> Floats:
    """(methods, 3) mean, greatest and standard deviation of the errors on the held-out poses, mm."""
    geometric = km(rig, training, Run())
    compliant = skcm(rig, training, Run())
    model, _ = calibrate(rig, rig_text("ys100"), training, run=Run(seed))
    errors = (
        _error_mm(geometric, geometric.nominal.x, held_out),
        _error_mm(geometric, geometric.fit.x, held_out),
        _with_effects_mm(compliant, held_out),
        _compensated_mm(geometric, training, held_out, seed),
        evaluate(model, held_out).errors_mm["hybrid"],
    )
    norms = [np.linalg.norm(error, axis=1) for error in errors]
    return np.array([(norm.mean(), norm.max(), norm.std()) for norm in norms])


def _error_mm(solution: Solution, x: Floats, observations: Observations) -> Floats:
    chain = solution.chain
    error: Floats = observations.position_mm - chain.positions_mm(x[: len(chain)], chain.bind(observations))
    return error


def _with_effects_mm(found: Adopted, observations: Observations) -> Floats:
    solution, names = found.solution, found.solution.chain.rig.joint_names
    context = EffectContext(solution.chain, solution.fit.x[: len(solution.chain)], observations)
    change = fitted_columns(found.effects, context).change(coefficient_values(found.effects), len(names))
    return _error_mm(solution, solution.fit.x, corrected(observations, change, names))


def _compensated_mm(solution: Solution, training: Observations, held_out: Observations, seed: int) -> Floats:
    chain, x = solution.chain, solution.fit.x
    rotation = chain.base(x, 0).rotation
    names = usable_torques(chain, x, training)
    decision = torque_compensation(
        features(chain, x, training, names),
        _error_mm(solution, x, training) @ rotation,
        group_labels(training),
        standstill_labels(training),
        names,
        seed=seed,
    )
    error = _error_mm(solution, x, held_out)
    if decision.residual is None:
        return error
    return error - decision.residual.predict(features(chain, x, held_out, names)) @ rotation.T


def main() -> None:
    """Print the tables of all seeds and their mean beside the paper's."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--reducers", choices=("stiffening", "linear"), default="stiffening")
    parser.add_argument("--swing", type=float, help="joint 1 within +- so many degrees; its limits by default")
    options = parser.parse_args()
    reducers = stiffening if options.reducers == "stiffening" else linear
    print("seed   " + "".join(f"{method:>24}" for method in METHODS) + "   (mean, max, std of 50 held-out poses, mm)")
    tables = []
    for seed in range(options.first, options.first + options.seeds):
        with threadpool_limits(1, user_api="blas"):
            found = table(*robot(seed, reducers(seed), options.swing), seed)
        tables.append(found)
        cells = (f"{mean:10.4f}{most:7.3f}{std:7.3f}" for mean, most, std in found)
        print(f"{seed:6d} " + "".join(cells), flush=True)
    every = np.array(tables)
    print(f"\nmean of {len(every)} robots, {options.reducers} reducers; in brackets the paper's robot")
    print(f"{'':10}" + "".join(f"{column + ' mm':>20}" for column in COLUMNS))
    for row, method in enumerate(METHODS):
        paper = PAPER.get(method)
        beside = [f"({value:7.4f})" if paper else "" for value in paper or (0.0,) * 3]
        cells = (f"{value:10.4f} {text:9}" for value, text in zip(every[:, row].mean(axis=0), beside, strict=True))
        print(f"{method:10}" + "".join(cells))
    lowest = (every[:, -1] < every[:, :-1].min(axis=1)).sum(axis=0)
    print(
        "rigcal is the lowest: " + ", ".join(f"{n} of {len(every)} ({c})" for n, c in zip(lowest, COLUMNS, strict=True))
    )


if __name__ == "__main__":
    main()
