"""What `rigcal session guide` reads and shows, without a daemon."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import pytest

from calibration.rig.description import shipped_rig
from daemon.cli import guide_terminal
from daemon.cli.guide_terminal import lead, plan_rows, screen
from daemon.commands import WRONG_USE, CommandError
from daemon.guide.job import Job, Request
from daemon.guide.position import BoomPosition
from daemon.guide.request import request_of
from daemon.guide.view import Around, _after_all, state_of
from daemon.models.gap_files import poses_csv
from daemon.store.queries.guides import GuideRow
from drivers.clock import Stamp

RIG = shipped_rig("swdt82")
MIDDLE = {joint.name: sum(joint.limits) / 2 for joint in RIG.joints}
POSE = {joint.column: MIDDLE[joint.name] for joint in RIG.joints}


def test_a_plan_is_read_as_rigcal_plan_writes_it(tmp_path: Path) -> None:
    file = tmp_path / "plan.csv"
    rows = [{"pose": n, **POSE, "theta4_dir": 1, "prisms": ["r", "w"]} for n in (1, 2)]
    file.write_text(poses_csv(rows), encoding="utf-8")
    request = request_of({"plan": plan_rows(file), "prisms": ["r"]}, RIG, [])
    assert request.planned("r") == (MIDDLE, MIDDLE)


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "no poses"), ("theta1_deg\nx\n", "line 2: could not convert"), (None, "No such file")],
)
def test_a_file_that_is_no_plan_is_refused_with_its_place(tmp_path: Path, text: str | None, message: str) -> None:
    file = tmp_path / "plan.csv"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    with pytest.raises(CommandError, match=message) as refused:
        plan_rows(file)
    assert refused.value.status == WRONG_USE


def at_a_pose(*warnings: str, boom: BoomPosition | None = None) -> dict[str, Any]:
    """State of a guide that waits for a pose; by default its joints were last read 30 s ago, elsewhere."""
    job = Job.of(Request(("cp1",), ("r",), 1, 0, plan=((MIDDLE, ("r",)),)))
    for kind, details in (
        ("opened", {"session": "s001-r", "last": 0}),
        ("shot", {"point": "cp1", "misclosure_mm": None}),
        ("aimed", {}),
    ):
        job = job.after(kind, details)
    row = GuideRow(1, "open", "S1", "Ada", None, {}, 3, Stamp(0, 0, "boot"))
    if boom is None:
        values = MIDDLE | {"theta1": 0.0}
        boom = BoomPosition(values, 30.0, None, is_fresh=False, missing="the joints were read 30 s ago")
    around = Around(boom, None, None, None, 3, False, False, False, 1.0, 5, [*warnings], None)
    return state_of(RIG, row, job, around)


def test_the_screen_fits_a_narrow_terminal_and_says_what_is_old() -> None:
    guide = at_a_pose()
    assert guide["step"]["kind"] == "go_to_pose"
    lines = screen(guide, 60)
    assert max(map(len, lines)) < 60
    joint = next(line for line in lines if "theta1" in line)
    assert "+22.5 to go  (old)" in joint
    assert "theta3" in "".join(lines)
    assert any("30 s ago" in line for line in lines)
    whole = " ".join(line.strip() for line in lines)
    assert "Move every joint to its target; the pose is measured automatically once the boom stands." in whole
    assert "Enter: Measure here" in whole


def test_what_a_boom_does_whose_joints_are_not_read_is_not_known() -> None:
    for is_fresh, stands_s, kind, said in (
        (False, None, "go_to_pose", "The joints are not read now; "),
        (True, None, "hold", "The boom moves; "),
        (True, 4.0, "hold", "The boom stands for 4 s; "),
    ):
        guide = at_a_pose(boom=BoomPosition(MIDDLE, 0.1 if is_fresh else 30.0, stands_s, is_fresh))
        assert guide["step"]["kind"] == kind
        assert any(line.startswith(said) for line in screen(guide, 80))


def test_off_a_terminal_targets_are_printed_and_a_warning_once_until_it_changes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setattr(guide_terminal, "LOOK_S", 0.0)
    silent = [at_a_pose(f"theta1 was read {age_s} s ago") for age_s in (3, 4, 5)]
    states = [at_a_pose("fog"), at_a_pose(), at_a_pose("fog"), at_a_pose("rain"), *silent]
    states.append(at_a_pose() | {"state": "finished"})
    coming = iter(states)
    assert lead(lambda _command, **_arguments: {"guide": next(coming)})["state"] == "finished"
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "fog" in line] == ["  warning: fog"]
    assert "  warning: rain" in lines
    assert [line for line in lines if "was read" in line] == ["  warning: theta1 was read 3 s ago"]
    (targets,) = (line for line in lines if line.startswith("  targets: "))
    for joint in RIG.joints:
        assert f"{joint.name} {MIDDLE[joint.name]:.1f} {joint.unit}" in targets


def test_who_loses_the_daemon_is_told_that_the_guide_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())

    def gone(_command: str, **_arguments: Any) -> Any:
        raise CommandError("no daemon is listening")

    with pytest.raises(CommandError, match="no daemon is listening; an open guide is kept, and `rigcal session guide`"):
        lead(gone)


def test_who_has_measured_all_is_told_that_the_jobs_need_nobody() -> None:
    awaiting = {"id": None, "jobs": 4, "is_acceptable": None, "refused_because": None}
    said = _after_all(awaiting)
    assert said == "You may leave now: 4 jobs are still working on the model; `rigcal jobs list` shows them."
