"""What an engineer brings along: descriptions of arms, exports of instruments with their maps, joint values."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from calibration.errors import RigError
from calibration.rig.exchange.draft import Draft
from calibration.rig.exchange.from_table import draft_of_table
from calibration.rig.exchange.from_urdf import draft_of_urdf
from calibration.rig.exchange.urdf import parse_urdf
from daemon.cli.imported_points import map_text, read_export, read_joints, read_map
from daemon.rig_files import load_rig
from drivers.errors import DescriptionError
from drivers.stations.exports import format_of
from tests.fuzz.target import CORPUS, Run, Target, check_refusal, scratch_directory
from tests.fuzz.targets.logs import on_file

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
        b"08KI",
        b"07TP",
        b"Station",
        b"Prism constant (mm)",
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


def _rig_of(draft_of: Callable[[str], Draft]) -> Run:
    def run(data: bytes) -> None:
        with suppress(UnicodeDecodeError):
            try:
                draft_of(data.decode()).rig()
            except RigError as error:
                check_refusal(error)

    return run


def _export(path: Path) -> None:
    text = read_export(path)
    known = format_of(text, str(path))
    guess = known.guess(text, str(path))
    map_text(guess.map, str(path))
    known.passed_over(text, str(path))
    for fix in known.read(text, guess.map, str(path)):
        assert all(map(math.isfinite, (*fix.position_mm, fix.time_s or 0.0))), fix


def _map(path: Path) -> None:
    table = (CORPUS / "exports" / "seed-leica").read_text(encoding="utf-8")
    format_of(table, str(path)).read(table, read_map(path), str(path))


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
    Target(
        "urdf", lambda: _rig_of(lambda text: draft_of_urdf(parse_urdf(text, "arm"), "arm")), "text", _URDF, is_slow=True
    ),
    Target("dh-table", lambda: _rig_of(lambda text: draft_of_table(text, "arm")), "text", _TABLE, is_slow=True),
    Target("exports", lambda: on_file(".txt", _export), "text", _EXPORT, is_slow=True),
    Target("import-map", lambda: on_file(".toml", _map), "text", _MAP, is_slow=True),
    Target(
        "joint-values", _joints, "text", (b"pose", b"time_s", b"time", b"q1_deg", b"nan", b"1e308", b","), is_slow=True
    ),
]
