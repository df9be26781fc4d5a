"""What a rig file holds fixed and the data show to be off is named."""

from __future__ import annotations

from calibration.observations import parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import parse_rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text
from tests.simulated.observations import simulate_observations


def test_parallel_axes_without_beta_are_named() -> None:
    whole = shipped_rig("ur10")  # whose axes 2, 3 and 4 are parallel
    data = simulate_observations(RigTruth(whole, 4), 60, 4).csv_text().encode()
    observations = parse_observations(data, whole, "simulated.csv")
    text = rig_text("ur10").replace("[[row]]", '[[row]]\nidentify = ["alpha", "a", "d", "theta"]')

    bare = identify(parse_rig(text, "bare.toml"), text, observations, effects="none")
    full = identify(whole, rig_text("ur10"), observations, effects="none")

    assert any("does not let calibration correct row2.beta, row3.beta, which" in warning for warning in bare.warnings)
    assert not any("correct row" in warning for warning in full.warnings)
