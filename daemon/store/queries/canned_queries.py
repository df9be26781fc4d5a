"""Ready-made queries for people; each finds its rows by an index, however large the store is.

Parameters are written `:name`. A session's readings are found by its first and last instant on the monotonic clock,
which is in the indexes of the large tables; the wall clock may have been set in between.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from daemon.store.views import Channel, in_session, iso


@dataclass(frozen=True)
class Query:
    """A query with its description.

    Attributes:
        name: name in addresses.
        title: what the query shows.
        description: meaning of its rows and columns.
        sql: the query.
        parameters: names of its parameters.
    """

    name: str
    title: str
    description: str
    sql: str
    parameters: tuple[str, ...] = ()


def canned_queries(channels: Iterable[Channel]) -> tuple[Query, ...]:
    """Return the queries for a store.

    Args:
        channels: channels of the store; there is a column for each joint.
    """
    joints = [channel for channel in channels if channel.is_joint]
    return (
        Query(
            "sessions",
            "Sessions, newest first",
            "Every calibration session with its number of observations, used and excluded.",
            "SELECT * FROM v_sessions ORDER BY started DESC",
        ),
        Query(
            "observations_of_session",
            "Observations of a session",
            "The observations with their joints: those that calibration uses, and those that it does not use, with the "
            "reason.",
            "SELECT * FROM v_observations WHERE session = :session ORDER BY time",
            ("session",),
        ),
        Query(
            "exclusions_of_session",
            "Why fixes of a session are not used",
            "Number of excluded observations by reason.",
            """SELECT excluded AS reason, count(*) AS observations FROM observations
WHERE session_id = :session AND excluded IS NOT NULL GROUP BY excluded ORDER BY observations DESC""",
            ("session",),
        ),
        Query(
            "standstill_scatter",
            "Scatter of the fixes of each standstill",
            "Number of fixes at each pose of a session, their mean position, and their standard deviation about it.",
            """SELECT pose, prism, count(*) AS fixes, avg(x_mm) AS x_mm, avg(y_mm) AS y_mm, avg(z_mm) AS z_mm,
    sqrt(max(avg(x_mm * x_mm) - avg(x_mm) * avg(x_mm), 0)) AS std_x_mm,
    sqrt(max(avg(y_mm * y_mm) - avg(y_mm) * avg(y_mm), 0)) AS std_y_mm,
    sqrt(max(avg(z_mm * z_mm) - avg(z_mm) * avg(z_mm), 0)) AS std_z_mm
FROM observations WHERE session_id = :session AND excluded IS NULL AND pose IS NOT NULL
GROUP BY pose, prism ORDER BY min(id)""",
            ("session",),
        ),
        Query(
            "joints_of_session",
            "Joints in a session, second by second",
            "Mean reading of each joint in each second of a session that has ended.",
            f"""WITH means AS (SELECT boots.id AS boot_id, row.monotonic_ns / 1000000000 AS second, row.channel_id,
        min(row.utc_ns) AS utc_ns, avg(row.value) AS value
    {in_session("joint_samples")}
    GROUP BY boots.id, second, row.channel_id)
SELECT {iso("min(utc_ns)")} AS time{_joint_values(joints)}
FROM means JOIN channels ON channels.id = channel_id GROUP BY boot_id, second ORDER BY boot_id, second""",
            ("session",),
        ),
        Query(
            "fixes_of_session",
            "Fixes in a session",
            "All records of the stations from the start of a session to its end, including failed measurements.",
            f"""SELECT row.id AS fix, station, {iso("row.utc_ns")} AS time, row.status, lock,
    hz_angle_rad * 57.29577951308232 AS hz_angle_deg, zenith_angle_rad * 57.29577951308232 AS zenith_angle_deg,
    slope_distance_m, reason
{in_session("links CROSS JOIN fixes")} AND row.station = links.name
ORDER BY row.id""",
            ("session",),
        ),
        Query(
            "misclosures",
            "Misclosures of control points",
            "Every shot of a control point: how far it was from the place where the point was first measured.",
            f"""SELECT setup_id AS setup, name AS point, session_id AS session, phase, {iso("utc_ns")} AS time,
    misclosure_mm FROM control_shots ORDER BY id DESC""",
        ),
        Query(
            "newest_joints",
            "Newest reading of each joint",
            "The last reading of each joint, within ten seconds before the newest reading of any joint.",
            f"""WITH newest AS
    (SELECT boot_id, monotonic_ns FROM joint_samples ORDER BY boot_id DESC, monotonic_ns DESC LIMIT 1)
SELECT channels.name AS joint, channels.unit, {iso("max(row.utc_ns)")} AS time, row.value, row.status
FROM newest CROSS JOIN joint_samples AS row JOIN channels ON channels.id = row.channel_id
WHERE row.boot_id = newest.boot_id AND row.monotonic_ns >= newest.monotonic_ns - 10000000000
GROUP BY row.channel_id ORDER BY row.channel_id""",
        ),
        Query(
            "gaps_by_channel",
            "Gaps by channel and reason",
            "How often and for how long each channel gave no usable data, and why; an open gap is counted without its "
            "duration.",
            f"""SELECT channel, reason, count(*) AS gaps, sum(end_utc_ns - start_utc_ns) / 1e9 AS total_s,
    count(*) FILTER (WHERE end_utc_ns IS NULL) AS still_open, {iso("max(start_utc_ns)")} AS newest
FROM gaps GROUP BY channel, reason ORDER BY total_s DESC""",
        ),
        Query(
            "model_history",
            "Which model was live, since when, and who decided it",
            "Every change of a model's state.",
            f"""SELECT {iso("change.utc_ns")} AS time, change.model_id AS model, model.rig, model.stage, change.state,
    change.operator, change.caller_user AS user, change.reason, change.replaced_id AS replaced
FROM model_states AS change JOIN models AS model ON model.id = change.model_id ORDER BY change.id DESC""",
        ),
    )


def _joint_values(joints: Iterable[Channel]) -> str:
    return "".join(
        f""",
    max(CASE WHEN channels.name = '{_quoted(joint.name)}' AND channels.unit = '{_quoted(joint.unit)}'
        THEN value END) AS \"{joint.column.replace('"', '""')}\""""
        for joint in joints
    )


def _quoted(text: str) -> str:
    return text.replace("'", "''")
