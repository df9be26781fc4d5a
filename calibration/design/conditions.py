"""Conditions of a pose: direction of approach, motion, dwell, time, temperature, payload, pressures.

Some effects are visible only where conditions differ. A plan varies those conditions that the effects in question need,
between levels that an operator can set.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from calibration.observations import Floats
from calibration.rig.description import Rig

Conditions = Mapping[str, Floats]
"""Optional column of observations -> (n,) its value in each pose; `fixes` is the number of fixes of each prism."""

FIXES = 10  # per prism at a standstill: each takes seconds, and the variance of their mean is smaller by this factor

DWELLS_S = (10.0, 120.0)
TEMPERATURES_DEGC = (5.0, 25.0)
PRESSURES_BAR = (50.0, 150.0)
ROUNDS_S = (0.0, 14400.0, 28800.0, 43200.0)
_POSE_S = 60.0  # from one fix of a round to the next
_MOVING = 0.5  # share of poses that may be measured in motion
_PACE = 0.1  # largest share of a joint's greatest rate; at higher rates the timing error outweighs the information
_LOAD = 0.05  # payload as a share of the machine's weight, where the rig file names no payload
_SLOW = ("time_s", "temperature_degC", "payload_kg")  # not practical to change from pose to pose


def drawn(
    rig: Rig, count: int, rng: np.random.Generator, *, begin_s: float = 0.0, payload_kg: float = 0.0
) -> Conditions:
    """Draw all conditions of `count` poses, each from its levels.

    Args:
        rig: the rig description.
        count: number of poses.
        rng: random generator.
        begin_s: `time_s` of the first round.
        payload_kg: payload that the machine has carried; 0 for the payload of the rig file.
    """
    sides = rng.choice([-1.0, 1.0], (count, len(rig.joints)))
    pace = _PACE * rng.random(sides.shape) * (rng.random(count) < _MOVING)[:, None]
    out = {f"{joint.name}_dir": sides[:, i] for i, joint in enumerate(rig.joints)}
    out["fixes"] = np.full(count, float(FIXES))
    out |= {f"{joint.name}_rate": (pace * sides)[:, i] * joint.max_rate for i, joint in enumerate(rig.joints)}
    levels: dict[str, Sequence[float]] = {
        "time_s": [begin_s + after_s for after_s in ROUNDS_S],
        "temperature_degC": TEMPERATURES_DEGC,
        "dwell_s": DWELLS_S,
        **dict.fromkeys(_pressures(rig), PRESSURES_BAR),
    }
    if any(mass.payload for mass in rig.masses):
        levels["payload_kg"] = (0.0, payload_kg or _payload_kg(rig))
    return out | {column: rng.choice(values, count) for column, values in levels.items()}


def under(conditions: Conditions, names: Collection[str]) -> Conditions:
    """Keep only the named conditions; a pose measured in motion gets no dwell and one fix."""
    out = {name: values for name, values in conditions.items() if name in names}
    rates = [values for name, values in out.items() if name.endswith("_rate")]
    if rates:
        moves, then = np.any(rates, axis=0), {"dwell_s": 0.0, "fixes": 1.0}
        out |= {name: np.where(moves, then[name], values) for name, values in out.items() if name in then}
    return out


def kinds_of(rig: Rig) -> tuple[tuple[str, ...], ...]:
    """Return the conditions of a rig, in groups that change together."""
    joints = rig.joint_names
    payload = [("payload_kg",)] if any(mass.payload for mass in rig.masses) else []
    return (
        *payload,
        ("temperature_degC",),
        ("time_s",),
        ("dwell_s",),
        *((column,) for column in _pressures(rig)),
        tuple(f"{name}_rate" for name in joints),
        *((f"{name}_dir",) for name in joints),
    )


def needed(rig: Rig, is_known: Callable[[Collection[str]], bool]) -> tuple[str, ...] | None:
    """Return a minimal set of conditions that provides all inputs of an effect, or None if no set does.

    Args:
        rig: the rig description.
        is_known: True if conditions of these names provide all inputs of the effect.
    """
    kinds = kinds_of(rig)
    kept = [name for kind in kinds for name in kind]
    if not is_known(kept):
        return None
    for kind in kinds:
        rest = [name for name in kept if name not in kind]
        if is_known(rest):
            kept = rest
    return tuple(kept)


def changed(conditions: Conditions, kind: Collection[str]) -> Conditions:
    """Change the conditions of one kind by the largest amount that a plan allows."""
    out = dict(conditions)
    for name in kind:
        values = conditions[name]
        if name.endswith(("_dir", "_rate")):
            out[name] = -values
        elif name == "time_s":
            out[name] = values + ROUNDS_S[-1]
        else:
            out[name] = values.min() + values.max() - values
    return out


def slow(names: Collection[str]) -> tuple[str, ...]:
    """Return the conditions that divide a plan into blocks, slowest to change first."""
    return (*(name for name in _SLOW if name in names), *sorted(name for name in names if name.endswith("_bar")))


def with_distinct_times(conditions: Conditions) -> Conditions:
    """Give each pose a distinct `time_s` within its round, in the order of measurement."""
    if "time_s" not in conditions:
        return conditions
    times: list[float] = []
    for begin_s in conditions["time_s"].tolist():
        times.append(max(begin_s, times[-1] + _POSE_S) if times else begin_s)
    return {**conditions, "time_s": np.array(times)}


def instructions(rig: Rig, conditions: Conditions) -> tuple[str, ...]:
    """Return instructions for the operator, one sentence for each condition of a plan."""
    out = []
    sides = [joint.name for joint in rig.joints if f"{joint.name}_dir" in conditions]
    if sides:
        out.append(
            f"approach the pose with {' and '.join(sides)} from below where its direction column is 1, and from above "
            f"where it is -1"
        )
    if any(name.endswith("_rate") for name in conditions):
        out.append("where rates are given, take the fix in motion, as the boom passes the pose at these rates")
    if "fixes" in conditions:
        out.append("take as many fixes of each prism as the column fixes gives, all under the number of their pose")
    if "dwell_s" in conditions:
        out.append("let the boom stand for dwell_s before the fix")
    if "payload_kg" in conditions:
        out.append(f"carry payload_kg: nothing, or {conditions['payload_kg'].max():.0f} kg")
    if "temperature_degC" in conditions:
        out.append("measure the cold poses and the warm ones at about temperature_degC, in the morning and at noon")
    if "time_s" in conditions:
        hours = np.ptp(conditions["time_s"]) / 3600.0
        out.append(f"measure at time_s, {hours:.1f} hours from first to last, without moving the station")
    out += [
        f"bring the cylinder to about {name}, by the load that the boom carries or pushes against"
        for name in sorted(conditions)
        if name.endswith("_bar")
    ]
    return tuple(out)


def _pressures(rig: Rig) -> tuple[str, ...]:
    return tuple(f"{joint.name}_bar" for joint in rig.joints if joint.kind == "prismatic")


def _payload_kg(rig: Rig) -> float:
    named = sum(mass.kg for mass in rig.masses if mass.payload)
    return named or _LOAD * sum(mass.kg for mass in rig.masses)
