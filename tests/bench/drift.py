"""How check sessions score against a live model: of a boom that is as it was, and of one whose lift joint got loose.

python -m tests.bench.drift [--first 1000] [--machines 12]
"""

from __future__ import annotations

import argparse

import numpy as np

from calibration.evaluation.drift import check
from calibration.numerics.statistics import Cusum
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from daemon.rig_files import load_rig
from daemon.warm_up import prepare
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
TRAINING_POSES, CHECK_POSES, SESSIONS = 30, 4, 40
HIDDEN = {"as it was": "", "1.5 mrad of play": "backlash@theta4:width_rad=1.5e-3"}
SETUPS = {"known set-up": "S1", "new set-up": "S2"}


def observed(machine: int, hidden: str, poses: int, seed: int, setup: str) -> Observations:
    """Fixes of two prisms."""
    truth = RigTruth(SOURCE.rig, machine, effects=parse_effects(hidden))
    data = simulate_observations(truth, poses, seed, prisms=["r", "s"], setup=setup)
    return parse_observations(data.csv_text().encode(), SOURCE.rig, "simulated.csv")


def main() -> None:
    """Print a line for every kind of check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=12)
    parser.add_argument("--first", type=int, default=1000, help="Number of the first simulated machine.")
    options = parser.parse_args()
    prepare()
    machines = range(options.first, options.first + options.machines)
    live = {
        machine: identify(
            SOURCE.rig, SOURCE.text, observed(machine, "", TRAINING_POSES, 500 + machine, "S1"), effects="none"
        )
        for machine in machines
    }
    print(f"{len(machines)} booms, {SESSIONS} check sessions of {CHECK_POSES} standstills each")
    for name, hidden in HIDDEN.items():
        for place, setup in SETUPS.items():
            ratios, highest, alarms = [], 0.0, []
            for machine in machines:
                sums, alarm = Cusum(), "never"
                for number in range(SESSIONS):
                    seed = 9000 + 100 * machine + number
                    found = check(live[machine], observed(machine, hidden, CHECK_POSES, seed, setup))
                    sums = sums.after(found.scores)
                    ratios.append(found.ratio)
                    highest = max(highest, sums.upper, sums.lower)
                    if sums.alarm == "worse" and alarm == "never":
                        alarm = str(number + 1)
                alarms.append(alarm)
            ratio = float(np.sqrt(np.mean(np.square(ratios))))
            print(
                f"{name:>16}, {place:>12}: errors {ratio:.2f} times the predicted; highest sum {highest:.1f}; "
                f"alarm in session {' '.join(alarms)}"
            )


if __name__ == "__main__":
    main()
