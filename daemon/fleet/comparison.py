"""Comparison of rigs: common deviations, outliers, rigs that have changed, and what each rig would gain from.

Rigs are compared with rigs of the same rig name. Constants of the machine are deviations from the drawings; the
influence of the prior in each rig's fit is removed before rigs are combined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.fleet.hierarchical import FleetEstimate, false_discovery_threshold, fleet_estimate, without_prior

FALSE_SHARE = 0.01  # false discovery rate of common deviations and of outliers
_WORTH = 0.25  # smallest gain worth reporting, as a share of the noise
_DEG_PER_RAD = 57.29577951308232

Answer = Mapping[str, Any]


@dataclass(frozen=True)
class Quantity:
    """A constant of the machine, or a coefficient of an effect, over the rigs of a group.

    Attributes:
        rig: name of their rig.
        kind: `parameter` or `effect`.
        name: for example `row4.d` or `backlash@theta4:width_rad`.
        unit: of all numbers.
        own, own_sigma: (n,) estimate from each rig's own data and its standard error; NaN if they do not determine it.
        fleet: estimate of the distribution over the rigs.
        is_common: whether the fleet's mean differs from 0, which means that the drawings or the rig file are wrong.
        outliers: (n,) True for outlying rigs; the test accounts for the number of quantities in the group.
    """

    rig: str
    kind: str
    name: str
    unit: str
    own: np.ndarray[Any, np.dtype[np.float64]]
    own_sigma: np.ndarray[Any, np.dtype[np.float64]]
    fleet: FleetEstimate
    is_common: bool
    outliers: np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Group:
    """The assessed rigs of one rig name.

    Attributes:
        rig: their rig name.
        answers: answer of each rig.
        quantities: quantities that enough rigs have measured.
        effects: `family@where` -> number of rigs in which it was named.
    """

    rig: str
    answers: tuple[Answer, ...]
    quantities: tuple[Quantity, ...]
    effects: Mapping[str, int]

    @property
    def common(self) -> list[Quantity]:
        """Deviations common to all rigs, the most significant first."""
        return sorted((q for q in self.quantities if q.is_common), key=lambda q: q.fleet.p_common)

    def outlying(self, number: int) -> list[Quantity]:
        """Return the quantities in which a rig is an outlier, the largest deviation first."""
        found = [q for q in self.quantities if q.outliers[number]]
        return sorted(found, key=lambda q: -abs(q.fleet.deviation[number]))


@dataclass(frozen=True)
class Fleet:
    """The comparison.

    Attributes:
        groups: one for each rig name.
        failed: answers of rigs that could not be assessed.
    """

    groups: tuple[Group, ...]
    failed: tuple[Answer, ...]


def compare(answers: Sequence[Answer]) -> Fleet:
    """Compare the rigs of a fleet, given the answers of `daemon.fleet.assess.assess`."""
    good = [answer for answer in answers if "error" not in answer]
    names = list(dict.fromkeys(answer["rig"] for answer in good))
    groups = [_group(name, [answer for answer in good if answer["rig"] == name]) for name in names]
    return Fleet(tuple(groups), tuple(answer for answer in answers if "error" in answer))


def _group(rig: str, answers: list[Answer]) -> Group:
    measured: dict[tuple[str, str, str], tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = {}

    def note(kind: str, name: str, unit: str, rig_number: int, value: float, sigma: float) -> None:
        blank = np.full((2, len(answers)), np.nan)
        values, sigmas = measured.setdefault((kind, name, unit), (blank[0], blank[1]))
        values[rig_number], sigmas[rig_number] = value, sigma

    counts: dict[str, int] = {}
    for number, answer in enumerate(answers):
        parameters = answer["parameters"]
        value = np.array([p["value"] for p in parameters])
        prior = np.array([np.inf if p["prior_sigma"] is None else p["prior_sigma"] for p in parameters])
        own, sigma = without_prior(value, np.array([p["sigma"] for p in parameters]), prior)
        for parameter, one, its_sigma in zip(parameters, own.tolist(), sigma.tolist(), strict=True):
            scale, unit = (_DEG_PER_RAD, "deg") if parameter["unit"] == "rad" else (1.0, parameter["unit"])
            note("parameter", parameter["name"], unit, number, one * scale, its_sigma * scale)
        for effect in answer["effects"]:
            place = f"{effect['family']}@{effect['where']}"
            counts[place] = counts.get(place, 0) + 1
            for name, coefficient in effect["coefficients"].items():
                error = coefficient["standard_error"]
                if error:
                    unit = coefficient["unit"]
                    note("effect", f"{place}:{name}", unit, number, coefficient["value"], error)
    estimated = [(key, own, fleet) for key, own in measured.items() if (fleet := fleet_estimate(*own)) is not None]
    common_p = np.array([fleet.p_common for (kind, *_), _, fleet in estimated if kind == "parameter"])
    common_at = false_discovery_threshold(common_p, FALSE_SHARE)
    outlier_at = false_discovery_threshold(np.concatenate([f.p for _, _, f in estimated] or [np.empty(0)]), FALSE_SHARE)
    quantities = [
        Quantity(
            rig,
            *key,
            own,
            sigma,
            fleet,
            is_common=key[0] == "parameter" and fleet.p_common <= common_at,
            outliers=fleet.is_outlier & (fleet.p <= outlier_at),
        )
        for key, (own, sigma), fleet in estimated
    ]
    ordered = dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
    return Group(rig, tuple(answers), tuple(quantities), ordered)


# ---- who gains from what ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gain:
    """Gain of a rig from an action.

    Attributes:
        action: calibrate, effects, poses, recalibrate, resolve or look.
        gain_mm: expected decrease of the RMS error, mm; NaN if unknown.
        text: what to do.
    """

    action: str
    gain_mm: float
    text: str


def gains(group: Group, number: int) -> list[Gain]:
    """Return the actions that would help a rig: urgent ones without a known gain first, then the largest gain."""
    answer = group.answers[number]
    stages, noise = answer["stages"], answer["noise_mm"]
    found: list[Gain] = []
    drift = answer["drift"]
    if drift is not None and drift["alarm"] == "worse":
        text = f"recalibrate: errors in session {drift['session']} are {drift['ratio']:.1f} times the expected size"
        found.append(Gain("recalibrate", float("nan"), text))
    for quantity in group.outlying(number)[:3]:
        deviation = quantity.fleet.deviation[number]
        text = f"inspect {quantity.name}: {deviation:+.1f} standard deviations from the fleet"
        found.append(Gain("look", float("nan"), text))
    if answer["verdict"] == "indistinguishable":
        found.append(Gain("resolve", float("nan"), "measure the poses that `rigcal gap` proposes"))
    offered = [
        Gain(
            "calibrate",
            stages["nominal"] - stages["geometric"],
            "use the calibrated kinematics in place of the drawing",
        ),
        Gain("effects", stages["geometric"] - stages["effects"], "use the named effects"),
    ]
    if answer["expected_rms_mm"] is not None:
        offered.append(Gain("poses", answer["expected_rms_mm"], "measure more poses"))
    worth = [gain for gain in offered if gain.gain_mm > _WORTH * noise]
    return [*found, *sorted(worth, key=lambda gain: -gain.gain_mm)]
