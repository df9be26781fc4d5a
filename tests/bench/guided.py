"""Guided sessions on simulated machines: `python -m tests.bench.guided --first N`.

Each machine is built within its tolerances and measured as a guide leads: prism by prism, poses chosen on the spot by
the gain meter, each missed by up to half its tolerance, five fixes at each, until the stop rule says stop. Two
questions: does the expected accuracy that is shown at the end hold (the model's own error over the work volume, against
the truth), and is the model as good as one from 1.5 times as many poses of each prism drawn evenly among those in view?
Both models are the geometric ones that `calibrate` makes, with effects where the machines have some.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.design.accuracy import expected_accuracy
from calibration.design.candidates import work_volume
from calibration.design.gain import FORECAST, from_rows, random_poses
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import calibrate
from calibration.rig.description import Rig
from daemon.guide.job import Forecast, Job, Request, stop_reason
from daemon.guide.keeper import NEEDED_FIXES
from daemon.guide.meter import Meter, joined
from daemon.guide.meter_link import Place
from daemon.guide.position import tolerance
from daemon.rig_files import RigSource, load_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

PRISMS = ("w", "b", "r", "s")
SETUP = "S1"
MORE = 1.5  # times the poses, drawn at random
HELD_OUT = 400
MISSED = 0.5  # of a joint's tolerance, at most


class BenchMeter(Meter):
    """The gain meter on rows in memory."""

    def __init__(self, source: RigSource) -> None:
        super().__init__(Place("", None, source.text))
        self.rows: list[Observations] = []

    def _rows(self, sessions: Sequence[str], still_open: str) -> Observations | None:
        del sessions, still_open
        return joined(self.rows) if self.rows else None


@dataclass
class Guided:
    """A guided job: the state of its end, the model of its rows, and what was shown last."""

    job: Job
    rows: Observations
    shown_mm: float
    slowest_s: float


def guided(source: RigSource, truth: RigTruth, seed: int, most: int, target_mm: float | None = None) -> Guided:
    meter, rng = BenchMeter(source), np.random.default_rng([seed, 20])
    job = Job.of(Request(("cp1",), PRISMS, most, 0, target_mm))
    shown: Mapping[str, Any] = {}
    slowest_s = 0.0
    while job.state == "open":
        step, run = job.step, job.run
        assert step is not None
        about = {"sessions": [], "setup": SETUP, "session": run.session, "prism": run.prism}
        if not run.session:
            job = job.after("opened", {"session": f"s{job.at}", "last": 0})
        elif step.kind == "shoot_control_point":
            job = job.after("shot", {"point": step.point, "misclosure_mm": 0.0})
        elif step.kind == "change_prism":
            job = job.after("aimed", {})
        elif step.kind == "close":
            job = job.after("closed", {"session": run.session})
        elif run.poses is None:
            asked = {"do": "choose", "count": run.most, "seed": 1000 * seed + 100 * job.at, "evenly": False}
            job = job.after("planned", meter.answer(about | asked))
        elif job.is_enough:
            job = job.after("left", {})
        else:
            assert run.next_pose is not None
            readings = np.array([[run.poses[run.next_pose].joints[name] for name in source.rig.joint_names]])
            readings = missed(source.rig, readings, rng)
            noise = seed + 7919 * len(meter.rows)
            meter.rows.append(measured(source.rig, truth, readings, run.prism, noise, run.session, str(run.done)))
            job = job.after("measured", {"pose": str(run.done), "last": 0})
            began = time.perf_counter()
            prisms = list(dict.fromkeys(run.prism for run in job.runs[: job.at + 1]))
            shown = meter.answer(about | {"do": "assess", "prisms": prisms, "next": job.run.upcoming(FORECAST)})
            slowest_s = max(slowest_s, time.perf_counter() - began)
            if shown["prism_mm"] is not None and not job.is_enough:
                forecast = Forecast(shown["now_mm"], shown["prism_mm"], shown["prism_after_5_mm"])
                reason = stop_reason(forecast, target_mm, job.run.done)
                job = job.after("enough", {"reason": reason}) if reason else job
    return Guided(job, joined(meter.rows), shown["now_mm"], slowest_s)


def missed(rig: Rig, readings: Floats, rng: np.random.Generator) -> Floats:
    """Where an operator stops who goes to poses (n, joints), inside the limits."""
    low, high = np.array([joint.limits for joint in rig.joints]).T
    by = MISSED * np.array([tolerance(*joint.limits) for joint in rig.joints])
    stopped: Floats = np.clip(readings + by * rng.uniform(-1.0, 1.0, readings.shape), low, high)
    return stopped


def measured(
    rig: Rig, truth: RigTruth, readings: Floats, prism: str, seed: int, session: str, pose: str = ""
) -> Observations:
    held = dict(zip(rig.joint_names, readings.T, strict=True))
    data = simulate_observations(
        truth, len(readings), seed, poses=held, prisms=[prism], repeats=NEEDED_FIXES, setup=SETUP, session=session
    )
    table = parse_observations(data.csv_text().encode(), rig, "simulated.csv")
    return replace(table, pose=np.full(len(table), pose)) if pose else table


def at_random(source: RigSource, truth: RigTruth, job: Job, seed: int) -> Observations:
    """Rows of 1.5 times as many poses of each prism, drawn evenly among those in view."""
    parts: list[Observations] = []
    for number, run in enumerate(job.runs):
        known = from_rows(source.rig, joined(parts) if parts else None, SETUP)
        poses = random_poses(known, run.prism, math.ceil(MORE * run.done), 100 * seed + number)
        parts.append(measured(source.rig, truth, poses, run.prism, seed + 104729 * (number + 1), f"r{number}"))
    return joined(parts)


def model_of(source: RigSource, rows: Observations, effects: str) -> CalibratedModel:
    return calibrate(source.rig, source.text, rows, effects=effects, residual="none")[0]


def error_mm(model: CalibratedModel, truth: RigTruth, seed: int) -> float:
    """RMS 3-D error of a model over the work volume, of all prisms."""
    rig, n = model.rig, HELD_OUT
    known = from_rows(rig, None, SETUP)
    poses = work_volume(known.knowledge, known.at, np.random.default_rng([seed, 30]), n)
    held = dict(zip(rig.joint_names, poses.T, strict=True))
    square = 0.0
    for prism in rig.prism_names:
        rows = Observations(
            np.full(n, prism),
            held,
            np.full((n, 3), np.nan),
            np.full((n, 3), np.nan),
            np.full(n, SETUP),
            np.full(n, ""),
            np.arange(n).astype(np.str_),
        )
        off = Predictor.of(model).predict(rows).position_mm - truth.prism_mm(prism, held, setup=SETUP)
        square += float((off**2).sum()) / n
    return math.sqrt(square / len(rig.prism_names))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rig", default="swdt82")
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--poses", type=int, default=40, help="most poses of a prism")
    parser.add_argument("--effect", action="append", default=[], help="hidden effect of the machines")
    options = parser.parse_args()
    source = load_rig(options.rig)
    effects = "none" if not options.effect else "auto"
    rows: list[tuple[float, float, float, float]] = []
    for seed in range(options.first, options.first + options.seeds):
        truth = RigTruth(source.rig, seed, effects=parse_effects(",".join(options.effect)) if options.effect else ())
        led = guided(source, truth, seed, options.poses)
        model = model_of(source, led.rows, effects)
        other = model_of(source, at_random(source, truth, led.job, seed), effects)
        told = expected_accuracy(model, np.random.default_rng(0)).rms_mm
        own, by_chance = error_mm(model, truth, seed), error_mm(other, truth, seed)
        rows.append((led.shown_mm, own, by_chance, told))
        print(
            f"machine {seed}: poses {'+'.join(str(run.done) for run in led.job.runs)}, shown {led.shown_mm:.3f} mm, "
            f"true {own:.3f} mm, model's report {told:.3f} mm; {MORE:g} times as many at random {by_chance:.3f} mm; "
            f"slowest answer of the meter {led.slowest_s:.2f} s",
            flush=True,
        )
    shown, own, by_chance, told = np.array(rows).T
    print(f"shown over true, mean {shown.mean() / own.mean():.3f}; of the machines' ratios {np.mean(shown / own):.3f}")
    print(f"the model's own report over true, mean {told.mean() / own.mean():.3f}")
    print(
        f"guided {own.mean():.3f} mm, {MORE:g} times as many at random {by_chance.mean():.3f} mm in the mean; guided "
        f"is as good or better on {(own <= by_chance).sum()} of {len(own)}"
    )


if __name__ == "__main__":
    main()
