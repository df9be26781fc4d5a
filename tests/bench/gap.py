"""How long the gap workflow takes: `python -m tests.bench.gap`.

A boom with one effect or four, and one prism at each of 250 or 10,000 poses; every family of the library, stability
resampling, refits and the model included. Screening alone is one weighing of the whole library about a fit that is
there. The bars are those of the workflow on two cores.
"""

from __future__ import annotations

import argparse
import time

from threadpoolctl import threadpool_limits

from calibration.effects.context import EffectContext
from calibration.effects.library import library
from calibration.gap.candidates import candidate_effects
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import Screen
from calibration.identification.solve import solve
from calibration.observations import Observations, parse_observations
from calibration.pipeline.find_gap import find_gap
from calibration.run_settings import Run
from daemon.rig_files import RigSource, load_rig
from simulators.blind.scene import SceneSettings, draw_scene
from simulators.effects.library import parse_effects

ONE = "boom_droop@boom:flexibility_per_Nm2=1e-8"
FOUR = f"{ONE},backlash@theta1:width_rad=2e-3,angle_scale@theta4:scale=2e-3,transducer_scale@L3:scale=4e-3"
BARS_S = {250: 30.0, 10_000: 300.0}
SCREENING_BAR_S = 1.0


def measured(source: RigSource, poses: int, effects: str, seed: int) -> Observations:
    """A shift of work on a machine with hidden effects."""
    scene = draw_scene(source.rig, seed, SceneSettings(poses=poses, held_out=1))
    table = scene.observe(parse_effects(effects)).training
    return parse_observations(table.csv_text().encode(), source.rig, "simulated.csv")


def screening_seconds(source: RigSource, observations: Observations, seed: int) -> float:
    """One weighing of the whole library, the least of three."""
    with Run().workers() as pool:
        solution = solve(source.rig, observations, prior="recalibration", run=Run(seed, pool))
    over = Projection(solution, EffectContext(solution.chain, solution.fit.x, observations))
    seconds = []
    for _ in range(3):
        started = time.monotonic()
        Screen(over, candidate_effects(over.context, over, library()).candidates).score()
        seconds.append(time.monotonic() - started)
    return min(seconds)


def main() -> None:
    """Print a line for each data set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1_000_000)
    parser.add_argument("--poses", type=int, nargs="+", default=list(BARS_S))
    options = parser.parse_args()
    source = load_rig("swdt82")
    for poses in options.poses:
        for hidden in (ONE, FOUR):
            observations = measured(source, poses, hidden, options.seed)
            started = time.monotonic()
            gap = find_gap(source.rig, source.text, observations, run=Run(options.seed))
            seconds = time.monotonic() - started
            named = ", ".join(f"{e.family}@{e.where}" for e in gap.effects) or "nothing"
            bar = BARS_S.get(poses)
            verdict = "" if bar is None else f" (bar {bar:g} s: {'met' if seconds <= bar else 'MISSED'})"
            print(f"{poses} poses, {hidden.count('@')} hidden: {seconds:.1f} s{verdict}; named {named}", flush=True)
        with threadpool_limits(1, user_api="blas"):
            screening = screening_seconds(source, observations, options.seed)
        verdict = f" (bar {SCREENING_BAR_S:g} s: {'met' if screening <= SCREENING_BAR_S else 'MISSED'})"
        print(f"{poses} poses, screening alone: {screening:.2f} s{verdict if poses == min(BARS_S) else ''}", flush=True)


if __name__ == "__main__":
    main()
