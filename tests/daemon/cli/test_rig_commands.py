"""`rigcal rig`, `rigcal simulate` and the rig of `rigcal run --sim`, as a user has them."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.rig.description import parse_rig
from daemon.acquisition.channel_files import ChannelFiles
from daemon.acquisition.channels import decoder_factories
from daemon.acquisition.simulated_channels import with_simulated_channels
from daemon.rig_files import load_rig
from drivers.readings import Reading
from simulators.rig.truth import RigTruth
from simulators.rig_simulator import RigSimulator
from tests.commands import answer, run
from tests.robots import ROBOTS


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def panda(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig file of a robot with a joint that mimics another one."""
    path = tmp_path_factory.mktemp("rigs") / "panda.toml"
    answer("rig", "import", ROBOTS["panda"].path, "--out", path)
    return path


# ---- check and import ------------------------------------------------------------------------------------------------


def test_check_shows_places_reach_radii_and_what_data_can_show(tmp_path: Path) -> None:
    found = answer("rig", "check", "ur10", "--svg", tmp_path / "ur10.svg")
    places = found["zero_pose"]
    np.testing.assert_allclose(places["prisms_mm"]["tmac"], [-1184.3, -256.141, 11.6], atol=1e-6)
    assert len(places["frames_mm"]) == found["rows"] + 1
    assert 1184.3 < found["reach_mm"] < 1500.0
    assert {link["assumed"] for link in found["links"]} == {True}
    assert found["identifiability"]["rank"] < found["identifiability"]["parameters"]
    assert "assumes a radius" in found["warnings"][0]
    assert (tmp_path / "ur10.svg").read_text(encoding="utf-8").count("<path") > 20


def test_check_and_import_name_each_other_for_a_file_of_the_other_kind(tmp_path: Path) -> None:
    table, rig = tmp_path / "table.csv", tmp_path / "arm.toml"
    table.write_text("joint,a_mm\nq1,100\n", encoding="utf-8")
    rig.write_text("", encoding="utf-8")
    told = run("rig", "check", table)
    assert told.exit_code == 2
    assert f"`rigcal rig import {table} --out RIG.toml` makes one from it" in " ".join(told.stderr.split())
    told = run("rig", "import", rig, "--out", tmp_path / "new.toml")
    assert told.exit_code == 2
    assert f"`rigcal rig check {rig}` checks it" in " ".join(told.stderr.split())


def test_check_draws_the_chain_for_people() -> None:
    shown = run("rig", "check", "swdt82").stdout
    assert "swdt82: valid: 9 rows, 9 joints, 4 prisms" in shown
    side = shown.split("From the side")[1].split("From above")[0]
    assert side.count("*") >= 3
    assert "#" in side


def test_a_radius_of_a_row_is_what_plan_keeps_clear_of(tmp_path: Path) -> None:
    text = load_rig("ur10").text.replace("a_mm = -612", "a_mm = -612\nradius_mm = 75")
    (tmp_path / "thick.toml").write_text(text, encoding="utf-8")
    links = {link["row"]: link for link in answer("rig", "check", tmp_path / "thick.toml")["links"]}
    assert (links[2]["radius_mm"], links[2]["assumed"]) == (75.0, False)
    assert links[3]["assumed"]
    planned = answer("plan", "--rig", tmp_path / "thick.toml", "--poses", "3")
    assert any("75 mm of row 2" in sentence for sentence in planned["assumptions"])


@pytest.mark.parametrize(
    ("pattern", "scale", "said"),
    [
        (r"(?<=alpha_deg = )[-\d.]+", 0.01745329, "alpha_deg of row 1 is 1.5708, a multiple of a right angle in rad"),
        (r"(?<=limits = \[)-360, 360", 0.01745329, "no joint turns further than 6.28318 deg: if limits are in rad"),
        (r"(?<=radius_mm = )75", 10.0, "radius_mm of row 2 is 750 mm, over a quarter of the reach"),
        (r"(?<=[ad]_mm = )[-\d.]+", 0.001, "no length of a row is over 0.612 mm: if lengths are in m"),
    ],
    ids=["angles", "limits", "radius", "lengths"],
)
def test_check_asks_about_numbers_that_would_fit_another_unit(
    tmp_path: Path, pattern: str, scale: float, said: str
) -> None:
    text = load_rig("ur10").text.replace("a_mm = -612", "a_mm = -612\nradius_mm = 75")
    text = re.sub(pattern, lambda found: ", ".join(f"{float(x) * scale:.7f}" for x in found[0].split(",")), text)
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    assert any(said in sentence for sentence in answer("rig", "check", tmp_path / "mine.toml")["warnings"])
    assert not any("here, convert" in text or "quarter" in text for text in answer("rig", "check", "ur10")["warnings"])


def test_check_tells_every_fault_with_its_line(tmp_path: Path) -> None:
    lines = load_rig("ur10").text.splitlines()
    lines[lines.index("d_mm = 127.3")] = "d_mm = 'x'"
    lines[lines.index('name = "tmac"')] = 'nam = "tmac"'
    (tmp_path / "bad.toml").write_text("\n".join(lines), encoding="utf-8")
    done = run("rig", "check", tmp_path / "bad.toml")
    assert done.exit_code == 2
    for key, line in (("row.1.d_mm", lines.index("d_mm = 'x'")), ("prism.1.nam", lines.index('nam = "tmac"'))):
        assert any(key in told and f"(line {line + 1})" in told for told in done.stderr.splitlines()), done.stderr


def test_a_rig_survives_the_way_out_and_in(panda: Path, tmp_path: Path) -> None:
    for name in ("panda.urdf", "panda.csv"):
        answer("rig", "export", panda, "--out", tmp_path / name)
        tips = [] if name.endswith("csv") else ["--tip", "panda_leftfinger", "--tip", "panda_rightfinger"]
        copy = tmp_path / f"{name}.toml"
        again = answer("rig", "import", tmp_path / name, *tips, "--out", copy)
        assert again["joints"] == [joint.name for joint in load_rig(str(panda)).rig.joints]
        wanted, found = (answer("rig", "check", path)["zero_pose"] for path in (panda, copy))
        for prism, place in wanted["prisms_mm"].items():
            np.testing.assert_allclose(found["prisms_mm"][prism], place, atol=1e-5)


def test_an_import_does_not_overwrite_a_rig_file(tmp_path: Path) -> None:
    mine, table = tmp_path / "mine.toml", tmp_path / "t.csv"
    mine.write_text("# a day's work\n", encoding="utf-8")
    table.write_text("joint,a_mm\nq1,1\n", encoding="utf-8")
    done = run("rig", "import", table, "--out", mine)
    assert (done.exit_code, "exists and is not overwritten" in done.stderr) == (2, True), done.stderr
    assert mine.read_text(encoding="utf-8") == "# a day's work\n"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("rig", "import", "{csv}", "--tip", "x", "--out", "o"), "name links of a URDF"),
        (("rig", "import", "{urdf}", "--convention", "dh", "--out", "o"), "is for a table"),
        (("rig", "export", "ur10", "--out", "o.stl"), "must end in one of"),
        (("rig", "check", "nowhere.toml"), "nowhere.toml: there is no such file"),
        (("rig", "check", "./nowhere"), "./nowhere: there is no such file; give another path, or a shipped rig ("),
        (("rig", "check", "nowhere"), "nowhere: neither a shipped rig"),
        (("run", "--rig", "ur10"), "--rig and --by-hand are for a simulated rig"),
        (("simulate", "--rig", "ur10", "--poses", "3", "--effect", "nix@q1", "--out", "o"), "unknown effect"),
        (("simulate", "--rig", "ur10", "--poses", "3", "--effect", "backlash@q9", "--out", "o"), "possible at"),
        (("simulate", "--rig", "ur10", "--poses", "3", "--effect", "backlash", "--out", "o"), "as in backlash@JOINT"),
        (("simulate", "--rig", "ur10", "--poses", "3", "--effect", "clock_drift", "--out", "o"), "clock_drift@clock"),
        (
            ("simulate", "--rig", "ur10", "--poses", "3", "--effect", "backlash@q2:width_rad=1e30", "--out", "o"),
            "backlash@q2: width_rad=1e+30 is beyond 0.005, the largest value that such a machine can have",
        ),
        (("simulate", "--rig", "ur10", "--poses", "3", "--noise", "nan", "--out", "o"), "'nan' is not a finite number"),
    ],
)
def test_wrong_use_is_refused(tmp_path: Path, arguments: tuple[str, ...], reason: str) -> None:
    (tmp_path / "t.csv").write_text("joint,a_mm\nq1,1\n", encoding="utf-8")
    places = {"{csv}": str(tmp_path / "t.csv"), "{urdf}": str(ROBOTS["ur5"].path)}
    done = run(*(places.get(word, word) for word in arguments))
    assert (done.exit_code, reason in done.stderr) == (2, True), done.stderr


# ---- simulate --------------------------------------------------------------------------------------------------------


def test_a_seed_is_a_machine_and_a_recording_its_poses(tmp_path: Path) -> None:
    out, truth = tmp_path / "a.csv", tmp_path / "truth.json"
    machine = ("simulate", "--rig", "ur10", "--poses", "20", "--seed", "4", "--truth", truth)
    first = answer(*machine, "--out", out)
    built, text = json.loads(truth.read_text(encoding="utf-8")), out.read_text(encoding="utf-8")
    assert first["fixes"] == len(rows_of(out)) == 20
    answer(*machine, "--out", out)
    assert out.read_text(encoding="utf-8") == text
    answer(*machine, "--recording", "1", "--out", out)
    other = json.loads(truth.read_text(encoding="utf-8"))
    assert out.read_text(encoding="utf-8") != text
    assert (other["rows"], other["prisms"], other["base"]) == (built["rows"], built["prisms"], built["base"])
    off = np.array([row["a_mm"] for row in built["rows"]]) - [row.a_mm for row in load_rig("ur10").rig.rows]
    assert 0.1 < np.abs(off).max() < 5.0, "within the tolerance of 1 mm, and not the drawings"


def test_noise_is_stated_and_an_effect_moves_what_is_measured(tmp_path: Path) -> None:
    plain, bent = tmp_path / "plain.csv", tmp_path / "bent.csv"
    machine = ("simulate", "--rig", "swdt82", "--poses", "10", "--noise", "0.5")
    assert answer(*machine, "--out", plain)["noise_rms_mm"] > 0.5
    answer(*machine, "--effect", "angle_scale@theta3:scale=1e-3", "--out", bent)
    one, other = rows_of(plain), rows_of(bent)
    assert {row["sigma_x_mm"] for row in one} == {"0.5"}
    moved = [
        float(np.linalg.norm([float(a[f"{k}_mm"]) - float(b[f"{k}_mm"]) for k in "xyz"]))
        for a, b in zip(one, other, strict=True)
    ]
    assert max(moved) > 5.0


def test_a_plan_is_visited_pose_by_pose(tmp_path: Path) -> None:
    plan, out = tmp_path / "plan.csv", tmp_path / "out.csv"
    columns = [joint.column for joint in load_rig("ur10").rig.joints]
    lines = [",".join(["pose", *columns, "q1_dir"]), "1,10,20,30,40,50,60,1", "2,-10,-20,-30,-40,-50,-60,-1"]
    plan.write_text("\n".join(lines) + "\n", encoding="utf-8")
    answer("simulate", "--rig", "ur10", "--poses", "4", "--plan", plan, "--out", out)
    rows = rows_of(out)
    np.testing.assert_allclose([float(row["q2_deg"]) for row in rows], [20, -20, 20, -20], atol=0.01)
    assert [row["q1_dir"] for row in rows] == ["1.0", "-1.0", "1.0", "-1.0"]
    plan.write_text("\n".join(lines[:1]) + "\n1,10,20,30,40,50,900\n", encoding="utf-8")
    assert (
        "line 2: q6 = 900 deg is beyond its limits"
        in run("simulate", "--rig", "ur10", "--poses", "4", "--plan", plan, "--out", out).stderr
    )


# ---- run --sim --rig -------------------------------------------------------------------------------------------------


def test_joints_without_a_channel_are_read_from_simulated_devices(panda: Path) -> None:
    """All joints of a robot arrive at the decoders as they are, over the simulated bus."""
    source = load_rig(str(panda))
    rig = parse_rig(with_simulated_channels(source.rig, source.text), "panda")
    assert [channel.name for channel in rig.channels] == list(rig.joint_names)
    simulator = RigSimulator(RigTruth(rig, 1), 1)
    decoders = [factory() for factory in decoder_factories(rig, ChannelFiles.read(rig, source.directory), "boom")]
    found: dict[str, float] = {}
    for step in range(1, 40):
        for frame in simulator.poll(step * 0.05).frames:
            for decoder in decoders:
                found |= {r.channel: r.value for r in _readings(decoder, frame) if r.value is not None}
    middle = {joint.name: sum(joint.limits) / 2.0 for joint in rig.joints}
    assert found == pytest.approx(middle, abs=0.05)
    assert with_simulated_channels(rig, rig.text) == rig.text, "who has channels keeps them"


def _readings(decoder: Any, frame: Any) -> list[Reading]:
    from drivers.clock import Stamp

    if frame.arbitration_id != decoder.arbitration_id:
        return []
    return [record for record in decoder.decode(Stamp(0, 0, "b"), frame.data) if isinstance(record, Reading)]
