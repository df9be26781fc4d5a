"""A certificate is a p-value: seldom small where an effect is not there, and corrected for the number of names."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from calibration.gap.background.certificate import _adjusted, _f_test


def test_p_values_are_corrected_for_false_discoveries() -> None:
    assert np.allclose(_adjusted(np.array([0.01, 0.04, 0.03, 1.0])), [0.04, 0.16 / 3.0, 0.16 / 3.0, 1.0])
    assert _adjusted(np.array([0.03]))[0] == 0.03


def test_rows_that_cannot_show_an_effect_certify_nothing() -> None:
    """As the half of the poses that were all measured after a jump."""
    rows: Any = SimpleNamespace(explained=lambda _model, _effect: (0.0, 0, 5.0), products=SimpleNamespace(rows=10))
    model: Any = None
    assert _f_test(rows, model, (0, 0, 1.0)) == 1.0
