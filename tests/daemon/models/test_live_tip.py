"""Where the tip is now: a position with its sigma, or a status that says why there is none."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import parse_observations
from calibration.pipeline.calibrate import identify
from daemon.commands import CommandError
from daemon.config.sections import TipCanSection, TipSection
from daemon.host.ended_threads import EndedThreads
from daemon.models.live_model import Loaded
from daemon.models.model_files import write_model
from daemon.models.tip_sender import TipSender
from drivers.can.ports import CanLinkConfig
from drivers.can.tip_frames import TipStatus, encode_tip
from drivers.can_link import CanLink
from drivers.clock import NS_PER_S, Stamp, SystemClock
from drivers.readings import DeviceEvent, EventKind, Status
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.daemon.support.jobs import SOURCE
from tests.daemon.support.models import TRUTH, ModelRig, pose
from tests.drivers.can_support import running, unused_channel
from tests.simulated.observations import simulate_observations


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[ModelRig]:
    """A live model, loaded, at set-up S1."""
    rig = ModelRig(tmp_path)
    rig.accepted()
    assert isinstance(rig.settled(), Loaded)
    yield rig
    rig.close()


def true_mm(prism: str, joints: dict[str, float]) -> np.ndarray:
    """Where the simulated machine has a prism, in the frame of the station at S1."""
    return TRUTH.prism_mm(prism, {name: np.array([v]) for name, v in joints.items()}, setup="S1")[0]


def model_of(rig: ModelRig) -> CalibratedModel:
    live = rig.live.now()
    assert isinstance(live, Loaded)
    return live.model


def test_the_tip_is_within_a_few_sigma_of_the_true_one(rig: ModelRig) -> None:
    rig.setup = "S1"
    for seed in range(8):
        joints = pose(seed)
        rig.clock.advance(60.0)
        rig.drive(joints)
        for prism in ("r", "s"):
            tip = rig.tip.tip_command({"prism": prism})
            assert (tip["status"], tip["setup"], tip["reason"]) == ("ok", "S1", ""), tip
            off = np.array(tip["station_mm"]) - true_mm(prism, joints)
            assert (np.abs(off) < 4.0 * np.array(tip["station_sigma_mm"])).all(), (seed, off, tip["station_sigma_mm"])
            assert 0.2 < tip["sigma_mm"] < 20.0
    assert json.dumps(tip)


def test_base_and_station_frame_are_the_same_place(rig: ModelRig) -> None:
    rig.drive(pose(1))
    rig.setup = "S1"
    model = model_of(rig)
    tip = rig.tip.tip("r", "S1")
    base = model.chain.base(model.values, 0)
    assert tip.base_mm is not None
    np.testing.assert_allclose(base.rotation @ tip.base_mm + base.translation_mm, tip.station_mm, atol=1e-6)
    assert tip.base_mm == rig.tip.tip("r").base_mm, "no set-up is needed for the base frame"


def test_an_unknown_set_up_gives_no_place_in_its_frame(rig: ModelRig) -> None:
    rig.drive(pose(1))
    rig.setup = "S9"
    tip = rig.tip.tip_command({})
    assert (tip["status"], tip["setup"], tip["station_mm"]) == ("ok", None, None)
    assert tip["base_mm"] is not None


def test_what_is_known_of_the_machine_reaches_the_model_as_in_training(rig: ModelRig) -> None:
    joints = pose(2)
    rig.drive(joints)
    rig.drive(joints | {"theta4": joints["theta4"] + 2.0})
    tip = rig.tip.tip("r")
    assert tip.joints["theta4_deg"] == pytest.approx(joints["theta4"] + 2.0)
    state = rig.joiner.latest()
    assert not isinstance(state, str)
    assert state.values["theta4_dir"] == 1.0
    assert state.dwell_s == pytest.approx(2.9, abs=0.2)


# ---- when there is none ----------------------------------------------------------------------------------------------


def test_without_a_live_model_the_status_says_so(tmp_path: Path) -> None:
    rig = ModelRig(tmp_path)
    try:
        rig.settled()
        rig.drive(pose(1))
        tip = rig.tip.tip_command({})
        assert (tip["status"], tip["base_mm"]) == ("no_model", None)
        assert "no model is live" in tip["reason"]
    finally:
        rig.close()


def test_a_live_model_that_cannot_be_used_is_told_from_none(rig: ModelRig) -> None:
    rig.drive(pose(1))
    live = rig.models.live()
    assert live is not None
    (live.path / "model.json").write_text("{}")
    rig.live.changed()
    rig.settled()
    tip = rig.tip.tip("r")
    assert (tip.status, tip.base_mm) == (TipStatus.MODEL_UNUSABLE, None)
    assert "model.json" in tip.reason


def test_readings_that_are_old_give_no_position(rig: ModelRig) -> None:
    rig.drive(pose(1))
    assert rig.tip.tip("r").status is TipStatus.OK
    rig.clock.advance(1.5)
    stale = rig.tip.tip("r")
    assert (stale.status, stale.base_mm, stale.message().position_mm) == (TipStatus.STALE, None, None)
    assert "1.5 s ago" in stale.reason


def test_readings_of_another_boot_give_no_position_whatever_the_clock_shows(rig: ModelRig) -> None:
    rig.drive(pose(1))
    read = rig.clock.now()
    for monotonic_ns in (NS_PER_S, read.monotonic_ns, read.monotonic_ns + NS_PER_S // 10):
        rig.clock.set(Stamp(read.utc_ns + 60 * NS_PER_S, monotonic_ns, "boot-b"))
        rig.tip.on_records([])  # the bus stays silent
        tip = rig.tip.tip("r")
        assert (tip.status, tip.base_mm, tip.age_s, tip.utc_ns) == (TipStatus.STALE, None, None, None)
        assert tip.reason == "the joints were last read before the computer was restarted; is the bus silent?"
    rig.drive(pose(1))
    assert rig.tip.tip("r").status is TipStatus.OK


def test_readings_ahead_of_the_clock_give_no_position_beyond_what_clocks_differ_by(rig: ModelRig) -> None:
    rig.drive(pose(1))
    rig.clock.advance(-0.05)
    tip = rig.tip.tip("r")
    assert (tip.status, tip.age_s) == (TipStatus.OK, pytest.approx(-0.05))
    assert encode_tip(tip.message(), 0x680, 0)[1].data[5] == 0
    rig.clock.advance(-1.95)
    ahead = rig.tip.tip("r")
    assert (ahead.status, ahead.base_mm) == (TipStatus.STALE, None)
    assert "2.0 s ahead of the clock" in ahead.reason


def test_one_silent_joint_is_enough_and_is_named(rig: ModelRig) -> None:
    rig.drive(pose(1))
    rig.drive(pose(1), seconds=1.5, unread="L2")
    stale = rig.tip.tip("r")
    assert stale.status is TipStatus.STALE
    assert "is L2 silent?" in stale.reason


def test_a_joint_that_was_never_read_or_reads_badly_is_named(rig: ModelRig) -> None:
    assert rig.tip.tip("r").status is TipStatus.STALE
    rig.drive(pose(1), unread="theta5")
    missing = rig.tip.tip("r")
    assert (missing.status, missing.reason) == (TipStatus.STALE, "theta5: no reading yet")
    rig.drive(pose(1))
    rig.clock.advance(0.1)
    now = rig.clock.now()
    rig.read({name: v for name, v in pose(1).items() if name != "L3"}, now)
    rig.read({"L3": 0.0}, now, Status.OUT_OF_RANGE)
    bad = rig.tip.tip("r")
    assert bad.status is TipStatus.STALE
    assert "L3: its reading at the newest instant that all joints were read is out_of_range" in bad.reason


def test_a_joint_beyond_its_limits_gives_no_position(rig: ModelRig) -> None:
    rig.drive(pose(1) | {"theta3": 170.0})
    tip = rig.tip.tip("r")
    assert (tip.status, tip.base_mm) == (TipStatus.OUT_OF_LIMITS, None)
    assert tip.reason == "theta3 reads 170.00 deg, outside its limits 30 .. 150 deg"


def test_a_joint_read_on_another_turn_gives_the_same_tip(rig: ModelRig) -> None:
    rig.drive(pose(1))
    tip = rig.tip.tip("r")
    rig.drive(pose(1) | {"theta3": pose(1)["theta3"] + 360.0, "theta7": pose(1)["theta7"] - 720.0})
    again = rig.tip.tip("r")
    assert (again.status, again.warnings) == (TipStatus.OK, ())
    assert again.joints == pytest.approx(tip.joints)
    assert again.base_mm == pytest.approx(tip.base_mm)


def test_after_an_encoder_jumped_there_is_no_position_until_an_operator_has_checked_its_zero(tmp_path: Path) -> None:
    rig = ModelRig(tmp_path)
    try:
        rig.accepted()
        rig.settled()
        rig.drive(pose(1))
        assert rig.tip.tip("r").status is TipStatus.OK
        rig.take([DeviceEvent("theta4", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])
        rig.settled()
        rig.drive(pose(1))
        lost = rig.tip.tip("r")
        assert (lost.status, lost.base_mm) == (TipStatus.ZERO_LOST, None)
        assert lost.reason.startswith("theta4 jumped since the live model was trained")
    finally:
        rig.close()
    again = ModelRig(tmp_path)
    try:
        again.clock.advance(3600.0)
        again.settled()
        again.drive(pose(1))
        assert again.tip.tip("r").status is TipStatus.ZERO_LOST, "a restart mends no zero"
        assert "theta4" in again.registry.zeros_checked_command({"operator": "Ada"})
        again.settled()
        again.drive(pose(1))
        assert again.tip.tip("r").status is TipStatus.OK
        assert again.registry.show_command({})["history"][-1]["operator"] == "Ada"
    finally:
        again.close()


def test_an_angle_is_the_same_a_turn_further(rig: ModelRig) -> None:
    rig.drive(pose(1))
    one = rig.tip.tip("r").base_mm
    rig.clock.advance(60.0)
    rig.drive(pose(1) | {"theta3": pose(1)["theta3"] + 360.0})
    again = rig.tip.tip("r")
    assert again.status is TipStatus.OK, again.reason
    np.testing.assert_allclose(again.base_mm, one, atol=1e-3)


def test_a_pose_beyond_the_training_data_is_given_as_doubtful(rig: ModelRig) -> None:
    rig.drive(pose(1))
    untrained = rig.tip.tip("b")  # a prism that was never measured
    assert untrained.status is TipStatus.DOUBTFUL
    assert untrained.base_mm is not None
    assert any("was never measured in training" in warning for warning in untrained.warnings)


@pytest.fixture(scope="module")
def play_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with 3 mrad of play at theta4."""
    truth = RigTruth(SOURCE.rig, 5, effects=parse_effects("backlash@theta4:width_rad=3e-3"))
    data = simulate_observations(truth, 40, 11, setup="S1", prisms=("r",), noise_mm=0.5)
    observations = parse_observations(data.csv_text().encode(), SOURCE.rig, "simulated.csv")
    directory = tmp_path_factory.mktemp("play") / "model"
    write_model(directory, identify(SOURCE.rig, SOURCE.text, observations, effects="backlash@theta4"))
    return directory


def test_the_tip_of_a_model_with_play_is_doubtful_from_a_start_until_its_joint_moves(
    tmp_path: Path, play_model: Path
) -> None:
    rig = ModelRig(tmp_path)
    try:
        rig.registry.accept_command({"id": rig.compared(rig.candidate(trained=play_model), live=None), "operator": "A"})
        rig.settled()
        rig.drive(pose(1) | {"theta4": pose(1)["theta4"] - 0.2})
        started = rig.tip.tip("r")
        assert started.status is TipStatus.DOUBTFUL
        assert any("lacks the column theta4_dir" in warning for warning in started.warnings), started.warnings
        rig.drive(pose(1))
        known = rig.tip.tip("r")
        assert (known.status, known.warnings) == (TipStatus.OK, ())
        assert known.sigma_mm is not None
        rig.clock.advance(60.0)  # the bus is cut, and the joint may move up and come back from above
        rig.drive(pose(1))
        again = rig.tip.tip("r")
        assert again.status is TipStatus.DOUBTFUL
        assert again.sigma_mm is not None
        off_mm = np.linalg.norm(np.subtract(again.base_mm, known.base_mm))
        assert again.sigma_mm > off_mm > 3.0 * known.sigma_mm, "its sigma covers both ends of the play"
    finally:
        rig.close()


def test_a_model_that_fails_in_a_pose_says_so(rig: ModelRig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.drive(pose(1))

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(Predictor, "predict", fail)
    tip = rig.tip.tip("r")
    assert (tip.status, tip.base_mm) == (TipStatus.FAILED, None)
    assert "a defect" in tip.reason


def test_a_prism_must_be_named_and_known(rig: ModelRig) -> None:
    with pytest.raises(CommandError, match="has no prism 'q'; it has w, b, r, s"):
        rig.tip.tip_command({"prism": "q"})


# ---- over CAN --------------------------------------------------------------------------------------------------------


def test_the_sender_sends_the_tip_and_then_that_it_is_stale(rig: ModelRig) -> None:
    rig.drive(pose(1))
    can = TipCanSection(link="boom", arbitration_id=0x680)
    config = CanLinkConfig(
        name="boom",
        interface="virtual",
        channel=unused_channel(),
        allow_transmit=True,
        own_identifiers=can.identifiers,
    )
    link = CanLink(config, SystemClock())
    sender = TipSender(rig.tip, TipSection(prism="r", rate_hz=20.0, can=can), can, link)
    with running(link) as heard:
        sender.start()
        heard.wait(lambda: len(heard.sent) >= 4, "two tips")
        rig.clock.advance(5.0)
        heard.wait(lambda: heard.sent and heard.sent[-1].data[7] == TipStatus.STALE, "a stale tip")
        sender.stop()
    first, second = heard.sent[:2]
    assert (first.arbitration_id, second.arbitration_id) == (0x680, 0x681)
    x_mm = int.from_bytes(first.data[:3], "little", signed=True) / 10
    z_mm = int.from_bytes(second.data[:3], "little", signed=True) / 10
    model, joints = model_of(rig), pose(1)
    base = model.chain.base(model.values, 0)
    true = base.rotation.T @ (true_mm("r", joints) - base.translation_mm)
    assert [x_mm, z_mm] == pytest.approx([true[0], true[2]], abs=15.0)
    counters = [frame.data[6] for frame in heard.sent[:4]]
    assert counters[0] == counters[1] < counters[2] == counters[3], "two frames a tip; a late tip gives way to the next"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_tip_that_may_not_be_sent_ends_the_sender_and_that_is_told(rig: ModelRig) -> None:
    can = TipCanSection(link="boom", arbitration_id=0x680)
    listening = CanLinkConfig(name="boom", interface="virtual", channel=unused_channel())
    sender = TipSender(rig.tip, TipSection(prism="r", rate_hz=20.0, can=can), can, CanLink(listening, SystemClock()))
    with EndedThreads() as ended:
        sender.start()
        sender.join()
    assert "TransmitForbiddenError: boom" in ended.found()["tip"]
