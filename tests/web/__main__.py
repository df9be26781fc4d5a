"""Drive the page in a browser where what that tests has changed since it last passed: `make webtest`.

tests/web/passed names the state of the sources in which the tests passed, and is committed with them. Where no
Chromium is to be had the tests are skipped, and nothing is written.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

from tests.web.browser import chromium

ROOT = Path(__file__).parents[2]
PASSED = Path(__file__).with_name("passed")
TESTED = (
    "daemon/web",
    "daemon/guide",
    "daemon/cli/commands/web.py",
    "daemon/store/history.py",
    "tests/web",
    "tests/daemon/web",
)


def state() -> str:
    """Return the SHA-256 of the names and contents of all files that the tests are about."""
    digest = hashlib.sha256()
    files = [
        path for place in TESTED for path in ((ROOT / place).rglob("*") if (ROOT / place).is_dir() else [ROOT / place])
    ]
    for path in sorted(files):
        if path.is_file() and "__pycache__" not in path.parts and path != PASSED:
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            digest.update(f"{path.relative_to(ROOT).as_posix()} {content}\n".encode())
    return digest.hexdigest()


def main() -> int:
    """Run the tests if they must run; return pytest's exit status."""
    now = state()
    if PASSED.exists() and PASSED.read_text("utf-8").strip() == now:
        print("The page's browser tests passed in this state of the sources (tests/web/passed).")
        return 0
    if chromium() is None:
        print("The page's browser tests are skipped: there is no Chromium here (apt install chromium).")
        return 0
    command = [sys.executable, "-m", "pytest", "-m", "browser", "-n", "2", "--dist", "loadfile", "--durations", "10"]
    status = subprocess.run([*command, "tests/web"], cwd=ROOT, check=False).returncode
    if status == 0:
        PASSED.write_text(now + "\n", "utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
