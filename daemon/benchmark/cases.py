"""Cases of the benchmark as files; a separate simulator process draws them, so that the analysis stays blind.

The hidden effects are in a separate file, `LABELS`, that no worker gets.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# -P keeps the current directory off the module search path, so that no file there is imported.
COMMAND = (sys.executable, "-P", "-m", "simulators.blind.case_files")
CASES, LABELS = "cases.json", "labels.json"
_PLAN = "poses.json"
_WRONG_OPTIONS = 2


class CasesError(Exception):
    """The cases could not be drawn or measured."""


class NoSuchCasesError(CasesError):
    """The options select no case; the message lists the known values."""


@dataclass(frozen=True)
class Case:
    """A case without its label.

    Attributes:
        name: of the case; it does not depend on the label.
        directory: directory of its files.
        without: families to leave out of the library.
    """

    name: str
    directory: Path
    without: tuple[str, ...]

    def csv(self, kind: str = "") -> bytes:
        """Return a file of the case.

        Args:
            kind: "" for observations, `-held-out` for readings, `-twin` or `-measured` for further observations.
        """
        return (self.directory / f"{self.name}{kind}.csv").read_bytes()


def draw_cases(rig: str, options: Sequence[str], directory: Path) -> tuple[Case, ...]:
    """Draw cases into a directory.

    Args:
        rig: name of a shipped rig, or path of a rig file.
        options: the selection, as options of `python -m simulators.blind.case_files draw`.
        directory: for the files.

    Raises:
        NoSuchCasesError: the options select no case.
        CasesError: drawing failed.
    """
    _run("draw", rig, directory, options)
    drawn = json.loads((directory / CASES).read_text(encoding="utf-8"))
    return tuple(Case(case["case"], directory, tuple(case["without"])) for case in drawn)


def measure(rig: str, poses: Mapping[str, Sequence[Mapping[str, Any]]], directory: Path) -> None:
    """Measure additional poses of cases and write them as `-measured` observations.

    Args:
        rig: the rig that the cases were drawn with.
        poses: case -> rows of a plan.
        directory: directory that the cases were drawn into.

    Raises:
        CasesError: there is no such case, or a row lacks a joint.
    """
    plan = directory / _PLAN
    plan.write_text(json.dumps(poses), encoding="utf-8")
    _run("measure", rig, directory, ["--plan", str(plan)])


def read_labels(directory: Path) -> dict[str, Any]:
    """Return labels of all cases (`labels`), rules of drawing and judging (`rules`) and empty cells (`dropped`)."""
    labels: dict[str, Any] = json.loads((directory / LABELS).read_text(encoding="utf-8"))
    return labels


def _run(do: str, rig: str, directory: Path, options: Sequence[str]) -> None:
    command = [*COMMAND, do, "--rig", rig, "--out", str(directory), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        is_wrong = do == "draw" and done.returncode == _WRONG_OPTIONS
        message = done.stderr.strip() or f"{do} of cases ended with status {done.returncode}"
        raise (NoSuchCasesError if is_wrong else CasesError)(message)
