"""The daemon as its users run it: a process of its own, on a simulated rig or a replay, told by its socket."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daemon.commands import CommandError
from daemon.control.protocol import request

CONFIG = """rig = "swdt82"
state_directory = "."

[[can]]
{bus}

[[station]]
serial.path = "/dev/rigcal-station"

[jobs]
enabled = {jobs}
"""
DEADLINE_S = 300.0


class DaemonProcess:
    """`rigcal run` in a directory; options as on the command line."""

    def __init__(self, directory: Path, *options: str, jobs: bool = True, bus: str = 'channel = "can0"') -> None:
        self.directory = directory
        self.config = directory / "rigcal.toml"
        self.socket = directory / "control.sock"
        self.config.write_text(CONFIG.format(jobs=str(jobs).lower(), bus=bus), encoding="utf-8")
        command = [sys.executable, "-m", "daemon.cli.main", "run", "--config", str(self.config), *options]
        self._log = (directory / "daemon.log").open("a", encoding="utf-8")
        self.process = subprocess.Popen(command, stdout=self._log, stderr=self._log, start_new_session=True)

    def say(self, command: str, **arguments: Any) -> Any:
        return request(self.socket, command, arguments)

    def answers(self) -> bool:
        try:
            self.say("status")
        except CommandError:
            return False
        return True

    def has_fix(self) -> bool:
        return self.answers() and any(s["fixes"] for s in self.say("status")["acquisition"]["stations"])

    def wait(self, what: str, done: Callable[[], Any]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert self.process.poll() is None, f"the daemon ended: {self.log_text()}"
            assert time.monotonic() < deadline, f"waited for {what}: {self.log_text()}"
            time.sleep(0.05)

    def log_text(self) -> str:
        return (self.directory / "daemon.log").read_text(encoding="utf-8")

    def kill(self) -> None:
        """As a power cut would, for the process."""
        self.process.kill()
        self.process.wait()
        self._log.close()

    def stop(self) -> int:
        """As a terminal does with Ctrl-C: the signal reaches all that the daemon has not set apart."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
        try:
            status = self.process.wait(timeout=60)
            assert "Traceback" not in self.log_text(), self.log_text()
            return status
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
            self._log.close()
