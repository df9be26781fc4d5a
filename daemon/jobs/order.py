"""The messages between the daemon and a job's process: an order one way, a JSON object a line the other.

The process tells its number first, `{"pid": 4711}`, then any number of `{"progress": 0.3, "message": "..."}` and last
`{"result": {...}}` or `{"error": "..."}`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

QUOTED_BYTES = 60


@dataclass(frozen=True)
class Order:
    """The work that the daemon asks a job's process for.

    Attributes:
        kind: gap, residual, report, comparison or drift.
        job_id: names the files that the job writes.
        store: the store, opened read-only.
        models_directory: where models go, a directory each.
        session_ids: sessions to use: to train on (gap), to hold out (report, comparison, drift).
        model: the model directory to start from (residual, report, comparison).
        model_sha256: of its manifest: which model is meant, whatever has come to lie there since.
        train_ids: sessions that the model was trained on (report).
        seed: of every random choice.
        live_model, live_sha256: directory and manifest of the live model, if there is one (comparison, drift).
        live_id: its number in the store (comparison, drift).
        live_since: number of the change by which it went live (drift).
        held_out_ids: sessions that nothing is fitted to, to judge by (gap).
        tolerance_mm: root mean square error that the machine may have (gap, report); None where none is stated.
        store_file: device and inode of the store that the daemon has open: another file of that name is none of its.
    """

    kind: str
    job_id: int
    store: str
    models_directory: str
    session_ids: tuple[str, ...]
    seed: int
    model: str | None = None
    model_sha256: str | None = None
    train_ids: tuple[str, ...] = ()
    live_model: str | None = None
    live_sha256: str | None = None
    live_id: int | None = None
    live_since: int | None = None
    held_out_ids: tuple[str, ...] = ()
    tolerance_mm: float | None = None
    store_file: tuple[int, int] | None = None

    def to_line(self) -> bytes:
        """Return the line that the process reads."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: str) -> Order:
        """Return the order in a line that `to_line` made."""
        order = json.loads(line)
        lists = ("session_ids", "train_ids", "held_out_ids", "store_file")
        return cls(**order | {key: tuple(order[key]) for key in lists if order[key] is not None})


@dataclass(frozen=True)
class Started:
    """The beginning of a job.

    Attributes:
        pid: of its process.
    """

    pid: int


@dataclass(frozen=True)
class Progress:
    """Progress of a job.

    Attributes:
        share: of the whole, 0 to 1.
        message: what it does now.
    """

    share: float
    message: str


@dataclass(frozen=True)
class Outcome:
    """The end of a job.

    Attributes:
        state: done, failed, cancelled or interrupted, as in the store.
        error: one sentence, None when it is done.
        result: what the store keeps of a job that is done.
    """

    state: str
    error: str | None = None
    result: Mapping[str, Any] | None = None


def parse_message(line: bytes) -> Started | Progress | Outcome:
    """Return the message of a job's process in one line; a line that is no message is a job that failed."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        message = None
    match message:
        case {"pid": int() as pid}:
            return Started(pid)
        case {"progress": float() | int() as share, "message": str() as text} if -math.inf < share < math.inf:
            return Progress(float(min(max(share, 0), 1)), text)
        case {"result": dict() as result}:
            return Outcome("done", result=result)
        case {"error": str() as error}:
            return Outcome("failed", error)
    said = line.rstrip()[:QUOTED_BYTES].decode("utf-8", "replace")
    return Outcome("failed", f"its process said {said!r}, which is no message of a job; the daemon's log may tell why")
