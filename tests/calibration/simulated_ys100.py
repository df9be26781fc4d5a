"""The second paper's experiment on simulated YS100s: 50 random poses to fit, 50 others to validate, a laser tracker.

Each seed is a robot of its own whose reducers are soft around zero torque and stiffen under load. The nominal model is
14 mm off on average, as the paper's is; noise is 0.03 mm on each axis, and the encoders have that of the rig file.
"""

from __future__ import annotations

import numpy as np

from calibration.observations import Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.base import Effect
from simulators.effects.families.joints import JointCompliance
from simulators.effects.variants import StiffeningCompliance
from simulators.rig.dataset import random_poses
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

POSES = 50
NOISE_MM = 0.03
PERTURBATION = 0.63  # build tolerances; more or less 14 mm
# Joint -> deflection under the largest torque (rad) and that torque (N m) of the nominal robot.
LOADS = {
    "theta2": (1.0e-3, 5800.0),
    "theta3": (1.0e-3, 3100.0),
    "theta4": (0.6e-3, 750.0),
    "theta5": (0.6e-3, 800.0),
    "theta6": (0.4e-3, 220.0),
}


def stiffening(seed: int) -> tuple[Effect, ...]:
    """Reducers of a robot, each drawn at random: size, how much softer it is without load, and where it stiffens."""
    rng = np.random.default_rng([seed, 20])
    effects: list[Effect] = []
    for joint, (deflection_rad, load) in LOADS.items():
        share = rng.uniform(0.5, 1.5)
        ratio, knee = np.exp(rng.uniform(np.log([2.0, 0.02]), np.log([20.0, 0.3])))
        stiff = share * deflection_rad / load / (1.0 + (ratio - 1.0) * knee * np.arctan(1.0 / knee))
        effects.append(StiffeningCompliance(joint, ratio * stiff, stiff, knee * load))
    return tuple(effects)


def linear(seed: int) -> tuple[Effect, ...]:
    """The same robot with springs of constant stiffness."""
    rng = np.random.default_rng([seed, 20])
    return tuple(JointCompliance(joint, rng.uniform(0.5, 1.5) * angle / load) for joint, (angle, load) in LOADS.items())


def robot(
    seed: int, effects: tuple[Effect, ...], swing_deg: float | None = None
) -> tuple[Rig, Observations, Observations]:
    """The rig, the poses to fit and the poses to validate, theta1 within +-`swing_deg` where that is given."""
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, seed, perturbation=PERTURBATION, effects=effects)

    def measured(stream: int) -> Observations:
        poses = random_poses(rig, POSES, np.random.default_rng([stream, 21]))
        if swing_deg is not None:
            poses["theta1"] *= swing_deg / rig.joint("theta1").limits[1]
        table = simulate_observations(truth, POSES, stream, poses=poses, noise_mm=NOISE_MM)
        return parse_observations(table.csv_text().encode(), rig, "simulated.csv")

    return rig, measured(seed), measured(seed + 500_000)
