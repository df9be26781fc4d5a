"""The page of all commands, and what shells complete."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from daemon.cli.main import main
from deploy.release.debian import completion

REPOSITORY = Path(__file__).parents[3]


def test_every_command_and_option_is_documented() -> None:
    page = (REPOSITORY / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    for line in ("## rigcal status", "### rigcal session start", "`--refit-base`", "`rigcal completion [OPTIONS]"):
        assert line in page or line.strip("`") in page, line
    for name in main.list_commands(None):  # type: ignore[arg-type] # of no context
        assert f"\n## rigcal {name}\n" in page or f"\n### rigcal {name} " in page, name


@pytest.mark.parametrize(("words", "number", "expected"), [("rigcal sta", 1, "status"), ("rigcal jobs l", 2, "list")])
def test_bash_completes_commands(words: str, number: int, expected: str) -> None:
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(number), "_RIGCAL_COMPLETE": "bash_complete"}
    program = [sys.executable, "-c", "from daemon.cli.main import main; main(prog_name='rigcal')"]
    done = subprocess.run(program, env={**os.environ, **asked}, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [f"plain,{expected}"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell_is_sound_and_is_packed(shell: str) -> None:
    done = CliRunner().invoke(main, ["completion", shell])
    assert done.exit_code == 0
    assert "_RIGCAL_COMPLETE" in done.stdout
    if shutil.which(shell):
        assert subprocess.run([shell, "-n"], input=done.stdout, text=True, check=False).returncode == 0
    assert completion(REPOSITORY, shell).decode() == done.stdout
