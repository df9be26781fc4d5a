"""Run the tests that take long, marked `long`, where what they test has changed since they last passed: make long.

tests/long.passed names the state of the sources in which they passed. It is committed with the change that needed it;
where it is that of another state, as on a computer that runs them for a change that came without it, they run.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PASSED = ROOT / "tests" / "long.passed"
TESTED = ("calibration", "simulators", "daemon/cli", "daemon/report", "daemon/warm_up.py", "requirements-dev.lock")
SKIPPED = {"__pycache__"}
MARK = "pytest.mark.long"


def state(root: Path) -> str:
    """Return the SHA-256 of the names and contents of all files that the long tests are about, and of those tests."""
    files = [path for place in TESTED for path in _files(root / place)]
    files += [path for path in _files(root / "tests") if path.suffix == ".py" and MARK in path.read_text("utf-8")]
    digest = hashlib.sha256()
    for path in sorted(files):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        digest.update(f"{path.relative_to(root).as_posix()} {content}\n".encode())
    return digest.hexdigest()


def _files(place: Path) -> list[Path]:
    if place.is_file():
        return [place]
    return [path for path in place.rglob("*") if path.is_file() and not SKIPPED & set(path.parts)]


def main() -> int:
    """Run the tests if they must run; return pytest's exit status."""
    now = state(ROOT)
    if PASSED.exists() and PASSED.read_text("utf-8").strip() == now:
        print("The long tests passed in this state of the sources (tests/long.passed).")
        return 0
    command = [sys.executable, "-m", "pytest", "-m", "long", "-n", "auto", "--dist", "load", "--durations", "20"]
    status = subprocess.run(command, cwd=ROOT, check=False).returncode
    if status == 0:
        PASSED.write_text(now + "\n", "utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
