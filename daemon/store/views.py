"""Views of the store for people and other programs: times as ISO text, joints as columns, units in names.

There is a column for each joint and signal in the store, so the views are created again when a rig has new channels.
Each view reads its table row by row and keeps the table's numbers, so that a query by session, id or instant
(`boot_id`, `monotonic_ns`) uses the table's own index.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sqlite_utils import Database

from daemon.store.places import between

_CHANNELS = "SELECT name, unit, kind FROM channels ORDER BY kind, id"
_DEG_PER_RAD = 57.29577951308232


@dataclass(frozen=True)
class Channel:
    """A joint or a signal of the store.

    Attributes:
        name: name of the channel.
        unit: unit of its values.
        is_joint: whether it is a joint; otherwise it is a signal.
    """

    name: str
    unit: str
    is_joint: bool

    @property
    def column(self) -> str:
        """Name of the channel's column of observations: `theta1_deg`, `boom_valve_mA`."""
        return f"{self.name}_{self.unit.replace('/', '_per_')}" if self.unit else self.name


@dataclass(frozen=True)
class View:
    """A view.

    Attributes:
        source: SQL after FROM.
        columns: name -> SQL of its value.
    """

    source: str
    columns: Mapping[str, str]

    @property
    def sql(self) -> str:
        """The SELECT statement of the view."""
        listed = ",\n    ".join(f"{sql} AS {_identifier(name)}" for name, sql in self.columns.items())
        return f"SELECT\n    {listed}\nFROM {self.source}"


def iso(column: str) -> str:
    """Return SQL that converts an instant in ns to ISO text with microseconds, in UTC."""
    return (
        f"strftime('%Y-%m-%dT%H:%M:%S', {column} / 1000000000, 'unixepoch') "
        f"|| printf('.%06dZ', {column} / 1000 % 1000000)"
    )


def in_session(table: str) -> str:
    """Return SQL of FROM and WHERE for the rows of `table`, as `row`, from a session's start to its end.

    The session's name is the parameter `:session`.
    """
    first, last = ((f"session.{end}_boot_id", f"session.{end}_monotonic_ns") for end in ("started", "ended"))
    return f"""FROM calibration_sessions AS session CROSS JOIN boots CROSS JOIN {table} AS row
WHERE session.id = :session AND {between("row.", first, last)}"""


def channels_of(db: Database) -> list[Channel]:
    """Return the channels in a store, joints first."""
    return [Channel(name, unit, kind == "joint") for name, unit, kind in db.execute(_CHANNELS).fetchall()]


def views(channels: Iterable[Channel]) -> dict[str, View]:
    """Return every view by its name.

    Args:
        channels: joints and signals with columns.
    """
    channels = list(channels)
    joints = [channel for channel in channels if channel.is_joint]
    return {
        "v_observations": View(
            "observations",
            {
                "id": "id",
                "session": "session_id",
                "setup": "setup_id",
                "prism": "prism",
                "pose": "pose",
                "time": iso("utc_ns"),
                **{f"{axis}_mm": f"{axis}_mm" for axis in "xyz"},
                **{f"sigma_{axis}_mm": f"sigma_{axis}_mm" for axis in "xyz"},
                **_values(channels),
                "dwell_s": "dwell_s",
                "moving": "moving",
                "excluded": "excluded",
                "fix_id": "fix_id",
            },
        ),
        "v_fixes": View(
            "fixes",
            {
                "id": "id",
                "station": "station",
                "time": iso("utc_ns"),
                "status": "status",
                "lock": "lock",
                "hz_angle_deg": f"hz_angle_rad * {_DEG_PER_RAD}",
                "zenith_angle_deg": f"zenith_angle_rad * {_DEG_PER_RAD}",
                "slope_distance_m": "slope_distance_m",
                "east_m": "east_m",
                "north_m": "north_m",
                "up_m": "up_m",
                "face": "face",
                "prism_constant_mm": "prism_constant_mm",
                "ppm": "ppm",
                "tilt_ok": "tilt_ok",
                "reason": "reason",
                "boot_id": "boot_id",
                "monotonic_ns": "monotonic_ns",
            },
        ),
        "v_joints": View(
            "joint_samples JOIN channels ON channels.id = channel_id",
            {
                "id": "joint_samples.id",
                "time": iso("utc_ns"),
                "joint": "channels.name",
                **{joint.column: _own_value(joint) for joint in joints},
                "status": "status",
                "boot_id": "boot_id",
                "monotonic_ns": "monotonic_ns",
            },
        ),
        "v_sessions": View(
            "calibration_sessions AS session",
            {
                "session": "id",
                "rig": "rig",
                "prism": "prism",
                "kind": "kind",
                "state": "state",
                "started": iso("started_utc_ns"),
                "ended": iso("ended_utc_ns"),
                "duration_s": "(ended_utc_ns - started_utc_ns) / 1e9",
                "setup": "setup_id",
                "operator": "operator",
                "observations": "(SELECT count(*) FROM observations WHERE session_id = session.id "
                "AND excluded IS NULL)",
                "excluded_observations": "(SELECT count(*) FROM observations WHERE session_id = session.id "
                "AND excluded IS NOT NULL)",
                "not_used": "excluded",
                "note": "note",
                "rig_sha256": "rig_sha256",
            },
        ),
        "v_jobs": View(
            "jobs",
            {
                "job": "id",
                "kind": "kind",
                "state": "state",
                "session": "through_session_id",
                "created": iso("created_utc_ns"),
                "started": iso("started_utc_ns"),
                "ended": iso("ended_utc_ns"),
                "duration_s": "(ended_utc_ns - started_utc_ns) / 1e9",
                "progress": "progress",
                "message": "message",
                "attempts": "attempts",
                "error": "error",
            },
        ),
        "v_models": View(
            "models AS model",
            {
                "model": "id",
                "rig": "rig",
                "stage": "stage",
                "state": "state",
                "created": iso("created_utc_ns"),
                "live_since": "(SELECT " + iso("utc_ns") + " FROM model_states WHERE model_id = model.id "
                "AND state = 'live' AND zeros_checked_through IS NULL ORDER BY id DESC LIMIT 1)",
                "training_rms_mm": "metrics_json ->> '$.training[#-1].rms_mm'",
                "noise_mm": "metrics_json ->> '$.noise_mm'",
                "job": "job_id",
                "path": "path",
                "rig_sha256": "rig_sha256",
            },
        ),
        "v_alarms": View(
            "alarms",
            {
                "alarm": "id",
                "kind": "kind",
                "subject": "subject",
                "severity": "severity",
                "raised": iso("raised_utc_ns"),
                "cleared": iso("cleared_utc_ns"),
                "duration_s": "(cleared_utc_ns - raised_utc_ns) / 1e9",
                "text": "text",
                "remedy": "remedy",
            },
        ),
    }


def drop_views(db: Database) -> None:
    """Drop the store's views, so that a migration can change their tables."""
    for name in db.view_names():
        if name in views(()):
            db[name].drop()


def make_views(db: Database) -> None:
    """Create the views of a store that are missing or do not match its channels."""
    for name, view in views(channels_of(db)).items():
        db.create_view(name, view.sql, replace=True)  # does nothing if the view is the same


def _values(channels: Iterable[Channel]) -> dict[str, str]:
    """Return the columns of an observation's values: each joint with its direction and rate, and the signals."""
    names: dict[str, None] = {}
    for channel in channels:
        names[channel.column] = None
        if channel.is_joint:
            names |= {f"{channel.name}_dir": None, f"{channel.name}_rate": None}
    return {name: f"values_json ->> {_text(name)}" for name in names}


def _own_value(joint: Channel) -> str:
    return f"CASE WHEN channels.name = {_text(joint.name)} AND channels.unit = {_text(joint.unit)} THEN value END"


def _identifier(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _text(name: str) -> str:
    return "'" + name.replace("'", "''") + "'"
