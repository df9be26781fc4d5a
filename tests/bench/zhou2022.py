"""The first paper's section 4 on a simulated boom: `python -m tests.bench.zhou2022 [--out DIR] [--seed N]`.

The boom bends, its lift joint gives way under load and an encoder sits off its axis. It is measured as the paper's was:
every joint swept alone, then poses of all joints together; held out are a path of 200 points of the front of the feed
and other poses. The data go to DIR as CSV files, and the real command makes DIR/comparison-swdt82.html of them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.dataset import SimulatedObservations, random_poses
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

Floats = NDArray[np.float64]

EFFECTS = (
    "boom_droop@boom,"
    "joint_compliance@theta4:compliance_rad_per_Nm=2e-8,"
    "encoder_harmonic@theta3:cosk_rad=1.5e-3:sink_rad=1.0e-3:k=2"
)
PATH_POINTS, WAYPOINTS = 200, 6


def sweeps(rig: Rig, stops: int) -> dict[str, Floats]:
    """Every joint over its range in `stops` steps, the others in the middle of theirs."""
    middle = {joint.name: np.full(stops * len(rig.joints), np.mean(joint.limits)) for joint in rig.joints}
    for number, joint in enumerate(rig.joints):
        middle[joint.name][number * stops : (number + 1) * stops] = np.linspace(*joint.limits, stops)
    return middle


def path(rig: Rig, rng: np.random.Generator) -> dict[str, Floats]:
    """A smooth motion of all joints through random way-points."""
    along = np.linspace(0.0, 1.0, PATH_POINTS)
    points = random_poses(rig, WAYPOINTS, rng)
    out = {}
    for joint in rig.joints:
        spline = CubicSpline(np.linspace(0.0, 1.0, WAYPOINTS), points[joint.name])
        out[joint.name] = np.clip(spline(along), *joint.limits)
    return out


def table(parts: Mapping[str, SimulatedObservations]) -> str:
    """One CSV of several parts, one after the other in time; poses get the part's name."""
    begin_s: float = 0.0
    columns: dict[str, list[NDArray[np.generic]]] = {}
    for name, part in parts.items():
        renamed = {"pose": np.char.add(f"{name} ", part.columns["pose"].astype(np.str_))}
        later = {"time_s": np.asarray(part.columns["time_s"], dtype=np.float64) + begin_s}
        for column, values in {**part.columns, **renamed, **later}.items():
            columns.setdefault(column, []).append(values)
        begin_s = float(later["time_s"].max()) + 600.0
    whole = {name: np.concatenate(values) for name, values in columns.items()}
    return SimulatedObservations(whole, np.empty((0, 3)), np.empty((0, 3))).csv_text()


def data_sets(seed: int, poses: int, stops: int, perturbation: float, effects: str = EFFECTS) -> tuple[str, str]:
    """The training CSV and the held-out one of one boom."""
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, seed, perturbation=perturbation, effects=parse_effects(effects))
    alone = sweeps(rig, stops)
    single = simulate_observations(truth, stops * len(rig.joints), seed, poses=alone)
    multi = simulate_observations(truth, poses, seed + 1_000_000)
    moving = path(rig, np.random.default_rng([seed, 30]))
    along = simulate_observations(truth, PATH_POINTS, seed + 2_000_000, poses=moving, prisms=("r",))
    others = simulate_observations(truth, poses // 2, seed + 3_000_000)
    return table({"single": single, "multi": multi}), table({"path": along, "others": others})


def main() -> None:
    """Simulate, write, and run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="where data and page go; a new directory in /tmp by default")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--poses", type=int, default=160, help="multi-joint poses; four fixes each")
    parser.add_argument("--stops", type=int, default=11, help="of every joint's sweep")
    parser.add_argument("--perturbation", type=float, default=1.0, help="of the boom, in build tolerances")
    parser.add_argument("--prior", choices=("recalibration", "as-built"), default="recalibration")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp(prefix="zhou2022-"))
    out.mkdir(parents=True, exist_ok=True)
    training, held_out = data_sets(options.seed, options.poses, options.stops, options.perturbation)
    (out / "train.csv").write_text(training, encoding="utf-8")
    (out / "holdout.csv").write_text(held_out, encoding="utf-8")
    command = [
        sys.executable, "-m", "daemon.cli.main", "compare", "--protocol", "zhou2022", "--rig", "swdt82",
        "--data", str(out / "train.csv"), "--holdout", str(out / "holdout.csv"), "--out", str(out),
        "--prior", options.prior,
    ]  # fmt: skip
    print("$ rigcal", *command[3:], flush=True)
    raise SystemExit(subprocess.run(command, check=False).returncode)


if __name__ == "__main__":
    main()
