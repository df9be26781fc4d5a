"""What a prediction costs: `python -m tests.bench.prediction [--rows 10000] [--repetitions 200] [--json]`.

Models of a simulated boom, the swdt82, have nothing but kinematics, five effects, and each residual learner on top of
those, trained on joints, coordinates and 30 control signals. Each predicts one pose and many: positions with their
standard deviations, every check included. One pose runs on one thread; many on two, and on one beside it.

`inverse` brings r, or r and s together, from a nominal command about 1 % of the joints' ranges off to where the model
has them, a pose at a time; its times are medians over poses.

All else are medians and, because other programs disturb them, the least of all repetitions. What runs on one thread is
given in processor time, which is what the clock would say on a machine that has nothing else to do.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.model.inverse import CLOSURE_MM, inverse
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.residual.selection import Kind
from calibration.rig.description import Rig, shipped_rig
from calibration.run_settings import Run
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text
from tests.simulated.observations import simulate_observations

RIG = "swdt82"
TRAINING_POSES, SEED = 1000, 1000
HIDDEN = (
    "encoder_harmonic@theta3:cosk_rad=2e-3:sink_rad=1e-3,backlash@theta4:width_rad=3e-3,"
    "stiffening_compliance@theta8:soft_rad_per_Nm=8e-7:stiff_rad_per_Nm=1e-7"
)
EFFECTS = "joint_compliance@theta4,joint_compliance@theta8,backlash@theta4,encoder_harmonic@theta3,transducer_scale@L2"
WHAT = ("one_us", "many_ms", "many_one_thread_ms")
TARGETS = 30
BARS = {"one_us": 200.0, "many_ms": 50.0, "inverse_ms": 5.0}
PRISMS = (("r",), ("r", "s"))
KINDS: tuple[Kind, ...] = ("rbfn", "lightgbm", "chain", "default")


def observations(rig: Rig, poses: int, seed: int, signals: int) -> Observations:
    """Fixes of r and s with all directions of approach and as many control signals."""
    truth = RigTruth(rig, SEED, effects=parse_effects(HIDDEN))
    drawn = np.random.default_rng(seed + 1)
    columns = {f"{joint.name}_dir": drawn.choice([-1.0, 1.0], poses) for joint in rig.joints}
    columns |= {f"signal{i}_mA": drawn.normal(size=poses) for i in range(signals)}
    data = simulate_observations(truth, poses, seed, prisms=("r", "s"), prisms_per_pose="one", columns=columns)
    return parse_observations(data.csv_text().encode(), rig, "simulated.csv")


def one_call(model: CalibratedModel, rows: Observations, pool: Executor | None = None) -> object:
    """Predict as a program does that is given a model."""
    return Predictor.of(model).predict(rows, pool)


def median_and_least(
    run: Callable[[], object], repetitions: int, clock: Callable[[], float] = time.thread_time
) -> tuple[float, float]:
    """Seconds of one call."""
    run()
    times = []
    for _ in range(repetitions):
        began = clock()
        run()
        times.append(clock() - began)
    return statistics.median(times), min(times)


def models(signals: int) -> dict[str, CalibratedModel]:
    """What is measured, by name."""
    rig = shipped_rig(RIG)
    training = observations(rig, TRAINING_POSES, SEED, signals)
    found = {"kinematics": identify(rig, rig_text(RIG), training, effects="none")}
    found["5 effects"] = identify(rig, rig_text(RIG), training, effects=EFFECTS)
    # Whether a learner helps is not the question here: each is trained on kinematics alone, which leave it something.
    for kind in KINDS:
        learned = train_residual(found["kinematics"], training, kind=kind, run=Run(SEED))
        found[f"5 effects, {kind}"] = replace(found["5 effects"], residual=learned.residual)
    return found


def inversions(model: CalibratedModel, rows: Observations, prisms: tuple[str, ...]) -> dict[str, float]:
    """Milliseconds of a pose, the worst closure and the share of poses that close."""
    rng = np.random.default_rng(SEED)
    times, closures = [], []
    for pose in range(TARGETS):
        there = rows.select(np.full(len(prisms), pose))
        there = replace(there, prism=np.array(prisms), pose=np.full(len(prisms), "1"))
        nominal = {}
        for joint in model.rig.joints:
            off = 0.01 * (joint.limits[1] - joint.limits[0]) * rng.normal()
            nominal[joint.name] = np.clip(there.joints[joint.name] + off, *joint.limits)
        targets = replace(there, joints=nominal, position_mm=Predictor.of(model).predict(there).position_mm)
        began = time.thread_time()
        found = inverse(model, targets)
        times.append(1e3 * (time.thread_time() - began))
        closures.append(float(found.closure_mm.max()))
    return {
        "ms": statistics.median(times),
        "worst_ms": max(times),
        "worst_closure_mm": max(closures),
        "reached": float(np.mean([closure <= CLOSURE_MM for closure in closures])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="What a prediction costs.")
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--signals", type=int, default=30, help="control signals beside joints and coordinates")
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = observations(shipped_rig(RIG), options.rows, SEED + 1, options.signals)
    few = max(5, options.repetitions // 20)
    result: dict[str, dict[str, float | str]] = {}
    inverted: dict[str, dict[str, float]] = {}
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(2) as pool:
        for name, model in models(options.signals).items():
            one = rows.select(np.array([0]))
            times = {
                "one_us": (
                    1e6,
                    partial(one_call, model, one),
                    options.repetitions,
                    time.thread_time,
                ),
                "many_ms": (1e3, partial(one_call, model, rows, pool), few, time.perf_counter),
                "many_one_thread_ms": (1e3, partial(one_call, model, rows), few, time.thread_time),
            }
            result[name] = {"learner": model.residual.learner.kind if model.residual else "none"}
            for what, (unit, run, repetitions, clock) in times.items():
                median, least = median_and_least(run, repetitions, clock)
                result[name] |= {what: unit * median, f"least_{what}": unit * least}
            for prisms in PRISMS:
                inverted[f"{name}: {' and '.join(prisms)}"] = inversions(model, rows, prisms)
    if options.json:
        facts = {"rows": options.rows, "signals": options.signals, "load": os.getloadavg()[0], "bars": BARS}
        print(json.dumps({**facts, "models": result, "inverse": inverted}))
        return
    print(f"load average {os.getloadavg()[0]:.1f}")
    print(f"{'median (least)':28s} {'one pose, us':>18s} {f'{options.rows} poses, ms':>20s} {'on one thread':>20s}")
    for name, found in result.items():
        cells = [f"{found[what]:8.1f} ({found[f'least_{what}']:.1f})" for what in WHAT]
        print(f"{name:28s} {cells[0]:>18s} {cells[1]:>20s} {cells[2]:>20s}  {found['learner']}")
    print(f"{'bar':28s} {BARS['one_us']:18.0f} {BARS['many_ms']:20.0f}")
    print(f"\n{'inverse, one pose':38s} {'ms':>8s} {'worst':>8s} {'worst closure, mm':>18s} {'reached':>8s}")
    for name, seen in inverted.items():
        print(
            f"{name:38s} {seen['ms']:8.2f} {seen['worst_ms']:8.2f} {seen['worst_closure_mm']:18.4f} "
            f"{seen['reached']:8.0%}"
        )
    print(f"{'bar':38s} {BARS['inverse_ms']:8.0f} {'':8s} {CLOSURE_MM:18.2f}")


if __name__ == "__main__":
    main()
