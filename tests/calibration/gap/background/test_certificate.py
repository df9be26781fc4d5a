"""A certificate is a p-value: seldom small where an effect is not there, and corrected for the number of names."""

from __future__ import annotations

import numpy as np

from calibration.gap.background.certificate import _adjusted


def test_p_values_are_corrected_for_false_discoveries() -> None:
    assert np.allclose(_adjusted(np.array([0.01, 0.04, 0.03, 1.0])), [0.04, 0.16 / 3.0, 0.16 / 3.0, 1.0])
    assert _adjusted(np.array([0.03]))[0] == 0.03
