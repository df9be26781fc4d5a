"""The commands that the unit and the documentation give are commands that the program has."""

import re
import sys
from pathlib import Path

from tests.deploy.conftest import DEPLOY, run

RIGCAL = [sys.executable, "-m", "daemon.cli.main"]


def test_the_program_takes_the_command_line_of_the_unit() -> None:
    unit = (DEPLOY / "rigcal.service").read_text(encoding="utf-8")
    arguments = re.findall(r"(?m)^ExecStart=\S+ (.*)$", unit)[0].split()
    result = run(*RIGCAL, *arguments, "--help")
    assert result.returncode == 0, result.stdout


def test_the_check_that_is_recommended_accepts_the_example_configuration(installed: Path) -> None:
    example = installed / "etc/rigcal/rigcal.toml"
    command = re.findall(r"rigcal (config check) /etc/rigcal/rigcal\.toml", example.read_text(encoding="utf-8"))[0]
    result = run(*RIGCAL, *command.split(), example)
    assert result.returncode == 0, result.stdout
