"""The messages between the daemon and a job's process.

The daemon sends one order. The process answers with one JSON object per line: first its process id, `{"pid": 4711}`,
then any number of `{"progress": 0.3, "message": "..."}`, and last `{"result": {...}}` or `{"error": "..."}`.
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
    """The work that the daemon gives to a job's process.

    Attributes:
        kind: gap, residual, report, comparison or drift.
        job_id: number of the job, which names the files that it writes.
        store: path of the store, which is opened read-only.
        models_directory: parent directory of the models' directories.
        session_ids: sessions to use: to train on (gap), to hold out (report, comparison, drift).
        seed: of all random choices.
        model: the model directory to start from (residual, report, comparison).
        model_sha256: checksum of the model's manifest, which identifies the model even if its directory has changed.
        train_ids: sessions that the model was trained on (report).
        live_model, live_sha256: directory and manifest checksum of the live model, if there is one (comparison, drift).
        live_id: number of the live model in the store (comparison, drift).
        live_since: number of the change by which the live model went live (drift).
        held_out_ids: sessions that are held out to judge the model (gap).
        tolerance_mm: root mean square error that the machine may have (gap, report); None if none is configured.
        store_file: device and inode of the store that the daemon has open, so that a replaced file is detected.
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
        """Return the order as the line that the process reads."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: str) -> Order:
        """Parse a line that `to_line` made."""
        order = json.loads(line)
        lists = ("session_ids", "train_ids", "held_out_ids", "store_file")
        return cls(**order | {key: tuple(order[key]) for key in lists if order[key] is not None})


@dataclass(frozen=True)
class Started:
    """The start of a job.

    Attributes:
        pid: id of its process.
    """

    pid: int


@dataclass(frozen=True)
class ProgressMessage:
    """ProgressMessage of a job.

    Attributes:
        share: share of the work that is done, 0 to 1.
        message: current step.
    """

    share: float
    message: str


@dataclass(frozen=True)
class Outcome:
    """The end of a job.

    Attributes:
        state: done, failed, cancelled or interrupted, as in the store.
        error: one sentence; None if the job is done.
        result: what the store keeps of a job that is done.
    """

    state: str
    error: str | None = None
    result: Mapping[str, Any] | None = None


def parse_message(line: bytes) -> Started | ProgressMessage | Outcome:
    """Parse a line from a job's process; a line that is not a message counts as failure of the job."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        message = None
    match message:
        case {"pid": int() as pid}:
            return Started(pid)
        case {"progress": float() | int() as share, "message": str() as text} if -math.inf < share < math.inf:
            return ProgressMessage(float(min(max(share, 0), 1)), text)
        case {"result": dict() as result}:
            return Outcome("done", result=result)
        case {"error": str() as error}:
            return Outcome("failed", error)
    said = line.rstrip()[:QUOTED_BYTES].decode("utf-8", "replace")
    return Outcome("failed", f"its process sent {said!r}, which is not a message of a job; see the daemon's log")
