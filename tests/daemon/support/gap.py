"""Answers of the gap workflow: of a simulated boom with a backlash, put together by hand around a real model."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from calibration.effects.base import FittedCoefficient
from calibration.gap.result import Candidate, Disagreement, Evidence, Experiment, Forecast, GapResult, Round
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from daemon.rig_files import load_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
EFFECT = "backlash@theta4"
HIDDEN = f"{EFFECT}:width_rad=3e-3"
POSES = 60
WIDTH_BOUNDS = {"width_rad": (0.0, 5e-3)}
COSINE_BOUNDS = {"cosk_rad": (-6e-3, 6e-3), "sink_rad": (-6e-3, 6e-3)}


def session_csv(poses: int = POSES, seed: int = 5, setup: str = "S1", hidden: str = HIDDEN) -> bytes:
    """Observations of the simulated boom, two prisms a pose."""
    truth = RigTruth(SOURCE.rig, 1, effects=parse_effects(hidden))
    data = simulate_observations(truth, poses, seed, prisms=["r", "s"], setup=setup)
    return data.csv_text().encode()


@functools.cache
def named() -> GapResult:
    """A backlash at theta4 was found and adopted in the first round, nothing in the second."""
    observations = parse_observations(session_csv(), SOURCE.rig, "session.csv")
    model = identify(SOURCE.rig, SOURCE.text, observations, effects=EFFECT)
    before = observations.position_mm - Predictor.of(model).geometric_mm(observations)
    after = observations.position_mm - Predictor.of(model).effects_mm(observations)
    (effect,) = model.effects
    backlash = Candidate("backlash", "theta4", 0.9997, 310.2, effect.coefficients, WIDTH_BOUNDS)
    return GapResult(
        verdict="named",
        effects=model.effects,
        posterior={EFFECT: 0.9997},
        evidence={EFFECT: Evidence(412.0, 0.9997, {"theta4": 1.0}, 1e-9)},
        indistinguishable=(),
        description=None,
        remaining_significant=False,
        remaining_mm=0.4,
        disabled={
            "thermal_expansion": "needs the column temperature_degC",
            "latency": "it has no effect in these poses",
        },
        before_mm=rms(before),
        after_mm=rms(after),
        noise_mm=2.9,
        noise_source="from repeats of 60 standstills",
        held_out=None,
        disagreements=(
            Disagreement("theta4", "direction", 1e-12),
            Disagreement("theta5", "direction", 0.004),
        ),
        experiments=(Experiment("prism", "Measure prism b as well: none was below the feed."),),
        rounds=(
            Round(rms(before) * 1.02, (EFFECT,), (backlash, *rivals())),
            Round(rms(after) * 1.02, (), ()),
        ),
        forecasts=forecasts(),
        model=model,
        observations=observations,
        error_before_mm=before,
        error_after_mm=after,
        warnings=("Joint L2 moved over less than a tenth of its range.",),
    )


def nothing() -> GapResult:
    """The same data, had nothing been found."""
    gap = named()
    left = gap.error_after_mm
    return replace(
        gap,
        verdict="none",
        effects=(),
        posterior={},
        evidence={},
        model=replace(gap.model, effects=(), covariance=_of_kinematics(gap)),
        before_mm=gap.after_mm,
        error_before_mm=left,
        disagreements=(),
        experiments=(),
        rounds=(Round(gap.after_mm, (), rivals()),),
        warnings=(),
    )


def pending() -> GapResult:
    """A set of two: what moves both apart is proposed."""
    gap = named()
    return replace(
        gap,
        verdict="indistinguishable",
        effects=(),
        posterior={},
        evidence={},
        model=replace(gap.model, effects=(), covariance=_of_kinematics(gap)),
        indistinguishable=rivals()[:2],
        remaining_significant=True,
        after_mm=gap.before_mm,
        error_after_mm=gap.error_before_mm,
        experiments=(
            Experiment("poses", "Measure these 3 poses.", tuple(pose(number) for number in (1, 2, 3))),
            Experiment("approach", "Approach each pose once from below and once from above at theta4."),
        ),
        rounds=(Round(gap.before_mm, (), rivals()),),
    )


def unidentified() -> GapResult:
    """Structure that nothing of the library explains."""
    return replace(
        pending(),
        verdict="unidentified",
        indistinguishable=(),
        description="theta4 angle error = 2.3e-4 (rad/K) dT cos theta4; not in the library",
        experiments=(),
    )


def pose(number: int) -> dict[str, object]:
    """A row of a plan, as `rigcal plan` has it."""
    return {
        "pose": number,
        **{joint.column: sum(joint.limits) / 2.0 + number for joint in SOURCE.rig.joints},
        "theta4_dir": 1,
        "prisms": ["r", "s"],
    }


def rivals() -> tuple[Candidate, ...]:
    """Candidates that were not named."""
    cosine = FittedCoefficient("cosk_rad", "rad", 1.1e-3, 2.0e-4, 1.5e-3)
    sine = FittedCoefficient("sink_rad", "rad", -4.0e-4, 2.0e-4, 1.5e-3)
    width = FittedCoefficient("width_rad", "rad", 6.1e-3, 3.0e-4, 1.0e-3)
    return (
        Candidate("encoder_harmonic", "theta4", 2e-4, 301.5, (cosine, sine), COSINE_BOUNDS, "less probable"),
        Candidate("backlash", "theta5", 1e-4, 120.0, (width,), WIDTH_BOUNDS, "its width is beyond the bound"),
        Candidate("gravity_flip_play", "theta4", 1e-9, 4.0, (width,), WIDTH_BOUNDS, "wins in 12 % of half-samples"),
    )


def forecasts() -> tuple[Forecast, ...]:
    """What the data could show, well and not at all."""
    return (
        Forecast("backlash", "theta4", "rad", 0.81, 5.1, 2.6e-4, "load_hysteresis@theta4", 0.62),
        Forecast("backlash", "theta5", "rad", 0.80, 4.2, 3.6e-4, "load_hysteresis@theta5", 0.55),
        Forecast("boom_droop", "boom", "1/(N m^2)", 0.08, 1.6, float("inf"), "joint_compliance@theta4", 0.2),
        Forecast("station_scale", "station", "1", 0.01, 0.02, float("inf"), "", 1.0),
    )


def rms(error_mm: Floats) -> float:
    """RMS 3-D length."""
    return float(np.sqrt((error_mm**2).sum(axis=1).mean()))


def of_time(gap: GapResult) -> Observations:
    """The rows with a temperature that rises with the time."""
    time_s = gap.observations.extra["time_s"]
    return replace(gap.observations, extra={**gap.observations.extra, "temperature_degC": 5.0 + time_s / 600.0})


def _of_kinematics(gap: GapResult) -> Floats:
    size = len(gap.model.values)
    return gap.model.covariance[:size, :size]
