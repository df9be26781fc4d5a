"""Measured UR10 data, 70/30 by 100 mm workspace cells, through the command line: `python -m tests.bench.ur10`.

Prints the held-out RMS of every stage, how long the command took, start-up and report included, how large its model is
on disk, and how long that takes to predict 10,000 poses. Twice for each division: with the effects that the data ask
for (`--effects auto`), and with a curve at every joint that moves the prism. Before them the least that kinematics can
leave there: what they leave of the held-out rows when fitted to these themselves.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.observations import format_observations, parse_observations
from calibration.rig import shipped_rig
from daemon.modelfiles import read_model

DATA = Path(__file__).parents[1] / "data"
SHARE = 0.7
CURVES = ",".join(f"joint_error_map@q{joint}" for joint in range(1, 6))  # the prism stands on the axis of q6
MANY, REPETITIONS = 10_000, 10


def split(name: str, seed: int, directory: Path) -> tuple[Path, Path]:
    """Write the data as two files that share no cell: (training, held out)."""
    rig = shipped_rig("ur10")
    table = parse_observations((DATA / f"{name}.csv").read_bytes(), rig, name)
    cells = table.cells()
    order = np.random.default_rng(seed).permutation(np.unique(cells))
    training = np.isin(cells, order[: round(SHARE * len(order))])
    paths = directory / "training.csv", directory / "held_out.csv"
    for path, rows in zip(paths, (training, ~training), strict=True):
        path.write_text(format_observations(table.select(rows), rig), encoding="utf-8")
    return paths


def predict_seconds(model: Path, data: Path) -> float:
    """Of many poses, the least of several repetitions on two threads."""
    loaded = read_model(model)
    table = parse_observations(data.read_bytes(), loaded.rig, data.name)
    many = table.select(np.resize(np.arange(len(table)), MANY))
    seconds = []
    with ThreadPoolExecutor(2) as pool, threadpool_limits(1, user_api="blas"):
        for _ in range(REPETITIONS):
            started = time.monotonic()
            loaded.predict(many, pool)
            seconds.append(time.monotonic() - started)
    return min(seconds)


def main() -> None:
    """Print two lines for each seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="ur10_random_poses", choices=("ur10_random_poses", "ur10_iso_cubes"))
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    print(f"{options.data}: RMS on held-out cells, mm")
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as scratch:
            training, held_out = split(options.data, seed, Path(scratch))
            floor = Path(scratch) / "floor"
            _calibrate(held_out, "none", floor, "--residual", "none")
            geometric = next(s for s in _stages(floor, held_out) if s["stage"] == "geometric")
            print(f"seed {seed}, kinematics fitted to the held-out rows: {geometric['rms_mm']:.3f}")
            for name, effects in (("auto", "auto"), ("curves", CURVES)):
                _print_line(f"seed {seed}, {name}", training, held_out, effects, Path(scratch) / name)


def _print_line(label: str, training: Path, held_out: Path, effects: str, model: Path) -> None:
    started = time.monotonic()
    _calibrate(training, effects, model)
    seconds = time.monotonic() - started
    figures = "  ".join(f"{stage['stage']} {stage['rms_mm']:.3f}" for stage in _stages(model, held_out))
    megabytes = sum(file.stat().st_size for file in model.rglob("*") if file.is_file()) / 1e6
    print(
        f"{label}: {figures}   calibrate took {seconds:.1f} s, the model has {megabytes:.1f} MB, "
        f"{MANY:,} predictions take {1e3 * predict_seconds(model, held_out):.0f} ms",
        flush=True,
    )


def _calibrate(data: Path, effects: str, model: Path, *options: str) -> None:
    _rigcal("calibrate", "--rig", "ur10", "--data", str(data), "--out", str(model), "--effects", effects, *options)


def _stages(model: Path, data: Path) -> list[dict[str, Any]]:
    stages: list[dict[str, Any]] = _rigcal("evaluate", "--model", str(model), "--data", str(data))["stages"]
    return stages


def _rigcal(*arguments: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "daemon.cli.main", *arguments, "--json"]
    result: dict[str, Any] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return result


if __name__ == "__main__":
    main()
