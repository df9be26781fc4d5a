"""The simulated rig of a soak: a process that outlives the daemon, told what to do over its standard input.

It is swdt82 with one encoder more talkative: its TPDO carries alarms and warnings beside the position. Warnings of the
others never reach the bus, as on most machines.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import queue
import random
import shutil
import subprocess
import sys
import threading
import uuid
from importlib import resources
from pathlib import Path
from typing import Any

from drivers.clock import NS_PER_S, ScaledClock, Stamp, SystemClock

ANSWER_S = 60.0
SPEED = 0.45  # of the joints' greatest rates
STANDS_S = (2.0, 6.0)
SETTLED_S = 5.0
DIAGNOSED = 38  # the node whose TPDO carries these objects
DIAGNOSED_WORDS = (0x60040020, 0x65030010, 0x65050010)
UNASKED = ("fault", "arrived", "plugged", "ready")


class RigProcess:
    """`python -m simulators`, with the machine's controller as bus master, as on a rig on which rigcal only listens.

    Args:
        directory: where ports and logs appear.
        rate: simulated seconds per second.
        seed: which machine, which noise.

    Attributes:
        clock: shared by rig and daemon.
        origin: of the clock, as the processes' command lines have it.
        rig_file: describes it.
        can_port, station_port, wire_log: see `simulators.live` and `simulators.wire_log`.
        aimed: what the station was last told to turn to.
        turns_ns: when it was told to turn, on the rig's clock.
    """

    def __init__(self, directory: Path, rate: float, seed: int) -> None:
        now = SystemClock().now()
        self.clock = ScaledClock(rate, Stamp(now.utc_ns, now.monotonic_ns, f"soak-{uuid.uuid4()}"))
        stamp = self.clock.origin
        self.origin = f"{stamp.utc_ns},{stamp.monotonic_ns},{stamp.boot_id}"
        self.can_port, self.station_port, self.wire_log = directory / "can", directory / "station", directory / "wire"
        self.aimed = ""
        self.turns_ns: list[int] = []
        self._aiming = threading.Lock()
        self.rig_file = _write_rig(directory)
        command = [sys.executable, "-m", "simulators", "--rig", str(self.rig_file), "--seed", str(seed)]
        command += ["--rate", str(rate), "--map", f"{DIAGNOSED}:{'+'.join(f'{word:X}' for word in DIAGNOSED_WORDS)}"]
        command += ["--origin", self.origin, "--can-port", str(self.can_port), "--station-port", str(self.station_port)]
        command += ["--sync-ms", "200", "--signal-ms", "200", "--wire-log", str(self.wire_log)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self._ready = threading.Event()
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._turn = threading.Lock()
        self._reader = threading.Thread(target=self._read, name="rig", daemon=True)
        self._reader.start()
        if not self._ready.wait(ANSWER_S):
            raise RuntimeError("the simulated rig does not start")

    def now_ns(self) -> int:
        """The instant on the rig's monotonic clock."""
        return self.clock.monotonic_ns()

    def do(self, what: str, **arguments: Any) -> dict[str, Any]:
        """Give a command; its answer. RuntimeError if it is refused."""
        with self._turn:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps({"do": what, **arguments}) + "\n")
            self._process.stdin.flush()
            answer = self._answers.get(timeout=ANSWER_S)
        if answer["event"] == "error":
            raise RuntimeError(f"the simulated rig: {what} {arguments}: {answer['text']}")
        return answer

    def aim(self, target: str) -> None:
        """Turn the station to a prism or control point."""
        with self._aiming:
            self._aim(target)

    def aim_again(self) -> None:
        """Turn the station once more to what it was last told to turn to, whoever else turns it at the same time."""
        with self._aiming:
            self._aim(self.aimed)

    def _aim(self, target: str) -> None:
        self.do("aim", target=target)
        self.aimed = target
        self.turns_ns.append(self.now_ns())

    def has_settled(self) -> bool:
        """Whether the station is where it was last told to turn to, and was told so some seconds ago."""
        return self.tracked() == self.aimed and self.now_ns() - self.turns_ns[-1] > SETTLED_S * NS_PER_S

    def tracked(self) -> str | None:
        """What the station is locked on, as whoever looks through the telescope sees."""
        target: str | None = self.do("tracked")["target"]
        return target

    def drive(self, stop: threading.Event, rng: random.Random) -> None:
        """Move the boom from one random pose to the next until `stop`."""
        for seed in itertools.count(rng.randrange(1 << 30)):
            for pose in self.do("poses", n=20, seed=seed)["poses"]:
                moving_s = self.do("move", pose=pose, speed=SPEED)["seconds"]
                if self.clock.wait(stop, moving_s + rng.uniform(*STANDS_S)):
                    return

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.wait(timeout=20)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._reader.join(timeout=10)
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            event = json.loads(line)
            if event["event"] == "ready":
                self._ready.set()
            elif event["event"] not in UNASKED:
                self._answers.put(event)


def _write_rig(directory: Path) -> Path:
    """The rig's file, with the files beside it that it names."""
    shipped = Path(str(resources.files("calibration").joinpath("rigs")))
    shutil.copy(shipped / "machine.dbc", directory)
    text = (shipped / "swdt82.toml").read_text(encoding="utf-8")
    line = f"node = {DIAGNOSED}\n"
    assert text.count(line) == 1
    (directory / "soak.toml").write_text(text.replace(line, line + 'eds = "diagnosed.eds"\n'), encoding="utf-8")
    objects = [("1800", 0, 5), ("1800", 1, 0x180 + DIAGNOSED), ("1A00", 0, len(DIAGNOSED_WORDS))]
    objects += [("1A00", sub, word) for sub, word in enumerate(DIAGNOSED_WORDS, 1)]
    lines = [
        "[DeviceInfo]",
        "[MandatoryObjects]",
        "SupportedObjects=0",
        "[OptionalObjects]",
        "SupportedObjects=2",
        "1=0x1800",
        "2=0x1A00",
    ]
    lines += [f"[{index}]\nParameterName={index}\nObjectType=0x9\nSubNumber=5" for index in ("1800", "1A00")]
    for index, sub, value in objects:
        lines.append(f"[{index}sub{sub}]\nParameterName={index}.{sub}\nObjectType=0x7\nDataType=0x0007")
        lines.append(f"AccessType=rw\nDefaultValue={value:#x}\nPDOMapping=0")
    (directory / "diagnosed.eds").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return directory / "soak.toml"
