"""The projection off what kinematics do, by products alone and by rows."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.gap.projected.projection import SoftProjection
from calibration.numerics.matrices import gram


def test_rows_and_products_are_those_of_noise_and_kinematics_together() -> None:
    rng = np.random.default_rng(0)
    kinematics, rows = rng.normal(size=(300, 90)), rng.normal(size=(300, 5))
    kinematics[:, 20:] *= rng.random((300, 70)) < 0.05  # splines: most of these are zero
    together = np.linalg.inv(np.eye(300) + kinematics @ kinematics.T)
    soft = SoftProjection(kinematics)
    projected, removed = soft(rows), soft.removed(rows)
    np.testing.assert_allclose(gram(kinematics), kinematics.T @ kinematics, atol=1e-12)
    np.testing.assert_allclose(projected.T @ projected, rows.T @ together @ rows, atol=1e-10)
    np.testing.assert_allclose(rows.T @ rows - removed.T @ removed, rows.T @ together @ rows, atol=1e-10)
    assert soft.degrees_of_freedom == pytest.approx(300 - np.trace(together))
