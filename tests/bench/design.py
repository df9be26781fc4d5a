"""Planned poses against random ones on simulated machines: `python -m tests.bench.design`.

For every machine, built within its tolerances and set up where the plan was told, the same number of poses is measured
once as planned and once drawn evenly among the reachable ones, and the model's own error (its position less the true
one for the same readings) is taken over other poses of the whole work volume. A fix adds its noise to that, which no
choice of poses can lower. Beside it, the error that the calibrated model expects of itself.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.design.candidates import CANDIDATES, Candidates, draw, work_volume
from calibration.design.knowledge import Knowledge
from calibration.design.poses import plan
from calibration.design.visibility import Bodies, Site, in_view, site
from calibration.identification.refinement import refine
from calibration.identification.solve import place
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

HELD_OUT = 300


@dataclass(frozen=True)
class Trial:
    """One machine measured at some poses: RMS 3-D errors in mm, of the model over the volume and as it expects it."""

    actual_mm: float
    expected_mm: float


@dataclass(frozen=True)
class Ground:
    """A machine on its ground, and what the planner knows of it."""

    truth: RigTruth
    knowledge: Knowledge
    at: Site
    candidates: Candidates


def ground(rig: Rig, seed: int, candidates: int = CANDIDATES) -> Ground:
    truth = RigTruth(rig, seed)
    placed = truth.placement()
    chain = Chain(rig, {"": Placement(placed.rotation, placed.position_mm)})
    at = site(chain, np.zeros(len(chain)), setup=0)
    knowledge = Knowledge.of_rig(chain)
    return Ground(truth, knowledge, at, draw(knowledge, at, np.random.default_rng([seed, 1]), candidates))


def at_random(here: Ground, poses: int, seed: int) -> Candidates:
    """Poses drawn evenly among those that the rig can take and in which the station sees a prism."""
    chain = here.knowledge.chain
    drawn = work_volume(here.knowledge, here.at, np.random.default_rng([seed, 2]), 10 * poses)
    seen = in_view(Bodies.of(chain, here.knowledge.x, drawn), here.at)
    which = np.flatnonzero(seen.any(axis=1))[:poses]
    return Candidates(drawn[which], {}, seen[which])


def measured(here: Ground, poses: Candidates, seed: int) -> Observations:
    """Fixes of all prisms in view, with the noise that the rig file gives."""
    rig = here.truth.rig
    held = dict(zip(rig.joint_names, poses.readings.T, strict=True))
    data = simulate_observations(here.truth, len(poses), seed, poses=held)
    table = parse_observations(data.csv_text().encode(), rig, "simulated.csv")
    return table.select(poses.seen.ravel())


def trial(here: Ground, poses: Candidates, seed: int) -> Trial:
    rig = here.truth.rig
    chain, samples, start = place(rig, measured(here, poses, seed))
    fit = refine(chain, samples, start.x)
    others = work_volume(here.knowledge, here.at, np.random.default_rng([seed, 3]), HELD_OUT)
    prisms = len(rig.prisms)
    data = ChainData(
        np.repeat(others, prisms, axis=0), np.tile(np.arange(prisms), len(others)), np.zeros(len(others) * prisms, int)
    )
    held = dict(zip(rig.joint_names, others.T, strict=True))
    true_mm = np.stack([here.truth.prism_mm(name, held) for name in rig.prism_names], axis=1).reshape(-1, 3)
    lin = chain.linearise(fit.x, data)
    spread = lin.jacobian @ np.linalg.cholesky(fit.covariance + 1e-18 * np.eye(len(chain)))
    return Trial(rms(lin.position_mm - true_mm), float(np.sqrt((spread**2).sum() / len(spread))))


def rms(error_mm: Floats) -> float:
    return float(np.sqrt((error_mm**2).sum() / len(error_mm)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", nargs="+", default=["swdt82", "ys100"])
    parser.add_argument("--poses", nargs="+", type=int, default=[20, 30, 50])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    options = parser.parse_args()
    print("model's own error over the work volume, RMS in mm; mean over machines (lowest and highest ratio)")
    with threadpool_limits(1, user_api="blas"):
        for name in options.rigs:
            _compare(shipped_rig(name), options.poses, range(options.first, options.first + options.seeds))
            _time(shipped_rig(name))


def _compare(rig: Rig, counts: list[int], seeds: range) -> None:
    grounds = {seed: ground(rig, seed) for seed in seeds}
    for count in counts:
        planned = [trial(here, plan(here.knowledge, here.candidates, count).poses, s) for s, here in grounds.items()]
        drawn = [trial(here, at_random(here, count, s), s) for s, here in grounds.items()]
        ratio = np.array([d.actual_mm / p.actual_mm for p, d in zip(planned, drawn, strict=True)])
        means = [float(np.sqrt(np.mean([t.actual_mm**2 for t in trials]))) for trials in (planned, drawn)]
        expected = [float(np.sqrt(np.mean([t.expected_mm**2 for t in trials]))) for trials in (planned, drawn)]
        own, others = [f"{mean:.3f} (expected {e:.3f})" for mean, e in zip(means, expected, strict=True)]
        print(
            f"{rig.name:7s} {count:3d} poses, {len(ratio)} machines: planned {own}, random {others}, "
            f"random / planned {means[1] / means[0]:.2f} ({ratio.min():.2f} .. {ratio.max():.2f}), "
            f"planned better in {(ratio > 1).sum()}",
            flush=True,
        )


def _time(rig: Rig) -> None:
    """What 50 poses from 10,000 candidates take, drawing and ordering included; the shortest of three."""
    seconds = []
    for seed in range(3):
        began = time.perf_counter()
        here = ground(rig, seed)
        plan(here.knowledge, here.candidates, 50)
        seconds.append(time.perf_counter() - began)
    print(f"{rig.name:7s} 50 poses from {CANDIDATES} candidates: {min(seconds):.2f} s", flush=True)
    here = ground(rig, 0)
    joint = rig.joints[1].name
    for effects in ((f"backlash@{joint}", f"encoder_harmonic@{joint}"), ("base_settlement@base", "latency@clock")):
        began = time.perf_counter()
        found = plan(here.knowledge, here.candidates, 20, separate=effects).stands_out
        sigma = ", ".join(f"{name} {value:.1f} sigma" for name, value in found.items())
        print(f"{rig.name:7s} 20 poses that separate: {time.perf_counter() - began:.2f} s ({sigma})", flush=True)


if __name__ == "__main__":
    main()
