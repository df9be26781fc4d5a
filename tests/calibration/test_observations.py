"""Rig files and observations: what is wrong is refused whole, with its place; what is right survives the round trip."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import DataError, RigError
from calibration.observations import Observations, format_observations, parse_observations
from calibration.rig.channels import AnyChannel
from calibration.rig.description import Rig, parse_rig, shipped_rig, shipped_rigs
from tests.calibration.conftest import Session, rig_text

RIG = shipped_rig("ur10")
HEADER = "prism,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm"
ROW = "tmac,1,2,3,4,5,6,100,200,300"


def parse(text: str | bytes, **options: bool):  # type: ignore[no-untyped-def]  # Observations
    return parse_observations(text.encode() if isinstance(text, str) else text, RIG, "data.csv", **options)


@pytest.mark.slow
def test_observations_survive_the_round_trip_exactly(session: Session) -> None:
    text = format_observations(session.training, session.rig)
    again = parse_observations(text.encode(), session.rig, "again.csv")
    assert format_observations(again, session.rig) == text
    np.testing.assert_array_equal(again.position_mm, session.training.position_mm)
    np.testing.assert_array_equal(again.joints["L2"], session.training.joints["L2"])


def test_optional_columns_are_kept_and_strange_ones_are_listed() -> None:
    table = parse(f"{HEADER},temperature_degC,q1_dir,boom_valve_mA,remark\n{ROW},21.5,-1,400,fine\n{ROW},,0,,\n")
    assert table.extra["temperature_degC"][0] == 21.5
    assert math.isnan(table.extra["temperature_degC"][1])
    assert set(table.extra) == {"temperature_degC", "q1_dir", "boom_valve_mA"}
    assert table.ignored_columns == ("remark",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", r"data\.csv"),
        (f"{HEADER}\n", "no observations below the header"),
        (f"{HEADER}\n{ROW},7\n", "line 2: 11 fields, but the header has 10"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('300', 'nan')}\n", "line 3, column z_mm: 'nan' is not a finite number"),
        (f"{HEADER}\n{ROW.replace('300', 'x')}\n", "line 2, column z_mm: 'x' is not a finite number; write it as"),
        (f"{HEADER}\n{ROW.replace('300', '1_000')}\n", "'1_000' is not a finite number; write it as 1234.5"),
        (f"{HEADER}\n{ROW.replace('300', '１２')}\n", "'１２' is not a finite number"),  # noqa: RUF001
        (
            f"{HEADER}\n{ROW.replace('300', '1e300')}\n",
            "line 2, column z_mm: 1e.300 is beyond the range of a total station",
        ),
        (
            f"{HEADER}\n{ROW.replace('tmac,1,', 'tmac,1e300,')}\n",
            "column q1_deg: 1e.300 is beyond what a joint can read",
        ),
        (
            f"{HEADER}\n{ROW}\n{ROW.replace('tmac,1,', 'tmac,9000,')}\n",
            "column q1_deg: readings from 1 to 9000 deg span more turns than the joint's limits, .* to degrees twice",
        ),
        (f"{HEADER}\n{ROW.replace('300', '1e999')}\n", "is too large for a number"),
        (f"{HEADER}\n{ROW.replace(',6,', ',,')}\n", "line 2, column q6_deg: empty"),
        (f"{HEADER}\n{ROW.replace('tmac', 'nose')}\n", "line 2, column prism"),
        (f"{HEADER.replace('q6_deg', 'q7_deg')}\n{ROW}\n", "q6_deg"),
        (f"{HEADER},x_mm\n{ROW},1\n", "x_mm"),
        (f"{HEADER},q1_dir\n{ROW},2\n", "line 2, column q1_dir: 2 is not a direction"),
        (
            f"{HEADER},sigma_x_mm,sigma_y_mm,sigma_z_mm\n{ROW},0,1,1\n",
            "column sigma_x_mm: 0 is not a standard deviation",
        ),
        *[
            (
                f"{HEADER},sigma_x_mm,sigma_y_mm,sigma_z_mm\n{ROW},1e-6,1,1\n{ROW},1,{sigma},1\n",
                f"line 3, column sigma_y_mm: {sigma} is smaller than any instrument's .* deviation .at least 1e-06",
            )
            for sigma in ("9e-07", "1e-300")
        ],
        (
            f"{HEADER},sigma_y_mm\n{ROW},1\n",
            "line 1, column sigma_y_mm: other sigma columns missing; give all of sigma_x_mm",
        ),
        (
            f"{HEADER},sigma_x_mm,sigma_y_mm,sigma_z_mm\n{ROW},,,\n{ROW},1,,1\n",
            "line 3, column sigma_y_mm: empty, but the row has other sigmas",
        ),
        (f"{HEADER},,\n{ROW},,\n", "line 1: 2 columns have no name"),
        (
            f"\ufeff\ufeff{HEADER}\n{ROW}\n",
            r"column prism: column missing for rig 'ur10' \(but there is '\\ufeffprism'\)",
        ),
        (
            f"{HEADER.replace('q1_deg', 'Q1_DEG')}\n{ROW}\n",
            r"column q1_deg: column missing for rig 'ur10' \(but there is 'Q1_DEG'\)",
        ),
        (
            f"{HEADER},setup\n{ROW},Tür\n{ROW},Tu\u0308r\n",
            r"line 3, column setup: 'Tu\\u0308r' and 'T\\xfcr' look the same",
        ),
        (f"{HEADER},setup\n{ROW},S 1\n{ROW},S\xa01\n", r"line 3, column setup: 'S\\xa01' and 'S 1' look the same"),
        (
            f"{HEADER},pose\n{ROW},{'p' * 201}\n",
            "line 2, column pose: the label has 201 characters; the maximum is 200",
        ),
        (f"{HEADER}\n{ROW.replace('tmac', 'nose' * 99)}\n", "line 2, column prism: the label has 396 characters"),
        (f"{HEADER}\n{ROW}\n".encode("utf-16-le"), "line 1: contains a zero byte, so it is not UTF-8 text"),
        (HEADER.encode() + b"\n\xff\xfe", "line 2: byte .* is not UTF-8"),
        *[
            (
                f"{HEADER},{column}\n{ROW},\n{ROW},{value}\n",
                rf"line 3, column {column}: {re.escape(f'{float(value):g}')} is outside the possible range .*unit",
            )
            for column, value in [
                ("payload_kg", "-500"),
                ("payload_kg", "110000"),
                ("temperature_degC", "-300"),
                ("temperature_degC", "223.15"),
                ("temperature_degC", "1e300"),
                ("q3_rate", "1e300"),
                ("q4_Nm", "-1e300"),
                ("boom_valve_mA", "1e300"),
                ("lift_bar", "1e13"),
                ("time_s", "1e300"),
            ]
        ],
    ],
)
def test_a_bad_file_is_refused_with_its_place(text: str | bytes, message: str) -> None:
    with pytest.raises(DataError, match=message):
        parse(text)


def test_what_optional_columns_can_be_is_wide() -> None:
    columns = {"payload_kg": 1e5, "temperature_degC": -40.0, "q1_rate": -720.0, "q1_Nm": -1e6, "time_s": 1.7e9}
    table = parse(f"{HEADER},{','.join(columns)}\n{ROW},{','.join(map(str, columns.values()))}\n")
    assert {name: values.tolist() for name, values in table.extra.items()} == {k: [v] for k, v in columns.items()}


@given(st.binary(max_size=400) | st.text(max_size=400).map(lambda t: f"{HEADER}\n{t}".encode()))
def test_arbitrary_bytes_are_read_or_refused(data: bytes) -> None:
    try:
        table = parse(data)
    except DataError as error:
        refusal = str(error)
    else:
        refusal = ""
        assert np.isfinite(table.position_mm).all()
    assert refusal.startswith("data.csv") or not refusal


class Column:
    """A column of a data frame, as pandas and polars have it."""

    def __init__(self, values: list[object]) -> None:
        self._values = values

    def to_numpy(self) -> np.ndarray:
        return np.array(self._values)


class Frame(dict[str, Column]):
    """A data frame as far as it is asked for anything."""

    @property
    def columns(self) -> list[str]:
        return list(self)


def frame(**changes: list[object]) -> Frame:
    columns: dict[str, list[object]] = dict(zip(HEADER.split(","), ([c, c] for c in ROW.split(",")), strict=True))
    numbers = {name: [float(str(v)) for v in cells] for name, cells in columns.items() if name != "prism"}
    return Frame({name: Column(values) for name, values in {**columns, **numbers, **changes}.items()})


def test_a_file_a_text_and_a_data_frame_are_the_same_observations(tmp_path: Path) -> None:
    extra = {"session": [1.0, 2.0], "temperature_degC": [21.5, math.nan], "remark": ["fine", None]}
    text = f"{HEADER},session,temperature_degC,remark\n{ROW},1,21.5,fine\n{ROW},2,,\n"
    path = tmp_path / "data.csv"
    path.write_text(text)
    expected = parse(text)
    for found in (
        Observations.from_csv(path, RIG),
        Observations.from_csv(str(path), RIG),
        Observations.from_csv(text, RIG),
        Observations.from_frame(frame(**extra), RIG),
    ):
        assert format_observations(found, RIG) == format_observations(expected, RIG)
        assert found.ignored_columns == ("remark",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_mm": [100.0, math.nan]}, "data frame, row 1 (from 0), column x_mm: empty, but every observation needs it"),
        ({"x_mm": [math.inf, 1.0]}, "data frame, row 0 (from 0), column x_mm: 'inf' is not a finite number"),
        ({"y_mm": [1.0, 1e9]}, "data frame, row 1 (from 0), column y_mm: 1e+09 is beyond the range of a total station"),
        ({"prism": ["tmac", "nobody"]}, "data frame, row 1 (from 0), column prism: rig"),
        ({"setup": ["a", "a\u200b"]}, "data frame, row 1 (from 0), column setup: "),
        ({"time_s": ["noon", 3]}, "data frame, row 0 (from 0), column time_s: 'noon' is not a finite number"),
        ({"x_mm": [1.0]}, "data frame, column x_mm: 1 cells, but column prism has 2"),
        ({"sigma_x_mm": [1.0, 1.0]}, "data frame, column sigma_x_mm: other sigma columns missing; give all of"),
    ],
)
def test_a_bad_data_frame_is_refused_with_its_place(changes: dict[str, list[object]], message: str) -> None:
    with pytest.raises(DataError, match=re.escape(message)):
        Observations.from_frame(frame(**changes), RIG)


def test_rows_keep_the_numbers_of_the_file_whatever_is_left_out() -> None:
    rows = "\n".join(ROW if number % 5 else "" for number in range(1, 20))  # some lines are empty
    found = parse(f"{HEADER}\n{rows}\n")
    assert [found.row_name(row) for row in (0, 3, 4)] == ["line 2", "line 5", "line 7"]
    kept = found.select(np.arange(16) % 3 == 1).select(np.array([3, 1]))
    assert kept.row_name(0, 1) == "lines 14, 7"
    assert kept.row_number(0) == 14
    of_frame = Observations.from_frame(frame(), RIG).select(np.array([1]))
    assert of_frame.row_name(0) == "row 1 (from 0)"


def test_fixes_of_a_daemon_are_named_by_pose_and_session() -> None:
    found = replace(
        parse("\n".join([HEADER, *[ROW] * 5]) + "\n"),
        place="pose",
        session=np.array(["s1", "s1", "s1", "s2", "s2"]),
        pose=np.array(["1.2", "1.2", "1.3", "1.9", ""]),
    )
    assert found.row_name(0) == "pose 1.2 of session s1"
    assert found.row_name(0, 1, 2, 3) == "poses 1.2, 1.3 of session s1, pose 1.9 of session s2"
    assert found.select(np.array([4])).row_name(0) == "pose (unnamed) of session s2"


def test_columns_of_a_data_frame_that_nothing_uses_are_told_apart() -> None:
    made = frame(tilt_deg=[1.0, 2.5], remark=["fine", None], still=[3, 3])
    assert Observations.from_frame(made, RIG).ignored_numbers == ("tilt_deg",)
    rig = RIG.with_signals("tilt_deg")
    assert Observations.from_frame(made, rig).extra["tilt_deg"].tolist() == [1.0, 2.5]


def test_a_missing_column_is_told_with_those_that_may_be_it_under_another_name() -> None:
    renamed = {("height" if name == "z_mm" else name): column for name, column in frame().items()}
    with pytest.raises(DataError, match=r"column z_mm: column missing for rig .*; other columns found: .*'height'"):
        Observations.from_frame(Frame(renamed), RIG)


def test_a_data_frame_must_have_the_columns_and_a_row() -> None:
    whole = frame()
    with pytest.raises(DataError, match="data frame, column z_mm: column missing for rig"):
        Observations.from_frame(Frame({name: whole[name] for name in whole if name != "z_mm"}), RIG)
    with pytest.raises(DataError, match="data frame: no observations"):
        Observations.from_frame(Frame({name: Column([]) for name in whole}), RIG)
    with pytest.raises(DataError, match="data frame: no columns"):
        Observations.from_frame(Frame(), RIG)
    blind = Frame({name: whole[name] for name in whole if name[1:] != "_mm"})
    assert np.isnan(Observations.from_frame(blind, RIG, positions_required=False).position_mm).all()


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.csv: cannot be read: No such file"):
        Observations.from_csv(tmp_path / "nowhere.csv", RIG)


def test_prediction_rows_may_lack_positions() -> None:
    header, row = HEADER.removesuffix(",x_mm,y_mm,z_mm"), ROW.removesuffix(",100,200,300")
    assert np.isnan(parse(f"{header}\n{row}\n", positions_required=False).position_mm).all()


def test_cells_round_as_the_contract_says() -> None:
    table = parse(f"{HEADER}\n{ROW.replace('100,200,300', '149.9,-250.1,50')}\n{ROW}\n")
    assert table.cells().tolist() == ["1,-3,0", "1,2,3"]
    assert table.groups().tolist() == table.cells().tolist()


def test_every_shipped_rig_reads() -> None:
    assert shipped_rigs() == ("swdt82", "ur10", "ys100")
    assert [len(shipped_rig(name).rows) for name in shipped_rigs()] == [9, 6, 6]
    with pytest.raises(RigError, match=r"no such rig; give a shipped rig \(swdt82, ur10, ys100\) or"):
        shipped_rig("r2d2")


def test_a_rig_is_read_by_its_name_or_from_its_file(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(rig_text("ys100"))
    assert Rig.read("ys100") == Rig.read(path) == Rig.read(str(path)) == shipped_rig("ys100")
    with pytest.raises(RigError, match="neither a shipped rig \\(swdt82, ur10, ys100\\) nor a rig file"):
        Rig.read("r2d2")
    with pytest.raises(RigError, match=r"^r2d2\.toml: there is no such file; give another path, or a shipped rig \("):
        Rig.read("r2d2.toml")
    path.write_bytes(b"name = '\xff'")
    with pytest.raises(RigError, match=r"own\.toml: cannot be read: not UTF-8 text"):
        Rig.read(path)


ARM = """
name = "arm"
convention = "{convention}"
tolerances = {{ length_mm = 1, angle_deg = 0.1, beta_deg = 0.1, prism_mm = 1 }}
joint = [
    {{ name = "lift", kind = "prismatic", limits = [0, 500], sigma = 0.1 }},
    {{ name = "q1", kind = "revolute", limits = [-90, 90], sigma = 0.01 }},
    {{ name = "q2", kind = "revolute", limits = [-90, 90], sigma = 0.01 }},
    {{ name = "q3", kind = "revolute", limits = [-90, 90], sigma = 0.01 }},
]
prism = [{{ name = "tip", frame = 5, offset_mm = [100, 0, 0] }}]
row = [{rows}]
"""


@pytest.mark.parametrize(
    ("convention", "alphas_deg", "with_beta"),
    [
        # The lift slides along the axis of q1; q2 lies across it; the mounting of the second arm and q3 along q2.
        ("dh", (5, -90, 180, 0), [1, 3, 4]),
        ("mdh_beta_after", (0, 5, -90, 180), [1, 3, 4]),
        ("mdh_beta_before", (0, 5, -90, 180), [2, 4, 5]),
    ],
)
def test_rows_that_say_nothing_have_beta_where_axes_are_nearly_parallel(
    convention: str, alphas_deg: tuple[int, ...], with_beta: list[int]
) -> None:
    drives = ["{ d = { lift = 1 } }", "{ theta = { q1 = 1 } }", "{ theta = { q2 = 1 } }"]
    rows = [f"{{ alpha_deg = {a}, drive = {d} }}" for a, d in zip(alphas_deg, drives, strict=False)]
    rows.append(f"{{ after = 3, alpha_deg = {alphas_deg[3]}, before = {{ rz_deg = 40 }} }}")
    rows.append("{ before = { x_mm = 50 }, drive = { theta = { q3 = 1 } } }")

    rig = parse_rig(ARM.format(convention=convention, rows=", ".join(rows)), "arm.toml")

    assert [number for number, row in enumerate(rig.rows, 1) if "beta" in row.identify] == with_beta
    kept = parse_rig(rig_text("swdt82"), "swdt82.toml")
    assert [number for number, row in enumerate(kept.rows, 1) if "beta" in row.identify] == [1, 4]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "ur10"', 'name = "ur10', "not valid TOML"),
        ("length_mm = 1.0", "lenght_mm = 1.0", "tolerances.lenght_mm: unknown key; allowed here: length_mm"),
        ("length_mm = 1.0", "", "tolerances.length_mm: missing; it is required"),
        ("d_mm = 127.3", "d = 127.3", "row.1.d: unknown key; allowed here: alpha_deg, a_mm, d_mm"),
        ("gravity = [0, 0, -1]", "gravity = [0, 0, 0]", "gravity: must not be zero"),
        ("theta = { q1 = 1.0 }", "theta = { q1 = 0.0 }", "row 1: the coefficient of joint 'q1' is 0"),
        (
            "limits = [-360, 360]",
            "limits = [360, -360]",
            "limits are 360.0 .. -360.0; the first must be less than the second",
        ),
        ("theta = { q1 = 1.0 }", "theta = { q9 = 1.0 }", "row 1: driven by unknown joint 'q9'"),
        ("theta = { q1 = 1.0 }", "theta = { q2 = 1.0 }", "joint 'q1' drives no row"),
        (
            '"q1"\nkind = "revolute"',
            '"z"\nkind = "prismatic"',
            "the name 'z' is reserved: the column z_mm belongs to the fix",
        ),
        ("frame = 6", "frame = 7", "frame 7 is too large; the rig has 6 rows"),
        ("d_mm = 127.3", "d_mm = 127.3\nb_mm = 1", "convention 'dh' has no b"),
    ],
)
def test_a_rig_file_that_contradicts_itself_is_refused(old: str, new: str, message: str) -> None:
    text = rig_text("ur10")
    assert old in text
    with pytest.raises(RigError, match=message):
        parse_rig(text.replace(old, new, 1), "mine.toml")


def test_two_joints_are_not_read_from_one_place() -> None:
    text = rig_text("swdt82")
    for old in ("node = 49", "node = 48"):
        assert old in text
    with pytest.raises(RigError, match="joints 'L2' and 'L3' are read from the same place on the bus"):
        parse_rig(text.replace("node = 49", "node = 48"), "mine.toml")


def test_each_channel_tells_its_place_on_the_bus_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    place = AnyChannel.place

    def counted(channel: AnyChannel) -> dict[str, object]:
        asked.append(channel.name)
        return place(channel)

    monkeypatch.setattr(AnyChannel, "place", counted)
    rig = parse_rig(rig_text("swdt82"), "swdt82.toml")
    assert sorted(asked) == sorted(rig.joint_names)
