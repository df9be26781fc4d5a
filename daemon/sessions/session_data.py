"""Contents of stored sessions and the time of their rows, for calibration, reports and export.

Observations are given as CSV (docs/reference/formats.md), so that a session is read exactly as an imported file.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from calibration.errors import DataError
from calibration.rig.description import Rig
from calibration.table import LABEL_COLUMNS, POSITION_COLUMNS, SIGMA_COLUMNS
from daemon.commands import HOW_TO_READ_AGAIN, OTHER_RIG_FILE
from daemon.report.calibration.inputs import ControlPoint, SetupLine
from daemon.report.words import not_used
from daemon.rig_files import misreading
from daemon.store.queries.observations import moving_observations, observations
from daemon.store.queries.sessions import all_sessions, session
from daemon.store.queries.setups import misclosures, setups_of
from daemon.store.queries.time_axis import time_axis
from daemon.store.reader import Reader
from drivers.clock import SIMULATED_BOOT

Misclosure = tuple[float, float, float]


def sessions_csv(reader: Reader, rig: Rig, session_ids: Sequence[str], *, moving: bool = False) -> bytes:
    """Return the observations of sessions that calibration may use, as CSV, oldest first.

    `time_s` counts from the store's first observation that calibration may use, on one axis for all sessions
    (`daemon.store.queries.time_axis`). It does not depend on the sessions requested, because a model may learn effects
    of time (a jump, a settling base) from some sessions and is applied to others.

    Args:
        reader: the store.
        rig: the machine.
        session_ids: the sessions.
        moving: return the observations of a moving boom instead.

    Raises:
        DataError: the readings of one of the sessions were converted from counts with a different rig file, so that
            they are not readings of `rig`.
    """
    for name in session_ids:
        row = session(reader, name)
        if row is not None and (why := misreading(rig, row["rig_text"], row["prism"])):
            raise DataError(f"session {name}", f"{OTHER_RIG_FILE}{why}; {HOW_TO_READ_AGAIN}")
    rows = (moving_observations if moving else observations)(reader, session_ids)
    values = [json.loads(row["values_json"]) for row in rows]
    joints = [joint.column for joint in rig.joints]
    more = sorted({name for row in values for name in row} - set(joints))
    axis = time_axis(reader)
    at_s = [axis.observed(reader.stamp(row)) for row in rows]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["prism", *joints, *POSITION_COLUMNS, *LABEL_COLUMNS, "time_s", *SIGMA_COLUMNS, "dwell_s", *more])
    for row, measured, seconds in zip(rows, values, at_s, strict=True):
        cells = [row["prism"], *(measured.get(name) for name in joints)]
        cells += [row[name] for name in POSITION_COLUMNS]
        cells += [row["setup_id"], row["session_id"], row["pose"], round(seconds, 6)]
        cells += [row[name] for name in SIGMA_COLUMNS] + [row["dwell_s"], *(measured.get(name) for name in more)]
        writer.writerow("" if cell is None else repr(cell) if isinstance(cell, float) else cell for cell in cells)
    return out.getvalue().encode()


def require_used(reader: Reader, session_ids: Collection[str]) -> None:
    """Raise DataError if calibration does not use one of the given sessions; its jobs use closed ones only.

    A session that is not used only because the rig file has changed since passes: its own rig file reads it, and
    `sessions_csv` refuses any other.

    Args:
        reader: the store.
        session_ids: the sessions; a check session is used, too.

    Raises:
        DataError: a session is open, was aborted, or is excluded and was not accepted by an operator.
    """
    for row in all_sessions(reader):
        name, why = row["id"], row["not_used"]
        if why is None or name not in session_ids:
            continue
        if row["state"] == "open":
            reason = f"{why}; stop it first: `rigcal session stop`"
        elif row["state"] == "aborted":
            reason = f"{why}, and calibration does not use aborted sessions; leave it out"
        elif why.startswith(OTHER_RIG_FILE):
            if "; " not in why:  # the only reason
                continue
            reason = f"{why}; {HOW_TO_READ_AGAIN}"
        else:
            reason = not_used(name, why)
        raise DataError(f"session {name}", reason)


@dataclass(frozen=True)
class Measured:
    """Operators, instruments and time of a set of sessions.

    Attributes:
        sessions, operators, instruments, setups: names, each once; an operator is the name given, or else the user
            name.
        measured_utc_ns: start of the first session and end of the last; None without any.
        is_simulated: True if a simulated rig was measured, in simulated time.
    """

    sessions: tuple[str, ...]
    operators: tuple[str, ...]
    instruments: tuple[str, ...]
    setups: tuple[str, ...]
    measured_utc_ns: tuple[int, int] | None
    is_simulated: bool


def sessions_measured(reader: Reader, session_ids: Sequence[str]) -> Measured:
    """Return operators, instruments and time of the given sessions."""
    rows = [row for name in session_ids if (row := session(reader, name)) is not None]
    instants = [row[key] for row in rows for key in ("started_utc_ns", "ended_utc_ns") if row[key] is not None]
    setups = setups_of(reader, session_ids)
    return Measured(
        tuple(row["id"] for row in rows),
        tuple(dict.fromkeys(name for row in rows if (name := row["operator"] or row["caller_user"]))),
        tuple(dict.fromkeys(" ".join(filter(None, (s["instrument"], s.get("serial")))) for s in setups)),
        tuple(setup["id"] for setup in setups),
        (min(instants), max(instants)) if instants else None,
        any(reader.stamp(row, "started_").boot_id.startswith(SIMULATED_BOOT) for row in rows),
    )


def setup_lines(reader: Reader, session_ids: Sequence[str]) -> list[SetupLine]:
    """Return the set-ups of the given sessions with the misclosures of their control points, for the report.

    A point shot in several sessions is shown with its shot at the first session's start and at the last session's end.
    """
    lines = []
    for setup in setups_of(reader, session_ids):
        shots = misclosures(reader, setup["id"], session_ids)
        first: dict[str, Misclosure] = {}
        last: dict[str, Misclosure] = {}
        for shot in shots:
            misclosure = (shot["x"], shot["y"], shot["z"])
            if shot["phase"] == "start":
                first.setdefault(shot["name"], misclosure)
            else:
                last[shot["name"]] = misclosure
        points = [ControlPoint(name, first.get(name), last.get(name)) for name in sorted({*first, *last})]
        lines.append(SetupLine(setup["id"], setup["instrument"], setup["state"] == "moved", points))
    return lines
