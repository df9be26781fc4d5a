"""A background is widened by what the errors ask for, and by nothing where they are noise."""

from __future__ import annotations

from calibration.gap.background.blocks import Block, possible_blocks, smooth_blocks
from calibration.gap.background.search import search_given_background
from calibration.gap.background.system import Model, System
from calibration.gap.background.widening import further_blocks
from calibration.gap.joint_fit import Problem
from calibration.identification.solve import solve
from calibration.observations import parse_observations
from calibration.run_settings import DEFAULT_RUN
from daemon.rig_files import load_rig
from simulators.effects.base import Effect
from simulators.effects.unknown import JointPairError, draw_surface
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
RIG = SOURCE.rig
UNKNOWN = JointPairError("theta1", rms_rad=3e-3, seed=5)


def beside_smooth(*effects: Effect) -> tuple[System, Model, list[Block]]:
    """Return the model beside the smooth background of a simulated machine, and what it may be widened by."""
    data = simulate_observations(RigTruth(RIG, 1, effects=effects), 120, 1, noise_mm=1.0, prisms=("r",))
    rows = parse_observations(data.csv_text().encode(), RIG, "machine.csv")
    own = Problem(solve(RIG, rows, prior="recalibration", run=DEFAULT_RUN), rows, "recalibration", 0)
    joint = own.with_mild_outliers(own.kinematics_only())
    average = own.solution.samples.average
    found = search_given_background(own, joint, smooth_blocks(joint.context, average), ("angle_scale",), ())
    return *found, list(possible_blocks(joint.context, average))


def test_an_error_that_two_distant_joints_decide_is_taken_into_the_background() -> None:
    surface = draw_surface(RIG, UNKNOWN.seed)
    pair = sorted((surface.first, surface.second), key=RIG.joint_names.index)
    assert abs(RIG.joint_names.index(pair[0]) - RIG.joint_names.index(pair[1])) > 1
    system, model, possible = beside_smooth(UNKNOWN)
    further = further_blocks(system, model, lambda: iter(possible))
    assert further[0].name == f"surface({' and '.join(pair)})@theta1"
    assert not {block.name for block in further} & set(system.blocks)


def test_noise_asks_for_nothing() -> None:
    system, model, possible = beside_smooth()
    assert further_blocks(system, model, lambda: iter(possible)) == ()
