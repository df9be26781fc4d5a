"""Files of instruments and their programs: what is read of them, and how bad ones are refused.

The samples are made here by the formats' rules. The real download of a GTS-229, which is not ours to keep, is read
where RIGCAL_GTS229 names it (`sample_data/topcon_gts_229` of the repository totalopenstation/totalopenstation).
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DescriptionError
from drivers.stations.export_format import ExportedFix
from drivers.stations.exports import export_formats, format_of
from drivers.stations.topcon.framing import block_check

POINTS = [
    ("1", 43_575, 97.0930, 131.7260, ""),
    ("2", 64_702, 96.8990, 136.0970, "w"),
    ("3", 70_501, 96.8040, 153.91, "b"),
]


SETUP = "_'_(_)1.540"


def gts_record(slope_mm: int, zenith_gon: float, hz_gon: float, corrections: str = "+00+00", *, tilt: str = "t") -> str:
    level_mm = round(slope_mm * math.sin(math.radians(zenith_gon * 0.9)))
    data = (
        f"?+{slope_mm:08d}m{round(zenith_gon * 1e4):07d}+{round(hz_gon * 1e4):07d}g+{level_mm:08d}{tilt}**{corrections}"
    )
    return data + block_check(data.encode()).decode()


def gts_download(points: list[tuple[str, int, float, float, str]] = POINTS, setups: tuple[str, ...] = (SETUP,)) -> str:
    """A memory download as the instrument sends it: the points, at each set-up."""
    measured = "".join(
        f"_+{name}_ {gts_record(slope, zenith, hz)}_*{code}_,1.500" for name, slope, zenith, hz, code in points
    )
    fields = "".join(setup + measured for setup in setups) + "_"
    lines = []
    for number, at in enumerate(range(0, len(fields), 128)):
        data = fields[at : at + 128].ljust(128) + str(number % 10)
        lines.append(f"\x02{data}{block_check(data.encode()).decode()}\x03\n")
    return "".join(lines) + "\x04\n"


def fixes(text: str, name: str) -> list[ExportedFix]:
    found = format_of(text, "file")
    assert found.name == name
    return found.read(text, found.guess(text, "file").map, "file")


def refused(text: str) -> str:
    def read() -> None:
        found = format_of(text, "survey.txt")
        found.read(text, found.guess(text, "survey.txt").map, "survey.txt")

    with pytest.raises(DescriptionError) as error:
        read()
    return str(error.value)


# ---- Topcon GTS ------------------------------------------------------------------------------------------------------


def test_a_gts_download_is_read_record_by_record() -> None:
    first, second, third = fixes(gts_download(), "topcon_gts")
    assert [(fix.point, fix.target) for fix in (first, second, third)] == [("1", ""), ("2", "w"), ("3", "b")]
    zenith, hz = math.radians(97.0930 * 0.9), math.radians(131.7260 * 0.9)
    level = 43_575 * math.sin(zenith)
    expected = (level * math.sin(hz), level * math.cos(hz), 43_575 * math.cos(zenith))
    np.testing.assert_allclose(first.position_mm, expected, atol=1e-6)


def test_gts_points_are_of_the_job_the_instrument_and_the_height_before_them() -> None:
    setups = ("_'JOB1_(ST-A_)1.500", "_(ST-B_)1.500", "_)1.620", "_'JOB2_(ST-A_)1.500")
    found = fixes(gts_download(POINTS[:1], setups), "topcon_gts")
    assert [fix.station for fix in found] == [
        "JOB1/ST-A/1.500",
        "JOB1/ST-B/1.500",
        "JOB1/ST-B/1.620",
        "JOB2/ST-A/1.500",
    ]


def test_a_gts_point_has_the_prism_constant_of_its_record() -> None:
    record = gts_record(8000, 100.0, 10.0, "+00-30")
    fields = f"{SETUP}_+1_ {gts_record(8000, 100.0, 10.0)}_+2_ {record}_".ljust(128)
    data = [fields[at : at + 128].ljust(128) + str(at // 128) for at in range(0, len(fields), 128)]
    text = "".join(f"\x02{block}{block_check(block.encode()).decode()}\x03\n" for block in data) + "\x04\n"
    assert [fix.prism_constant_mm for fix in fixes(text, "topcon_gts")] == [0.0, -30.0]


def test_a_gts_download_with_a_point_measured_while_the_compensator_was_off_is_refused() -> None:
    block = f"{SETUP}_+1_ {gts_record(8000, 100.0, 10.0, tilt='*')}_".ljust(128) + "0"
    text = f"\x02{block}{block_check(block.encode()).decode()}\x03\n\x04\n"
    assert "point 1: the compensator is off" in refused(text)


def test_a_gts_download_of_more_than_ten_blocks() -> None:
    points = [(str(n), 40_000 + n, 97.0, 130.0 + n / 10, "") for n in range(1, 54)]
    found = fixes(gts_download(points), "topcon_gts")
    assert [fix.point for fix in found] == [str(n) for n in range(1, 54)]


def test_damaged_gts_downloads_are_refused_with_their_line() -> None:
    text = gts_download()
    lines = text.split("\n")
    assert "line 2: the block check is wrong" in refused(text.replace("1539100", "1539101"))
    assert "line 1: the download ends within a field" in refused("\n".join([lines[0], *lines[2:]]))
    many = gts_download(POINTS * 2).split("\n")
    assert "line 2: found block 2, expected block 1" in refused("\n".join([many[0], *many[2:]]))
    assert "line 1: 121 characters; a block has 128" in refused(text.replace("1317260", "1317260"[:0], 1)[:121])
    unchecked = gts_record(1000, 100.0, 0.0)[:-3] + "000"
    fields = f"_'_(_)1.540_+1_ {unchecked}_*_,1.500_".ljust(128) + "0"
    broken = f"\x02{fields}{block_check(fields.encode()).decode()}\x03\n\x04\n"
    assert "block check of the record of point 1 is wrong" in refused(broken)


@pytest.mark.skipif("RIGCAL_GTS229" not in os.environ, reason="RIGCAL_GTS229 names no real download of a GTS-229")
def test_the_real_download_of_a_gts_229() -> None:
    found = fixes(Path(os.environ["RIGCAL_GTS229"]).read_text(encoding="latin-1"), "topcon_gts")
    assert [fix.point for fix in found] == [str(n) for n in range(1, 54)]


# ---- Sokkia SDR ------------------------------------------------------------------------------------------------------

SDR_HEAD = "00NMSDR33 V04-04.02     01-Jan-26 12:00 211111\n10NMJOB1            121111\n"


def sdr(code: str, *cells: object) -> str:
    return code + "".join(f"{cell!s:16.16}" for cell in cells) + "\n"


def test_sdr_coordinates_are_those_of_the_prism_from_the_instrument() -> None:
    station, target = sdr("02TP", "0003", 937.274, 509.97, 20.053, 1.505), "03NM1.60000000\n"
    text = SDR_HEAD + station + target + sdr("08TP", "0009", 908.838, 510.504, 19.699, "w") + "\x0358903\n"
    (fix,) = fixes(text, "sokkia_sdr")
    np.testing.assert_allclose(fix.position_mm, (534.0, -28436.0, 19699 + 1600 - 20053 - 1505), atol=1e-6)
    assert (fix.point, fix.target, fix.line) == ("0009", "w", 5)


def test_sdr_polar_measurements() -> None:
    (fix,) = fixes(SDR_HEAD + sdr("09F1", "0003", "0004", 10.0, 100.0, 50.0, "r"), "sokkia_sdr")
    np.testing.assert_allclose(fix.position_mm, (10_000 * math.sqrt(0.5), 10_000 * math.sqrt(0.5), 0.0), atol=1e-6)


def test_bad_sdr_files_are_refused() -> None:
    good = sdr("08TP", "1", 1.0, 2.0, 3.0)
    assert "line 4: 'x.0' is not a number, in column 2" in refused(SDR_HEAD + good + sdr("08TP", "2", "x.0", 2.0, 3.0))
    assert "line 3: 'nan' is not a number, in column 3" in refused(SDR_HEAD + sdr("08TP", "1", 1.0, "nan", 3.0))
    assert "different column widths" in refused(SDR_HEAD.replace("SDR33", "SDR20") + good)
    cut = refused(SDR_HEAD + good + sdr("08TP", "2", 1.0, 2.0, 333.123)[: 4 + 3 * 16 + 3] + "\n")
    assert "line 4: the record 08TP ends with '333' within column 4: it is truncated or lost trailing blanks" in cut
    moved = sdr("02TP", "3", 0.0, 0.0, 0.0, 1.5) + good + sdr("02TP", "3", 9.0, 0.0, 0.0, 1.5)
    assert "line 5: the station 'JOB1/3' has a second place; rename it, or split" in refused(SDR_HEAD + moved)


def test_sdr_points_are_of_the_station_that_stood_there_though_its_coordinates_were_left_at_0() -> None:
    stood = [sdr("02TP", name, 0.0, 0.0, 0.0, 0.0) for name in ("A", "B", "A")]
    polar = [sdr("09F1", name, n, 10.0, 90.0, 0.0, "r") for n, name in enumerate(("A", "B", "A"))]
    found = fixes(SDR_HEAD + "".join(a + b for a, b in zip(stood, polar, strict=True)), "sokkia_sdr")
    assert [fix.station for fix in found] == ["JOB1/A", "JOB1/B", "JOB1/A"]
    places = [sdr("02TP", name, north, 0.0, 0.0, 0.0) for name, north in (("A", 0.0), ("B", 7.0))]
    found = fixes(SDR_HEAD + "".join(place + sdr("08TP", "1", 9.0, 1.0, 2.0) for place in places), "sokkia_sdr")
    assert [(fix.station, fix.position_mm[1]) for fix in found] == [("JOB1/A", 9000.0), ("JOB1/B", 2000.0)]


def test_sdr_stations_of_two_jobs_are_two_set_ups_though_their_names_are_the_same() -> None:
    polar, place = sdr("09F1", "1", "1", 10.0, 90.0, 0.0, "r"), sdr("08TP", "2", 9.0, 1.0, 2.0)
    measured = sdr("07TP", "1", "B", 45.0, 45.0) + polar + place
    first, second = (sdr("02TP", "1", north, 0.0, 0.0, 1.5) + measured for north in (0.0, 7.0))
    found = fixes(SDR_HEAD + first + sdr("10NM", "JOB2") + second, "sokkia_sdr")
    assert [fix.station for fix in found] == ["JOB1/1", "JOB1/1", "JOB2/1", "JOB2/1"]
    assert [fix.times_set_up for fix in found] == [1, 1, 2, 2]


def test_sdr_coordinates_that_were_typed_in_are_no_fixes_and_that_is_said() -> None:
    stood, measured = sdr("02KI", "A", 0.0, 0.0, 0.0, 0.0), sdr("08TP", "1", 1.0, 2.0, 3.0)
    text = SDR_HEAD + sdr("08KI", "1", 7.5, 1.2, 0.3) * 2 + stood + measured
    assert [(fix.line, fix.point) for fix in fixes(text, "sokkia_sdr")] == [(6, "1")]
    said = "job.sdr has 2 records 08KI, from line 3 on: coordinates typed in, not measured; skipped"
    assert export_formats()["sokkia_sdr"].passed_over(text, "job.sdr") == (said,)


@pytest.mark.parametrize("code", ["08RS", "08TV", "08NM", "08"])
def test_sdr_coordinates_that_are_not_known_to_be_measured_are_no_fixes_and_that_is_said(code: str) -> None:
    text = SDR_HEAD + sdr("08TP", "1", 1.0, 2.0, 3.0) + sdr(f"{code:4}", "2", 1.0, 2.0, 3.0)
    assert [fix.point for fix in fixes(text, "sokkia_sdr")] == ["1"]
    (note,) = export_formats()["sokkia_sdr"].passed_over(text, "job.sdr")
    assert f"has 1 record {code}" in note
    assert note.endswith("from line 4 on: not known to be measured, unlike 08TP; skipped")


def test_an_sdr_file_of_typed_coordinates_alone_is_refused() -> None:
    said = refused(SDR_HEAD + sdr("08KI", "1", 1.0, 2.0, 3.0))
    assert "no measured point (records 08TP, 09F1 or 09F2); survey.txt has 1 record 08KI, from line 3 on: coord" in said


def test_a_new_sdr_job_has_neither_the_station_nor_the_origin_of_the_job_before() -> None:
    place = sdr("08TP", "1", 9.0, 1.0, 2.0)
    text = SDR_HEAD + sdr("02TP", "A", 7.0, 0.0, 0.0, 0.0) + place + sdr("10NM", "JOB2") + place
    found = [(fix.station, fix.position_mm[1]) for fix in fixes(text, "sokkia_sdr")]
    assert found == [("JOB1/A", 2000.0), ("JOB2", 9000.0)]


@pytest.mark.parametrize("back", [sdr("07TP", "A", "B", 90.0, 10.0), "", sdr("07TP", "A", "B", "", 10.0)])
@pytest.mark.parametrize("polar_first", [False, True])
def test_sdr_coordinates_and_angles_from_another_zero_are_refused(back: str, polar_first: bool) -> None:
    measured = [sdr("08TP", "1", 0.0, 5.0, 0.0), sdr("09F1", "A", "1", 5.0, 90.0, 10.0)]
    text = SDR_HEAD + sdr("02TP", "A", 0.0, 0.0, 0.0, 0.0) + back
    said = refused(text + "".join(measured[::-1] if polar_first else measured))
    assert "of the station 'JOB1/A' may be in two frames, as no back-sight (07) shows that the circle's zero is" in said


def test_a_new_sdr_job_has_not_the_target_height_of_the_job_before() -> None:
    place = sdr("08TP", "1", 9.0, 1.0, 2.0)
    found = fixes(SDR_HEAD + "03NM1.60000000\n" + place + sdr("10NM", "JOB2") + place, "sokkia_sdr")
    assert [fix.position_mm[2] for fix in found] == [3600.0, 2000.0]


def test_an_sdr_circle_that_is_set_anew_in_a_set_up_is_refused() -> None:
    stood = sdr("02TP", "A", 0.0, 0.0, 0.0, 0.0)
    before = sdr("07TP", "A", "B", 45.0, 0.0) + sdr("09F1", "A", "1", 5.0, 90.0, 90.0)
    said = refused(
        SDR_HEAD + stood + before + sdr("07TP", "A", "B", 45.0, 45.0) + sdr("09F1", "A", "2", 5.0, 90.0, 90.0)
    )
    assert "line 7: by its back-sight, the circle of the station 'JOB1/A' has a different zero than in line 5" in said
    again = sdr("07TP", "A", "B", 45.0, 0.003) + sdr("09F1", "A", "2", 5.0, 90.0, 90.0)  # sighted once more, not set
    assert len(fixes(SDR_HEAD + stood + before + again, "sokkia_sdr")) == 2


def test_a_second_sdr_header_of_other_units_is_refused() -> None:
    place = sdr("08TP", "1", 9.0, 1.0, 2.0)
    assert len(fixes((SDR_HEAD + place) * 2, "sokkia_sdr")) == 2
    feet = SDR_HEAD.replace("211111", "221111")
    assert "line 4: a second header has different units than the first" in refused(SDR_HEAD + place + feet + place)


def test_an_sdr_description_may_hold_any_character_but_a_line_end() -> None:
    (fix,) = fixes(SDR_HEAD + sdr("08TP", "1", 1.0, 2.0, 3.0, "a\x85b\u2028c\x0b"), "sokkia_sdr")
    assert fix.target == "a\x85b\u2028c"


@pytest.mark.parametrize(("azimuth", "circle"), [(45.0, 45.0), (0.0, 360.0), (359.9999, 0.0001)])
def test_sdr_coordinates_and_angles_from_their_north_are_of_one_set_up(azimuth: float, circle: float) -> None:
    stood = sdr("02TP", "A", 0.0, 0.0, 0.0, 0.0) + sdr("07TP", "A", "B", azimuth, circle)
    measured = sdr("08TP", "1", 0.0, 5.0, 0.0) + sdr("09F1", "A", "1", 5.0, 90.0, 90.0)
    first, second = fixes(SDR_HEAD.replace("211111", "111111") + stood + measured, "sokkia_sdr")
    np.testing.assert_allclose(first.position_mm, second.position_mm, atol=1e-6)


# ---- tables ----------------------------------------------------------------------------------------------------------

LEICA = "PtID,East [m],North [m],Height [m],Code,Date/Time\nP1,1.5,2.5,3.5,w,2026-11-24T10:00:00\nP2,1,2,3,b,\n"
FARO = "FARO CAM2 export;;;\nUnits: millimeters;;;\nName;X;Y;Z\np1;1000,5;2000,25;-300,125\n"
VICON = (
    "Trajectories\n100\n,,rig:tip,,,rig:base,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n"
    "1,0,1.5,2.5,3.5,4,5,6\n2,0,,,,4.5,5.5,6.5\n\nDevices\n1000\n"
)
ANGLES = "nr\thz (gon)\tv (gon)\tslope distance (m)\n7\t100\t100\t12.5\n"


def test_a_leica_table() -> None:
    first, second = fixes(LEICA, "leica_csv")
    assert (first.point, first.target, first.position_mm) == ("P1", "w", (1500.0, 2500.0, 3500.0))
    assert (first.time_s, second.time_s) == (1795514400.0, None)


def test_a_faro_table_with_a_preamble_and_decimal_commas() -> None:
    (fix,) = fixes(FARO, "faro_csv")
    assert fix.position_mm == (1000.5, 2000.25, -300.125)
    assert fix.line == 4


@pytest.mark.parametrize(
    "text",
    [
        "Punkt;Höhe [mm];Rechtswert [mm];Hochwert [mm]\nP1;300,5;1000,25;2000,5\n",
        'name,x,y,z\nP1,"1000,25","2000,5","300,5"\n',
        "// Collection::Group::Target X Y Z (mm)\nP1, 1000.25, 2000.5, 300.5\n",
        "name x [mm] y [mm] z [mm]\nP1 1000.25 2000.5 300.5\n",
        "Pkt;Rechtswert (Y) [mm];Hochwert (X) [mm];Höhe (Z) [mm]\n# moved 2 m\n;;;\nP1;1000,25;2000,5;300,5\n",
        "punktnavn;y (HW) [mm];x (RW) [mm];z (NHN) [mm]\nP1;2000,5;1000,25;300,5\n",
    ],
)
def test_coordinates_are_found_however_they_are_named_and_separated(text: str) -> None:
    (fix,) = fixes(text, "plain_csv")
    assert (fix.point, fix.position_mm) == ("P1", (1000.25, 2000.5, 300.5))


@pytest.mark.parametrize(("right", "unit"), [(90.0, "deg"), (100.0, "gon"), (math.pi / 2, "rad")])
def test_the_unit_of_angles_follows_from_their_size_where_none_is_named(right: float, unit: str) -> None:
    text = f"name,hz,v,slope distance\nP1,{3.99 * right},{right},12.5\nP2,{right},{right},12.5\n"
    guess = export_formats()["plain_csv"].guess(text, "file")
    assert (guess.map.angle_unit, guess.map.length_unit) == (unit, "m")


@pytest.mark.parametrize(
    ("above", "length", "where"),
    [
        ("Job A\nAll units in mm\n", "mm", "'mm' in line 2"),
        ("Coordinate units are in metres;;;\n", "m", "'metres' in line 1"),
        ("Units of angles and lengths: gon, in m\n", "m", "'m' in line 1"),
        ("Length unit = in;;;\n", "in", "'in' in line 1"),
        ("Units: gon/mm, speeds in m/s\n", "mm", "'mm' in line 1"),
        ('Instrument unit: TS16 M 1"\nUnit: International feet, i.e. 0.3048 m\n', "ft", "'feet' in line 2"),
        ('Instrument unit: TS16 M 1"\n', "m", ""),
        ("Einheit: mm\n", "mm", "'mm' in line 1"),
        ("# Alle Maße in mm\n", "mm", "'mm' in line 1"),
        ("All values in mm\nMeasurement units: Metric\n", "mm", "'mm' in line 1"),
        ("Coordinates (ft)\nAngle units: DMS\nPressure unit: hPa\n", "ft", "'ft' in line 1"),
        ("Community: Foot Hills\nLength of the rod (mm): 1200\nDistance unit: cm\n", "cm", "'cm' in line 3"),
    ],
)
@pytest.mark.parametrize("header", ["Point;X;Y;Z\n", ""])
def test_a_unit_above_a_table_is_taken_and_said_with_its_line(above: str, length: str, where: str, header: str) -> None:
    found = export_formats()["plain_csv"].guess(f"{above}{header}1;20.5;30.25;10\n", "file")
    assert found.map.length_unit == length
    assert (f"the unit of length is {length}, according to {where}" in found.notes) == bool(where)


@pytest.mark.parametrize(
    "header",
    [
        "Punkt;X (Easting) [mm];Y (Northing) [mm];Z (up) [mm]\n",
        "Point;Actual X (mm);Actual Y (mm);Actual Z (mm)\n",
        "Point;X(actual);Y(actual);Z(actual)\n;[mm];[mm];[mm]\n",
        "Point;X;Y;Z\n\n---;mm;mm;mm\n",
        "Point;X (1) [mm];Y (UTM32) [mm];Z (grid) [mm]\n",
    ],
)
def test_remarks_in_brackets_are_no_units(header: str) -> None:
    (fix,) = fixes(f"{header}P1;1;2;3\n", "plain_csv")
    assert fix.position_mm == (1.0, 2.0, 3.0)


def test_commas_that_are_decimal_signs_are_those_of_measured_columns_and_said() -> None:
    remark, number = ("point;x;y;z;remark\n1;1.5;2;3;4,5\n", "point;x;y;z\n1;1,234;2;3\n")
    assert export_formats()["plain_csv"].guess(remark, "file").map.decimal == "."
    assert "commas are decimal signs, as in '1,234'" in export_formats()["plain_csv"].guess(number, "file").notes


@pytest.mark.parametrize("semicolons", [False, True])
def test_vicon_trajectories(semicolons: bool) -> None:
    found = fixes(VICON.replace(",", ";") if semicolons else VICON, "vicon_csv")
    assert [(fix.point, fix.target) for fix in found] == [("1", "rig:tip"), ("1", "rig:base"), ("2", "rig:base")]
    assert (found[2].position_mm, found[2].time_s) == ((4.5, 5.5, 6.5), 0.02)


@pytest.mark.parametrize("empty", ["", ",,,,,,,", "\n\n"])
@pytest.mark.parametrize("after", ["Devices\n1000\n1,0,9,9,9\n", "\nGait Events,,\n1,0,9,9,9\n", ""])
def test_vicon_frames_go_on_after_an_empty_line_until_the_next_block(empty: str, after: str) -> None:
    text = VICON.replace("2,0,,,", f"{empty}\n1000000,0,,,").split("\nDevices")[0]
    found = fixes(f"{text}1000001,0,1,1,1\n{after}", "vicon_csv")
    assert [(fix.point, fix.target[4:]) for fix in found[2:]] == [("1000000", "base"), ("1000001", "tip")]


def test_angles_and_a_distance_become_a_position() -> None:
    (fix,) = fixes(ANGLES, "plain_csv")
    np.testing.assert_allclose(fix.position_mm, (12_500.0, 0.0, 0.0), atol=1e-6)
    first, second = fixes("p,hz [deg],v [deg],sd [m],hr\n1,9,100,5,0\n2,9,100,5,1.5\n", "plain_csv")
    assert first.position_mm == second.position_mm  # the prism's, however high above the ground


@pytest.mark.parametrize(
    "name", ["Station", "SETUP", "set-up", "Stn", "Standpunkt", "Station name", "Setup_ID", "Stn."]
)
def test_a_column_of_stations_says_where_the_instrument_stood(name: str) -> None:
    text = f"{name};point;x;y;z\nA;1;1;2;3\nA;2;1;2;4\nB;3;5;2;3\nB;4;5;2;4\n"
    assert [fix.station for fix in fixes(text, "plain_csv")] == ["A", "A", "B", "B"]


@pytest.mark.parametrize("values", [range(0, 100, 20), ["P1", "P2", "P3"], [0, 20, 40, 60, 80, 100, 120, 120]])
def test_a_column_of_stations_with_a_value_in_each_row_is_refused(values: list[object]) -> None:
    rows = [f"{value},{n},2,3" for n, value in enumerate(values)]
    said = refused("\n".join(["station,x,y,z", *rows]) + "\n")
    different = len(set(values))
    assert f"line 1, column station: {different} different values in {len(rows)} rows, so it does not name" in said


@pytest.mark.parametrize(("role", "names"), [("station", ["Station", "Setup"]), ("prism", ["Code", "Target"])])
def test_of_two_columns_that_may_name_the_same_the_one_that_is_taken_is_said(role: str, names: list[str]) -> None:
    found = export_formats()["plain_csv"].guess(f"{','.join(names)},x,y,z\nA,1,1,2,3\nA,2,1,2,3\n", "file")
    assert dict(found.map.columns)[role] == names[0]
    assert f"{role} is read from {names[0]!r}, although columns {', '.join(names)} are possible" in found.notes


@pytest.mark.parametrize(
    ("name", "cell"), [("Prism constant (mm)", "-34.4"), ("prism const. [m]", "-0.0344"), ("Prismenkonstante", "-34.4")]
)
def test_a_column_of_prism_constants_is_in_mm_or_in_the_unit_of_its_name(name: str, cell: str) -> None:
    first, second = fixes(f"{name};point;x [m];y [m];z [m]\n{cell};1;1;2;3\n;2;1;2;3\n", "plain_csv")
    assert first.prism_constant_mm == pytest.approx(-34.4)
    assert second.prism_constant_mm is None


@pytest.mark.parametrize("cell", ["-", "n/a", "-34.4mm"])
def test_a_prism_constant_that_is_no_number_is_not_known(cell: str) -> None:
    (fix,) = fixes(f"prism constant;point;x [m];y [m];z [m]\n{cell};1;1;2;3\n", "plain_csv")
    assert fix.prism_constant_mm is None


def test_a_column_of_stations_with_empty_cells_is_refused() -> None:
    said = refused("station;point;x;y;z\nS1;1;1;2;3\n;2;1;2;3\nS2;3;1;2;3\n;4;1;2;3\n")
    assert "line 3, column station: the station is missing, but not in other rows; fill it in" in said
    assert len(fixes("station;point;x;y;z\n;1;1;2;3\n;2;1;2;3\n", "plain_csv")) == 2


def test_a_table_without_a_header() -> None:
    first, second = fixes("a1 1000.0 2000.0 300.0\na2 1100.0 2000.0 300.0\n", "plain_csv")
    assert (first.point, second.position_mm) == ("a1", (1100.0, 2000.0, 300.0))


@pytest.mark.parametrize(
    "text",
    [
        "p;x;y;z;code;t\n1;1;2;3\n2;1;2;3\n",
        "p;x;y;z;;\n1;1;2;3\n2;1;2;3;\n",
        "1,1,2,3,,\n2,1,2,3\n",
        "1,1,2,3\n2,1,2,3,\n",
    ],
)
def test_a_row_need_not_have_the_last_cells_where_they_are_empty_in_all_rows(text: str) -> None:
    assert [fix.position_mm for fix in fixes(text, "plain_csv")] == [(1000.0, 2000.0, 3000.0)] * 2


def test_what_is_not_named_is_guessed_and_said() -> None:
    found = export_formats()["plain_csv"].guess("point,x,y,z\n1,1.5,2,3\n", "file")
    assert found.map.length_unit == "m"
    assert any("gives no known unit of length" in note for note in found.notes)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LEICA.replace("1.5,2.5", "1.5,2.5x"), "survey.txt, line 2, column North [m]: '2.5x' is not a number"),
        (LEICA.replace(",b,", ",b,yesterday"), "survey.txt, line 3, column Date/Time: 'yesterday' is not a time"),
        (
            "point,x,y,z\n1,2,3,4\n2,5\n",
            "survey.txt, line 3: 2 cells instead of 4: a cell is missing or the line is cut; write empty",
        ),
        (VICON.replace("2,0,", "two,0,"), "survey.txt, line 7, column Frame: 'two' is not a frame number"),
        (VICON.replace("mm", "deg"), "units are deg"),
        (VICON.replace(",,rig:base,,", ",").replace("4.5", "x"), "line 7, column unnamed 6 X: 'x' is not a number"),
        (LEICA.replace("1.5,2.5", "1e308,2.5"), "column East [m]: '1e308' is larger than any instrument measures"),
        ("some text\nand more\n", "no line names columns x, y, z"),
        (
            "nom,est,nord,haut\nP1,1.5,2.5,3.5\n",
            "line 1: this line looks like a header, but its names are unknown (nom, est, nord",
        ),
        (
            "Pkt;Hz [gon];V [gon];Q [m]\n1;131,7;97,1;43,6;\n",
            "line 1: this line looks like a header, but its names are unknown",
        ),
        (
            "name,x,y,z\nP1,1229,36,2472,01,120,82\n",
            "line 2: 7 cells instead of 4: commas are used both between columns",
        ),
        ("P1,1229,36,2472,01,120,82\n", "line 1: 7 cells instead of 4"),
        ("name;x;y;z\nP1;1.5;2.5;3.5;4.5\n", "line 2: 5 cells instead of 4: remove the extra cell"),
        ("name,x [mm],y [m],z [mm]\nP1,1229.5,2.5,3.5\n", "different units, 'x [mm]' in mm and 'y [m]' in m"),
        ("name,x,y,z\nP1,1229.5,,3.5\n", "line 2, column y: the cell is empty"),
        ("name;x;y;-z\nP1;1;2;3\n", "its names are unknown (name, x, y, -z)"),
        ("name,x,y,z,Time [ms]\nP1,1,2,3,4\n", "line 1, column Time [ms]: times in 'ms' are not supported"),
        ("name,x,y,z,Time (milliseconds)\nP1,1,2,3,4\n", "column Time (milliseconds): times in 'milliseconds' are not"),
        ("name;x;y;z;Time\n;m;m;m;[ms]\nP1;1;2;3;4\n", "line 2, column Time: times in 'ms' are not supported"),
        # angles from the horizon, heights below the prism, a grid whose X is north
        ("p;hz [deg];v [deg];sd\nP;10;-5;5\n", "line 2, column v [deg]: below 0 or above a full circle in deg, so it"),
        ("p;hz [gon];v [gon];sd\nP;10;401;5\n", "line 2, column v [gon]: below 0 or above a full circle in gon"),
        ("p;hz [deg];v [deg];sd\nP;9;5;5\nQ;9;356;5\n", "line 2, column v [deg]: all angles are within 45 deg of 0"),
        (
            "p;x;y;z;Zielhöhe\nP;1;2;3;1,5\nQ;1;2;3;0\n",
            "line 3, column Zielhöhe: the target height differs from line 2",
        ),
        ("p,x,y,z,hr\nP,1,2,3,1.5 m\n", "line 2, column hr: '1.5 m' is not a number"),
        ("Pkt;Y [m];X [m];Z [m]\nP;1;2;3\n", "line 1: 'Y [m]' is before 'X [m]', as in grids whose X is north"),
        # units
        ("Units: mm; heights in ft\nname;x;y;z\nP1;1;2;3\n", "length: 'mm' in line 1 (mm) and 'ft' in line 1 (ft)"),
        ("Height unit: m\nUnit mm\nP1;1;2;3\n", "of length: 'm' in line 1 (m) and 'mm' in line 2 (mm); keep one"),
        (ANGLES.replace("gon", "mil"), "line 1, column hz (mil): 'mil' is not a known unit of angles; export deg"),
        (LEICA.replace("[m]", "(US ft)"), "line 1, column East (US ft): 'US ft' is not a known unit of length"),
        ("Units: micrometers\nP1;1;2;3\n", "line 1: 'micrometers' is not a known unit of length; export mm, cm"),
        ("Units of angles: mils\nUnits used;furlongs\nP1;1;2;3\n", "line 2: 'furlongs' is not a known unit of length"),
        ("A\nUnit: US survey feet\nP1;1;2;3\n", "line 2: 'us survey feet' is not a known unit of length"),
        ("All coordinates in usft\nP1;1;2;3\n", "line 1: 'usft' is not a known unit of length"),
        ("Angle units: Degrees DMS\np;hz;v;sd [m]\nP;1;90;3\n", "line 1: 'dms' is not a known unit of angles; ex"),
        ("name;x (actual) [km];y;z\nP1;1;2;3\n", "column x (actual) [km]: 'km' is not a known unit of length"),
        ("name;x;y;z\n;km;km;km\nP1;1;2;3\n", "line 2, column x: 'km' is not a known unit of length"),
        ("name;x [mm];y;z\n;m;m;m\nP1;1;2;3\n", "different units, 'x [mm]' in mm and 'x [mm]' in m"),
        # cells that are lost, and rows
        (
            "point prism x y z t\n1 w 1 2 3 20\n2 1 2 3 20\n",
            "line 3: 5 cells instead of 6: a cell is missing or the line is cut; blanks",
        ),
        ("1 1.5 2 3 20\n2 1 2 3\n", "line 2: 4 cells instead of 5: a cell is missing or the line is cut; blanks"),
        ("p,x,y,z,code,t\n1,10.5,20.5,123.4,w,20\n2,10.5,20.5,12", "line 3: 4 cells instead of 6: a cell is missing"),
        ("p;x;y;z;t\n1;10.5;20.5;123.4;20\n2;10.5;123.4;20\n", "line 3: 4 cells instead of 5: a cell is missing or"),
        ("1,1.1,2.2,3.3\n2,1.1,2.2,33,1.2,2.3,3.4\n", "line 2: 7 cells instead of 4: remove the extra cell, or split"),
        ("1\t1.1\t2.2\t3.3\n2\t7\t1.1\t2.2\t3.3\n", "line 2: 5 cells instead of 4: remove the extra cell, or split"),
        ("p;x;y;z\n#1;1;2;3\n2;1;2;3\n", "line 2: # begins a comment, but this may be a point: delete the line, or"),
        ("P1,,2.0,3.0\nP2,1,2,3\n", "line 1: the line has numbers like the points from line 2 on, but is not"),
        ("P1 2.0 3.0\nP2 1 2 3\n", "line 1: the line has numbers like the points from line 2 on"),
        # signs before fractions
        (
            'name,x,y,z\nP1,"1,234",5,6\nP2,7,567.8,9\n',
            "line 3: '567.8', and '1,234' in line 2: both points and com",
        ),
        ("name;x;y;z\nP1;1.234;567,8;9\n", "line 2: '567,8', and '1.234' in line 2: both points and commas"),
        (VICON.replace("1.5", '"1,234"'), "line 6: '2.5', and '1,234' in line 6: both points and commas"),
        # columns of one meaning
        (
            "name;X;Y;Z;Actual X\nP1;1;2;3;1\n",
            "line 1: columns 'X' and 'Actual X' may both be x; rename one, or write a map",
        ),
        (
            "p;X (Northing);Y (Easting);Z\nP;1;2;3\n",
            "columns 'X (Northing)' and 'Y (Easting)' may both be x; rename one",
        ),
        ("name;Height;X;Y;Z\nP1;1;2;3;1\n", "columns 'Height' and 'Z' may both be z"),
        ("name;East;North;X;Y;Z\nP1;1;2;3;1;1\n", "columns 'East' and 'X' may both be x"),
        (
            "name;hz;azimuth;v;sd\nP1;1;2;3;1\n",
            "columns 'hz' and 'azimuth' may both be hz; rename one, or write a map with",
        ),
        # Vicon
        (VICON.replace("4,5,6", "4,5"), "line 6, column rig:base Z: the cell is empty; a marker must have all three"),
        (
            VICON.replace("4,5,6", "4,5,6,7"),
            "line 6: 9 cells instead of 8: remove the extra cell, or split joined lines",
        ),
        (VICON.replace("2,0,", "1,1,"), "line 7, column Frame: frame 1 is already in line 6; export one row per frame"),
        (VICON.replace("2,0,", '"1,002",0,'), "line 7, column Frame: '1,002' is not a frame number"),
        (VICON.replace("base", "tip"), "line 3: two markers are called 'rig:tip'; rename one"),
        (VICON.replace("Devices", "Trajectories"), "line 9: a second block of trajectories; save each block"),
    ],
)
def test_bad_tables_are_refused_whole(text: str, said: str) -> None:
    assert said in refused(text)


@pytest.mark.parametrize(
    ("text", "change", "said"),
    [
        (LEICA, {"header_line": 99}, "the map's header is in line 99, the file has 4"),
        (VICON, {"header_line": 99}, "the map's header is in line 99, the file has 11"),
        (LEICA, {"columns": {"point": 1, "x": 0, "y": 3, "z": 4}}, "column 0: the map counts columns from 1"),
        (
            SDR_HEAD + sdr("08TP", "1", 1.0, 2.0, 3.0),
            {"angle_unit": "deg"},
            "line 1: the header has units m and gon, the map m and deg; ",
        ),
        (
            SDR_HEAD + sdr("08TP", "1", 1.0, 2.0, 3.0),
            {"length_unit": "ft"},
            "the header has units m and gon, the map ft and",
        ),
    ],
)
def test_a_map_of_another_file_is_refused(text: str, change: dict[str, object], said: str) -> None:
    known = format_of(text, "file")
    columns = known.guess(text, "file").map
    with pytest.raises(DescriptionError, match=re.escape(said)):
        known.read(text, columns.model_copy(update=change), "file")


@pytest.mark.timeout(20)
@pytest.mark.parametrize("endless", [" " * 500_000, "(" * 500_000, "( " * 250_000, "\n" * 500_000])
def test_what_never_closes_is_read_in_linear_time(endless: str) -> None:
    assert refused(f"name,x [mm,{endless}\n1,2\n")
    assert refused(f"name x [mm {endless}\n1 2\n")
    assert refused(f"Trajectories{endless}x")


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (SDR_HEAD + sdr("09F1", "A", "1", 0.0, 90.0, 10.0), 3, "the distance 0 m is not between 0 and 6000 m"),
        (SDR_HEAD + sdr("09F1", "A", "1", -5.0, 90.0, 10.0), 3, "the distance -5 m is not between 0 and 6000 m"),
        (SDR_HEAD + sdr("09F1", "A", "1", 99999.0, 90.0, 10.0), 3, "the distance 99999 m is not between 0 and 6000 m"),
        (SDR_HEAD + sdr("08TP", "1", 0.0, 0.0, 0.0), 3, "all coordinates are zero"),
        ("point,hz_deg,zenith_deg,distance_m\n1,10,90,5\n2,20,91,0\n", 3, "the distance 0 m is not"),
        ("point,x_m,y_m,z_m\n1,1,2,3\n2,0,0,0\n", 3, "all coordinates are zero"),
        (
            gts_download([("1", 43_575, 97.0, 131.0, ""), ("2", 7_000_000, 97.0, 131.0, "")]),
            None,
            "exceeds max_range_m",
        ),
    ],
)
def test_a_point_that_nothing_was_measured_of_is_refused_with_its_line(text: str, line: int | None, said: str) -> None:
    message = refused(text)
    assert said in message
    assert line is None or f"line {line}" in message


def test_an_empty_file_is_of_no_format() -> None:
    assert "unknown format" in refused("\n")


@pytest.mark.parametrize("seed", range(6))
def test_hostile_files_are_read_or_refused(seed: int) -> None:
    samples = [gts_download(), SDR_HEAD + sdr("08TP", "1", 1.0, 2.0, 3.0), LEICA, FARO, VICON, ANGLES]
    rng = np.random.default_rng(seed)
    for _ in range(150):
        text = list(samples[seed])
        for _ in range(int(rng.integers(1, 6))):
            place = int(rng.integers(len(text)))
            text[place : place + int(rng.integers(0, 9))] = chr(int(rng.choice([0, 10, 34, 44, 57, 59, 95, 955])))
        with contextlib.suppress(DescriptionError):
            known = format_of("".join(text), "file")
            known.read("".join(text), known.guess("".join(text), "file").map, "file")
