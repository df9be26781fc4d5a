"""The simulated rig when its process is no longer there."""

from __future__ import annotations

import uuid
from functools import partial
from pathlib import Path

import pytest

from daemon.acquisition.simulated_rig import SimulatedRig, SimulationError
from drivers.clock import ScaledClock, Stamp, SystemClock


def test_a_simulated_rig_whose_process_has_died_says_how_to_start_it_again(tmp_path: Path) -> None:
    now = SystemClock().now()
    clock = ScaledClock(20.0, Stamp(now.utc_ns, now.monotonic_ns, f"simulated-{uuid.uuid4()}"))
    simulation = SimulatedRig("swdt82", {}, tmp_path, clock)
    try:
        assert not simulation.has_ended()
        simulation._process.kill()
        simulation._process.wait()
        assert simulation.has_ended()
        for ask in (partial(simulation.aim, "r"), partial(simulation.aim, "r"), partial(simulation.visit, [])):
            with pytest.raises(
                SimulationError, match=r"^the simulated rig has ended; .* start both again with `rigcal run --sim`"
            ):
                ask()
    finally:
        simulation.close()
