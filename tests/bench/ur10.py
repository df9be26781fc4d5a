"""Measured UR10 data, 70/30 by 100 mm workspace cells: `python -m tests.bench.ur10`.

First kinematics alone, for many divisions: fitted to the training rows, to 100 of them, and, as the least that
kinematics can leave there, to the held-out rows themselves.

Then whole calibrations of a few divisions through the command line: the held-out RMS of every stage, how long the
command took, start-up and report included, how large its model is on disk, and how long that takes to predict 10,000
poses. Twice for each: with the effects that the data ask for (`--effects auto`), and with a curve at every joint that
moves the prism.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.identification.solve import solve
from calibration.model.prediction import Predictor
from calibration.observations import Observations, format_observations, parse_observations
from calibration.rig.description import shipped_rig
from calibration.run_settings import Run
from daemon.models.model_files import read_model
from tests.commands import answer_apart

DATA = Path(__file__).parents[1] / "data"
SHARE = 0.7
FEW = 100
GEOMETRIC_BAR = 0.48
CURVES = ",".join(f"joint_error_map@q{joint}" for joint in range(1, 6))  # the prism stands on the axis of q6
MANY, REPETITIONS = 10_000, 10


def split(name: str, seed: int) -> tuple[Observations, Observations]:
    """The data in two parts that share no cell: (training, held out)."""
    table = parse_observations((DATA / f"{name}.csv").read_bytes(), shipped_rig("ur10"), name)
    cells = table.cells()
    order = np.random.default_rng(seed).permutation(np.unique(cells))
    training = np.isin(cells, order[: round(SHARE * len(order))])
    return table.select(training), table.select(~training)


def kinematics(name: str, divisions: int) -> None:
    """The first table."""
    print("seed  training rows         100 of them           held-out rows themselves")
    found = []
    with ThreadPoolExecutor(2) as pool, threadpool_limits(1, user_api="blas"):
        for seed in range(divisions):
            training, held_out = split(name, seed)
            drawn = np.sort(np.random.default_rng(seed).permutation(len(training))[:FEW])
            line = [_left(data, held_out, pool) for data in (training, training.select(drawn), held_out)]
            found.append([rms for rms, _ in line])
            print(f"{seed:4}  " + "  ".join(f"{rms:.4f} in {seconds:4.2f} s    " for rms, seconds in line), flush=True)
    print("mean  " + "  ".join(f"{rms:.4f}              " for rms in np.mean(found, axis=0)))
    print(f"at most {GEOMETRIC_BAR} mm: {sum(row[0] <= GEOMETRIC_BAR for row in found)} of {divisions} divisions\n")


def _left(data: Observations, held_out: Observations, pool: ThreadPoolExecutor) -> tuple[float, float]:
    """RMS on the held-out rows of kinematics fitted to others, and how many seconds the fit took."""
    started = time.monotonic()
    solution = solve(shipped_rig("ur10"), data, prior="recalibration", run=Run(0, pool))
    seconds = time.monotonic() - started
    chain = solution.chain
    error = held_out.position_mm - chain.positions_mm(solution.fit.x[: len(chain)], chain.bind(held_out))
    return float(np.sqrt((error**2).sum(axis=1).mean())), seconds


def predict_seconds(model: Path, data: Path) -> float:
    """Of many poses, the least of several repetitions on two threads."""
    loaded = read_model(model)
    table = parse_observations(data.read_bytes(), loaded.rig, data.name)
    many = table.select(np.resize(np.arange(len(table)), MANY))
    seconds = []
    with ThreadPoolExecutor(2) as pool, threadpool_limits(1, user_api="blas"):
        for _ in range(REPETITIONS):
            started = time.monotonic()
            Predictor.of(loaded).predict(many, pool)
            seconds.append(time.monotonic() - started)
    return min(seconds)


def main() -> None:
    """Print the table, then two lines for each seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="ur10_random_poses", choices=("ur10_random_poses", "ur10_iso_cubes"))
    parser.add_argument("--seeds", type=int, default=3, help="divisions that are calibrated with all stages")
    parser.add_argument("--divisions", type=int, default=20, help="of which kinematics alone are judged")
    options = parser.parse_args()
    print(f"{options.data}: RMS on held-out cells, mm")
    kinematics(options.data, options.divisions)
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as scratch:
            training, held_out = (Path(scratch) / f"{part}.csv" for part in ("training", "held_out"))
            for path, rows in zip((training, held_out), split(options.data, seed), strict=True):
                path.write_text(format_observations(rows, shipped_rig("ur10")), encoding="utf-8")
            for name, effects in (("auto", "auto"), ("curves", CURVES)):
                _print_line(f"seed {seed}, {name}", training, held_out, effects, Path(scratch) / name)


def _print_line(label: str, training: Path, held_out: Path, effects: str, model: Path) -> None:
    started = time.monotonic()
    answer_apart("calibrate", "--rig", "ur10", "--data", str(training), "--out", str(model), "--effects", effects)
    seconds = time.monotonic() - started
    stages = answer_apart("evaluate", "--model", str(model), "--data", str(held_out))["stages"]
    figures = "  ".join(f"{stage['stage']} {stage['rms_mm']:.3f}" for stage in stages)
    megabytes = sum(file.stat().st_size for file in model.rglob("*") if file.is_file()) / 1e6
    print(
        f"{label}: {figures}   calibrate took {seconds:.1f} s, the model has {megabytes:.1f} MB, "
        f"{MANY:,} predictions take {1e3 * predict_seconds(model, held_out):.0f} ms",
        flush=True,
    )


if __name__ == "__main__":
    main()
