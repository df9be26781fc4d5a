"""Drive the page in a browser where what that tests has changed since it last passed: `make webtest`.

tests/web.passed names the state of the sources in which the tests passed (tests/passed.py). Where no Chromium is to be
had the tests are skipped, and nothing is written.
"""

from __future__ import annotations

import subprocess
import sys

from tests.passed import ROOT, Passed
from tests.web.browser import chromium

PASSED = Passed(
    "web.passed",
    (
        "daemon/web",
        "daemon/guide",
        "daemon/cli/commands/web.py",
        "daemon/store/queries/history.py",
        "tests/web",
        "tests/daemon/web",
    ),
)


def main() -> int:
    """Run the tests if they must run; return pytest's exit status."""
    if PASSED.holds():
        print("The page's browser tests passed in this state of the sources (tests/web.passed).")
        return 0
    if chromium() is None:
        print("The page's browser tests are skipped: there is no Chromium here (apt install chromium).")
        return 0
    command = [sys.executable, "-m", "pytest", "-m", "browser", "-n", "2", "--dist", "loadfile", "--durations", "10"]
    status = subprocess.run([*command, "tests/web"], cwd=ROOT, check=False).returncode
    if status == 0:
        PASSED.note()
    return status


if __name__ == "__main__":
    sys.exit(main())
