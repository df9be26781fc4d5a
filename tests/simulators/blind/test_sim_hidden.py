"""Cases for a search for missing effects: what they promise to whoever scores it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.observations import parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.blind.duty_cycle import draw_poses
from simulators.blind.hiding import UnreachableError, hide
from simulators.blind.scene import Scene, SceneSettings, draw_scene
from simulators.effects.library import FAMILIES, parse_effects
from simulators.rig.noise import NoiseSettings
from simulators.rig.screws import nominal_constants, pose_chain, screw_chain
from simulators.rig.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]

SMALL = SceneSettings(poses=60, held_out=30)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return shipped_rig("swdt82")


@pytest.fixture(scope="module")
def scene(rig: Rig) -> Scene:
    return draw_scene(rig, 5, SMALL)


def spread_mm(shift: Floats) -> float:
    """3-D RMS about the mean: a base that may be anywhere takes no more."""
    return float(np.sqrt(np.mean(np.sum((shift - shift.mean(axis=0)) ** 2, axis=1))))


def number(table, column: str) -> Floats:
    return table.columns[column].astype(float)


class TestScene:
    def test_the_same_seed_draws_the_same_data_and_another_seed_other_data(self, rig: Rig) -> None:
        texts = [draw_scene(rig, s, SMALL).observe(()).training.csv_text() for s in (5, 5, 6)]
        assert texts[0] == texts[1]
        assert texts[0] != texts[2]

    def test_its_tables_are_the_contracts(self, rig: Rig, scene: Scene) -> None:
        observed = scene.observe(parse_effects("boom_droop@boom"))
        for data, n in ((observed.training, 60), (observed.held_out, 30)):
            table = parse_observations(data.csv_text().encode(), rig, "case.csv")
            assert len(table) == n
            assert table.ignored_columns == ()
            assert {"time_s", "dwell_s", "payload_kg", "temperature_degC", "L2_bar", "theta4_dir"} <= set(table.extra)
        assert "sigma_x_mm" in observed.training.columns
        assert "sigma_x_mm" not in observed.held_out.columns

    def test_its_twin_has_the_same_noise_and_readings(self, scene: Scene) -> None:
        effects = parse_effects("joint_compliance@theta4")
        data, twin = scene.observe(effects).training, scene.observe(()).training
        assert np.array_equal(data.columns["theta4_deg"], twin.columns["theta4_deg"])
        moved = data.measured_mm - twin.measured_mm
        assert np.allclose(moved, scene.displacement_mm(effects), atol=1e-9)
        assert spread_mm(moved) > 1.0

    def test_held_out_poses_are_free_of_noise_and_within_the_times_of_the_training(self, scene: Scene) -> None:
        effects = parse_effects("base_settlement@base")
        observed = scene.observe(effects)
        first_s = number(observed.training, "time_s").min()
        truth = replace_effects(scene.truth, [effects[0].anchored(first_s, 0.0)])
        there = observed.held_out
        joints = {j.name: number(there, j.column) for j in scene.truth.rig.joints}
        want = truth.prism_mm("r", joints, {"time_s": number(there, "time_s")})
        assert np.allclose(there.measured_mm, want)
        times = number(observed.training, "time_s")
        assert times.min() < number(there, "time_s").min()
        assert number(there, "time_s").max() < times.max()
        assert not set(there.columns["pose"].tolist()) & set(observed.training.columns["pose"].tolist())

    def test_a_scene_knows_the_noise_of_fixes_and_readings_together(self, scene: Scene) -> None:
        observed = scene.observe(()).training
        good = ~scene.training.noise.is_outlier
        off = (observed.measured_mm - observed.oracle_mm)[good]
        assert scene.noise_rms_mm == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        assert scene.noise_rms_mm > 1.05 * np.sqrt(np.mean(np.sum(scene.training.noise.error_mm[good] ** 2, axis=1)))

    def test_noise_is_wrongly_stated_by_a_few_percent(self, rig: Rig) -> None:
        ratios = []
        for seed in range(8):
            scene = draw_scene(rig, seed, SMALL)
            ratio = scene.training.stated_sigma_mm / scene.training.noise.sigma_mm
            assert np.ptp(ratio) < 1e-9
            ratios.append(ratio[0, 0])
        assert 0.95 <= min(ratios) < 0.99
        assert 1.01 < max(ratios) <= 1.05

    def test_fixes_of_a_standstill_share_part_of_their_noise(self, rig: Rig) -> None:
        noise = NoiseSettings(common_share=0.5, wander_share=0.0, outliers=0.0)
        settings = SceneSettings(poses=300, held_out=1, repeats=2, noise=noise)
        shift = draw_scene(rig, 1, settings).training.noise.error_mm.reshape(300, 2, 3)
        shared = np.mean(shift[:, 0] * shift[:, 1]) / np.mean(shift**2)
        assert shared == pytest.approx(0.5, abs=0.1)

    def test_noise_may_wander_from_pose_to_pose(self, rig: Rig) -> None:
        noise = NoiseSettings(common_share=0.0, wander_share=0.8, wander_poses=10.0, outliers=0.0)
        shift = draw_scene(rig, 1, SceneSettings(poses=600, held_out=1, noise=noise)).training.noise.error_mm
        neighbours = np.mean(shift[1:] * shift[:-1]) / np.mean(shift**2)
        assert neighbours == pytest.approx(0.8 * np.exp(-0.1), abs=0.12)

    def test_a_few_fixes_are_outliers_and_far_off(self, rig: Rig) -> None:
        noise = draw_scene(rig, 2, SceneSettings(poses=1000, held_out=1)).training.noise
        assert 5 <= noise.is_outlier.sum() <= 28
        size = np.linalg.norm(noise.error_mm, axis=1) / np.linalg.norm(noise.sigma_mm, axis=1)
        assert size[noise.is_outlier].min() > 7.9
        assert size[~noise.is_outlier].max() < 6.0

    def test_coarse_encoders_read_in_their_steps(self, rig: Rig) -> None:
        noise = NoiseSettings(encoder_step_deg=0.1)
        steps = number(draw_scene(rig, 2, replace(SMALL, noise=noise)).observe(()).training, "theta4_deg") / 0.1
        assert np.allclose(steps, np.rint(steps))

    def test_readings_of_creeping_joints_are_a_little_off_their_instant(self, rig: Rig) -> None:
        scene = draw_scene(rig, 2, SceneSettings(poses=400, held_out=1, moving=0.5, noise=NoiseSettings(jitter_s=0.1)))
        rate = scene.training.columns["theta4_rate"]
        off = scene.training.readings["theta4"] - scene.training.joints["theta4"]
        assert np.std(off[rate == 0.0]) < 0.01
        assert np.std(off[rate != 0.0] / rate[rate != 0.0]) == pytest.approx(0.1, rel=0.5)
        assert np.all(np.sign(rate[rate != 0.0]) == scene.training.columns["theta4_dir"][rate != 0.0])
        assert np.all(scene.training.columns["dwell_s"][rate != 0.0] == 0.0)

    def test_columns_can_be_missing_and_decoys_can_be_there(self, rig: Rig) -> None:
        settings = replace(SMALL, missing=("_dir", "temperature_degC"), sigma_columns=False, is_decoy=True)
        columns = draw_scene(rig, 2, settings).observe(()).training.columns
        assert not any(name.endswith("_dir") for name in columns)
        assert "temperature_degC" not in columns
        assert "sigma_x_mm" not in columns
        assert {"spare1_bar", "spare2_mA"} <= set(columns)

    def test_a_decoy_temperature_follows_the_time(self, rig: Rig) -> None:
        for decoy in (True, False):
            data = draw_scene(rig, 2, replace(SMALL, is_decoy=decoy)).observe(()).training
            likeness = np.corrcoef(number(data, "time_s"), number(data, "temperature_degC"))[0, 1]
            assert (likeness > 0.99) == decoy

    def test_the_payload_changes_in_the_course_of_the_shift(self, rig: Rig) -> None:
        for seed in range(5):
            payload = number(draw_scene(rig, seed, SMALL).observe(()).training, "payload_kg")
            assert set(payload.tolist()) == {0.0, 300.0}

    @pytest.mark.parametrize(
        "settings",
        [
            *(SceneSettings(poses=2), SceneSettings(held_out=0), SceneSettings(moving=2.0)),
            *(SceneSettings(noise=NoiseSettings(outliers=2.0)), SceneSettings(noise=NoiseSettings(jitter_s=-1.0))),
            SceneSettings(noise=NoiseSettings(common_share=0.7, wander_share=0.4)),
        ],
    )
    def test_settings_that_mean_nothing_are_refused(self, rig: Rig, settings: SceneSettings) -> None:
        with pytest.raises(ValueError, match=r"of a scene|a scene needs|noise"):
            draw_scene(rig, 1, settings)


class TestFurtherPoses:
    def test_they_are_of_the_same_machine_after_the_shift(self, rig: Rig, scene: Scene) -> None:
        effects = parse_effects("angle_scale@theta3:scale=2e-3,transducer_cumulative@L2:mm_per_m=0.2")
        poses = draw_poses(rig, "wide", 8, np.random.default_rng(3))
        data = scene.measure(effects, poses, 1, columns={"theta4_dir": -np.ones(8)})
        table = parse_observations(data.csv_text().encode(), rig, "more.csv")
        assert len(table) == 8
        before = scene.observe(effects).training
        assert list(data.columns) == list(before.columns)
        assert table.extra["time_s"].min() > number(before, "time_s").max()
        assert not set(data.columns["pose"].tolist()) & set(before.columns["pose"].tolist())
        assert np.all(table.extra["theta4_dir"] == -1.0)
        assert set(table.extra["payload_kg"]) == {number(before, "payload_kg")[-1]}
        # The path goes on where the shift's ended.
        last = {k: v[-1:] for k, v in scene.training.columns.items()}
        way = np.cumsum(np.abs(np.diff(poses["L2"], prepend=scene.training.joints["L2"][-1]))) / 1e3
        places = scene.machine(effects).prism_mm("r", poses, {"L2_travel_m": last["L2_travel_m"] + way})
        assert np.median(np.linalg.norm(data.measured_mm - places, axis=1)) < 10.0


class TestHide:
    def test_effects_are_as_large_as_asked_for(self, scene: Scene) -> None:
        for size in (1.0, 4.0):
            for hidden in hide(scene, ("boom_droop", "backlash", "base_step"), size, spread_mm, 7):
                assert hidden.size == pytest.approx(size, rel=0.011)
                assert spread_mm(scene.displacement_mm([hidden.effect])) == hidden.size

    def test_the_same_seed_hides_the_same(self, scene: Scene) -> None:
        first, again, other = (hide(scene, ("encoder_harmonic",), 2.0, spread_mm, s) for s in (1, 1, 2))
        assert first == again
        assert first != other

    def test_places_vary_and_twice_the_same_family_is_at_two_places(self, scene: Scene) -> None:
        places = {hide(scene, ("angle_scale",), 2.0, spread_mm, s)[0].effect.where for s in range(20)}
        assert len(places) >= 4
        both = hide(scene, ("backlash", "backlash"), 1.0, spread_mm, 3)
        assert both[0].effect.where != both[1].effect.where
        assert hide(scene, ("backlash",), 1.0, spread_mm, 3, where=("theta4",))[0].effect.where == "theta4"

    def test_nothing_is_hidden_beyond_its_hard_bounds(self, scene: Scene) -> None:
        for family, coefficient, bound in (
            ("backlash", "width_rad", 5e-3),
            ("thermal_expansion", "per_K", 2.5e-5),
            ("base_step", "z_mm", 20.0),
            ("clock_drift", "ppm", 50.0),
        ):
            largest = 0.0
            for size in (0.5, 2.0, 8.0, 32.0, 128.0, 512.0):
                try:
                    (hidden,) = hide(scene, (family,), size, spread_mm, 1)
                except UnreachableError:
                    break
                largest = max(largest, abs(getattr(hidden.effect, coefficient)))
            else:
                raise AssertionError(f"{family} grew without end")
            assert 0.0 < largest <= bound * (1 + 1e-9)

    def test_a_joint_never_gives_way_by_more_than_its_bound_at_the_largest_load(self, scene: Scene) -> None:
        nominal = RigTruth(scene.truth.rig, 0, perturbation=0.0)
        poses = draw_poses(scene.truth.rig, "wide", 256, np.random.default_rng([0, 41]))
        for where in ("theta4", "theta5"):
            bounded = scene.draws.draw("joint_compliance", where, np.random.default_rng(0))
            load = np.abs(nominal.gravity_load(where, poses)).max()
            assert bounded.scaled(bounded.most).compliance_rad_per_Nm * load == pytest.approx(20e-3, rel=0.05)

    def test_loads_bend_only_what_carries_them(self, scene: Scene) -> None:
        assert "theta3" not in scene.draws.places("joint_compliance")
        assert "theta4" in scene.draws.places("joint_compliance")

    def test_every_effect_has_a_place_on_the_boom_and_a_size_that_can_be_seen(self, scene: Scene) -> None:
        for family in FAMILIES:
            (hidden,) = hide(scene, (family,), 0.1, spread_mm, 2)
            assert hidden.effect.where in scene.draws.places(family)

    def test_what_cannot_be_hidden_says_why(self, scene: Scene) -> None:
        with pytest.raises(UnreachableError, match="no place for it at L2"):
            hide(scene, ("backlash",), 1.0, spread_mm, 1, where=("L2",))
        ur10 = draw_scene(shipped_rig("ur10"), 1, SMALL)
        with pytest.raises(UnreachableError, match="boom_droop: this rig has no place"):
            hide(ur10, ("boom_droop",), 1.0, spread_mm, 1)


class TestPosePlans:
    def feed(self, rig: Rig, poses: dict[str, Floats]) -> Floats:
        chain = screw_chain(rig, nominal_constants(rig))
        rad = {j.name: np.deg2rad(poses[j.name]) if j.kind == "revolute" else poses[j.name] for j in rig.joints}
        return pose_chain(chain, rad).axes(len(rig.rows))[:, :, 2]

    def test_a_face_is_drilled_with_the_feed_parallel(self, rig: Rig) -> None:
        poses = draw_poses(rig, "face", 200, np.random.default_rng(1))
        feed = self.feed(rig, poses)
        off_deg = np.rad2deg(np.arccos(np.clip(feed @ np.median(feed, axis=0), -1.0, 1.0)))
        assert np.percentile(off_deg, 90) < 3.0
        assert np.corrcoef(poses["theta4"], poses["theta5"])[0, 1] < -0.5
        wide = draw_poses(rig, "wide", 200, np.random.default_rng(1))
        assert np.std(poses["theta3"]) < 0.6 * np.std(wide["theta3"])
        assert np.std(poses["L2"]) > 0.9 * np.std(wide["L2"])

    def test_sparse_poses_come_in_clusters(self, rig: Rig) -> None:
        poses = draw_poses(rig, "sparse", 60, np.random.default_rng(1))
        scaled = np.array([(poses[j.name] - j.limits[0]) / (j.limits[1] - j.limits[0]) for j in rig.joints]).T
        apart = np.linalg.norm(scaled[:, None] - scaled[None], axis=2) + 9.0 * np.eye(60)
        assert np.median(apart.min(axis=1)) < 0.25
        assert np.median(apart) > 0.8

    @pytest.mark.parametrize("plan", ["wide", "face", "sparse"])
    @pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
    def test_poses_are_within_the_limits_of_any_rig(self, name: str, plan) -> None:
        rig = shipped_rig(name)
        for joint in rig.joints:
            values = draw_poses(rig, plan, 40, np.random.default_rng(1))[joint.name]
            assert values.shape == (40,)
            assert values.min() >= joint.limits[0]
            assert values.max() <= joint.limits[1]
