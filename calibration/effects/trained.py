"""What a family that moves prisms keeps of its training rows: how large its columns were there.

In rows that lack what an effect needs it may be anything that it was in training.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.effects.base import PrismFamily, Settings
from calibration.observations import Floats


class TrainedFamily(PrismFamily):
    """A prism family whose settings have the `sizes` of its columns in the training rows."""

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return sum((float(v) * settings[name]) ** 2 for v, name in zip(values, size_names(len(values)), strict=True))


def sizes(shift_mm: Floats) -> dict[str, float]:
    """Settings `size1_mm` ...: RMS of each coordinate per unit of each coefficient, for columns (n, 3, k)."""
    rms = np.sqrt((shift_mm**2).mean(axis=(0, 1))) if len(shift_mm) else np.zeros(shift_mm.shape[2])
    return {name: float(value) for name, value in zip(size_names(len(rms)), rms, strict=True)}


def size_names(coefficients: int) -> tuple[str, ...]:
    """Names of the settings that `sizes` makes."""
    return tuple(f"size{number}_mm" for number in range(1, coefficients + 1))


def check_settings(settings: Settings, names: Sequence[str], coefficients: int) -> None:
    """ValueError unless the settings are these and the sizes of so many coefficients."""
    expected = {*names, *size_names(coefficients)}
    if set(settings) != expected:
        raise ValueError(f"the settings are {', '.join(sorted(expected))}")
    negative = [name for name in size_names(coefficients) if settings[name] < 0.0]
    if negative:
        raise ValueError(f"the setting {negative[0]} is negative")
