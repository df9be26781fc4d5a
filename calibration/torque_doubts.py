"""Measured torques held against the loads that the rig file's masses make: other units show, and other signs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from calibration.effects.base import Situation

_UNITS = {"kN m": 1e-3, "kgf m": 1.0 / 9.80665, "N mm": 1e3}
_ALIKE = 0.7  # correlation about zero; less says nothing of a factor
_FAR = 5.0  # times: masses are not wrong by so much
_NEAR = 2.0  # times a unit: that unit
_LEAST_ROWS = 10


def times_computed(situation: Situation) -> Mapping[str, float]:
    """Joint -> by what its load has to be multiplied to make its `<name>_Nm`, where the one goes with the other."""
    rows = situation.observations
    extra = {name: values for name, values in rows.extra.items() if not name.endswith("_Nm")}
    computed = replace(situation, observations=replace(rows, extra=extra))
    out = {}
    for joint in situation.rig.joints if situation.rig.masses else ():
        if joint.kind != "revolute" or f"{joint.name}_Nm" not in rows.extra:
            continue
        measured, load = situation.extra(f"{joint.name}_Nm"), computed.torque(joint.name)
        known = np.isfinite(measured)
        size = float(np.linalg.norm(measured[known]) * np.linalg.norm(load[known]))
        product = float(measured[known] @ load[known])
        if known.sum() >= _LEAST_ROWS and abs(product) > _ALIKE * size and computed.greatest_torque(joint.name) > 0.0:
            out[joint.name] = product / float(load[known] @ load[known])
    return out


def unit_doubts(times_computed: Mapping[str, float]) -> Iterator[str]:
    """A sentence for the columns `<name>_Nm` in every other unit."""
    columns: dict[str, list[str]] = {}
    for name, times in times_computed.items():
        if not 1.0 / _FAR < abs(times) < _FAR:
            unit = next((u for u, size in _UNITS.items() if 1.0 / _NEAR < abs(times) / size < _NEAR), "another unit")
            columns.setdefault(unit, []).append(f"{name}_Nm ({abs(times):.2g} times)")
    for unit, strange in columns.items():
        yield (
            f"measured torques are far from the loads that the rig file's masses make, as if in {unit} or of another "
            f"shaft: {', '.join(strange)}; convert them to N m at the joint"
        )
