"""The files of the gap workflow: its model, report and answer, and the poses that it proposes."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from calibration.errors import ModelError
from calibration.gap.result import GapResult
from daemon.host.safe_output import json_line, write_file
from daemon.models.model_files import check_target, replaced_whole, require_place, write_model

MODEL = "model"
REPORT = "report.html"
ANSWER = "gap.json"
PLAN_CSV, PLAN_JSON = "plan.csv", "plan.json"
_NAMES = frozenset({MODEL, REPORT, ANSWER, PLAN_CSV, PLAN_JSON})
_LIST_SEPARATOR = " "


def check_gap_target(directory: Path) -> None:
    """Check that an answer may be written to `directory`: it does not exist, or it holds only an earlier answer.

    Raises:
        ModelError: other files there would be lost, or the directory cannot be created.
    """
    require_place(directory)
    if directory.exists():
        if not directory.is_dir():
            raise ModelError(f"{directory} is a file; name a directory for the report and the model")
        foreign = sorted({path.name for path in directory.iterdir()} - _NAMES)
        if foreign:
            raise ModelError(
                f"{directory} contains {foreign[0]!r}, which is not part of a gap report; name a different directory"
            )
        check_target(directory / MODEL)


def gap_answer(gap: GapResult, seconds: float) -> dict[str, object]:
    """Return the JSON object of `gap` (docs/reference/formats.md), with the rounds and forecasts of its report.

    Args:
        gap: result of the workflow.
        seconds: its duration.
    """
    return {
        "rig": gap.model.rig.name,
        "n": len(gap.observations),
        **gap.as_dict(),
        "rounds": [asdict(round_) for round_ in gap.rounds],
        "forecasts": [asdict(forecast) for forecast in gap.forecasts],
        "ignored_columns": list(gap.observations.ignored_columns),
        "seconds": seconds,
    }


def write_gap(directory: Path, gap: GapResult, answer: Mapping[str, object], report: str) -> str:
    """Write model, report, answer and, if poses are proposed, the plan; replace an earlier answer atomically.

    A reader sees either the earlier answer or the new one, even if the disk fills up during the write.

    Args:
        directory: target; missing parents are created.
        gap: result of the workflow.
        answer: as from `gap_answer`, with additions of the caller.
        report: the HTML document.

    Returns:
        SHA-256 of the model's manifest, which identifies the model.

    Raises:
        ModelError: `directory` holds other files, or the written model cannot be loaded.
        OSError: the files cannot be written.
    """
    check_gap_target(directory)
    texts = {REPORT: report, ANSWER: json_line(answer) + "\n"}
    poses = next_poses(gap)
    if poses:
        texts |= {PLAN_CSV: poses_csv(poses), PLAN_JSON: json_line({"rig": gap.model.rig.name, "poses": poses}) + "\n"}
    with replaced_whole(directory) as new:
        sha256 = write_model(new / MODEL, gap.model)
        for name, text in texts.items():
            write_file(new / name, text.encode())
    return sha256


def next_poses(gap: GapResult) -> list[Mapping[str, object]]:
    """Return the poses that the experiments propose, as rows of a plan, numbered from 1."""
    rows = [row for experiment in gap.experiments for row in experiment.poses]
    return [{**row, "pose": number} for number, row in enumerate(rows, start=1)]


def poses_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a plan's rows as CSV, as `rigcal plan --out` writes them; missing values are empty cells."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
    return _LIST_SEPARATOR.join(map(str, value)) if isinstance(value, list | tuple) else value
