"""How many standstills of check sessions it takes until a better model is found better, and a worse one never.

Simulated booms: the live model is trained on 15 poses, the candidate on 80. Both are held against each other on check
standstills that neither has seen, in either direction. `python -m tests.bench.promotion [--first 1000] [--machines 12]`
"""

from __future__ import annotations

import argparse
from statistics import fmean

from calibration.evaluation.promotion import compare_held_out
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from daemon.rig_files import load_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

LIVE_POSES, CANDIDATE_POSES = 15, 80
STANDSTILLS = (4, 10, 20, 40)
PRISMS = ("r", "s")
SOURCE = load_rig("swdt82")


def measured(truth: RigTruth, poses: int, seed: int) -> Observations:
    data = simulate_observations(truth, poses, seed, setup="S1", prisms=PRISMS)
    return parse_observations(data.csv_text().encode(), SOURCE.rig, "simulated.csv")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--machines", type=int, default=12)
    options = parser.parse_args()
    better = dict.fromkeys(STANDSTILLS, 0)
    worse = dict.fromkeys(STANDSTILLS, 0)
    gains = []
    for seed in range(options.first, options.first + options.machines):
        truth = RigTruth(SOURCE.rig, seed)
        live = identify(SOURCE.rig, SOURCE.text, measured(truth, LIVE_POSES, seed))
        candidate = identify(SOURCE.rig, SOURCE.text, measured(truth, CANDIDATE_POSES, seed + 5000))
        for count in STANDSTILLS:
            checks = measured(truth, count, seed + 9000)
            found = compare_held_out(candidate, live, checks)
            better[count] += found.is_better
            worse[count] += compare_held_out(live, candidate, checks).is_better
        gains.append(1.0 - found.after_mm / found.before_mm)
    print(f"{options.machines} machines; on {STANDSTILLS[-1]} standstills the error falls by {fmean(gains):.0%}")
    print("standstills   better found   worse taken for better")
    for count in STANDSTILLS:
        print(f"{count:11d}   {better[count]:12d}   {worse[count]:22d}")


if __name__ == "__main__":
    main()
