"""The daemon of a soak: started, stopped, killed, held up, kept from writing, and watched for what it uses."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon.commands import CommandError
from daemon.control.protocol import request
from tests.soak.rig_process import RigProcess

CONFIG = """rig = "{rig}"
state_directory = "."

[[can]]
interface = "slcan"
channel = "{can}"
bitrate = 250000
options = {{ sleep_after_open = 0.0 }}

[[station]]
serial.path = "{station}"
poll_interval_s = 0.2
link_delay_s = 0.02

[sessions]
settle_s = 2.0
shot_timeout_s = 20.0

[jobs]
enabled = false
"""
START_S = 120.0
STOP_S = 30.0  # of the service unit
EVERYTHING = resource.RLIM_INFINITY


UNIT = Path(__file__).parents[2] / "deploy" / "rigcal.service"


def unit_environment() -> dict[str, str]:
    """The environment that the service unit gives the daemon."""
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    given = [line.removeprefix("Environment=").partition("=") for line in lines if line.startswith("Environment=")]
    return {name: value for name, _, value in given}


@dataclass(frozen=True)
class Usage:
    """What the daemon's process uses at an instant.

    Attributes:
        life: number of the process: it is another one after a kill.
        at_s: real seconds since the process was started.
        anonymous_kib, proportional_kib: memory of its own, and with its share of what it shares. Pages of libraries are
            not its own: whether they count as private depends on who else has loaded them at that moment.
        descriptors, threads: how many are open.
        hanging: how many clients that do not behave are connected; each has a descriptor and a thread.
    """

    life: int
    at_s: float
    anonymous_kib: int
    proportional_kib: int
    descriptors: int
    threads: int
    hanging: int = 0


class DaemonProcess:
    """`rigcal run` on the simulated rig.

    Args:
        directory: its state directory.
        rig: the simulated rig.
        operator: socket of whoever aims the station.

    Attributes:
        store, socket: where it keeps its store, where it listens.
        life: number of the process.
    """

    def __init__(self, directory: Path, rig: RigProcess, operator: Path) -> None:
        self.directory, self._rig, self._operator = directory, rig, operator
        self.store, self.socket = directory / "rigcal.sqlite", directory / "control.sock"
        self._config = directory / "rigcal.toml"
        self._config.write_text(
            CONFIG.format(rig=rig.rig_file, can=rig.can_port, station=rig.station_port), encoding="utf-8"
        )
        self.life = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._started_s = 0.0

    def start(self) -> None:
        """Start it and wait until it answers."""
        origin, rate = self._rig.origin, str(self._rig.clock.rate)
        command = [sys.executable, "-m", "tests.soak.rig_daemon"]
        command += [str(self._config), rate, origin, str(self._operator)]
        # Through a pipe: a limit on the size of its files must not keep it from logging.
        self._process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, **unit_environment()},
            start_new_session=True,
        )
        self.life += 1
        self._started_s = time.monotonic()
        threading.Thread(target=self._keep_log, args=(self._process,), daemon=True).start()
        while not self.answers():
            if self._process.poll() is not None or time.monotonic() > self._started_s + START_S:
                raise RuntimeError(f"the daemon does not start; see {self.directory}/daemon.log")
            time.sleep(0.05)

    def say(self, command: str, *, timeout_s: float = 60.0, **arguments: Any) -> Any:
        """Send a command to it."""
        return request(self.socket, command, arguments, timeout_s=timeout_s)

    def answers(self) -> bool:
        """Whether it answers."""
        try:
            self.say("status", timeout_s=5.0)
        except CommandError:
            return False
        return True

    def is_alive(self) -> bool:
        """Whether the process is there."""
        return self._process is not None and self._process.poll() is None

    def kill(self) -> None:
        """End it as a power cut would."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def hold(self, real_s: float) -> None:
        """Stop it for a while, as a debugger or a starved computer does."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(real_s)
        finally:
            self._process.send_signal(signal.SIGCONT)

    def allow_writing(self, *, allowed: bool) -> None:
        """Whether files may grow: without, every write to the store fails as on a full disk."""
        assert self._process is not None
        resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE, (EVERYTHING if allowed else 1, EVERYTHING))

    def stop(self) -> tuple[int | None, float]:
        """Stop it as the service manager does; its exit status (None: it had to be killed) and how long it took."""
        assert self._process is not None
        began = time.monotonic()
        self._process.terminate()
        try:
            status: int | None = self._process.wait(timeout=4 * STOP_S)
        except subprocess.TimeoutExpired:
            status = None
            self.kill()
        return status, time.monotonic() - began

    def close(self) -> None:
        """Make sure that it has ended."""
        if self.is_alive():
            self.kill()

    def usage(self, hanging: int) -> Usage | None:
        """What it uses now, with so many clients that hang; None while there is no process."""
        process = self._process
        if process is None or process.poll() is not None:
            return None
        folder = Path("/proc", str(process.pid))
        try:
            lines = (folder / "smaps_rollup").read_text(encoding="ascii").splitlines()[1:]
            kib = {line.split(":")[0]: int(line.split()[1]) for line in lines}
            return Usage(
                life=self.life,
                at_s=time.monotonic() - self._started_s,
                anonymous_kib=kib["Anonymous"] + kib["Swap"],
                proportional_kib=kib["Pss"],
                descriptors=len(os.listdir(folder / "fd")),
                threads=len(os.listdir(folder / "task")),
                hanging=hanging,
            )
        except (OSError, KeyError):
            return None

    def _keep_log(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout as stream, (self.directory / "daemon.log").open("ab") as log:
            for line in stream:
                log.write(line)
                log.flush()
