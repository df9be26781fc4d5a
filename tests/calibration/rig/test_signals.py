"""Any column of numbers may be a signal of the rig: by its file, by name, and by what a warning says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import RigError
from calibration.observations import Observations, format_observations, parse_observations
from calibration.rig.description import Rig, parse_rig, shipped_rig
from calibration.rig.signals import how_to_use
from tests.calibration.conftest import rig_text

BOOM, ARM = rig_text("swdt82"), rig_text("ur10")
HEADER = "prism,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm"
ROW = "tmac,1,2,3,4,5,6,100,200,300"


def with_signal(text: str, name: str, unit: str) -> str:
    return f'{text}\n[[signal]]\nname = "{name}"\nunit = "{unit}"\n'


def read(text: str, rig: Rig) -> Observations:
    return parse_observations(text.encode(), rig, "data.csv")


@pytest.mark.parametrize(
    ("name", "unit", "column"),
    [("tilt_x", "deg", "tilt_x_deg"), ("wind", "mm/s", "wind_mm_per_s"), ("oil_flow", "", "oil_flow")],
)
def test_the_column_of_a_signal_is_read_and_survives_the_round_trip(name: str, unit: str, column: str) -> None:
    rig = parse_rig(with_signal(ARM, name, unit), "arm.toml")
    assert [signal.column for signal in rig.signals] == [column]
    found = read(f"{HEADER},{column}\n{ROW},1.5\n{ROW},\n", rig)
    np.testing.assert_array_equal(found.extra[column], [1.5, np.nan])
    assert found.ignored_columns == ()
    again = read(format_observations(found, rig), rig)
    np.testing.assert_array_equal(again.extra[column], found.extra[column])


@pytest.mark.parametrize(
    ("name", "unit", "reason"),
    [
        ("tilt", "furlong", "signal.1.unit: must be 'deg'"),
        ("tilt x", "deg", "signal.1.name: must consist of letters, digits and _"),
        ("temperature", "degC", "the column temperature_degC is already defined"),
        ("theta1_rate", "", "the column theta1_rate is already defined"),
        ("x_pred", "mm", "the column x_pred_mm is already defined"),
        ("rod_feed", "mm", "the column rod_feed_mm is already defined"),
        ("theta1", "V", "signal 'theta1': a joint has the same name"),
        ("L2", "bar", "signal 'L2': a joint has the same name; remove the signal, as its column is read without it"),
        ("r", "deg", "signal 'r': a prism has the same name"),
        ("pump", "degC", "signal 'pump': a channel has the same name"),
        ("frame3_x", "mm", "rigcal computes a column frame3_x_mm itself"),
    ],
)
def test_a_signal_that_something_else_is_called_is_refused(name: str, unit: str, reason: str) -> None:
    with pytest.raises(RigError, match=re.escape(reason)):
        parse_rig(with_signal(BOOM, name, unit), "boom.toml")


@pytest.mark.parametrize(("name", "unit"), [("a", "deg"), ("a", "mm"), ("a_deg", "")])
def test_two_signals_have_two_names_and_two_columns(name: str, unit: str) -> None:
    with pytest.raises(RigError, match="two signals are called"):
        parse_rig(with_signal(with_signal(ARM, "a", "deg"), name, unit), "arm.toml")


def test_a_rig_takes_signals_by_their_columns_as_its_file_would(tmp_path: Path) -> None:
    rig = shipped_rig("ur10").with_signals("tilt_x_deg", "q1_degC", "wind_mm_per_s")
    assert [(s.name, s.unit) for s in rig.signals] == [("tilt_x", "deg"), ("q1_degC", ""), ("wind", "mm/s")]
    path = tmp_path / "own.toml"
    path.write_text(rig.text, encoding="utf-8")
    assert Rig.read(path) == rig
    with pytest.raises(RigError, match="two signals are called 'tilt_x'"):
        rig.with_signals("tilt_x_deg")
    with pytest.raises(RigError, match=r"'tilt x' cannot be the column of a signal; .* as in tilt_x_deg"):
        rig.with_signals("tilt x")
    with pytest.raises(ValueError, match=r"has no text to .*; read the rig with Rig\.read"):
        Rig.model_validate(rig.model_dump(by_alias=True)).with_signals("tilt_y_deg")


def test_a_machine_is_the_same_with_other_signals_and_comments() -> None:
    rig = shipped_rig("ur10")
    assert rig.differences(parse_rig(with_signal(f"# mine\n{ARM}", "tilt", "deg"), "arm.toml")) == ()
    assert rig.differences(parse_rig(ARM.replace("d_mm = 127.3", "d_mm = 127.4", 1), "arm.toml")) == ("rows",)


@pytest.mark.parametrize(
    "column",
    ["tilt_x_deg", "oil flow [l/min]", "q1_degC", "x mm", "frame1_x_mm", "°C", "7", "humidity_%", "tmac", "Ölstand"],
)
def test_what_is_said_of_an_unused_column_makes_it_a_signal(column: str) -> None:
    text = f"{HEADER},{column},remark\n{ROW},1.5,good\n{ROW},2.5,\n"
    assert read(text, shipped_rig("ur10")).ignored_numbers == (column,)

    said = how_to_use(column, shipped_rig("ur10").taken)

    header, name, unit, flag = re.search(
        r"--signal (\S+), .* the three lines (\[\[signal\]\]), (name = \S+) and (unit = \S+)$", said
    ).group(2, 3, 4, 1)  # type: ignore[union-attr]
    if "rename" in said:
        text = text.replace(f",{column},", f",{flag},", 1)
    for rig in (
        parse_rig("\n".join((ARM, header, name, unit)), "arm.toml"),
        shipped_rig("ur10").with_signals(flag),
    ):
        np.testing.assert_array_equal(read(text, rig).extra[flag], [1.5, 2.5])


def test_only_columns_of_numbers_that_differ_could_be_used() -> None:
    columns = {"tilt": "1.5,2.5", "still": "3,3.0", "note": "4,five", "empty": ",", "x_pred_mm": "1,2", "late": ",7"}
    cells = [values.split(",") for values in columns.values()]
    text = "\n".join([f"{HEADER},{','.join(columns)}", *(",".join([ROW, *row]) for row in zip(*cells, strict=True))])
    found = read(text, shipped_rig("ur10"))
    assert found.ignored_numbers == ("tilt",)
    assert found.ignored_columns == tuple(columns)


def test_a_signal_that_ends_like_a_direction_is_any_number() -> None:
    rig = shipped_rig("ur10").with_signals("wind_dir")
    assert read(f"{HEADER},wind_dir\n{ROW},270\n", rig).extra["wind_dir"].tolist() == [270.0]
