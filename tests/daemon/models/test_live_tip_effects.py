"""The live tip of a model with effects: what the machine does is in the base frame, what fixes err by is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from calibration.model.files import model_to_files
from calibration.observations import Floats, parse_observations
from calibration.pipeline.calibrate import identify
from daemon.models.live_model import Loaded
from daemon.models.live_tip import Place
from daemon.sessions.session_data import sessions_csv
from daemon.store.reader import Reader
from drivers.can.tip_frames import TipStatus
from drivers.clock import NS_PER_S, Stamp
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.daemon.support.jobs import SOURCE, START
from tests.daemon.support.models import PRISMS, ModelRig, pose

JUMP = "transducer_index_jump@L2:jump_mm=12:time_s=900"
CONSTANT = "prism_constant@station:mm=34.4"
STEP = "base_step@base:tilt_x_rad=2e-3:tilt_y_rad=0:z_mm=15:time_s=1500"
DAY_S = 86400.0
STILL_S = 0.5

Trained = Callable[[str], ModelRig]


@pytest.fixture
def trained(tmp_path: Path) -> Iterator[Trained]:
    """A live model, trained on a session of a machine with an effect, a day later."""
    rigs = []

    def make(effect: str) -> ModelRig:
        rig = ModelRig(tmp_path)
        rigs.append(rig)
        rig.jobs.measured("a", 60, prisms=PRISMS, truth=machine(effect))
        with Reader(rig.config.store_path) as reader:
            data = sessions_csv(reader, SOURCE.rig, ["a"])
        observations = parse_observations(data, SOURCE.rig, "a.csv")
        model = identify(SOURCE.rig, SOURCE.text, observations, effects=effect.partition(":")[0])
        directory = tmp_path / "trained"
        directory.mkdir()
        for name, content in model_to_files(model).items():
            (directory / name).write_bytes(content)
        rig.clock.advance(DAY_S)
        live = rig.compared(rig.candidate(trained=directory), live=None)
        rig.registry.accept_command({"id": live, "operator": "Ada"})
        assert isinstance(rig.settled(), Loaded)
        return rig

    yield make
    for rig in rigs:
        rig.close()


def machine(effect: str = "") -> RigTruth:
    return RigTruth(SOURCE.rig, 1, effects=parse_effects(effect))


def true_mm(joints: dict[str, float], effect: str = "") -> Floats:
    """Where a machine with an effect has prism r a day later, as the station at S1 would measure it without noise."""
    read = {name: np.array([value]) for name, value in joints.items()}
    return machine(effect).prism_mm("r", read, {"time_s": np.array([DAY_S])}, setup="S1")[0]


def in_base(rig: ModelRig, station_mm: Floats) -> Floats:
    """A place in the live model's base frame."""
    live = rig.live.now()
    assert isinstance(live, Loaded)
    base = live.model.chain.base(live.model.values, 0)
    place_mm: Floats = base.rotation.T @ (station_mm - base.translation_mm)
    return place_mm


def distance_mm(place_mm: Place | Floats | None, other_mm: Floats) -> float:
    assert place_mm is not None
    return float(np.linalg.norm(np.asarray(place_mm) - other_mm))


@pytest.mark.parametrize("effect", [CONSTANT, STEP])
def test_what_fixes_err_by_and_how_the_base_moved_is_in_the_stations_frame_alone(trained: Trained, effect: str) -> None:
    rig, joints = trained(effect), pose(1)
    rig.drive(joints, STILL_S)
    tip = rig.tip.tip("r", "S1")
    assert tip.status is TipStatus.OK, tip.warnings
    assert distance_mm(tip.station_mm, true_mm(joints, effect)) < 4.0
    assert distance_mm(tip.base_mm, in_base(rig, true_mm(joints))) < 4.0
    assert distance_mm(true_mm(joints), true_mm(joints, effect)) > 30.0


def test_after_a_transducer_has_jumped_the_tip_is_where_its_true_length_has_it(trained: Trained) -> None:
    rig, joints = trained(JUMP), pose(1)
    rig.drive(joints, STILL_S)
    tip = rig.tip.tip("r", "S1")
    assert tip.status is TipStatus.OK, tip.warnings
    assert distance_mm(tip.station_mm, true_mm(joints, JUMP)) < 4.0
    assert distance_mm(tip.base_mm, in_base(rig, true_mm(joints, JUMP))) < 4.0
    assert distance_mm(true_mm(joints), true_mm(joints, JUMP)) > 10.0


def test_a_clock_that_was_set_back_since_the_training_takes_nothing_from_the_tip(trained: Trained) -> None:
    rig, now, joints = trained(JUMP), START.shifted(round(DAY_S * NS_PER_S)), pose(1)
    rig.clock.set(Stamp(START.utc_ns - NS_PER_S, now.monotonic_ns, now.boot_id))
    rig.drive(joints, STILL_S)
    tip = rig.tip.tip("r", "S1")
    assert tip.status is TipStatus.OK, tip.warnings
    assert distance_mm(tip.station_mm, true_mm(joints, JUMP)) < 4.0


def test_a_boot_whose_clock_is_behind_the_training_leaves_out_what_goes_by_time_and_says_so(trained: Trained) -> None:
    rig = trained(JUMP)
    rig.clock.set(Stamp(START.utc_ns - NS_PER_S, NS_PER_S, "next boot"))
    rig.drive(pose(1), STILL_S)
    tip = rig.tip.tip("r")
    assert tip.status is TipStatus.DOUBTFUL
    assert tip.warnings == ("transducer_index_jump@L2 is left out: this data lacks the column time_s",)


def test_a_path_travelled_since_the_training_is_doubted(trained: Trained) -> None:
    rig = trained("transducer_cumulative@L2:mm_per_m=0.1")
    rig.drive(pose(1), STILL_S)
    tip = rig.tip.tip("r")
    assert tip.status is TipStatus.DOUBTFUL
    (warning,) = tip.warnings
    assert warning.startswith("transducer_cumulative@L2 grows with the distance that L2 travels")
