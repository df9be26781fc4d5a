"""Public robots from URDF to a calibrated model and out again: `python -m tests.bench.robots [--only NAME]`.

Each robot of `tests.robots` is imported, checked, simulated, calibrated, judged on other poses of the same machine, and
exported, all by the commands of `rigcal`; the exported URDF is compared with the model by pinocchio.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from calibration.export.correction_grid import Machine, trained_ranges
from calibration.export.model_export import Export, without_parts
from daemon.models.model_files import read_model
from tests.commands import answer_apart
from tests.robots import ROBOTS, Pinocchio, Robot

POSES, HELD_OUT, COMPARED = 300, 200, 50
RATIO_BAR, EXACT_MM = 1.06, 1e-9


def run(name: str, robot: Robot, directory: Path, seed: int) -> bool:
    """Print the line of a robot; True if it is within the bars."""
    rig, model = str(directory / f"{name}.toml"), str(directory / name)
    train, test = (str(directory / f"{name}-{part}.csv") for part in ("train", "test"))
    answer_apart("rig", "import", str(robot.path), *robot.options, "--out", rig)
    checked = answer_apart("rig", "check", rig)["identifiability"]
    machine = ["simulate", "--rig", rig, "--seed", str(seed)]
    answer_apart(*machine, "--poses", str(POSES), "--out", train)
    noise_mm = answer_apart(*machine, "--poses", str(HELD_OUT), "--recording", "1", "--out", test)["noise_rms_mm"]
    plain = ["--effects", "none", "--residual", "none"]
    found = answer_apart("calibrate", "--rig", rig, "--data", train, *plain, "--out", model)
    stages = {s["stage"]: s["rms_mm"] for s in answer_apart("evaluate", "--model", model, "--data", test)["stages"]}
    answer_apart("model", "export", "--model", model, "--format", "urdf", "--out", model)
    off_mm = _against_pinocchio(Path(model))
    ratio = stages["geometric"] / noise_mm
    print(
        f"{name:10} {checked['rank']:3} of {checked['parameters']:3} parameters, nominal {stages['nominal']:6.3f}, "
        f"held out {stages['geometric']:.4f} mm, over the noise {ratio:.4f}, pinocchio {off_mm:.1e} mm, "
        f"{found['seconds']:.0f} s",
        flush=True,
    )
    return ratio <= RATIO_BAR and off_mm <= EXACT_MM


def _against_pinocchio(directory: Path) -> float:
    """Greatest difference of the exported URDF by pinocchio and the model's kinematics, mm."""
    model = read_model(directory)
    text = (directory / "model.urdf").read_text(encoding="utf-8")
    low, high = trained_ranges(model)
    poses = np.random.default_rng(0).uniform(low, high, (COMPARED, len(low)))
    machine = Machine(without_parts(model, ()), Export(model, "").setup)
    wanted = np.stack([machine.corrected_mm(prism, poses) for prism in model.rig.prism_names], axis=1)
    return float(np.abs(Pinocchio(text, model.rig.joints).places_mm(model.rig.prism_names, poses) - wanted).max())


def main() -> int:
    """Run all robots, or one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=tuple(ROBOTS))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chosen = {options.only: ROBOTS[options.only]} if options.only else ROBOTS
    with tempfile.TemporaryDirectory() as directory:
        good = [run(name, robot, Path(directory), options.seed) for name, robot in chosen.items()]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
