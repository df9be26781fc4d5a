"""The files of the gap workflow: its model, its report, its answer, and the poses that it asks for."""

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
    """Check that an answer may be written to `directory`: nothing is there, or the files of an earlier one.

    Raises:
        ModelError: something else is there that would be lost, or no directory can be made there.
    """
    require_place(directory)
    if directory.exists():
        if not directory.is_dir():
            raise ModelError(f"{directory} is a file; name a directory for the report and the model")
        foreign = sorted({path.name for path in directory.iterdir()} - _NAMES)
        if foreign:
            raise ModelError(
                f"{directory} holds {foreign[0]!r}, which is no part of a gap report; name another directory"
            )
        check_target(directory / MODEL)


def gap_answer(gap: GapResult, seconds: float) -> dict[str, object]:
    """Return the JSON object of `gap` (docs/reference/formats.md), with rounds and forecasts, as its report shows."""
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
    """Write model, report, answer and, where poses are asked for, the plan, in place of an earlier answer.

    A reader sees the earlier answer or the new one, also where the disk is full in between.

    Args:
        directory: where to; parents are made.
        gap: what was found.
        answer: as `gap_answer`, with what the caller adds to it.
        report: the HTML document.

    Returns:
        SHA-256 of the model's manifest, which names it.

    Raises:
        ModelError: `directory` holds something else, or the model does not load again.
        OSError: the file system refuses.
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
    """The poses that the experiments ask for, as rows of a plan, numbered on."""
    rows = [row for experiment in gap.experiments for row in experiment.poses]
    return [{**row, "pose": number} for number, row in enumerate(rows, start=1)]


def poses_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """A plan's rows as `rigcal plan --out` writes them; an empty cell where a row lacks a column."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
    return _LIST_SEPARATOR.join(map(str, value)) if isinstance(value, list | tuple) else value
