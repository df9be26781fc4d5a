"""The gain meter: a separate process that fits the measurements and predicts accuracy. `meter_link` starts it.

It reads questions from standard input, one JSON object per line, and writes the answers to standard output. It exits
when the input closes, because the daemon has then ended. The first line is a `Place`. A question is

    {"do": "assess", ..., "prisms": [NAME, ...], "next": [pose, ...]}
    {"do": "choose", ..., "count": 20, "seed": 3, "evenly": false}

each with the `sessions` to use, the session that is still open (`session`), `setup` and `prism`. A pose maps joint ->
number. An answer is {"result": {...}} or {"error": "one sentence"}. Only the daemon writes to the store.
"""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.design.gain import (
    FORECAST,
    LEAST_POSES,
    Measured,
    chosen_poses,
    from_rows,
    random_poses,
    reached,
    rms_mm,
    volume_share,
)
from calibration.errors import CalibrationError
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import parse_rig
from daemon.guide.meter_link import Place
from daemon.host.systemd import set_up_logging
from daemon.models.model_files import read_model_of_rig
from daemon.sessions.session_data import sessions_csv
from daemon.store.errors import StoreError
from daemon.store.files import FileIdentity
from daemon.store.reader import Reader
from daemon.warm_up import prepare

log = logging.getLogger(__name__)

MOST_FIXES = 20  # per standstill: with more, the joint readings' errors, common to all its fixes, dominate
_DIGITS = 3  # decimals of joint values in a pose


class Meter:
    """Answers questions about the measurements so far.

    Args:
        place: locations of the store and the live model.
    """

    def __init__(self, place: Place) -> None:
        self._place = place
        self._rig = parse_rig(place.rig_text, "the daemon's rig")
        self._kept: dict[str, Observations | None] = {}  # closed sessions
        self._lacking = self._known_to_lack()

    def _known_to_lack(self) -> float:
        """Return the scale of the joint errors that the live model leaves; the next model is assumed to leave them."""
        if self._place.live_model is None:
            return 0.0
        try:
            sha256 = str(self._place.live_sha256)
            return read_model_of_rig(Path(self._place.live_model), sha256, self._rig).joint_error_scale
        except (CalibrationError, OSError) as error:
            log.warning("the errors that the live model leaves are unknown: %s", error)
            return 0.0

    def answer(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Answer a question.

        Raises:
            CalibrationError, StoreError: there is no answer; the message gives the reason in one sentence.
        """
        rows = self._rows(question["sessions"], question["session"])
        try:
            measured = from_rows(self._rig, rows, question["setup"], lacking=self._lacking)
        except CalibrationError as error:
            if question["do"] != "choose":
                raise
            log.warning("poses are chosen from the rig file alone: %s", error)
            measured = from_rows(self._rig, None, question["setup"], lacking=self._lacking)
        if question["do"] == "choose":
            return self._chosen(measured, question)
        return self._assessed(measured, rows, question)

    def _chosen(self, measured: Measured, question: Mapping[str, Any]) -> dict[str, Any]:
        choose = random_poses if question["evenly"] else chosen_poses
        found = choose(measured, question["prism"], question["count"], question["seed"])
        return {"poses": [self._as_pose(readings) for readings in found]}

    def _assessed(self, measured: Measured, rows: Observations | None, question: Mapping[str, Any]) -> dict[str, Any]:
        prism, prisms = question["prism"], tuple(question["prisms"])
        found: dict[str, Any] = {
            "coverage": self._coverage(measured, rows, prism),
            "basis": self._basis(rows),
            "least_poses": math.ceil(len(measured.knowledge.chain) / 3),  # a calibration with fewer is refused
        }
        if not measured.is_placed:
            why = f"the station's place is known after {LEAST_POSES} poses; there is no estimate before"
            return (
                found
                | dict.fromkeys(("now_mm", "after_next_mm", "after_5_mm", "prism_mm", "prism_after_5_mm"))
                | {"why": why}
            )
        ahead = self._ahead(measured, prism, question["next"])
        now = measured.accuracy()
        after_next = measured.accuracy(measured.after(ahead[:1], prism))
        after_5 = measured.accuracy(measured.after(ahead, prism))
        return found | {
            "now_mm": rms_mm(now, prisms),
            "after_next_mm": rms_mm(after_next, prisms),
            "after_5_mm": rms_mm(after_5, prisms),
            "prism_mm": rms_mm(now, (prism,)),
            "prism_after_5_mm": rms_mm(after_5, (prism,)),
            "why": "",
        }

    def _ahead(self, measured: Measured, prism: str, planned: Sequence[Mapping[str, float]]) -> Floats:
        """Return the next five poses: the planned ones, then evenly drawn ones if fewer than five are planned."""
        ahead = np.array([[pose[name] for name in self._rig.joint_names] for pose in planned[:FORECAST]])
        ahead = ahead.reshape(-1, len(self._rig.joints))
        more = FORECAST - len(ahead)
        return np.concatenate([ahead, random_poses(measured, prism, more, 0)]) if more else ahead

    def _coverage(self, measured: Measured, rows: Observations | None, prism: str) -> dict[str, Any]:
        def of(some: Observations | None) -> dict[str, tuple[float, float]] | None:
            if some is None or len(some) == 0:
                return None
            return reached(self._rig, np.column_stack([some.joints[name] for name in self._rig.joint_names]))

        whole, own = of(rows), of(None if rows is None else rows.select(rows.prism == prism))
        joints = []
        for joint in self._rig.joints:
            low, high = (None, None) if whole is None else whole[joint.name]
            span = joint.limits[1] - joint.limits[0]
            share = 0.0 if low is None or high is None else min(1.0, (high - low) / span)
            about = {"name": joint.name, "unit": joint.unit, "low": joint.limits[0], "high": joint.limits[1]}
            joints.append(about | {"reached_low": low, "reached_high": high, "share": share})
        return {
            "joints": joints,
            "volume_share": 0.0 if whole is None else volume_share(measured.volume, whole),
            "prism_volume_share": 0.0 if own is None else volume_share(measured.volume, own),
        }

    def _basis(self, rows: Observations | None) -> str:
        if rows is None or len(rows) == 0:
            return "build tolerances alone: nothing is measured yet"
        sessions = sorted(set(rows.session.tolist()))
        text = f"build tolerances and {len(rows)} fixes of {len(sessions)} session{'s' if len(sessions) > 1 else ''}"
        if self._lacking:
            return f"{text}; a new model is assumed to leave the same errors as the live one"
        return f"{text}; errors that a geometric model cannot describe, such as droop, count only as scatter"

    # ---- rows --------------------------------------------------------------------------------------------------------

    def _rows(self, sessions: Sequence[str], still_open: str) -> Observations | None:
        """Return the observations of all given sessions; closed sessions are read once."""
        found = []
        with Reader(Path(self._place.store), self._identity()) as reader:
            for name in sessions:
                rows = self._kept[name] if name in self._kept else self._read(reader, name)
                if name != still_open:
                    self._kept[name] = rows
                if rows is not None:
                    found.append(rows)
        return joined(found) if found else None

    def _read(self, reader: Reader, session: str) -> Observations | None:
        data = sessions_csv(reader, self._rig, [session])
        if data.count(b"\n") < 2:  # only a header
            return None
        return thinned(parse_observations(data, self._rig, f"session {session}"))

    def _identity(self) -> FileIdentity | None:
        return None if self._place.store_file is None else FileIdentity(*self._place.store_file)

    def _as_pose(self, readings: Floats) -> dict[str, float]:
        return {name: round(float(readings[i]), _DIGITS) for i, name in enumerate(self._rig.joint_names)}


def thinned(rows: Observations) -> Observations:
    """Keep at most `MOST_FIXES` fixes of every standstill, spread evenly over it, so that the meter stays fast."""
    _, standstill = np.unique(rows.pose, return_inverse=True)
    kept = np.zeros(len(rows), dtype=bool)
    for number in range(standstill.max(initial=-1) + 1):
        at = np.flatnonzero(standstill == number)
        kept[at[np.unique(np.linspace(0, len(at) - 1, MOST_FIXES).round().astype(int))]] = True
    return rows.select(kept)


def joined(parts: Sequence[Observations]) -> Observations:
    """Concatenate the rows of several sessions, with the optional columns that all of them have."""
    columns = set.intersection(*(set(part.extra) for part in parts))

    def joined(name: str) -> Any:
        return np.concatenate([getattr(part, name) for part in parts])

    first = parts[0]
    return replace(
        first,
        joints={name: np.concatenate([part.joints[name] for part in parts]) for name in first.joints},
        extra={name: np.concatenate([part.extra[name] for part in parts]) for name in sorted(columns)},
        row_numbers=None,
        **{name: joined(name) for name in ("prism", "position_mm", "sigma_mm", "setup", "session", "pose")},
    )


def main() -> int:
    """Run the process; return exit status 0 once the daemon closes standard input."""
    line = sys.stdin.readline()
    if not line:
        return 0
    set_up_logging(is_prefixed=True)  # the daemon logs what it reads from standard error
    tell = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # a library that prints must not break the protocol
    meter = Meter(Place.from_line(line))
    for line in sys.stdin:
        began = time.monotonic()
        answer: dict[str, Any]
        try:
            answer = {"result": meter.answer(json.loads(line)) | {"seconds": round(time.monotonic() - began, 3)}}
        except (CalibrationError, StoreError) as error:
            answer = {"error": str(error)}
        except Exception as error:
            log.error("the gain meter failed", exc_info=error)
            answer = {"error": f"{type(error).__name__}: {error}; see the daemon's log for details"}
        tell.write(json.dumps(answer) + "\n")
        tell.flush()
    return 0


if __name__ == "__main__":
    prepare()
    sys.exit(main())
