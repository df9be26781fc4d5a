"""A measuring campaign on a machine of any rig: its observations, and the truth behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.blind.duty_cycle import continue_duty_cycle, draw_duty_cycle
from simulators.blind.effect_draws import require_plausible
from simulators.effects.library import parse_effects
from simulators.plan import PlanRow
from simulators.rig.dataset import SimulatedObservations, random_poses
from simulators.rig.observations import simulate_observations
from simulators.rig.truth import RigTruth

Floats = NDArray[np.float64]

_OF_POSES = ("time_s", "dwell_s")  # like directions and rates, these follow from the sequence of poses
_CONDITIONS = ("payload_kg", "temperature_degC", "dwell_s")


@dataclass(frozen=True)
class Campaign:
    """Observations of a machine at standstill in a sequence of poses.

    Attributes:
        truth: the machine.
        observations: table of the observations.
        setup: name of the station set-up.
    """

    truth: RigTruth
    observations: SimulatedObservations
    setup: str

    def truth_as_dict(self) -> dict[str, Any]:
        """Return what the analysis should find: constants, prisms, base, weights and effects of the machine."""
        truth, base = self.truth, self.truth.placement(self.setup)
        return {
            "format": "rigcal simulated truth",
            "rig": truth.rig.name,
            "seed": truth.seed,
            "rows": [
                {
                    **{f"{name}_deg": float(np.rad2deg(getattr(own, name))) for name in ("alpha", "theta", "beta")},
                    **{f"{name}_mm": float(getattr(own, name)) for name in ("a", "d", "b")},
                }
                for own in truth.constants
            ],
            "prisms": {name: truth.prism_offset_mm(name).tolist() for name in truth.rig.prism_names},
            "base": {"rotation": base.rotation.tolist(), "translation_mm": base.position_mm.tolist()},
            "masses": [{"frame": m.frame, "kg": m.kg, "centre_mm": m.place_mm.tolist()} for m in truth.masses],
            "effects": [{"family": effect.family, **asdict(effect)} for effect in truth.effects],
            "noise_rms_mm": self.observations.noise_rms_mm,
        }


def simulate_campaign(
    rig: Rig,
    poses: int,
    seed: int,
    *,
    plan: Sequence[PlanRow] = (),
    effects: str = "",
    noise_mm: float | None = None,
    recording: int = 0,
) -> Campaign:
    """Build a machine within its tolerances, and measure all prisms at standstill in each of a number of poses.

    Temperature, payload (if the rig has one) and the machine's signals vary as in a working day. Fixes have the random
    errors of the rig file's station or `noise_mm`, and readings the errors of the rig file's sensors.

    Args:
        rig: the description, from which the machine deviates.
        poses: number of poses; a plan with fewer rows is repeated.
        seed: the same seed builds the same machine.
        plan: rows of a pose plan; without a plan, poses are random within the joint limits.
        effects: hidden effects as `FAMILY@WHERE[:NAME=VALUE...]`, separated by commas.
        noise_mm: standard deviation of each coordinate of a fix; None for the station of the rig file.
        recording: a different number gives different poses and noise of the same machine.

    Raises:
        ValueError: an effect is unknown, has no place on the rig, or is larger than any machine can have.
    """
    hidden = parse_effects(effects)
    require_plausible(rig, hidden)
    truth = RigTruth(rig, seed, effects=hidden)
    rng = np.random.default_rng([seed, 44, recording])
    visited = [plan[i % len(plan)] for i in range(poses)] if plan else []
    if visited:
        held = {j.name: np.array([row.joints[j.name] for row in visited]) for j in rig.joints}
    else:
        held = random_poses(rig, poses, rng)
    observed = simulate_observations(
        truth,
        poses,
        int(rng.integers(2**31)),
        poses=held,
        noise_mm=noise_mm,
        sigma_columns=noise_mm is not None,
        columns=_conditions(truth, held, rng) | _planned(rig, visited),
    )
    return Campaign(truth, observed, "")


def _conditions(truth: RigTruth, held: Mapping[str, Floats], rng: np.random.Generator) -> dict[str, Floats]:
    """Return the columns on which effects may depend, except those that follow from the poses."""
    n = len(next(iter(held.values())))
    day = draw_duty_cycle(truth, max(n, 3), "wide", rng, moving=0.0, is_decoy=False).columns
    first = {name: float(values[0]) for name, values in day.items()}
    here = {name: float(values[0]) for name, values in held.items()}
    given = {name: day[name][:n] for name in ("temperature_degC", "payload_kg") if name in day}
    visited = continue_duty_cycle(truth, held, here, first, given, rng)
    own = {*_OF_POSES, *(f"{name}_{what}" for name in held for what in ("dir", "rate"))}
    return {name: values for name, values in visited.columns.items() if name not in own}


def _planned(rig: Rig, rows: Sequence[PlanRow]) -> dict[str, Floats]:
    """Return the columns that a plan prescribes; `_dir` is -1 or 1 for the direction from which a joint approaches."""
    sides = [f"{joint.name}_dir" for joint in rig.joints]
    return {
        name: np.array([row.conditions[name] for row in rows])
        for name in (*_CONDITIONS, *sides)
        if rows and all(name in row.conditions for row in rows)
    }
