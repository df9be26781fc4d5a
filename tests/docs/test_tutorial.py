"""The tutorial and the search for missing physics, word for word: minutes of computing, so marked `long`."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import Block, blocks

pytestmark = [pytest.mark.long, pytest.mark.timeout(2400)]

PAGE = "docs/tutorial.md"
DAEMON = "in another terminal"
DEADLINE_S = 1800.0
BIN = str(Path(sys.executable).parent)


class Reader:
    """Somebody who types what the page says.

    Args:
        directory: where; the page makes a directory of its own in it.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._env = {**os.environ, "PATH": os.pathsep.join([BIN, os.environ["PATH"]])}

    def type(self, text: str) -> str:
        """Give commands; they must end with status 0."""
        command = ["bash", "-euo", "pipefail", "-c", f'{text}\necho "$PWD;${{RIGCAL_SOCKET-}}" >&2']
        done = subprocess.run(
            command,
            cwd=self.directory,
            env=self._env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{text}\n{done.stdout[-3000:]}\n{done.stderr[-2000:]}"
        directory, _, socket = done.stderr.splitlines()[-1].partition(";")
        self.directory, self._env["RIGCAL_SOCKET"] = Path(directory), socket
        return done.stdout

    def ask(self, command: str) -> Any:
        return json.loads(self.type(f"{command} --json"))["result"]

    def jobs(self) -> Any:
        return self.ask("rigcal jobs list")

    def wait(self, done: Callable[[], Any]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline
            time.sleep(0.5)

    def start(self, command: str) -> subprocess.Popen[bytes]:
        """Give a command in another terminal."""
        with (self.directory / "daemon.log").open("w") as log:
            return subprocess.Popen(
                command.split(), cwd=self.directory, env=self._env, stdout=log, stderr=log, start_new_session=True
            )


def test_the_tutorial_ends_with_an_accepted_model(tmp_path: Path) -> None:
    page = [block for block in blocks(PAGE) if block.language == "sh" and block.title in ("", DAEMON)]
    reader = Reader(tmp_path)
    unpack, start, look, guide, jobs, accept, use = page
    assert start.title == DAEMON
    reader.type(unpack.text)
    daemon = reader.start(start.commands[0])
    try:
        reader.wait((reader.directory / "rigcal-sim" / "control.sock").exists)
        reader.type(look.text)
        reader.type(guide.text)
        reader.type(jobs.text)
        kinds = ("gap", "residual", "report", "comparison")
        reader.wait(lambda: sum(job["state"] not in ("queued", "running") for job in reader.jobs()) >= len(kinds))
        assert [(job["kind"], job["state"]) for job in reader.jobs()] == [(kind, "done") for kind in kinds]
        assert "effect backlash@theta4: " in reader.type(accepting(accept, reader))
        reader.type(use.text)
        assert (reader.directory / "exported" / "rigcal_model.h").is_file()
    finally:
        os.killpg(daemon.pid, signal.SIGINT)
        assert daemon.wait(timeout=60) == 0


def accepting(block: Block, reader: Reader) -> str:
    """Return the block with the number of the newest candidate, as the page asks for."""
    newest = max(model["id"] for model in reader.ask("rigcal model list") if model["state"] == "candidate")
    assert "model show 2\nrigcal model accept 2 " in block.text
    return re.sub(r"(model \w+) 2\b", rf"\1 {newest}", block.text)


def test_the_page_of_missing_physics_names_the_soft_joint(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    simulate = next(block for block in blocks("docs/how-to/calibrate.md") if "rigcal simulate" in block.text)
    reader.type(simulate.text)
    for block in blocks("docs/how-to/gap-report.md"):
        if block.language == "sh" and not block.title:
            reader.type(block.text)
    answer = json.loads((tmp_path / "gap" / "gap.json").read_text(encoding="utf-8"))
    assert (answer["verdict"], [(one["family"], one["where"]) for one in answer["effects"]]) == (
        "named",
        [("joint_compliance", "q2")],
    )
