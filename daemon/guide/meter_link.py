"""The daemon's link to the gain meter's process, which starts and ends with the guide."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from daemon.host.priority import METER_NICE, lower_priority
from daemon.host.systemd import parse_line
from daemon.store.queries.models import ModelRow
from daemon.store.store import Store

log = logging.getLogger(__name__)

# -P keeps the current directory, which holds no code of rigcal, off the module path.
METER_COMMAND = (sys.executable, "-P", "-m", "daemon.guide.meter")
MAX_LOGGED_BYTES = 4096
# Longest time for an answer, at least ten times what a desktop computer needs to compile the kernels and to choose each
# pose, because a rig's computer is slower and busy.
ANSWER_S, POSE_S = 120.0, 3.0
_END_S = 2.0  # a killed process that waits for a hung disk ends only once the disk answers

Answer = Mapping[str, Any]
"""`{"result": {...}}` or `{"error": "one sentence"}`."""


@dataclass(frozen=True)
class Place:
    """Locations of the gain meter's input.

    Attributes:
        store: the database.
        store_file: device and inode of the store that the daemon has open.
        rig_text: the rig file.
        live_model, live_sha256: directory and manifest of the live model; None without one.
    """

    store: str
    store_file: tuple[int, int] | None
    rig_text: str
    live_model: str | None = None
    live_sha256: str | None = None

    def to_line(self) -> bytes:
        """Return the line that the process reads first."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: str) -> Place:
        """Read a line that `to_line` made."""
        place = json.loads(line)
        return cls(**place | {"store_file": place["store_file"] and tuple(place["store_file"])})

    @classmethod
    def of(cls, store: Store, rig_text: str, live: ModelRow | None) -> Place:
        """Return the locations for a store that the daemon has open."""
        file = store.files.database
        return cls(
            str(store.path),
            (file.device, file.inode) if file else None,
            rig_text,
            None if live is None else str(live.path),
            None if live is None else live.manifest_sha256,
        )


class MeterLink:
    """The process that estimates the remaining gain; it answers one question at a time.

    Args:
        place: locations of its input.

    Attributes:
        pid: ID of the process.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, place: Place) -> None:
        self._process = subprocess.Popen(
            METER_COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        self.pid = self._process.pid
        lower_priority(METER_NICE, self.pid)
        self._waiting: dict[str, tuple[Mapping[str, Any], Callable[[Answer], None]]] = {}
        self._asked = threading.Condition()
        self._is_closing = False
        self._due = time.monotonic() + ANSWER_S  # for the process to read its order, then to answer a question
        self._order = place.to_line()
        threading.Thread(target=self._work, name="gain-meter", daemon=True).start()
        threading.Thread(target=self._log, name="gain-meter-log", daemon=True).start()

    def ask(self, question: Mapping[str, Any], take: Callable[[Answer], None]) -> None:
        """Queue a question; it replaces a pending question of the same kind.

        Args:
            question: the question, as described in `meter`.
            take: called with the answer in a different thread.
        """
        with self._asked:
            self._waiting[question["do"]] = question, take
            self._asked.notify_all()

    def close(self) -> None:
        """End the process without waiting for a pending answer."""
        with self._asked:
            self._is_closing = True
            self._asked.notify_all()
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)

    @property
    def is_late(self) -> bool:
        """Return True if a question was not answered in time: the process hangs."""
        return time.monotonic() > self._due

    @property
    def is_alive(self) -> bool:
        """Return True while the process runs and answers in time."""
        return self._process.poll() is None and not self.is_late

    def _work(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        # A pipe breaks when the process ends: `is_alive` is then False, and the guide restarts the process.
        with contextlib.suppress(OSError), self._process.stdout as answers, self._process.stdin as questions:
            questions.write(self._order)
            questions.flush()
            self._due = math.inf
            while (asked := self._next()) is not None:
                question, take = asked
                self._due = time.monotonic() + ANSWER_S + POSE_S * question.get("count", 0)
                questions.write(json.dumps(question).encode() + b"\n")
                questions.flush()
                answer = answers.readline()
                self._due = math.inf
                if self._is_closing:
                    return
                if not answer.endswith(b"\n"):
                    take({"error": "the gain meter's process has ended; it is being restarted"})
                    return
                try:
                    take(json.loads(answer))
                except Exception:
                    # Such as a full disk: the process ends with its pipes, is restarted and asked again
                    log.exception("an answer of the gain meter could not be used")
                    return

    def _next(self) -> tuple[Mapping[str, Any], Callable[[Answer], None]] | None:
        """Wait for a question; return None once the link closes."""
        with self._asked:
            self._asked.wait_for(lambda: self._waiting or self._is_closing)
            return None if self._is_closing else self._waiting.pop(next(iter(self._waiting)))

    def _log(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as errors:
            while line := errors.readline(MAX_LOGGED_BYTES):
                level, text = parse_line(line.rstrip().decode("utf-8", "replace"))
                log.log(level, "gain meter: %s", text)
