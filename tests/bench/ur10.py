"""Measured UR10 data, 70/30 by 100 mm workspace cells, through the command line: `python -m tests.bench.ur10`.

Prints the held-out RMS of every stage and how long the commands took, start-up and report included.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from calibration.observations import format_observations, parse_observations
from calibration.rig import shipped_rig

DATA = Path(__file__).parents[1] / "data"
SHARE = 0.7


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


def main() -> None:
    """Print a line for each seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="ur10_random_poses", choices=("ur10_random_poses", "ur10_iso_cubes"))
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    print(f"{options.data}: RMS on held-out cells, mm")
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as scratch:
            training, held_out = split(options.data, seed, Path(scratch))
            model = str(Path(scratch) / "model")
            started = time.monotonic()
            _rigcal("calibrate", "--rig", "ur10", "--data", str(training), "--out", model)
            seconds = time.monotonic() - started
            stages = _rigcal("evaluate", "--model", model, "--data", str(held_out))["stages"]
        figures = "  ".join(f"{stage['stage']} {stage['rms_mm']:.3f}" for stage in stages)
        print(f"seed {seed}: {figures}   calibrate took {seconds:.1f} s", flush=True)


def _rigcal(*arguments: str) -> dict[str, list[dict[str, float]]]:
    command = [sys.executable, "-m", "daemon.cli.main", *arguments, "--json"]
    result: dict[str, list[dict[str, float]]] = json.loads(
        subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
    )
    return result


if __name__ == "__main__":
    main()
