"""Golden cases of real devices yield the values that their sources state, which are written here by hand."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.golden.regenerate import REAL


def rows(case: str, table: str) -> list[dict[str, Any]]:
    lines = (REAL / case / "readings.jsonl").read_text(encoding="utf-8").splitlines()
    return [row for row in map(json.loads, lines) if row["table"] == table]


def degrees(whole: int, minutes: int, seconds: float) -> float:
    return (whole + minutes / 60 + seconds / 3600) * 0.017453292519943295


def assert_polar(fix: dict[str, Any], slope_m: float | None, zenith_rad: float, hz_rad: float) -> None:
    assert fix["slope_distance_m"] == (None if slope_m is None else pytest.approx(slope_m, abs=1e-9))
    assert fix["zenith_angle_rad"] == pytest.approx(zenith_rad, abs=1e-12)
    assert fix["hz_angle_rad"] == pytest.approx(hz_rad, abs=1e-12)


def test_every_real_case_says_where_it_comes_from() -> None:
    cases = [folder for folder in REAL.iterdir() if folder.is_dir()]
    assert cases
    for folder in cases:
        text = (folder / "SOURCE.md").read_text(encoding="utf-8")
        assert all(f"**{part}.**" in text for part in ("Source", "Licence", "Changed")), folder.name


def test_topcon_records_have_the_values_that_they_print() -> None:
    millimetre, tenth, angles, coordinates, tracking = rows("topcon-records", "fixes")
    assert_polar(millimetre, 1.060, degrees(90, 53, 56), degrees(354, 51, 5))
    assert (millimetre["status"], millimetre["face"], millimetre["edm_level"]) == ("ok", 1, 60)
    assert_polar(tenth, 2.1760, degrees(268, 22, 42.5), degrees(347, 6, 35.5))
    assert (tenth["status"], tenth["face"]) == ("ok", 2)
    assert_polar(angles, None, degrees(90, 53, 56), degrees(354, 51, 5))
    assert angles["status"] == "not_available"
    found = [coordinates[name] for name in ("north_m", "east_m", "up_m", "hz_angle_rad")]
    assert found == pytest.approx([1234566.148, -23.344, -29.912, degrees(251, 56, 56)], abs=1e-9)
    assert_polar(tracking, 1178.4812, degrees(85, 20, 30), degrees(120, 30, 40))
    assert (tracking["status"], tracking["lock"], tracking["face"]) == ("not_available", "standby", 1)
    assert rows("topcon-records", "decode_failures") == []


def test_a_set_record_has_the_values_that_the_manual_gives() -> None:
    (fix,) = rows("sokkia-set-record", "fixes")
    assert_polar(fix, 6.662, degrees(80, 48, 6), degrees(39, 43, 24))
    assert fix["status"] == "ok"
    assert rows("sokkia-set-record", "decode_failures") == []
    assert rows("sokkia-set-record", "device_events") == []  # it carries its SUM


def test_an_encoder_reads_its_preset_and_nothing_while_it_reports_a_hardware_error() -> None:
    samples = rows("cia406-preset", "joint_samples")
    assert [(s["raw_counts"], s["value"], s["status"]) for s in samples] == [
        (7200, 720.0, "ok"),
        (7200, None, "device_alarm"),
        (7200, 720.0, "ok"),
    ]
    events = rows("cia406-preset", "device_events")
    assert [(event["kind"], event["code"]) for event in events] == [
        ("boot_up", None),
        ("nmt_state", 0x7F),
        ("nmt_state", 0x05),
        ("emergency", 0x5000),
        ("emergency_cleared", 0),
    ]
    assert rows("cia406-preset", "decode_failures") == []
