"""`rigcal` with arguments: in this process, or as a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from click.testing import CliRunner, Result

from daemon.cli.main import main


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [*map(str, arguments)])


def answer(*arguments: object) -> dict[str, Any]:
    """The JSON object of a command."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def run_apart(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "daemon.cli.main", *arguments], capture_output=True, text=True, check=False
    )


def answer_apart(*arguments: str) -> dict[str, Any]:
    """The JSON object of a command; what else it says is seen on the terminal."""
    command = [sys.executable, "-m", "daemon.cli.main", *arguments, "--json"]
    found: dict[str, Any] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return found
