"""CPU time and memory of a calibration of many rows: `python -m tests.bench.many_rows`.

A simulated UR10 with compliance, an encoder's harmonic and a wrong scale, measured at 6,000 poses; effects are searched
and residual learners compared, as by default. It runs in a process of its own, so that its peak memory is its own.
"""

from __future__ import annotations

import argparse
import resource
import time
from multiprocessing import get_context

from calibration.observations import parse_observations
from calibration.pipeline.calibrate import calibrate
from daemon.rig_files import load_rig
from simulators.blind.scene import SceneSettings, draw_scene
from simulators.effects.library import parse_effects

HIDDEN = (
    "joint_compliance@q2:compliance_rad_per_Nm=2e-6,joint_compliance@q3:compliance_rad_per_Nm=3e-6,"
    "encoder_harmonic@q2:sink_rad=2e-4,angle_scale@q3:scale=5e-4"
)
CPU_BAR_S, MEMORY_BAR_GB = 60.0, 1.0


def simulated(poses: int, seed: int) -> bytes:
    """The observations of one machine, as a file has them."""
    scene = draw_scene(load_rig("ur10").rig, seed, SceneSettings(poses=poses, held_out=1))
    return scene.observe(parse_effects(HIDDEN)).training.csv_text().encode()


def measure(table: bytes) -> str:
    """Calibrate one machine and return the line about it."""
    source = load_rig("ur10")
    observations = parse_observations(table, source.rig, "simulated.csv")
    began, wall = time.process_time(), time.monotonic()
    model, _ = calibrate(source.rig, source.text, observations)
    cpu_s, wall_s = time.process_time() - began, time.monotonic() - wall
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    named = ", ".join(f"{e.family}@{e.where}" for e in model.effects) or "nothing"
    is_met = cpu_s <= CPU_BAR_S and peak_gb <= MEMORY_BAR_GB
    bar = f"bar {CPU_BAR_S:g} s, {MEMORY_BAR_GB:g} GB: {'met' if is_met else 'MISSED'}"
    return f"{len(observations)} rows: {cpu_s:.1f} s of CPU in {wall_s:.1f} s, {peak_gb:.2f} GB ({bar}); named {named}"


def main() -> None:
    """Print a line for each number of poses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, nargs="+", default=[1_500, 3_000, 6_000])
    parser.add_argument("--seed", type=int, default=1_000_000)
    options = parser.parse_args()
    for poses in options.poses:
        with get_context("spawn").Pool(1) as pool:
            print(pool.apply(measure, (simulated(poses, options.seed),)), flush=True)


if __name__ == "__main__":
    main()
