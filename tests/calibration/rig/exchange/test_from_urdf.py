"""Rigs made from URDF: the same machine to rounding, whatever its axes, couplings and branches."""

import tracemalloc
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from calibration.design.visibility import Bodies
from calibration.errors import RigError
from calibration.export.formats.urdf import urdf_text
from calibration.kinematics.chain import Chain, Placement
from calibration.rig.description import Rig, shipped_rig
from calibration.rig.exchange.from_urdf import draft_of_urdf
from calibration.rig.exchange.urdf import parse_urdf
from tests.robots import ROBOTS, Pinocchio

EXACT_MM = 1e-9


def chain_of(rig: Rig) -> Chain:
    return Chain(rig, {"": Placement.identity()})


def poses_of(rig: Rig, n: int = 20) -> np.ndarray:
    rng = np.random.default_rng(7)
    return np.array([rng.uniform(*joint.limits, n) for joint in rig.joints]).T


def prisms_mm(rig: Rig, poses: np.ndarray, x: np.ndarray | None = None) -> np.ndarray:
    chain = chain_of(rig)
    return Bodies.of(chain, np.zeros(len(chain)) if x is None else x, poses).prisms_mm


def again(text: str, rig: Rig) -> Rig:
    """The rig of an exported URDF."""
    return draft_of_urdf(parse_urdf(text, "exported"), "exported", None, rig.prism_names).rig()


def same_order(rig: Rig, other: Rig, poses: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a rig, and places of its prisms, in the order that another rig has joints and prisms in."""
    joints = [rig.joint_names.index(name) for name in other.joint_names]
    return poses[:, joints], places[:, [rig.prism_names.index(name) for name in other.prism_names]]


@pytest.mark.parametrize("name", ROBOTS)
def test_a_public_robot_is_the_machine_that_pinocchio_has(name: str) -> None:
    robot = ROBOTS[name]
    draft = robot.draft()
    rig, poses = draft.rig(), poses_of(draft.rig())
    tips = robot.tips or tuple(str(t.remark).split(";")[0].removeprefix("link ") for t in draft.sections["prism"])
    wanted = Pinocchio(robot.text, rig.joints).places_mm(tips, poses, robot.base)
    np.testing.assert_allclose(prisms_mm(rig, poses), wanted, rtol=0.0, atol=EXACT_MM)


@pytest.mark.parametrize("name", ROBOTS)
def test_back_to_urdf_and_again_to_a_rig_nothing_has_changed(name: str) -> None:
    rig = ROBOTS[name].draft().rig()
    poses, wanted = poses_of(rig), prisms_mm(rig, poses_of(rig))
    text = urdf_text(chain_of(rig), np.zeros(len(chain_of(rig))), ["as it -- came"])
    other = again(text, rig)
    poses, wanted = same_order(rig, other, poses, wanted)
    np.testing.assert_allclose(prisms_mm(other, poses), wanted, rtol=0.0, atol=EXACT_MM)
    for joint in rig.joints:
        np.testing.assert_allclose(other.joint(joint.name).limits, joint.limits, rtol=1e-12)
    kg, other_kg = (sorted((m.kg, *np.abs(m.inertia_kg_m2 or [0.0] * 6)) for m in r.masses) for r in (rig, other))
    np.testing.assert_allclose([m[0] for m in other_kg], [m[0] for m in kg], rtol=1e-12)


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
def test_a_rig_with_corrected_constants_is_the_same_machine_as_urdf(name: str) -> None:
    """Couplings, a boom that slides along x, beta, all three conventions."""
    rig = shipped_rig(name)
    x = np.random.default_rng(3).normal(0.0, 0.01, len(chain_of(rig)))
    x[-6:] = 0.0  # the base is where it is
    poses = poses_of(rig)
    wanted = prisms_mm(rig, poses, x)
    text = urdf_text(chain_of(rig), x, [])
    np.testing.assert_allclose(
        Pinocchio(text, rig.joints).places_mm(rig.prism_names, poses), wanted, rtol=0.0, atol=EXACT_MM
    )
    other = again(text, rig)
    poses, wanted = same_order(rig, other, poses, wanted)
    np.testing.assert_allclose(prisms_mm(other, poses), wanted, rtol=0.0, atol=1e-8)


def test_what_branches_off_can_be_corrected_and_what_cannot_move_is_not_asked_for() -> None:
    rig = ROBOTS["panda"].draft().rig()
    assert rig.rows[0].identify == (), "the first joint's mounting is the base's"
    mounting, follower = rig.rows[8], rig.rows[9]
    assert (mounting.after, mounting.drive, mounting.identify) == (7, {}, ("d", "theta"))
    assert follower.drive == {"d": {"panda_finger_joint1": 1.0}}
    assert [rig.prism(name).frame for name in rig.prism_names] == [11, 12]


def test_every_parallel_axis_has_a_beta_and_no_other_has() -> None:
    rows = ROBOTS["ur10"].draft().rig().rows
    assert [number for number, row in enumerate(rows, 1) if "beta" in row.identify] == [2, 3]


def test_masses_rest_on_the_frames_that_move_them() -> None:
    robot = ROBOTS["tiago"]
    rig, model = robot.draft().rig(), parse_urdf(robot.text, "tiago")
    total = sum(inertial.kg for inertial in model.links.values() if inertial is not None)
    assert sum(mass.kg for mass in rig.masses) == pytest.approx(total), "also those of joints that stand still"
    assert not any(mass.assumed for mass in rig.masses)


LINKS = '<link name="a"/><link name="b"/>'
JOINT = '<joint name="j" type="{}"><parent link="a"/><child link="b"/>{}</joint>'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<robot", "not valid XML"),
        ("<sdf/>", "not <robot>"),
        ('<!DOCTYPE r [<!ENTITY x "y">]><robot/>', "document type"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m"/></robot>', "run `xacro FILE"),
        ('<robot><xacro:macro name="m"/></robot>', "run `xacro FILE"),
        ('<robot><link name="${prefix}base"/></robot>', "run `xacro FILE"),
        ('<robot name="$(arg name)"><link name="base"/></robot>', "run `xacro FILE"),
        ("<robot>" + LINKS + "</robot>", "2 links are not the child of a joint"),
        ("<robot>" + LINKS + JOINT.format("spherical", "") + "</robot>", "unknown type of joint 'spherical'"),
        ("<robot>" + LINKS + JOINT.format("revolute", '<axis xyz="0 0 0"/>') + "</robot>", "its axis is zero"),
        ("<robot>" + LINKS + JOINT.format("revolute", '<axis xyz="0 1"/>') + "</robot>", "not three numbers"),
        ("<robot>" + LINKS + JOINT.format("revolute", '<axis xyz="0 1e308 0"/>') + "</robot>", "numbers below 1e"),
        ("<robot>" + LINKS + JOINT.format("fixed", '<origin xyz="0 nan 1"/>') + "</robot>", "not three numbers"),
        (
            "<robot>" + LINKS + JOINT.format("revolute", '<mimic joint="k"/>') + "</robot>",
            "there is no joint of that name",
        ),
        ("<robot>" + LINKS + JOINT.format("revolute", '<mimic joint="j"/>') + "</robot>", "mimics itself"),
        ("<robot>" + LINKS + JOINT.format("floating", "") + "</robot>", "no joint moves anything"),
        (
            "<robot>" + LINKS + JOINT.format("revolute", '<limit lower="1" upper="0"/>') + "</robot>",
            "lower limit 1 is greater",
        ),
        ("<robot>" + LINKS + '<link name="b"/>' + JOINT.format("revolute", "") + "</robot>", "'b': two links"),
        ("<robot>" + LINKS + 2 * JOINT.format("revolute", "") + "</robot>", "'j': two joints"),
        ("<robot>" + '<link name="a"/>' * 20_001 + "</robot>", "20,002 elements"),
        ("<robot>" + '<link name="b"/>' + JOINT.format("revolute", "") + "</robot>", "no link 'a'"),
    ],
)
def test_what_is_no_machine_is_refused_with_its_place(text: str, reason: str) -> None:
    with pytest.raises(RigError, match=reason):
        draft_of_urdf(parse_urdf(text, "bad.urdf"), "bad.urdf").rig()


MIXED = """<robot name="mixed" xmlns="http://of.some/schema">
<link name="b"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/>
<joint name="swing" type="revolute"><parent link="b"/><child link="l1"/><origin xyz="0.1 0.2 0.5" rpy="0.3 0 0.2"/>
  <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
<joint name="rack" type="prismatic"><parent link="l1"/><child link="l2"/><origin xyz="0.1 0.2 0.5" rpy="0.3 0 0.2"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/>
  <mimic joint="swing" multiplier="0.3" offset="0.05"/></joint>
<joint name="slide" type="prismatic"><parent link="l2"/><child link="l3"/><origin xyz="0.1 0 0" rpy="0.3 0 0.2"/>
  <axis xyz="1 0 0"/><limit lower="-0.5" upper="0.5" velocity="1" effort="1"/></joint>
<joint name="pinion" type="revolute"><parent link="l3"/><child link="l4"/><origin xyz="0.1 0.2 0.5" rpy="0.3 0 0.2"/>
  <axis xyz="0 1 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/>
  <mimic joint="slide" multiplier="-2" offset="0.1"/></joint>
<link name="tip"/><joint name="seat" type="fixed"><parent link="l4"/><child link="tip"/><origin xyz="0.3 0 0"/></joint>
</robot>"""


def test_a_slide_that_follows_a_turn_and_a_turn_that_follows_a_slide_move_as_far_as_in_the_document() -> None:
    rig = draft_of_urdf(parse_urdf(MIXED, "mixed.urdf"), "mixed.urdf").rig()
    poses = poses_of(rig)
    wanted = Pinocchio(MIXED, rig.joints).places_mm(["tip"], poses)
    np.testing.assert_allclose(prisms_mm(rig, poses), wanted, rtol=0.0, atol=EXACT_MM)


def test_unknown_links_and_still_tips_are_refused() -> None:
    urdf = parse_urdf(ROBOTS["ur5"].text, "ur5")
    for base, tips, reason in (
        ("nowhere", (), "there is no link 'nowhere'"),
        (None, ("base_link",), "no joint moves it"),
        ("wrist_1_link", ("forearm_link",), "not connected to the base"),
    ):
        with pytest.raises(RigError, match=reason):
            draft_of_urdf(urdf, "ur5", base, tips)


def test_a_joint_without_limits_gets_some_and_the_file_says_so() -> None:
    text = "<robot>" + LINKS + JOINT.format("continuous", '<axis xyz="0 0 1"/>') + "</robot>"
    draft = draft_of_urdf(parse_urdf(text, "turn.urdf"), "turn.urdf")
    assert draft.rig().joints[0].limits == (-180.0, 180.0)
    assert "limits assumed" in draft.text()
    assert "the limits of j," in draft.notes[0]


@pytest.mark.parametrize(
    ("limit", "limits", "note"),
    [
        ('upper="1.5707963267948966"', (0.0, 90.0), "the lower limit 0 of j: the URDF gives only the upper one"),
        ('lower="-1.5707963267948966"', (-90.0, 0.0), "the upper limit 0 of j: the URDF gives only the lower one"),
    ],
)
def test_a_limit_that_the_urdf_lacks_is_zero_and_the_import_says_so(
    limit: str, limits: tuple[float, float], note: str
) -> None:
    text = "<robot>" + LINKS + JOINT.format("revolute", f'<axis xyz="0 0 1"/><limit {limit}/>') + "</robot>"
    draft = draft_of_urdf(parse_urdf(text, "turn.urdf"), "turn.urdf")
    assert draft.rig().joints[0].limits == pytest.approx(limits)
    assert draft.notes[0].endswith(f"the station; {note}.")
    assert "limit assumed" in draft.text()


def test_a_document_that_yourdfpy_reads_too() -> None:
    import io

    import yourdfpy

    rig = ROBOTS["panda"].draft().rig()
    text = urdf_text(chain_of(rig), np.zeros(len(chain_of(rig))), [])
    assert ET.fromstring(text).tag == "robot"
    robot = yourdfpy.URDF.load(io.StringIO(text), load_meshes=False, build_scene_graph=True)
    pose = poses_of(rig, 1)
    robot.update_cfg(
        {j.name: np.radians(v) if j.kind == "revolute" else v / 1e3 for j, v in zip(rig.joints, pose[0], strict=True)}
    )
    found = [robot.get_transform(prism, "base")[:3, 3] * 1e3 for prism in rig.prism_names]
    np.testing.assert_allclose(found, prisms_mm(rig, pose)[0], rtol=0.0, atol=1e-9)


def test_a_document_of_too_many_elements_is_refused_before_they_take_memory() -> None:
    text = "<robot>" + '<a b=""/>' * 1_000_000 + "</robot>"
    tracemalloc.start()
    try:
        with pytest.raises(RigError, match="1,000,002 tags and comments; the maximum is 60,000"):
            parse_urdf(text, "many.urdf")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
