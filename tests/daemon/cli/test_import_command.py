"""`rigcal import`: exports of instruments become observations that the other commands read."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from calibration.observations import Observations
from calibration.rig.description import shipped_rig
from daemon.cli.imported_points import read_joints, setup_names
from daemon.cli.main import main
from drivers.errors import DescriptionError
from drivers.stations.export_format import ExportedFix
from tests.drivers.stations.exports.test_exports import POINTS, SDR_HEAD, SETUP, VICON, gts_download, sdr

RIG = shipped_rig("ur10")
JOINTS = [joint.column for joint in RIG.joints]
SURVEY = "PtID;X [mm];Y [mm];Z [mm];Code\n001;100,5;200;300;tmac\n002;110;210;310;tmac\n"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["import", *map(str, arguments)])


def told(*arguments: object) -> dict[str, Any]:
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def joints_csv(path: Path, key: str, cells: list[object]) -> Path:
    rows = [",".join([str(cell), *(f"{n + 10 * k}" for k in range(len(JOINTS)))]) for n, cell in enumerate(cells)]
    path.write_text("\n".join([",".join([key, *JOINTS]), *rows]) + "\n")
    return path


def test_joints_are_matched_by_the_number_of_the_pose(tmp_path: Path) -> None:
    survey = tmp_path / "survey.csv"
    survey.write_text(SURVEY)
    joints, out = joints_csv(tmp_path / "joints.csv", "pose", [2, 1]), tmp_path / "out.csv"
    result = told(survey, "--rig", "ur10", "--joints", joints, "--setup", "S1", "--out", out)
    assert (result["format"], result["points"], result["has_joints"]) == ("leica_csv", 2, True)
    found = Observations.from_csv(out, RIG)
    assert found.position_mm.tolist() == [[100.5, 200.0, 300.0], [110.0, 210.0, 310.0]]
    assert found.joints["q1"].tolist() == [1.0, 0.0]
    assert (found.pose.tolist(), found.setup.tolist()) == (["001", "002"], ["S1", "S1"])


def test_between_two_times_a_joint_goes_on_from_the_end_of_its_turn(tmp_path: Path) -> None:
    survey, out, joints = tmp_path / "walk.csv", tmp_path / "out.csv", tmp_path / "joints.csv"
    survey.write_text("point,x [mm],y [mm],z [mm],time\n1,1000,200,300,10.5\n")
    joints.write_text(f"time_s,{','.join(JOINTS)}\n10.0,359,1,10,-90,0,0\n11.0,3,359,20,-95,0,0\n")
    told(survey, "--rig", "ur10", "--joints", joints, "--prism", "tmac", "--out", out)
    found = Observations.from_csv(out, RIG)
    assert [float(found.joints[name][0]) for name in RIG.joint_names] == [1.0, 0.0, 15.0, -92.5, 0.0, 0.0]


@pytest.mark.parametrize("times", [("10.0", "10"), ("2026-11-24T10:00:00Z", "2026-11-24T11:00:00+01:00")])
@pytest.mark.parametrize("values", ["0,0,0,0,0,0", "0,0,0,0,0,5"])
def test_joint_values_at_one_time_are_refused_where_they_differ(
    tmp_path: Path, times: tuple[str, str], values: str
) -> None:
    joints, key = tmp_path / "joints.csv", "time" if "T" in times[0] else "time_s"
    joints.write_text(f"{key},{','.join(JOINTS)}\n{times[0]},0,0,0,0,0,0\n\n{times[1]},{values}\n")
    if values.endswith("5"):
        said = f"joints.csv, line 4, column {key}: time {times[1]!r} is in line 2 with different joint values; keep one"
        with pytest.raises(DescriptionError, match=re.escape(said)):
            read_joints(joints, RIG)
    else:
        assert len(read_joints(joints, RIG).times_s) == 1


def joined_by_time(folder: Path, column: str, at: str, joint_times: list[object]) -> Result:
    """The import of one point at a time, with joint values at others."""
    (folder / "walk.csv").write_text(f"point,x [mm],y [mm],z [mm],{column}\n1,1000,200,300,{at}\n")
    joints = joints_csv(folder / "joints.csv", "time_s" if "T" not in str(joint_times[0]) else "time", joint_times)
    given = ("--rig", "ur10", "--joints", joints, "--prism", "tmac")
    return run(folder / "walk.csv", *given, "--out", folder / "out.csv", "--json")


ZONED, BARE = ["2026-11-24T10:00:00Z"], ["2026-11-24T10:00:00"]
NO_ZONE = "have no time zone and are taken as UTC"


@pytest.mark.parametrize(
    ("column", "at", "joint_times", "said"),
    [
        ("time", "24.11.2026 10:00:00", BARE, f"times of walk.csv and joints.csv {NO_ZONE}"),
        ("time", "24.11.2026 10:00:00", [1795514400], f"times of walk.csv {NO_ZONE}"),
        ("time", "1795514400", BARE, f"times of joints.csv {NO_ZONE}"),
        ("time", ZONED[0], ZONED, ""),
        ("UTC", BARE[0], ZONED, ""),
    ],
)
def test_times_without_a_zone_are_taken_for_utc_and_that_is_said_once(
    tmp_path: Path, column: str, at: str, joint_times: list[object], said: str
) -> None:
    result = joined_by_time(tmp_path, column, at, joint_times)
    assert result.exit_code == 0, result.output
    assert [note for note in json.loads(result.stdout)["notes"] if "zone" in note] == [said] * bool(said)


@pytest.mark.parametrize(
    ("at", "joint_times", "said"),
    [
        (BARE[0], ZONED, "walk.csv, line 2: times of joints.csv have a time zone but times of walk.csv do not"),
        (ZONED[0], BARE, "walk.csv, line 2: times of walk.csv have a time zone but times of joints.csv do not"),
        (ZONED[0], ZONED + BARE, "joints.csv, line 3, column time: '2026-11-24T10:00:00': some times have a time zone"),
    ],
)
def test_times_with_a_zone_are_not_matched_with_those_without(
    tmp_path: Path, at: str, joint_times: list[object], said: str
) -> None:
    result = joined_by_time(tmp_path, "time", at, joint_times)
    assert (result.exit_code, said in result.stderr) == (2, True)


def test_joints_of_a_spreadsheet_in_another_language_are_refused(tmp_path: Path) -> None:
    survey, joints = tmp_path / "survey.csv", tmp_path / "joints.csv"
    survey.write_text(SURVEY)
    joints.write_text(f"pose;{';'.join(JOINTS)}\n1;0,5;0;0;0;0;0\n")
    done = run(survey, "--rig", "ur10", "--joints", joints, "--out", tmp_path / "out.csv")
    assert (done.exit_code, "line 1: has only one column: separate columns with commas" in done.stderr) == (2, True)


def test_a_point_that_is_there_twice_in_different_places_is_said(tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "out.csv"
    survey.write_text(SURVEY + "2;110;214;313;tmac\n2;110;210;510;tmac\n")
    *_, note = told(survey, "--out", out)["notes"]
    where = "'2' in lines 3 and 5, 200 mm apart"
    assert note == f"survey.csv has repeated points at different positions: {where}; all are used"


@pytest.mark.parametrize(("setup", "names"), [("S1", ["S1-J/A/1.5", "S1-J/B/1.6"]), ("", ["J/A/1.5", "J/B/1.6"])])
def test_a_file_of_two_set_ups_gives_rows_of_two_set_ups_and_says_so(
    tmp_path: Path, setup: str, names: list[str]
) -> None:
    download, out = tmp_path / "two.gts", tmp_path / "out.csv"
    download.write_text(gts_download(POINTS[:2], ("_'J_(A_)1.5", "_'J_(B_)1.6")))
    *_, note = told(download, *(["--setup", setup] if setup else []), "--out", out)["notes"]
    said = f"two.gts has 2 set-ups of the instrument, which the rows have too: {', '.join(names)}; "
    assert note == f"{said}each has its own frame"
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    assert [row["setup"] for row in rows] == [names[0], names[0], names[1], names[1]]


def test_a_file_of_one_named_set_up_has_the_given_name(tmp_path: Path) -> None:
    download, out = tmp_path / "one.gts", tmp_path / "out.csv"
    download.write_text(gts_download(POINTS[:2], ("_'J_(A_)1.5",)))
    assert len(told(download, "--setup", "S1", "--out", out)["notes"]) == 1
    assert [row["setup"] for row in csv.DictReader(out.read_text(encoding="utf-8").splitlines())] == ["S1", "S1"]


STOOD = sdr("02TP", "1", 0.0, 0.0, 0.0, 1.5)
SHOT = sdr("09F1", "1", "1", 10.0, 90.0, 0.0, "r")
BACK = sdr("07TP", "1", "2", 0.0, 0.0)


@pytest.mark.parametrize(
    ("text", "again"),
    [
        (gts_download(POINTS[:1], ("_'J_(A_)1.5",) * 2), "before line 1 as 'J/A/1.5'"),
        (gts_download(POINTS, (SETUP,) * 2), "before line 2 as '1.540'"),
        (SDR_HEAD + STOOD + BACK + SHOT + STOOD + BACK + SHOT, "before line 8 as 'JOB1/1'"),
        (SDR_HEAD + STOOD + SHOT + BACK + SHOT, "before line 6 as 'JOB1/1'"),
        (SDR_HEAD + STOOD + SHOT + "10NMJOB1\n" + SHOT * 2, "before line 6 as 'JOB1/1'"),
    ],
)
def test_an_instrument_that_is_set_up_again_under_the_same_name_is_said(tmp_path: Path, text: str, again: str) -> None:
    survey, out = tmp_path / "survey.txt", tmp_path / "out.csv"
    survey.write_text(text)
    found = told(survey, "--out", out)
    for notes in (found["notes"], told(survey, "--map", found["map_file"], "--out", tmp_path / "2.csv")["notes"]):
        assert notes[-1].startswith(f"survey.txt sets the instrument up again under an earlier name: {again}; ")
        assert notes[-1].endswith("split the file if the instrument was moved or turned")


@pytest.mark.parametrize(("height", "is_said"), [("1.5", True), ("0", False), ("", False)])
def test_coordinates_of_places_below_the_prism_are_said(tmp_path: Path, height: str, is_said: bool) -> None:
    survey = tmp_path / "survey.csv"
    survey.write_text(f"point,x [m],y [m],z [m],Target Height\n1,1,2,3,{height}\n2,1,2,4,{height}\n")
    found = told(survey, "--out", tmp_path / "out.csv")
    for notes in (found["notes"], told(survey, "--map", found["map_file"], "--out", tmp_path / "2.csv")["notes"]):
        said = "survey.csv has target heights of 1500 mm, so its coordinates may be of points that far below the prism"
        assert any(note.startswith(said) for note in notes) == is_said


@pytest.mark.parametrize("text", [gts_download(), SDR_HEAD + STOOD + BACK + SHOT * 3, SURVEY])
def test_an_instrument_that_is_set_up_once_is_not_said_to_be_set_up_again(tmp_path: Path, text: str) -> None:
    survey = tmp_path / "survey.txt"
    survey.write_text(text)
    assert not any("again" in note for note in told(survey, "--out", tmp_path / "out.csv")["notes"])


def test_a_table_of_two_stations_has_two_set_ups_though_one_is_given_for_all(tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "out.csv"
    survey.write_text("Setup;Point;X [m];Y [m];Z [m]\nS1;1;1;2;0\nS1;2;2;2;0\nS2;1;-3;2;0\nS2;2;-3;1;0\n")
    *_, note = told(survey, "--setup", "ALL", "--out", out)["notes"]
    assert note.startswith("survey.csv has 2 set-ups of the instrument, which the rows have too: ALL-S1, ALL-S2; ")
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    assert [row["setup"] for row in rows] == ["ALL-S1", "ALL-S1", "ALL-S2", "ALL-S2"]


CONSTANTS = "Station,Point,X [m],Y [m],Z [m],Prism,Prism constant (mm)\nA,1,1,2,3,w,0\nB,2,1,2,4,w,0\n"


def test_a_prism_that_one_station_measured_with_two_prism_constants_is_said(tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "out.csv"
    survey.write_text(CONSTANTS + "B,3,1,2,5,w,-30\nA,4,1,2,5,b,-30\n")
    found = told(survey, "--out", out)
    for notes in (found["notes"], told(survey, "--map", found["map_file"], "--out", tmp_path / "2.csv")["notes"]):
        said = "survey.csv has prism 'w' at 'B' measured with prism constants of 0 mm (from point '2', line 3) and -30"
        assert sum("prism constants of" in note for note in notes) == 1
        assert notes[-1].startswith(f"{said} mm (from point '3', line 4), so its distances are inconsistent: ")


@pytest.mark.parametrize(("prism", "is_said"), [(None, False), ("w", True)])
def test_two_codes_of_one_prism_have_one_prism_constant(tmp_path: Path, prism: str | None, is_said: bool) -> None:
    survey = tmp_path / "survey.csv"
    survey.write_text(CONSTANTS + "A,3,1,2,5,b,-30\n")
    notes = told(survey, *(("--prism", prism) if prism else ()), "--out", tmp_path / "out.csv")["notes"]
    assert any("prism constants of 0 mm (from" in note for note in notes) == is_said


def test_records_that_are_passed_over_are_said_with_a_map_as_well(tmp_path: Path) -> None:
    survey = tmp_path / "job.sdr"
    survey.write_text(SDR_HEAD + sdr("08KI", "1", 7.5, 1.2, 0.3) + sdr("08TP", "1", 1.0, 2.0, 3.0))
    found = told(survey, "--out", tmp_path / "1.csv")
    again = told(survey, "--map", found["map_file"], "--out", tmp_path / "2.csv")
    said = "job.sdr has 1 record 08KI, from line 3 on: coordinates typed in, not measured; skipped"
    assert (found["points"], again["points"], said in found["notes"], said in again["notes"]) == (1, 1, True, True)


@pytest.mark.parametrize("setup", ["", "S1"])
def test_a_station_without_a_name_shares_no_set_up_with_one_that_is_called_unnamed(setup: str) -> None:
    stations = ["unnamed", "", "unnamed-0"]
    found = [ExportedFix(n, "1", "", (0.0, 0.0, 0.0), station=station) for n, station in enumerate(stations)]
    assert len(set(setup_names(found, setup).values())) == 3


def test_joints_are_matched_by_time(tmp_path: Path) -> None:
    survey, out = tmp_path / "walk.csv", tmp_path / "out.csv"
    survey.write_text(VICON)
    joints = joints_csv(tmp_path / "joints.csv", "time_s", [0.0, 0.04])
    refused = run(survey, "--rig", "ur10", "--joints", joints, "--out", out)
    assert refused.exit_code == 2
    assert "walk.csv, line 6: point '1' has 'rig:tip', which is not a prism" in refused.stderr
    mapped = told(survey, "--out", out)
    map_path = Path(mapped["map_file"])
    map_path.write_text(map_path.read_text() + '\n[prisms]\n"rig:tip" = "tmac"\n"rig:base" = "tmac"\n')
    told(survey, "--map", map_path, "--rig", "ur10", "--joints", joints, "--out", out)
    found = Observations.from_csv(out, RIG)
    assert found.joints["q1"].tolist() == pytest.approx([0.25, 0.25, 0.5])


def test_a_saved_map_makes_an_import_repeatable(tmp_path: Path) -> None:
    survey, out, again = tmp_path / "survey.csv", tmp_path / "out.csv", tmp_path / "again.csv"
    survey.write_text(SURVEY)
    result = run(survey, "--out", out)
    assert result.exit_code == 0, result.output
    assert "columns are separated by semicolons" in result.stdout
    told(survey, "--map", tmp_path / "out.map.toml", "--out", again)
    assert again.read_bytes() == out.read_bytes()


def test_a_map_that_was_edited_is_not_written_over(tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "out.csv"
    survey.write_text(SURVEY)
    run(survey, "--out", out)
    assert "points written to " + f"{out} (replaced)" in run(survey, "--out", out).stdout, "the map is the same"
    other = tmp_path / "other.csv"
    other.write_text(SURVEY)
    assert run(other, "--out", out).exit_code == 0, "another file of the same columns"
    saved, before = tmp_path / "out.map.toml", out.read_bytes()
    edited = saved.read_text() + '\n[prisms]\ntmac = "r"\n'
    saved.write_text(edited)
    other.write_text(SURVEY.replace("100,5", "100,6"))
    refused = run(other, "--out", out)
    assert (refused.exit_code, saved.read_text()) == (2, edited)
    refused = run(survey, "--out", out)
    assert refused.exit_code == 2
    assert "describes other columns, perhaps edited: give it with --map" in refused.stderr
    assert (saved.read_text(), out.read_bytes()) == (edited, before)


def test_a_gts_download_becomes_observations(tmp_path: Path) -> None:
    download, out = tmp_path / "memory.gts", tmp_path / "out.csv"
    download.write_text(gts_download(), encoding="latin-1")
    result = run(download, "--rig", "swdt82", "--out", out)
    assert "memory.gts, line 1: point '1' has no code" in result.stderr
    assert not out.exists()
    assert told(download, "--rig", "swdt82", "--prism", "r", "--out", out)["points"] == 3
    assert [line.split(",")[0] for line in out.read_text().splitlines()] == ["prism", "r", "r", "r"]


@pytest.mark.parametrize("text", ["Nummer;X [m];Y [m];Z [m]\n1;1;2;3\n", "Pkt;X [m];Y [m];Z [m]\n;1;2;3\n"])
def test_points_without_names_have_no_joint_values_by_pose(tmp_path: Path, text: str) -> None:
    survey, joints = tmp_path / "survey.csv", joints_csv(tmp_path / "joints.csv", "pose", [1])
    survey.write_text(text)
    given = ("--rig", "ur10", "--prism", "tmac", "--joints", joints, "--out", tmp_path / "out.csv")
    assert "survey.csv, line 2: the point has no name, but joints.csv has" in run(survey, *given).stderr
    survey.write_text(text.replace("Nummer", "PktNr").replace("\n;", "\n1;"))
    assert told(survey, *given)["points"] == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("q3_deg", "q9_deg"), "joints.csv, line 1, column q3_deg: the column is missing"),
        (("\n1,1,", "\n1,x,"), "joints.csv, line 3, column q1_deg: 'x' is not a number"),
        (("\n1,1,", "\n2,1,"), "joints.csv, line 3, column pose: pose '2' is repeated"),
        (("\n1,1,", "\n9,1,"), "survey.csv, line 2: joints.csv has no pose '001'"),
        (("pose,", "row,"), "joints.csv, line 1: needs a column 'pose'"),
    ],
)
def test_joints_that_do_not_fit_are_refused(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    survey = tmp_path / "survey.csv"
    survey.write_text(SURVEY)
    joints = joints_csv(tmp_path / "joints.csv", "pose", [2, 1])
    joints.write_text(joints.read_text().replace(*change))
    result = run(survey, "--rig", "ur10", "--joints", joints, "--out", tmp_path / "out.csv")
    assert result.exit_code == 2
    assert said in result.stderr
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('length_unit = "furlong"', "map.toml: length_unit: must be"),
        (f"first_line = {'9' * 5000}", "map.toml: is not a TOML file: Exceeds the limit"),
        (
            f"header_line = 0x{'F' * 5000}",
            "map.toml: is not a TOML file: header_line: the whole number does not fit into 64 bits",
        ),
    ],
)
def test_a_wrong_map_is_refused(tmp_path: Path, line: str, said: str) -> None:
    survey, columns = tmp_path / "survey.csv", tmp_path / "map.toml"
    survey.write_text(SURVEY)
    columns.write_text(f'format = "leica_csv"\n{line}\n')
    result = run(survey, "--map", columns, "--out", tmp_path / "out.csv")
    assert result.exit_code == 2
    assert said in result.stderr
