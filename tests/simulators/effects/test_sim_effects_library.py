"""Every effect that the simulated machine can hide, against numbers and identities from elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest

from calibration.rig.description import Rig, shipped_rig
from simulators.devices.machine import Machine
from simulators.effects.base import Effect
from simulators.effects.library import FAMILIES, LIBRARY, OUTSIDE, parse_effects
from simulators.rig.dataset import random_poses
from simulators.rig.motion import BoomMotion
from simulators.rig.screws import rotation_by_vector
from simulators.rig.truth import RigTruth, replace_effects
from tests.simulated.observations import simulate_observations
from tests.simulators.matrices import Matrix, frames_by_matrices

N = 12
TIME_S = np.linspace(100.0, 7300.0, N)
WARM_DEGC = np.linspace(4.0, 26.0, N)


@pytest.fixture(scope="module")
def truth() -> RigTruth:
    return RigTruth(shipped_rig("swdt82"), 3)


@pytest.fixture(scope="module")
def joints(truth: RigTruth) -> dict[str, Matrix]:
    return random_poses(truth.rig, N, np.random.default_rng(4))


def place(truth: RigTruth, text: str, joints: dict[str, Matrix], *, prism: str = "r", **columns: Matrix) -> Matrix:
    return replace_effects(truth, parse_effects(text)).prism_mm(prism, joints, columns)


def in_base(truth: RigTruth, places_mm: Matrix) -> Matrix:
    there = truth.placement()
    return (places_mm - there.position_mm) @ there.rotation


def frames(truth: RigTruth, joints: dict[str, Matrix]) -> list[list[Matrix]]:
    return [frames_by_matrices(truth, {k: float(v[i]) for k, v in joints.items()}) for i in range(N)]


def angle(joints: dict[str, Matrix], name: str) -> Matrix:
    return np.deg2rad(joints[name])


def flatness(truth: RigTruth, joints: dict[str, Matrix]) -> Matrix:
    """Cosine of the boom's elevation."""
    booms = np.array([(T[5] - T[4])[:3, 3] for T in frames(truth, joints)])
    up = truth.placement().rotation.T @ [0.0, 0.0, 1.0]
    return np.cos(np.arcsin(booms @ up / np.linalg.norm(booms, axis=1)))


# What each effect at a joint adds to its value, in rad or mm.
Change = Callable[[RigTruth, dict[str, Matrix]], Matrix]
AT_JOINTS: dict[str, tuple[dict[str, Matrix], Change]] = {
    "angle_scale@theta3:scale=2e-3": ({}, lambda truth, q: 2e-3 * angle(q, "theta3")),
    "transducer_quadratic@L2:mm_per_m2=6": ({}, lambda truth, q: 6.0 * (q["L2"] / 1e3 - 1.084) ** 2),
    "transducer_index_jump@L3:jump_mm=7:time_s=2000": (
        {"time_s": TIME_S},
        lambda truth, q: np.where(TIME_S > 2000.0, 7.0, 0.0),
    ),
    "zero_step@theta4:jump_rad=4e-3:time_s=2000": (
        {"time_s": TIME_S},
        lambda truth, q: np.where(TIME_S > 2000.0, 4e-3, 0.0),
    ),
    "transducer_cumulative@L2:mm_per_m=0.2": (
        {},
        lambda truth, q: 0.2 * np.append(0.0, np.cumsum(np.abs(np.diff(q["L2"])))) / 1e3,
    ),
    "transducer_cumulative@L3:mm_per_m=0.1": ({"L3_travel_m": TIME_S / 100}, lambda truth, q: TIME_S / 1000),
    "cylinder_compression@L2:mm_per_bar=0.02": ({"L2_bar": 10.0 * WARM_DEGC}, lambda truth, q: 0.2 * WARM_DEGC),
    "leak_down@theta4:rad_per_s=2e-5": ({"dwell_s": TIME_S / 50}, lambda truth, q: -2e-5 * TIME_S / 50),
    "gear_mesh@theta1:cos_rad=1e-3:sin_rad=5e-4": (
        {},
        lambda truth, q: 1e-3 * np.cos(9 * angle(q, "theta1")) + 5e-4 * np.sin(9 * angle(q, "theta1")),
    ),
    "cross_law@theta5:rad=2e-3": (
        {},
        lambda truth, q: 2e-3 * np.sin(3 * angle(q, "theta4")) * (q["L2"] / 1084.0 - 1.0),
    ),
    "thermal_cross@theta4:rad_at_10K=2e-3:at_degC=10": (
        {"temperature_degC": WARM_DEGC},
        lambda truth, q: 2e-3 * (WARM_DEGC - 10.0) / 10.0 * q["L2"] / 2168.0,
    ),
    "stick_slip_rate@theta6:rad=2e-3:deg_per_s=0.2": (
        {"theta6_rate": np.linspace(-0.9, 0.9, N)},
        lambda truth, q: 2e-3 * np.tanh(np.linspace(-4.5, 4.5, N)),
    ),
}


@pytest.mark.parametrize("text", AT_JOINTS)
def test_an_effect_at_a_joint_changes_its_value_by_its_equation(truth, joints, text: str) -> None:
    columns, change = AT_JOINTS[text]
    where = parse_effects(text)[0].where
    added = change(truth, joints)
    moved = dict(joints)
    moved[where] = joints[where] + (np.rad2deg(added) if where.startswith("theta") else added)
    want = truth.prism_mm("r", moved)
    assert np.allclose(place(truth, text, joints, **columns), want, atol=1e-6)
    assert np.abs(want - truth.prism_mm("r", joints)).max() > 0.5


# Those that depend on the posture in which they end: what is added to the joint, given the posture.
IN_POSTURE: dict[str, tuple[dict[str, Matrix], Change]] = {
    "gravity_flip_play@theta6:width_rad=2e-3": (
        {},
        lambda truth, q: 1e-3 * np.sign(truth.gravity_load("theta6", q)),
    ),
    "payload_change@theta4:compliance_rad_per_Nm=1e-7": (
        {"payload_kg": np.full(N, 250.0)},
        lambda truth, q: (
            1e-7
            * (
                truth.gravity_load("theta4", q, {"payload_kg": np.full(N, 250.0)})
                - truth.gravity_load("theta4", q, {"payload_kg": np.zeros(N)})
            )
        ),
    ),
    "solar_bow@theta4:rad_per_K=2e-4:at_degC=12": (
        {"temperature_degC": WARM_DEGC},
        lambda truth, q: 2e-4 * (WARM_DEGC - 12.0) * flatness(truth, q),
    ),
    "creep@theta4:rad_per_Nm=5e-9:tau_s=20": (
        {"dwell_s": TIME_S / 50},
        lambda truth, q: 5e-9 * truth.gravity_load("theta4", q) * np.log(1.0 + TIME_S / 1000),
    ),
}


@pytest.mark.parametrize("text", IN_POSTURE)
def test_an_effect_of_the_posture_belongs_to_the_posture_in_which_it_ends(truth, joints, text: str) -> None:
    columns, change = IN_POSTURE[text]
    where = parse_effects(text)[0].where
    ended = dict(joints)
    for _ in range(12):
        ended[where] = joints[where] + np.rad2deg(change(truth, ended))
    want = truth.prism_mm("r", ended)
    assert np.allclose(place(truth, text, joints, **columns), want, atol=1e-3)
    assert np.abs(want - truth.prism_mm("r", joints)).max() > 2.0


def test_the_sun_bows_the_link_that_a_standard_dh_joint_turns() -> None:
    """UR10: q2 turns about the axis at frame 1, and moves the upper arm from there to frame 2."""
    truth = RigTruth(shipped_rig("ur10"), 3)
    pose = {j.name: np.zeros(N) for j in truth.rig.joints} | {"q2": np.linspace(-80.0, 60.0, N)}
    bowed = place(truth, "solar_bow@q2:rad_per_K=1e-4:at_degC=0", pose, prism="tmac", temperature_degC=np.full(N, 10.0))
    up = truth.placement().rotation.T @ [0.0, 0.0, 1.0]
    flat = []
    for T in frames(truth, pose):
        arm = (T[2] - T[1])[:3, 3]
        flat.append(np.cos(np.arcsin(arm @ up / np.linalg.norm(arm))))
    want = dict(pose, q2=pose["q2"] + np.rad2deg(1e-3 * np.array(flat)))
    assert np.allclose(bowed, truth.prism_mm("tmac", want), atol=1e-3)


class TestErrorMap:
    def test_its_curve_has_the_rms_asked_for_over_the_joints_range(self, truth) -> None:
        level = {j.name: np.full(400, sum(j.limits) / 2) for j in truth.rig.joints}
        level["theta3"] = np.linspace(30.0, 150.0, 400)
        for shape in ("", ":lines=2:highest=30"):
            text = f"joint_error_map@theta3:rms_rad=2e-3:seed=5{shape}"
            moved = np.linalg.norm(place(truth, text, level) - truth.prism_mm("r", level), axis=1)
            lever = np.linalg.norm(np.diff(truth.prism_mm("r", level), axis=0), axis=1).mean() / np.deg2rad(120 / 399)
            assert np.sqrt(np.mean(moved**2)) / lever == pytest.approx(2e-3, rel=0.02)

    def test_another_seed_is_another_curve_and_the_same_seed_the_same(self, truth, joints) -> None:
        first, again, other = (place(truth, f"joint_error_map@theta3:seed={s}", joints) for s in (1, 1, 2))
        assert np.array_equal(first, again)
        assert np.abs(first - other).max() > 1.0

    def test_lines_repeat_with_the_turn(self) -> None:
        truth = RigTruth(shipped_rig("ur10"), 1)
        pose = random_poses(truth.rig, N, np.random.default_rng(1)) | {"q1": np.linspace(-350.0, 0.0, N)}
        text = "joint_error_map@q1:lines=3:highest=12"
        once, twice = (
            place(truth, text, p, prism="tmac") - truth.prism_mm("tmac", p)
            for p in (pose, pose | {"q1": pose["q1"] + 360.0})
        )
        assert np.allclose(once, twice, atol=1e-9)


def test_steel_grows_from_the_bases_origin(truth, joints) -> None:
    got = in_base(truth, place(truth, "thermal_expansion@boom:per_K=12e-6", joints, temperature_degC=WARM_DEGC))
    cold = in_base(truth, truth.prism_mm("r", joints))
    assert np.allclose(got, cold * (1.0 + 12e-6 * (WARM_DEGC - 15.0))[:, None], atol=1e-9)
    # Ten metres, eleven kelvin: 1.3 mm.
    assert np.linalg.norm(got[-1] - cold[-1]) == pytest.approx(12e-6 * 11.0 * np.linalg.norm(cold[-1]))


def test_a_base_step_turns_and_lifts_the_whole_machine_after_its_time(truth, joints) -> None:
    text = "base_step@base:tilt_x_rad=1e-3:tilt_y_rad=-2e-3:z_mm=4:time_s=2000"
    got = in_base(truth, place(truth, text, joints, time_s=TIME_S))
    before = in_base(truth, truth.prism_mm("r", joints))
    turned = before @ rotation_by_vector(np.array([[1e-3, -2e-3, 0.0]]))[0].T + [0.0, 0.0, 4.0]
    late = TIME_S > 2000.0
    assert 0 < late.sum() < N
    assert np.allclose(got[late], turned[late], atol=1e-6)
    assert np.allclose(got[~late], before[~late], atol=1e-9)


def test_a_base_shift_moves_and_turns_the_whole_machine_over_the_ground_after_its_time(truth, joints) -> None:
    text = "base_shift@base:x_mm=30:y_mm=-10:heading_rad=5e-3:time_s=2000"
    got = in_base(truth, place(truth, text, joints, time_s=TIME_S))
    before = in_base(truth, truth.prism_mm("r", joints))
    c, s = np.cos(5e-3), np.sin(5e-3)
    turned = before @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [30.0, -10.0, 0.0]
    late = TIME_S > 2000.0
    assert np.allclose(got[late], turned[late], atol=1e-6)
    assert np.allclose(got[~late], before[~late], atol=1e-9)


def test_a_prism_that_slips_in_its_seat_is_elsewhere_in_its_frame_and_no_other_is(truth, joints) -> None:
    text = "prism_seat_step@r:x_mm=5:y_mm=-3:z_mm=8:time_s=2000"
    moved = place(truth, text, joints, time_s=TIME_S) - truth.prism_mm("r", joints)
    for i, T in enumerate(frames(truth, joints)):
        slipped = truth.placement().rotation @ T[9][:3, :3] @ [5.0, -3.0, 8.0]
        assert np.allclose(moved[i], slipped if TIME_S[i] > 2000.0 else 0.0, atol=1e-8)
    assert np.array_equal(place(truth, text, joints, prism="s", time_s=TIME_S), truth.prism_mm("s", joints))


def test_a_link_that_gives_way_to_the_side_turns_about_its_bearing_across_its_axis(truth, joints) -> None:
    """The slewing column's bearing, at the origin of frame 3, under all weights beyond: moments from matrices."""
    soft = 5e-9
    moved = in_base(truth, place(truth, f"lateral_compliance@theta3:compliance_rad_per_Nm={soft}", joints))
    moved = moved - in_base(truth, truth.prism_mm("r", joints))
    down = truth.placement().rotation.T @ [0.0, 0.0, -9.80665]
    masses = truth._build_masses(np.random.default_rng([truth.seed, 2]), 1.0)
    for i, T in enumerate(frames(truth, joints)):
        bearing, axis = T[3][:3, 3], T[3][:3, 2]
        moment = np.zeros(3)
        for mass in masses:
            if mass.frame >= 3:
                place_mm = T[mass.frame][:3, :3] @ mass.place_mm + T[mass.frame][:3, 3]
                moment += np.cross((place_mm - bearing) / 1e3, mass.kg * down)
        tilt = soft * (moment - (moment @ axis) * axis)
        arm = in_base(truth, truth.prism_mm("r", joints))[i] - bearing
        assert np.allclose(moved[i], np.cross(tilt, arm), atol=0.01 * np.linalg.norm(moved[i]))
    assert np.abs(moved).max() > 2.0


def test_a_coupled_row_gives_way_and_the_joints_own_row_does_not(truth, joints) -> None:
    """Row 2 of the boom keeps its bracket upright: it turns about its own axis, in a direction that is level."""
    text = "passive_compliance@row2:compliance_rad_per_Nm=5e-9"
    moved = in_base(truth, place(truth, text, joints)) - in_base(truth, truth.prism_mm("r", joints))
    for i, T in enumerate(frames(truth, joints)):
        arm = in_base(truth, truth.prism_mm("r", joints))[i] - T[2][:3, 3]
        # Small turns about the axis are across arm and axis both.
        size = np.linalg.norm(moved[i]) * np.linalg.norm(arm)
        assert abs(moved[i] @ arm) < 0.01 * size
        assert abs(moved[i] @ T[2][:3, 2]) < 0.01 * size
    assert np.abs(moved).max() > 2.0


def test_settlement_grows_by_the_hour_from_the_first_row(truth, joints) -> None:
    text = "base_settlement@base:tilt_x_rad_per_h=0:tilt_y_rad_per_h=5e-4:z_mm_per_h=-1.5"
    got = in_base(truth, place(truth, text, joints, time_s=TIME_S))
    before = in_base(truth, truth.prism_mm("r", joints))
    for i, hours in enumerate((TIME_S - 100.0) / 3600.0):
        turned = rotation_by_vector(np.array([[0.0, 5e-4 * hours, 0.0]]))[0] @ before[i]
        sunk = np.array([0.0, 0.0, 1.5 * hours])
        assert np.allclose(got[i], turned - sunk, atol=1e-6)
    # About the y axis to the positive side: what is ahead along x goes down.
    ahead = before[:, 0] > 1000.0
    assert np.all((got - before)[ahead & (TIME_S > 200.0), 2] < 0.0)


def test_gravity_stays_upright_when_the_base_tilts(truth, joints) -> None:
    """A tilt of the base moves a boom's droop with it, to a part in a thousand: load follows the tilt alone."""
    tilt = "base_step@base:tilt_x_rad=2e-3:tilt_y_rad=0:z_mm=0:time_s=0"
    both = place(truth, f"boom_droop@boom,{tilt}", joints, time_s=TIME_S)
    bent = in_base(truth, place(truth, "boom_droop@boom", joints))
    want = bent @ rotation_by_vector(np.array([[2e-3, 0.0, 0.0]]))[0].T
    droop = np.linalg.norm(bent - in_base(truth, truth.prism_mm("r", joints)), axis=1).max()
    assert np.abs(in_base(truth, both) - want).max() < 5e-3 * droop


def test_a_late_fix_shows_where_the_joints_were(truth, joints) -> None:
    rates = {f"{j.name}_rate": np.linspace(-0.045, 0.045, N) * j.max_rate for j in truth.rig.joints}
    earlier = {name: values - 0.1 * rates[f"{name}_rate"] for name, values in joints.items()}
    assert np.allclose(place(truth, "latency@clock:seconds=0.1", joints, **rates), truth.prism_mm("r", earlier))


def test_clocks_that_drift_make_late_rows_later(truth, joints) -> None:
    rates = {f"{j.name}_rate": np.full(N, 0.5) for j in truth.rig.joints}
    late_s = 20e-6 * (TIME_S - TIME_S[0])
    earlier = {name: values - 0.5 * late_s for name, values in joints.items()}
    got = place(truth, "clock_drift@clock:ppm=20", joints, time_s=TIME_S, **rates)
    assert np.allclose(got, truth.prism_mm("r", earlier), atol=1e-9)


def test_a_coupled_row_turns_further_and_the_joints_own_row_does_not(truth, joints) -> None:
    rows = list(truth.rig.rows)
    rows[1] = rows[1].model_copy(update={"drive": {"theta": {"theta1": -1.003}}})
    other = RigTruth(truth.rig.model_copy(update={"rows": tuple(rows)}), 3)
    for prism in ("w", "r"):
        got = place(truth, "linkage_coupling@theta1:coupling=3e-3", joints, prism=prism)
        # Standing where the true machine stands: the placement depends on the rows.
        want = truth.placement().to_station_mm(in_base(other, other.prism_mm(prism, joints)))
        assert np.allclose(got, want, atol=1e-6)


class TestStation:
    def test_its_scale_stretches_from_the_instruments_centre(self, truth, joints) -> None:
        got = place(truth, "station_scale@station:ppm=30", joints)
        assert np.allclose(got, truth.prism_mm("r", joints) * (1.0 + 30e-6), rtol=1e-12)

    def test_a_prism_constant_lengthens_the_line_of_sight(self, truth, joints) -> None:
        before, got = truth.prism_mm("r", joints), place(truth, "prism_constant@r:mm=30", joints)
        ranges = [np.linalg.norm(places, axis=1) for places in (before, got)]
        assert np.allclose(ranges[1] - ranges[0], 30.0)
        assert np.allclose(before / ranges[0][:, None], got / ranges[1][:, None])

    def test_a_prisms_constant_is_its_own_and_the_stations_is_everyones(self, truth, joints) -> None:
        before = truth.prism_mm("s", joints)
        assert np.array_equal(place(truth, "prism_constant@r", joints, prism="s"), before)
        assert np.array_equal(place(truth, "prism_incidence@r", joints, prism="s"), before)
        assert np.abs(place(truth, "prism_constant@station", joints, prism="s") - before).max() > 1.0

    def test_incidence_follows_the_side_that_the_prism_shows(self, truth, joints) -> None:
        before = truth.prism_mm("r", joints)
        got = place(truth, "prism_incidence@r:cos1_mm=3:sin1_mm=-2", joints)
        longer = np.linalg.norm(got, axis=1) - np.linalg.norm(before, axis=1)
        for i, T in enumerate(frames(truth, joints)):
            axes = truth.placement().rotation @ T[9][:3, :3]
            x, y = axes[:, 0] @ -before[i], axes[:, 1] @ -before[i]
            assert longer[i] == pytest.approx((3.0 * x - 2.0 * y) / np.hypot(x, y), abs=1e-8)


class TestBoom:
    def test_worn_pads_tilt_the_inner_section_about_the_mouth(self, truth, joints) -> None:
        got = in_base(truth, place(truth, "pad_play@boom:clearance_mm=4", joints, prism="b"))
        before = in_base(truth, truth.prism_mm("b", joints))
        for i, T in enumerate(frames(truth, joints)):
            root, boom = T[4][:3, 3], T[5][:3, 3] - T[4][:3, 3]
            axis = boom / np.linalg.norm(boom)
            lever = before[i] - (root + 5000.0 * axis)
            tilt = 4.0 / (1.4 * 2168.0 - joints["L2"][i])
            # Head and feed pull the tip down; the tilt is in the upright plane of the boom.
            down = truth.placement().rotation.T @ [0.0, 0.0, -1.0]
            level = np.cross(axis, down) / np.linalg.norm(np.cross(axis, down))
            assert np.allclose(got[i] - before[i], tilt * np.cross(level, lever), atol=2e-2)
        assert np.array_equal(place(truth, "pad_play@boom", joints, prism="w"), truth.prism_mm("w", joints))

    def test_a_boom_twists_about_its_axis_by_what_hangs_beside_it(self, truth, joints) -> None:
        """The tip's own place does not move; what is fixed to it turns about the boom."""
        text = "twist_by_reach@boom:flexibility_per_Nm2=2e-8"
        moved = in_base(truth, place(truth, text, joints)) - in_base(truth, truth.prism_mm("r", joints))
        turns = []
        for i, T in enumerate(frames(truth, joints)):
            tip, boom = T[5][:3, 3], T[5][:3, 3] - T[4][:3, 3]
            lever = in_base(truth, truth.prism_mm("r", joints))[i] - tip
            across = np.cross(boom / np.linalg.norm(boom), lever)
            turns.append(moved[i] @ across / (across @ across))
            assert np.linalg.norm(moved[i] - turns[-1] * across) < 0.02 * np.linalg.norm(moved[i]) + 1e-6
        assert 1e-4 < np.abs(turns).max() < 2e-2

    def test_a_carrier_rocks_towards_its_boom(self, truth, joints) -> None:
        before = truth.prism_mm("r", joints)
        assert np.all((place(truth, "base_rocking@base:rad_per_Nm=5e-9", joints) - before)[:, 2] < -1.0)


def test_a_prism_on_a_mast_hangs_to_where_gravity_pulls_it(truth, joints) -> None:
    moved = place(truth, "prism_mast_bend@r:mm=5", joints) - truth.prism_mm("r", joints)
    for i, T in enumerate(frames(truth, joints)):
        mast = truth.placement().rotation @ T[9][:3, 2]
        assert np.allclose(moved[i], 5.0 * np.cross(mast, np.cross([0.0, 0.0, -1.0], mast)), atol=1e-9)
    assert np.all(moved[:, 2] <= 0.0)
    assert np.array_equal(place(truth, "prism_mast_bend@r", joints, prism="s"), truth.prism_mm("s", joints))


@pytest.mark.parametrize("text", ["valve_current_error@theta4", "stiffening_compliance@theta4:knee_Nm=40000"])
def test_effects_of_other_simulations_are_known_by_name(truth, joints, text: str) -> None:
    columns = {"boom_valve_mA": np.full(N, 400.0), "pump_bar": np.full(N, 150.0)}
    assert np.abs(place(truth, text, joints, **columns) - truth.prism_mm("r", joints)).max() > 1.0


NEEDS = {
    "transducer_index_jump@L2": "time_s",
    "thermal_expansion@boom": "temperature_degC",
    "solar_bow@theta4": "temperature_degC",
    "base_settlement@base": "time_s",
    "base_step@base": "time_s",
    "base_shift@base": "time_s",
    "zero_step@theta4": "time_s",
    "prism_seat_step@r": "time_s",
    "payload_change@theta4": "payload_kg",
    "cylinder_compression@L3": "L3_bar",
    "leak_down@theta4": "dwell_s",
    "latency@clock": "theta1_rate",
    "clock_drift@clock": "time_s",
    "stick_slip_rate@theta5": "theta5_rate",
    "thermal_cross@theta4": "temperature_degC",
    "creep@theta4": "dwell_s",
}


@pytest.mark.parametrize("text", NEEDS)
def test_what_an_effect_needs_and_the_caller_lacks_is_said(truth, joints, text: str) -> None:
    with pytest.raises(ValueError, match=f"needs the column '{NEEDS[text]}'"):
        place(truth, text, joints)


@pytest.mark.parametrize(
    "text",
    [
        *("angle_scale@L2", "gravity_flip_play@L2", "joint_error_map@L2", "leak_down@L2", "solar_bow@boom"),
        *("transducer_quadratic@theta4", "transducer_index_jump@theta4", "transducer_cumulative@theta4"),
        *("cylinder_compression@theta4", "thermal_expansion@base", "base_settlement@boom", "base_step@station"),
        *("latency@station", "clock_drift@theta4", "station_scale@clock", "prism_constant@theta4"),
        *("prism_incidence@station", "linkage_coupling@theta4", "linkage_coupling@L2", "pad_play@L2"),
        *("payload_change@L2", "joint_error_map@theta4:length_deg=0", "joint_error_map@theta4:highest=2"),
        *("cross_law@theta1", "gear_mesh@L3", "thermal_cross@L2", "stick_slip_rate@theta4:deg_per_s=0"),
        *("zero_step@L2", "prism_seat_step@theta4", "prism_seat_step@station", "base_shift@boom"),
        *("lateral_compliance@theta1", "lateral_compliance@L2", "passive_compliance@row1", "passive_compliance@theta1"),
        *("creep@theta4:tau_s=0", "twist_by_reach@theta4", "base_rocking@boom", "prism_mast_bend@station"),
    ],
)
def test_an_effect_at_an_impossible_place_or_of_an_impossible_shape_is_refused(swdt82: Rig, text: str) -> None:
    with pytest.raises(ValueError, match=text.split("@", maxsplit=1)[0]):
        RigTruth(swdt82, 1, effects=parse_effects(text))


@pytest.mark.parametrize(
    "text",
    [
        "pad_play@boom",
        "passive_compliance@row2",
        "payload_change@q2",
        "linkage_coupling@q2",
        "twist_by_reach@boom",
        "thermal_cross@q2",
    ],
)
def test_a_rig_without_the_part_has_no_such_effect(text: str) -> None:
    with pytest.raises(ValueError, match="ur10"):
        RigTruth(shipped_rig("ur10"), 1, effects=parse_effects(text))


def columns_for(rig: Rig) -> dict[str, Matrix]:
    columns = {"time_s": TIME_S, "temperature_degC": WARM_DEGC, "dwell_s": TIME_S / 50, "payload_kg": np.full(N, 200.0)}
    for joint in rig.joints:
        columns |= {f"{joint.name}_dir": np.ones(N), f"{joint.name}_rate": np.full(N, 0.4)}
    columns |= {"L2_bar": np.full(N, 90.0), "arm_valve_mA": np.full(N, 400.0), "pump_bar": np.full(N, 150.0)}
    return columns


DEFAULT_PLACES = ("L2", "theta1", "theta4", "boom", "base", "clock", "station", "r", "row2")


def anywhere(family: str, rig: Rig) -> Effect:
    """The effect with its default coefficients at the first of a few places that it fits."""
    kind = FAMILIES[family]
    for where in DEFAULT_PLACES:
        effect = kind(where=where)
        try:
            effect.check(rig)
        except ValueError:
            continue
        return effect
    raise AssertionError(family)


@pytest.mark.parametrize("family", FAMILIES)
def test_half_the_coefficients_are_half_the_effect(truth, joints, family: str) -> None:
    columns = columns_for(truth.rig)
    effect = anywhere(family, truth.rig)
    assert set(effect.amplitudes) <= {f.name for f in fields(effect)}
    before = truth.prism_mm("r", joints, columns)
    whole, half = (
        replace_effects(truth, [type(effect)(effect.where, **{n: s * getattr(effect, n) for n in effect.amplitudes})])
        for s in (1e-2, 5e-3)
    )
    moved = [machine.prism_mm("r", joints, columns) - before for machine in (whole, half)]
    assert np.linalg.norm(moved[0]) > 0.0
    assert np.allclose(moved[0], 2.0 * moved[1], atol=0.02 * np.abs(moved[0]).max())


def test_library_and_outside_are_apart_and_the_library_is_the_contracts() -> None:
    assert not set(LIBRARY) & set(OUTSIDE)
    assert len(OUTSIDE) >= 6
    contract = """joint_compliance boom_droop pad_play backlash gravity_flip_play load_hysteresis encoder_harmonic
    joint_error_map angle_scale transducer_scale transducer_quadratic transducer_index_jump transducer_cumulative
    thermal_expansion solar_bow base_settlement base_step payload_change cylinder_compression leak_down latency
    clock_drift station_scale prism_constant prism_incidence linkage_coupling base_compliance base_shift
    lateral_compliance passive_compliance prism_seat_step zero_step"""
    assert list(LIBRARY) == contract.split()


@pytest.mark.parametrize(
    "text", ["thermal_expansion@boom", "solar_bow@theta4", "base_settlement@base", "clock_drift@clock"]
)
def test_once_anchored_an_effect_is_the_same_for_any_part_of_the_rows(truth, joints, text: str) -> None:
    columns = columns_for(truth.rig)
    (effect,) = parse_effects(text)
    fixed = replace_effects(truth, [effect.anchored(TIME_S[0], float(WARM_DEGC.mean()))])
    whole = fixed.prism_mm("r", joints, columns)
    assert np.allclose(whole, replace_effects(truth, [effect]).prism_mm("r", joints, columns), atol=1e-9)
    late = slice(7, N)
    part = fixed.prism_mm("r", {k: v[late] for k, v in joints.items()}, {k: v[late] for k, v in columns.items()})
    assert np.array_equal(whole[late], part)


def test_simulated_observations_count_time_and_warmth_over_all_prisms(swdt82: Rig) -> None:
    """Prisms in turn: each has rows of its own, and the same zero of time and temperature."""
    degrees = np.linspace(0.0, 30.0, 12)
    text = "thermal_expansion@boom:per_K=2e-5,base_settlement@base,transducer_cumulative@L2"
    data = simulate_observations(
        RigTruth(swdt82, 3, effects=parse_effects(text)),
        12,
        5,
        prisms_per_pose="one",
        noise_mm=0.0,
        joint_noise=False,
        columns={"temperature_degC": degrees},
    )
    first_s = float(data.columns["time_s"].astype(float).min())
    pinned = RigTruth(swdt82, 3, effects=[effect.anchored(first_s, 15.0) for effect in parse_effects(text)])
    read = {j.name: data.columns[j.column].astype(float) for j in swdt82.joints}
    numbers = {k: data.columns[k].astype(float) for k in ("time_s", "temperature_degC")}
    for prism in swdt82.prism_names:
        rows = data.columns["prism"] == prism
        assert np.allclose(data.measured_mm[rows], pinned.prism_mm(prism, read, numbers)[rows], atol=1e-9)


class TestLive:
    """The machine behind the simulated devices."""

    def machine(self, rig: Rig, text: str) -> tuple[Machine, BoomMotion]:
        motion = BoomMotion(rig)
        return Machine(RigTruth(rig, 3, effects=parse_effects(text)), 1, motion), motion

    def test_a_step_moves_the_prisms_when_its_time_has_come(self, swdt82: Rig) -> None:
        machine, _ = self.machine(swdt82, "base_step@base:z_mm=9:tilt_x_rad=0:tilt_y_rad=0:time_s=50")
        early, late = machine.place_mm("r", 49.9), machine.place_mm("r", 50.1)
        assert np.linalg.norm(late - early) == pytest.approx(9.0, abs=1e-6)

    def test_a_late_fix_trails_a_moving_boom(self, swdt82: Rig) -> None:
        late, motion = self.machine(swdt82, "latency@clock:seconds=0.2")
        prompt, same = self.machine(swdt82, "")
        for one in (motion, same):
            one.move(0.0, {"theta3": 120.0}, speed=0.2)
        assert np.allclose(late.place_mm("r", 3.2), prompt.place_mm("r", 3.0), atol=1e-3)
        assert np.linalg.norm(late.place_mm("r", 3.2) - prompt.place_mm("r", 3.2)) > 50.0

    def test_a_leak_begins_when_the_motion_ends(self, swdt82: Rig) -> None:
        machine, motion = self.machine(swdt82, "leak_down@theta4:rad_per_s=4e-5")
        end = motion.move(0.0, {"theta4": 30.0})
        heights = [machine.place_mm("r", end + wait)[2] for wait in (0.0, 100.0, 200.0)]
        assert heights[0] - heights[1] > 10.0
        assert heights[1] - heights[2] == pytest.approx(heights[0] - heights[1], rel=0.05)

    def test_a_slipping_wire_counts_the_way_there_and_back(self, swdt82: Rig) -> None:
        machine, motion = self.machine(swdt82, "transducer_cumulative@L2:mm_per_m=0.3")
        start = machine.place_mm("b", 0.0)
        motion.move(0.0, {"L2": 84.0})
        end = motion.move(0.0, {"L2": 1084.0})
        assert motion.values(end)["L2"] == pytest.approx(1084.0)
        assert np.linalg.norm(machine.place_mm("b", end) - start) == pytest.approx(0.6, abs=1e-6)

    def test_warmth_is_that_of_the_oil(self, swdt82: Rig) -> None:
        machine, _ = self.machine(swdt82, "thermal_expansion@boom:per_K=2e-5")
        grown = np.linalg.norm(machine.place_mm("r", 7200.0) - machine.place_mm("r", 0.0))
        assert 1.0 < grown < 5.0

    def test_an_effect_of_what_the_machine_does_not_sense_is_refused_at_once(self, swdt82: Rig) -> None:
        with pytest.raises(ValueError, match="needs the column 'payload_kg'"):
            self.machine(swdt82, "payload_change@theta4")
