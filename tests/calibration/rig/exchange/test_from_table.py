"""Rigs made from Denavit-Hartenberg tables, and tables of rigs."""

import numpy as np
import pytest

from calibration.design.visibility import Bodies
from calibration.errors import RigError
from calibration.export.formats.dh_csv import dh_text
from calibration.kinematics.chain import Chain, Placement
from calibration.rig.description import Rig, shipped_rig
from calibration.rig.exchange.from_table import draft_of_table

UR10 = """joint,theta_rad,d_m,a_mm,alpha_rad,lower,upper
q1,0,0.1273,0,1.5707963267948966,-360,360
q2,0,0,-612,0,-360,360
q3,0,0,-572.3,0,-360,360
q4,0,0.163941,0,1.5707963267948966,-360,360
q5,0,0.1157,0,-1.5707963267948966,-360,360
q6,0,0.0922,0,0,-360,360
"""


def places_mm(rig: Rig, x: np.ndarray | None = None) -> np.ndarray:
    chain = Chain(rig, {"": Placement.identity()})
    rng = np.random.default_rng(1)
    poses = {joint.name: rng.uniform(*joint.limits, 20) for joint in sorted(rig.joints, key=lambda j: j.name)}
    readings = np.array([poses[name] for name in rig.joint_names]).T
    return Bodies.of(chain, np.zeros(len(chain)) if x is None else x, readings).prisms_mm


def test_a_table_in_other_units_is_the_rig_that_ships() -> None:
    rig = draft_of_table(UR10, "ur10.csv").rig()
    assert (rig.name, rig.convention, rig.prism_names) == ("ur10", "dh", ("tool",))
    np.testing.assert_allclose(places_mm(rig), places_mm(shipped_rig("ur10")), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
def test_a_rigs_table_is_the_same_rig_again(name: str) -> None:
    rig = shipped_rig(name)
    x = np.random.default_rng(3).normal(0.0, 0.01, len(Chain(rig, {"": Placement.identity()})))
    x[-6:] = 0.0
    other = draft_of_table(dh_text(Chain(rig, {"": Placement.identity()}), x, ["of\ntwo lines"]), "again.csv").rig()
    np.testing.assert_allclose(places_mm(other), places_mm(rig, x), rtol=0.0, atol=1e-9)
    assert [row.identify for row in other.rows] == [row.identify for row in rig.rows]
    assert [joint.limits for joint in other.joints] == [joint.limits for joint in rig.joints]


def test_an_import_tells_whose_limits_it_assumes() -> None:
    text = "joint,alpha_deg,a_mm,d_mm,theta_deg,lower,upper\nq1,0,100,0,0,-90,90\nq2,0,100,0,0,,\n"
    draft = draft_of_table(text, "x.csv")
    assert draft.notes[-1] == (
        "Assumed: the random errors of readings (sigma), the limits of q2, the build tolerances and the station."
    )


@pytest.mark.parametrize(
    ("header", "assumed"),
    [
        ("joint,d_mm,theta_deg", "alpha_deg = 0 and a_mm = 0 for all rows: the table has no such columns"),
        ("joint,a_m,theta_rad", "alpha_deg = 0 and d_mm = 0 for all rows: the table has no such columns"),
        ("joint,d_mm,lower", "alpha_deg = 0, a_mm = 0 and theta_deg = 0 for all rows: the table has no such columns"),
    ],
)
def test_an_import_tells_which_constants_it_takes_as_zero(header: str, assumed: str) -> None:
    draft = draft_of_table(f"{header}\nq1,100,5\n", "x.csv")
    assert draft.notes[-1].endswith(f"the station; {assumed}.")
    assert assumed in draft.text()


def test_one_missing_column_is_named_in_the_singular() -> None:
    draft = draft_of_table("joint,alpha_deg,d_mm,theta_deg\nq1,0,100,0\n", "x.csv")
    assert draft.notes[-1].endswith("; a_mm = 0 for all rows: the table has no such column.")


def test_a_row_may_be_driven_by_a_sum() -> None:
    rig = draft_of_table("joint,a_mm,theta_drive\nq1,100,\nq2,100,\n,100,-q1 + 0.5*q2\n", "x.csv").rig()
    assert rig.rows[2].drive == {"theta": {"q1": -1.0, "q2": 0.5}}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "the file is empty"),
        ("joint,a_mm\n", "no rows"),
        ("joint,a_inch\nq1,1\n", r"header: unknown column 'a_inch'.*\(line 1\)"),
        ("joint,a_mm\nq1,one\n", r"a_mm: 'one' is not a number \(line 2\)"),
        ("joint,a_mm\nq1,1,2\n", "3 cells, but the header has 2"),
        ("joint,kind\nq1,screw\n", "neither revolute nor prismatic"),
        ("joint,theta_drive\nq1,q1 q2\n", "not a sum such as"),
        ("joint,a_mm,theta_drive,lower\nq1,9,,\n,,,-90\n", r"joint: empty; name the joint that .* \(line 3\)"),
        ("joint,theta_drive\nq1,0.5.5*q1\n", "not a sum such as"),
        ("a_mm\n1\n", "no row names a joint"),
        ("joint;a_mm\nq1;1,5\n", "separate columns by commas"),
        ("joint,lower,upper\nq1,-9,9\nq1,-9,8\n", r"upper: joint 'q1' has 9 on an earlier line.*\(line 3\)"),
        ("# convention: craig\njoint,a_mm\nq1,1\n", "'craig' is unknown; give one of"),
    ],
)
def test_a_table_that_is_none_is_refused_with_line_and_column(text: str, reason: str) -> None:
    with pytest.raises(RigError, match=reason):
        draft_of_table(text, "bad.csv")
