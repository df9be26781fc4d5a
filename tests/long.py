"""Run the tests that take long, marked `long`, where what they test has changed since they last passed: make long.

tests/long.passed names the state of the sources in which they passed (tests/passed.py).
"""

from __future__ import annotations

import subprocess
import sys

from tests.passed import ROOT, Passed

MARK = "pytest.mark.long"
PASSED = Passed(
    "long.passed",
    (
        "calibration",
        "simulators",
        "daemon/cli",
        "daemon/report",
        "daemon/warm_up.py",
        "docs/tutorial.md",
        "docs/how-to/calibrate.md",
        "docs/how-to/gap-report.md",
        "requirements-dev.lock",
        "pyproject.toml",
    ),
    lambda path: path.name.startswith("test_") and MARK in path.read_text("utf-8"),
)


def main() -> int:
    """Run the tests if they must run; return pytest's exit status."""
    if PASSED.holds():
        print("The long tests passed in this state of the sources (tests/long.passed).")
        return 0
    command = [sys.executable, "-m", "pytest", "-m", "long", "-n", "auto", "--dist", "load", "--durations", "20"]
    status = subprocess.run(command, cwd=ROOT, check=False).returncode
    if status == 0:
        PASSED.note()
    return status


if __name__ == "__main__":
    sys.exit(main())
