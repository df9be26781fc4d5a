"""An effect that a live rig hides, drawn here and told to nobody before the simulation is over.

envelope.sealed   what is hidden, JSON, XORed with random bytes that are in this process's memory alone
envelope.sha256   of the JSON, so that it cannot be changed later; its salt keeps it from being guessed
envelope.begin    UTC in ns of simulated second 0, from which the effect counts time
envelope.pad      those random bytes, written when the simulation ends: the envelope is open
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simulators.dataset import random_poses
from simulators.effect_draws import EffectDraws
from simulators.effects.base import Effect
from simulators.effects.spec import LIBRARY
from simulators.machine import TEMPERATE_DEGC
from simulators.truth import RigTruth, replace_effects
from simulators.visible import Visibility, reading_covariance_mm2

Floats = NDArray[np.float64]

SEALED, COMMITMENT, BEGIN, PAD = "envelope.sealed", "envelope.sha256", "envelope.begin", "envelope.pad"
SESSIONS_S = 900.0  # what a live rig is measured for, at least
SIZES = (1.0, 3.0)  # that show, RMS in units of a fix's noise
_POSES = 60
_DWELL_S = 3.5
_SALT = 16
_BEYOND = ("joint_error_map",)  # what takes hundreds of poses to see


@dataclass(frozen=True)
class Secret:
    """What is hidden.

    Attributes:
        effect: it.
        size: what shows of it in units of the noise, RMS, once the machine's constants have been fitted to it.
    """

    effect: Effect
    size: float


class Envelope:
    """A secret, sealed.

    Args:
        directory: where its files go.
        secret: what is in it.
        random: so many random bytes.
    """

    def __init__(self, directory: Path, secret: Secret, random: Callable[[int], bytes]) -> None:
        content = {
            "family": secret.effect.family,
            "where": secret.effect.where,
            "coefficients": {k: v for k, v in asdict(secret.effect).items() if k != "where"},
            "visible_over_noise": round(secret.size, 3),
            "salt": random(_SALT).hex(),
        }
        text = json.dumps(content).encode()
        self._directory, self._pad = directory, random(len(text))
        sealed = bytes(a ^ b for a, b in zip(text, self._pad, strict=True))
        (directory / SEALED).write_bytes(sealed)
        (directory / COMMITMENT).write_text(hashlib.sha256(text).hexdigest() + "\n", encoding="utf-8")

    def begin(self, utc_ns: int) -> None:
        """Say when simulated second 0 is."""
        (self._directory / BEGIN).write_text(f"{utc_ns}\n", encoding="utf-8")

    def open(self) -> None:
        """Let it be read."""
        (self._directory / PAD).write_bytes(self._pad)


def draw_secret(truth: RigTruth, rng: np.random.Generator) -> Secret:
    """An effect that shows in a session of standing poses, within its hard bounds.

    Args:
        truth: the machine without it.
        rng: draws.

    Raises:
        ValueError: no effect shows on this rig.
    """
    rig = truth.rig
    names = rig.prism_names
    drawn = random_poses(rig, _POSES, rng)
    prism = np.repeat(np.array(names), _POSES)
    joints = {name: np.tile(values, len(names)) for name, values in drawn.items()}
    columns = _columns(truth, len(prism), rng)
    sigma = {j.name: np.full(len(prism), np.hypot(j.sigma, j.resolution / np.sqrt(12.0))) for j in rig.joints}
    station = (rig.station.distance_sigma_mm**2 + rig.station.target_sigma_mm**2) * np.eye(3)
    visible = Visibility(truth, prism, joints, reading_covariance_mm2(truth, prism, joints, sigma) + station)
    draws = EffectDraws(rig, names, 0.0, SESSIONS_S, TEMPERATE_DEGC)
    at_mm = _places_mm(truth, prism, joints, columns)
    wanted = float(rng.uniform(*SIZES))
    for family in rng.permutation([name for name in LIBRARY if name not in _BEYOND]).tolist():
        for where in rng.permutation(np.array(draws.places(family), dtype=np.str_)).tolist():
            bounded = draws.draw(family, where, rng)
            try:
                there = _places_mm(replace_effects(truth, [bounded.effect]), prism, joints, columns)
            except ValueError:  # it needs what a live rig does not measure
                break
            size = visible.size(there - at_mm)
            if size > 0.0 and wanted / size <= bounded.most:
                return Secret(bounded.scaled(wanted / size), wanted)
    raise ValueError(f"no effect shows on rig {rig.name!r} within its bounds")


def _columns(truth: RigTruth, rows: int, rng: np.random.Generator) -> dict[str, Floats]:
    """What effects may depend on, as in sessions of standing poses."""
    joints = truth.rig.joints
    columns = {f"{joint.name}_dir": rng.choice([-1.0, 1.0], rows) for joint in joints}
    columns |= {f"{joint.name}_rate": np.zeros(rows) for joint in joints}
    columns["time_s"] = np.linspace(0.0, SESSIONS_S, rows)
    columns["dwell_s"] = np.full(rows, _DWELL_S)
    columns["temperature_degC"] = np.full(rows, TEMPERATE_DEGC)
    return columns


def _places_mm(
    truth: RigTruth, prism: NDArray[np.str_], joints: dict[str, Floats], columns: dict[str, Floats]
) -> Floats:
    """(n, 3) fixes of prisms (n,), station's frame."""
    out = np.empty((len(prism), 3))
    for name in np.unique(prism).tolist():
        rows = prism == name
        out[rows] = truth.prism_mm(
            name, {k: v[rows] for k, v in joints.items()}, {k: v[rows] for k, v in columns.items()}
        )
    return out
