"""Run the tests that take long, marked `long`, where what they test has changed since they last passed: make long.

They are two groups, each with a file that names the state of the sources in which it passed (tests/passed.py): those of
the mathematics, and those of the programs, which run daemons, commands and pages of the documentation to their end.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.passed import ROOT, Passed

MARK = "pytest.mark.long"
MATHEMATICS = "tests/calibration"
TESTED_BY_ALL = ("calibration", "simulators", "requirements-dev.lock", "pyproject.toml")


def is_long(path: Path) -> bool:
    """Return True for a file with tests that take long."""
    return path.name.startswith("test_") and MARK in path.read_text("utf-8")


def is_mathematics(path: Path) -> bool:
    """Return True for a test of the mathematics."""
    return path.is_relative_to(ROOT / MATHEMATICS)


@dataclass(frozen=True)
class Group:
    """Long tests of one kind.

    Attributes:
        name: of the group.
        chosen: pytest's arguments that choose its tests.
        passed: in which state they did.
    """

    name: str
    chosen: tuple[str, ...]
    passed: Passed

    def run(self) -> int:
        """Run the tests if they must run; return pytest's exit status."""
        if self.passed.holds():
            print(f"The long tests of the {self.name} passed in this state ({self.passed.path.relative_to(ROOT)}).")
            return 0
        options = ["-m", "long", "-n", "auto", "--dist", "loadfile", "--no-loadscope-reorder", "--durations", "20"]
        command = [sys.executable, "-m", "pytest", *options, *self.chosen]
        status = subprocess.run(command, cwd=ROOT, check=False).returncode
        if status == 0:
            self.passed.note()
        return status


GROUPS = (
    Group(
        "mathematics",
        (MATHEMATICS,),
        Passed("long_mathematics.passed", TESTED_BY_ALL, lambda path: is_long(path) and is_mathematics(path)),
    ),
    Group(
        "programs",
        ("tests", f"--ignore={MATHEMATICS}"),
        Passed(
            "long_programs.passed",
            (*TESTED_BY_ALL, "daemon", "drivers", "rigcal", "deploy", "docs/tutorial.md", "docs/how-to"),
            lambda path: is_long(path) and not is_mathematics(path),
        ),
    ),
)


def main() -> int:
    """Run the groups; return the first exit status that is not 0."""
    return next((status for group in GROUPS if (status := group.run())), 0)


if __name__ == "__main__":
    sys.exit(main())
