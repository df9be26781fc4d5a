"""Cases of the benchmark as files: a process of the simulators draws them, so that the analysis knows nothing of it.

The hidden effects are in a file of their own, `LABELS`, that no worker is given.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# -P keeps the current directory off the process's path, so that no file there is imported in place of a module.
COMMAND = (sys.executable, "-P", "-m", "simulators.blind.case_files")
CASES, LABELS = "cases.json", "labels.json"
_PLAN = "poses.json"
_WRONG_OPTIONS = 2


class CasesError(Exception):
    """The cases could not be drawn or measured."""


class NoSuchCasesError(CasesError):
    """No case is selected by the options; the message names the known values."""


@dataclass(frozen=True)
class Case:
    """A case without its label.

    Attributes:
        name: of the case; it does not depend on the label.
        directory: its files.
        without: families to leave out of the library.
    """

    name: str
    directory: Path
    without: tuple[str, ...]

    def csv(self, kind: str = "") -> bytes:
        """Content of one of its files: observations, `-held-out` readings, `-twin` or `-measured` observations."""
        return (self.directory / f"{self.name}{kind}.csv").read_bytes()


def draw_cases(rig: str, options: Sequence[str], directory: Path) -> tuple[Case, ...]:
    """Draw cases into a directory.

    Args:
        rig: shipped name or path.
        options: the selection, as `python -m simulators.blind.case_files draw` takes it.
        directory: for the files.

    Raises:
        NoSuchCasesError: the options select no case.
        CasesError: drawing failed.
    """
    _run("draw", rig, directory, options)
    drawn = json.loads((directory / CASES).read_text(encoding="utf-8"))
    return tuple(Case(case["case"], directory, tuple(case["without"])) for case in drawn)


def measure(rig: str, poses: Mapping[str, Sequence[Mapping[str, Any]]], directory: Path) -> None:
    """Measure further poses of cases, as a plan's rows ask for; a case then has `-measured` observations.

    Args:
        rig: as drawn with.
        poses: case -> rows.
        directory: as drawn into.

    Raises:
        CasesError: no such case, or a row lacks a joint.
    """
    plan = directory / _PLAN
    plan.write_text(json.dumps(poses), encoding="utf-8")
    _run("measure", rig, directory, ["--plan", str(plan)])


def read_labels(directory: Path) -> dict[str, Any]:
    """Labels of all cases (`labels`), rules of drawing and judging (`rules`), and cells without a case (`dropped`)."""
    labels: dict[str, Any] = json.loads((directory / LABELS).read_text(encoding="utf-8"))
    return labels


def _run(do: str, rig: str, directory: Path, options: Sequence[str]) -> None:
    command = [*COMMAND, do, "--rig", rig, "--out", str(directory), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        is_wrong = do == "draw" and done.returncode == _WRONG_OPTIONS
        message = done.stderr.strip() or f"{do} of cases ended with status {done.returncode}"
        raise (NoSuchCasesError if is_wrong else CasesError)(message)
