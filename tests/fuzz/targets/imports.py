"""What an engineer brings along: descriptions of arms, exports of instruments with their maps, joint values."""

from __future__ import annotations

import math
from contextlib import suppress

from calibration.errors import RigError
from calibration.rig.exchange.from_table import draft_of_table
from calibration.rig.exchange.from_urdf import draft_of_urdf
from calibration.rig.exchange.urdf import parse_urdf
from daemon.cli.imported_points import map_text, read_export, read_joints, read_map
from daemon.rig_files import load_rig
from drivers.errors import DescriptionError
from drivers.stations.exports import format_of
from tests.fuzz.target import Run, Target, check_refusal, scratch_directory

_URDF = (
    *(
        b"<link name=",
        b"<joint name=",
        b"<robot name=",
        b"</robot>",
        b"<parent link=",
        b"<child link=",
        b"<mimic joint=",
    ),
    *(b'type="prismatic"', b'type="revolute"', b'type="floating"', b'type="fixed"', b'type="continuous"'),
    *(b'xyz="0 0 1"', b'rpy="1e-9 0 3.14"', b'lower="-1e308"', b'upper="nan"', b'multiplier="-1000"', b'offset="inf"'),
    *(b"<!DOCTYPE x [<!ENTITY a 'b'>]>", b"&a;", b"<!--", b"-->", b"<![CDATA[", b"<inertia ixx=", b'<mass value="0"/>'),
)
_TABLE = (
    *(b"theta_deg", b"d_mm", b"a_mm", b"alpha_deg", b"alpha_rad", b"beta_deg", b"drive", b"lower", b"upper", b"kind"),
    *(
        b"max_rate",
        b"theta",
        b"revolute",
        b"prismatic",
        b"fixed",
        b"0.5*q1 - q2",
        b"-q3",
        b"1e308",
        b"nan",
        b";",
        b"\t",
    ),
)
_EXPORT = (
    *(b"PtID", b"East [m]", b"x [mm]", b"hz (gon)", b"slope distance", b"Date/Time", b"Frame", b"Sub Frame", b"mm"),
    *(
        b"Trajectories",
        b"Units: millimeters",
        b"00NMSDR33",
        b"02TP",
        b"03NM",
        b"08TP",
        b"09F1",
        b"_'_(_)",
        b"_*",
        b"\xff\xfe",
    ),
    *(b"1000,5", b"1.234.567,8", b"2026-11-24T10:00:00", b"-1e308", b"nan", b";", b"\t", b"//", b'"', b"\0"),
)
_MAP = (
    *(
        b"[columns]\n",
        b"[prisms]\n",
        b'separator = " "\n',
        b"header_line = 99\n",
        b"first_line = 2\n",
        b"rate_hz = 1e-320\n",
    ),
    *(b'time_format = "%Y-%j %U"\n', b'length_unit = "ft"\n', b'"x" = 1\n', b'"date" = "Date/Time"\n', b"9" * 30),
)


def _urdf() -> Run:
    def run(data: bytes) -> None:
        with suppress(UnicodeDecodeError):
            try:
                draft_of_urdf(parse_urdf(data.decode(), "arm.urdf"), "arm.urdf").rig()
            except RigError as error:
                check_refusal(error)

    return run


def _table() -> Run:
    def run(data: bytes) -> None:
        with suppress(UnicodeDecodeError):
            try:
                draft_of_table(data.decode(), "arm.csv").rig()
            except RigError as error:
                check_refusal(error)

    return run


def _exports() -> Run:
    path = scratch_directory() / "survey.txt"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        try:
            text = read_export(path)
            known = format_of(text, path.name)
            guess = known.guess(text, path.name)
            map_text(guess.map, path.name)
            fixes = known.read(text, guess.map, path.name)
        except DescriptionError as error:
            check_refusal(error, path.name)
        else:
            for fix in fixes:
                assert all(map(math.isfinite, (*fix.position_mm, fix.time_s or 0.0))), fix

    return run


def _maps() -> Run:
    path = scratch_directory() / "survey.map.toml"
    table = "PtID,East [m],North [m],Height [m],Code,Date/Time\nP1,1.5,2.5,3.5,w,2026-11-24T10:00:00\nP2,1,2,3,b,\n"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        try:
            columns = read_map(path)
            known = format_of(table, "survey.csv")
            known.read(table, columns, "survey.csv")
        except DescriptionError as error:
            check_refusal(error, "survey.")

    return run


def _joints() -> Run:
    path, rig = scratch_directory() / "joints.csv", load_rig("ur10").rig

    def run(data: bytes) -> None:
        path.write_bytes(data)
        try:
            found = read_joints(path, rig)
        except DescriptionError as error:
            check_refusal(error, path.name)
        else:
            for row in (*found.rows, *found.by_pose.values()):
                assert all(map(math.isfinite, row)), row

    return run


TARGETS = [
    Target("urdf", _urdf, "text", _URDF, is_slow=True),
    Target("dh-table", _table, "text", _TABLE, is_slow=True),
    Target("exports", _exports, "text", _EXPORT, is_slow=True),
    Target("import-map", _maps, "text", _MAP, is_slow=True),
    Target(
        "joint-values", _joints, "text", (b"pose", b"time_s", b"time", b"q1_deg", b"nan", b"1e308", b","), is_slow=True
    ),
]
