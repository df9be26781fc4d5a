"""Meanings of the store's views: a column taken from a table has the table's description, others have their own."""

from __future__ import annotations

from collections.abc import Mapping

from daemon.store.describe.table_words import TABLES
from daemon.store.describe.words import Words
from daemon.store.views import iso, views

_ORDER = {
    "boot_id": "boot of the computer; with `monotonic_ns` it gives the order of time, and both are indexed",
    "monotonic_ns": "ns on the monotonic clock of that boot",
}
_DURATION = {"duration_s": "duration, s"}


def _words(view: str, title: str, description: str, own: Mapping[str, str], *, has_channels: bool = False) -> Words:
    """Return the description of a view.

    Args:
        view: name of the view.
        title: as in `Words`.
        description: as in `Words`.
        own: meanings of columns that are not taken from a table, or that differ in the view.
        has_channels: as in `Words`.
    """
    found = views(())[view]
    table = found.source.split()[0]
    known = TABLES[table].meanings()
    known |= {iso(f"{prefix}utc_ns"): f"ISO time, UTC: {event}" for prefix, event in TABLES[table].instants.items()}
    plain = {name: sql.removeprefix(f"{table}.") for name, sql in found.columns.items()}
    columns = {name: known[sql] for name, sql in plain.items() if sql in known}
    return Words(title, description, columns | dict(own), has_channels=has_channels)


VIEWS: dict[str, Words] = {
    "v_observations": _words(
        "v_observations",
        "Observations, joints as columns",
        "The table that calibration reads: one row for each fix of a session with joints and signals at its instant.",
        {"fix_id": "the fix in `v_fixes`"},
        has_channels=True,
    ),
    "v_fixes": _words(
        "v_fixes",
        "Fixes, angles in degrees",
        "One row for each record of a total station, including failed measurements.",
        {"hz_angle_deg": "horizontal angle, degrees", "zenith_angle_deg": "zenith angle, degrees", **_ORDER},
    ),
    "v_joints": _words(
        "v_joints",
        "Joint readings, joints as columns",
        "One row for each reading: the column of its joint has the value, the others are empty. All readings within "
        "sessions, one per second otherwise.",
        {"joint": "name of the joint", **_ORDER},
        has_channels=True,
    ),
    "v_sessions": _words(
        "v_sessions",
        "Sessions with the numbers of their observations",
        "One row for each calibration session.",
        {
            "observations": "number of observations that calibration may use",
            "excluded_observations": "number of observations that it must not use",
            **_DURATION,
        },
    ),
    "v_jobs": _words("v_jobs", "Jobs with their times", "One row for each job.", _DURATION),
    "v_models": _words(
        "v_models",
        "Models with their errors",
        "One row for each calibrated model.",
        {
            "live_since": "ISO time, UTC: when it last went live, NULL if it never did",
            "training_rms_mm": "RMS error of its last stage on its own training rows, mm",
            "noise_mm": "scatter of a fix, mm",
        },
    ),
    "v_alarms": _words(
        "v_alarms",
        "Alarms with their times",
        "One row for each alarm.",
        {"duration_s": "how long it lasted, s"},
    ),
}


def channel_meaning(column: str, name: str, unit: str, *, is_joint: bool) -> str:
    """Return the meaning of a view's column of a joint or a signal.

    Args:
        column: name of the column.
        name: name of the channel.
        unit: unit of the channel.
        is_joint: whether the channel is a joint.
    """
    if column == f"{name}_dir":
        return f"last direction of motion of joint {name}, -1 or 1; NULL until it is seen to move"
    if column == f"{name}_rate":
        return f"speed of joint {name}, {unit}/s"
    return f"{'joint' if is_joint else 'signal'} {name}{f', {unit}' if unit else ''}"
