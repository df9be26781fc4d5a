"""What a residual has to learn: effects that depend on friction and hydraulics, and the signals that tell of them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.observations import Observations, parse_observations
from calibration.residual.features import usable_signals
from calibration.rig.description import Rig, shipped_rig
from simulators.devices.machine import Machine
from simulators.effects.library import parse_effects
from simulators.hydraulics import VALVE_JOINTS, motion_columns, oil_temperature_degC, pump_bar, valve_current_mA
from simulators.rig.dataset import SimulatedObservations, random_poses
from simulators.rig.motion import BoomMotion
from simulators.rig.truth import RigTruth, replace_effects
from tests.simulated.runs import simulate_runs

Floats = NDArray[np.float64]

N = 30


@pytest.fixture
def truth(swdt82: Rig) -> RigTruth:
    return RigTruth(swdt82, 3)


@pytest.fixture
def joints(swdt82: Rig) -> dict[str, Floats]:
    return random_poses(swdt82, N, np.random.default_rng(4))


def turned(
    truth: RigTruth, text: str, joint: str, joints: dict[str, Floats], columns: dict[str, Floats], prism: str = "r"
) -> Floats:
    """(n,) rad that a joint is off by, from how far a prism on it has moved; small angles."""
    hidden = replace_effects(truth, parse_effects(text))
    moved = hidden.prism_mm(prism, joints, columns) - truth.prism_mm(prism, joints)
    step = dict(joints, **{joint: joints[joint] + np.rad2deg(1e-6)})
    slope = (truth.prism_mm(prism, step) - truth.prism_mm(prism, joints)) / 1e-6
    angle: Floats = np.sum(moved * slope, axis=1) / np.sum(slope**2, axis=1)
    return angle


class TestLoadHysteresis:
    def test_friction_holds_a_joints_encoder_back_in_proportion_to_its_load(self, truth, joints) -> None:
        load = np.abs(truth.gravity_load("theta4", joints))
        for side in (-1.0, 1.0):
            off = turned(
                truth, "load_hysteresis@theta4:rad_per_Nm=1e-9", "theta4", joints, {"theta4_dir": np.full(N, side)}
            )
            assert np.allclose(off, side * 1e-9 * load, rtol=5e-3)

    def test_it_does_not_depend_on_speed_unless_stiction_is_asked_for(self, truth, joints) -> None:
        columns = {"theta4_dir": np.ones(N)}
        plain = turned(truth, "load_hysteresis@theta4:rad_per_Nm=1e-9", "theta4", joints, columns)
        sticky = "load_hysteresis@theta4:rad_per_Nm=1e-9:stiction_share=0.5:stribeck_deg_per_s=0.3"
        at = {
            rate: turned(truth, sticky, "theta4", joints, columns | {"theta4_rate": np.full(N, rate)})
            for rate in (0.0, 0.3, 3.0)
        }
        assert np.allclose(at[0.0], 1.5 * plain, rtol=5e-3)
        assert np.allclose(at[0.3], (1.0 + 0.5 * np.exp(-1.0)) * plain, rtol=5e-3)
        assert np.allclose(at[3.0], plain, rtol=5e-3)

    def test_stiction_without_the_rate_is_refused(self, truth, joints) -> None:
        hidden = replace_effects(truth, parse_effects("load_hysteresis@theta4:stiction_share=0.5"))
        with pytest.raises(ValueError, match="theta4_rate"):
            hidden.prism_mm("r", joints, {"theta4_dir": np.ones(N)})


class TestValveCurrentError:
    TEXT = "valve_current_error@theta3:rad_at_rated=1e-4:knee_mA=25"

    def off(self, truth: RigTruth, joints: dict[str, Floats], current: Floats, pump: float = 200.0) -> Floats:
        columns = {"slew_valve_mA": current, "pump_bar": np.full(N, pump)}
        return turned(truth, self.TEXT, "theta3", joints, columns)

    def test_a_closed_spool_moves_nothing(self, truth, joints) -> None:
        assert np.allclose(self.off(truth, joints, np.linspace(-180.0, 180.0, N)), 0.0, atol=1e-12)

    def test_it_grows_smoothly_past_the_dead_band_and_levels_off(self, truth, joints) -> None:
        one = {k: np.full(N, v[0]) for k, v in joints.items()}
        off = self.off(truth, one, np.linspace(180.0, 750.0, N))
        assert (np.diff(off) > 0.0).all()
        assert off[-1] == pytest.approx(1e-4, rel=0.01)
        assert self.off(truth, one, np.full(N, 205.0))[0] == pytest.approx(0.5e-4, rel=0.01)
        assert np.diff(off)[-1] < 0.01 * np.diff(off).max()

    def test_it_is_odd_in_the_current_and_proportional_to_the_pressure(self, truth, joints) -> None:
        current = np.linspace(185.0, 400.0, N)
        push, pull = self.off(truth, joints, current), self.off(truth, joints, -current)
        assert np.allclose(push, -pull, rtol=1e-3)
        assert np.allclose(self.off(truth, joints, current, pump=100.0), 0.5 * push, rtol=1e-3)


@pytest.mark.parametrize(
    "text",
    [
        "load_hysteresis@L2",
        "load_hysteresis@theta4:stribeck_deg_per_s=0",
        "valve_current_error@theta5",
        "valve_current_error@L3",
        "valve_current_error@theta4:knee_mA=0",
    ],
)
def test_an_effect_at_an_impossible_place_or_of_an_impossible_shape_is_refused(swdt82: Rig, text: str) -> None:
    with pytest.raises(ValueError, match=text.split("@", maxsplit=1)[0]):
        RigTruth(swdt82, 1, effects=parse_effects(text))


def table(simulated: SimulatedObservations, rig: Rig) -> Observations:
    return parse_observations(simulated.csv_text().encode(), rig, "runs.csv")


@pytest.fixture(scope="module")
def runs(swdt82: Rig) -> SimulatedObservations:
    return simulate_runs(RigTruth(swdt82, 3), 12, 40, 5)


class TestRuns:
    def test_thirty_control_signals_make_sixty_six_features(self, swdt82: Rig, runs: SimulatedObservations) -> None:
        observations = table(runs, swdt82)
        assert observations.ignored_columns == ()
        signals = set(usable_signals(observations))
        assert signals == set(observations.extra) - {"time_s"}
        assert len(signals) + len(swdt82.joints) + 3 * len(swdt82.rows) == 66

    def test_the_same_seed_gives_the_same_runs(self, swdt82: Rig, runs: SimulatedObservations) -> None:
        truth = RigTruth(swdt82, 3)
        assert simulate_runs(truth, 12, 40, 5).csv_text() == runs.csv_text()
        assert simulate_runs(truth, 12, 40, 6).csv_text() != runs.csv_text()

    def test_joints_stay_within_their_limits_and_runs_are_the_groups(self, swdt82: Rig, runs) -> None:
        observations = table(runs, swdt82)
        for joint in swdt82.joints:
            low, high = joint.limits
            values = observations.joints[joint.name]
            assert low - 6 * joint.sigma <= values.min() < values.max() <= high + 6 * joint.sigma
        assert len(np.unique(observations.groups())) == 12
        assert np.all(np.diff(observations.extra["time_s"]) > 0.0)

    def test_rates_are_the_slopes_of_the_readings(self, swdt82: Rig, runs: SimulatedObservations) -> None:
        observations = table(runs, swdt82)
        time_s, session = observations.extra["time_s"], observations.session
        for joint in swdt82.joints:
            value, rate = observations.joints[joint.name], observations.extra[f"{joint.name}_rate"]
            near = np.flatnonzero((np.diff(time_s) < 1.0) & (session[1:] == session[:-1]))
            assert len(near) > 10
            slope = np.diff(value)[near] / np.diff(time_s)[near]
            between = (rate[near] + rate[near + 1]) / 2
            tolerance = 0.02 * np.abs(rate).max() + 8.0 * joint.sigma / np.diff(time_s)[near]
            assert np.all(np.abs(slope - between) < tolerance)

    def test_direction_current_and_rate_agree_while_a_joint_moves(self, swdt82: Rig, runs) -> None:
        extra = table(runs, swdt82).extra
        for valve, name in VALVE_JOINTS.items():
            rate, current = extra[f"{name}_rate"], extra[f"{valve}_valve_mA"]
            moves = np.abs(rate) > 20 * swdt82.joint(name).sigma
            assert 0.2 < moves.mean() < 0.8
            assert np.array_equal(np.sign(rate[moves]), extra[f"{name}_dir"][moves])
            assert np.array_equal(np.sign(current[moves]), np.sign(rate[moves]))
            want = valve_current_mA(rate[moves] / swdt82.joint(name).max_rate)
            assert np.abs(current[moves] - want).max() < 30.0
        standing = extra["dwell_s"] > 0.0
        assert standing.mean() == pytest.approx(0.25)
        assert not extra["boom_valve_mA"][standing].any()
        assert extra["pump_bar"][standing].max() < 30.0 < extra["pump_bar"][~standing].mean()

    def test_boom_pressure_follows_the_load_and_the_rods_on_the_feed(self, swdt82: Rig, runs) -> None:
        extra, joints = table(runs, swdt82).extra, table(runs, swdt82).joints
        truth = RigTruth(swdt82, 3)
        torque = np.abs(truth.gravity_load("theta4", joints, {"payload_kg": extra["payload_kg"]}))
        assert np.corrcoef(extra["boom_a_bar"], torque)[0, 1] > 0.999
        empty = np.abs(truth.gravity_load("theta4", joints, {"payload_kg": np.zeros(len(torque))}))
        assert np.corrcoef(extra["boom_a_bar"], empty)[0, 1] < np.corrcoef(extra["boom_a_bar"], torque)[0, 1]
        assert np.abs(extra["boom_a_bar"] - extra["boom_pressure_bar"]).max() < 4.0

    def test_oil_temperature_and_rod_feed_differ_from_run_to_run(self, runs) -> None:
        assert len(np.unique(runs.columns["rod_feed_mm"])) == 12
        assert np.ptp(runs.columns["temperature_degC"].astype(float)) > 5.0

    def test_noise_is_the_stations_the_readings_and_the_timings(self, swdt82: Rig, runs) -> None:
        moving = runs.columns["dwell_s"].astype(float) == 0.0
        error = np.linalg.norm(runs.measured_mm - runs.oracle_mm, axis=1)
        assert 1.5 < np.sqrt(np.mean(error[~moving] ** 2)) < np.sqrt(np.mean(error[moving] ** 2)) < 6.0

    def test_hidden_effects_are_in_the_oracle_and_leave_everything_else_as_it_was(self, swdt82: Rig, runs) -> None:
        text = "load_hysteresis@theta4:stiction_share=0.5,valve_current_error@theta4,valve_current_error@theta3"
        hidden = simulate_runs(RigTruth(swdt82, 3, effects=parse_effects(text)), 12, 40, 5)
        assert hidden.noise_rms_mm == pytest.approx(runs.noise_rms_mm, rel=0.05)
        assert np.linalg.norm(hidden.oracle_mm - runs.oracle_mm, axis=1).max() > 10.0
        for name, values in runs.columns.items():
            if name not in ("x_mm", "y_mm", "z_mm"):
                assert np.array_equal(values, hidden.columns[name])

    def test_a_rig_without_hydraulics_has_its_own_signals_alone(self) -> None:
        rig = shipped_rig("ur10")
        observations = table(simulate_runs(RigTruth(rig, 1), 3, 10, 2), rig)
        assert not [name for name in observations.extra if name.endswith(("_mA", "_bar"))]
        assert {"q1_dir", "q1_rate", "dwell_s"} <= set(observations.extra)


def test_the_pump_idles_when_nothing_moves_and_the_oil_warms() -> None:
    assert pump_bar(0.0) < 30.0 < pump_bar(0.01) < pump_bar(0.3)
    assert pump_bar(0.6) == pump_bar(1.0)
    warm = oil_temperature_degC(np.array([0.0, 600.0, 36_000.0]), 20.0)
    assert warm[0] == 20.0 < warm[1] < warm[2] < 55.01


def test_a_machine_has_signals_for_the_valves_that_it_has() -> None:
    assert motion_columns({"q1": 0.5}) == {}
    assert set(motion_columns({"theta4": 0.5, "theta5": 0.1})) == {"boom_valve_mA", "pump_bar", "boom_b_bar"}
    assert set(motion_columns({"L3": 0.5})) == {"feed_valve_mA", "pump_bar"}


def test_a_live_machine_feels_its_valves_as_a_table_does(swdt82: Rig) -> None:
    text = "load_hysteresis@theta4:stiction_share=0.5,valve_current_error@theta3:rad_at_rated=1e-2"
    truth, plain = RigTruth(swdt82, 3, effects=parse_effects(text)), RigTruth(swdt82, 3)
    start = {j.name: j.limits[0] for j in swdt82.joints}
    motion = BoomMotion(swdt82, start)
    arrival = motion.move(0.0, {"theta3": swdt82.joint("theta3").limits[1]}, speed=0.2)
    live = Machine(truth, 1, motion)
    middle, end = arrival / 2, arrival + 1.0
    for t_s, current in ((middle, float(valve_current_mA(0.2))), (end, 0.0)):
        pose = motion.values(t_s)
        columns = {"theta3_dir": 1.0, "theta3_rate": motion.joint("theta3", t_s)[1], "slew_valve_mA": current}
        columns["pump_bar"] = float(pump_bar(0.2 if current else 0.0))
        assert np.allclose(live.place_mm("r", t_s), live.prism_at_mm("r", pose, columns), atol=1e-6)
        shift = live.place_mm("r", t_s) - plain.prism_mm("r", {k: np.array([v]) for k, v in pose.items()})[0]
        assert (np.linalg.norm(shift) > 10.0) == bool(current)
