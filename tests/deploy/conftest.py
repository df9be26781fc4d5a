"""The files of deploy/ installed under a directory, and systemd's own programs to put them through."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
DEPLOY = REPOSITORY / "deploy"

# Debian's users have no sbin in their PATH, and systemd keeps its daemons out of everybody's.
PROGRAM_PATH = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin", "/usr/lib/systemd", "/lib/systemd"])


def program(name: str, package: str) -> str:
    """Path of a system program; without it the test is skipped, and fails where CI=true."""
    found = shutil.which(name, path=PROGRAM_PATH)
    if found is None:
        give_up = pytest.fail if os.environ.get("CI") else pytest.skip
        give_up(f"{name} is not installed, so deploy/ was NOT checked; run: sudo apt-get install {package}")
    return found


def run(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run to the end with both outputs in `stdout`; `environment` is added to ours."""
    return subprocess.run(
        [str(part) for part in command],
        env=os.environ | environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        check=False,
    )


def private_namespaces() -> list[str]:
    """Command prefix that runs a shell script with mounts and network of its own; skips where that is not allowed."""
    prefix = [program("unshare", "util-linux"), "--mount", "--net", "sh", "-euc"]
    probe = run(*prefix, "true")
    if probe.returncode != 0:
        pytest.skip(f"no private namespaces here, so this file of deploy/ was NOT parsed: {probe.stdout.strip()}")
    return prefix


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A root directory as `deploy/install.sh` fills it."""
    root = tmp_path / "root"
    result = run(DEPLOY / "install.sh", DESTDIR=str(root))
    assert result.returncode == 0, result.stdout
    return root
