"""What every table, view and column of the store means, in words for people who read it with other tools.

An instant is three columns, `utc_ns`, `monotonic_ns` and `boot_id`, with a prefix where a row has several; `INSTANT`
describes them, and a table says in `instants` what happened at each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

INSTANT = {
    "utc_ns": "{}: ns since 1970 on the computer's clock, UTC, which may have been set wrongly",
    "monotonic_ns": "{}: ns on the monotonic clock of its boot",
    "boot_id": "{}: the boot of that clock",
}
CALLER = {
    "caller_user": "user whose process gave the command; empty where the computer knew no name",
    "caller_uid": "number of that user; NULL where no command caused the row",
    "caller_pid": "number of that process",
}


@dataclass(frozen=True)
class Words:
    """A table or a view in words.

    Attributes:
        title: its name for people.
        description: what a row is.
        columns: name -> meaning, but those of instants and the joints and signals of a view.
        instants: prefix of an instant's three columns -> what happened then; "" where they have no prefix.
        label: the column by which a row is named where other tables refer to it.
        has_channels: a view with columns of joints, and of signals where it is of observations.
    """

    title: str
    description: str
    columns: Mapping[str, str] = field(default_factory=dict)
    instants: Mapping[str, str] = field(default_factory=dict)
    label: str | None = None
    has_channels: bool = False

    def meanings(self) -> dict[str, str]:
        """Every column that is described -> its meaning."""
        of_instants = {
            f"{prefix}{name}": meaning.format(event)
            for prefix, event in self.instants.items()
            for name, meaning in INSTANT.items()
        }
        return {**self.columns, **of_instants}


_SAMPLE = {
    "id": "number of the reading",
    "channel_id": "the channel",
    "value": "the reading in the channel's unit; NULL where it may not be used",
    "status": "`ok`, or why the value may not be used: not_available, out_of_range, device_alarm, malformed, "
    "time_doubtful",
    "raw_counts": "what the device sent, before it was scaled",
}
_XYZ = {
    f"{axis}_mm": f"{name}, mm, in the station's frame"
    for axis, name in zip("xyz", ("east", "north", "up"), strict=True)
}
_SIGMA = {f"sigma_{axis}_mm": f"standard deviation of `{axis}_mm`" for axis in "xyz"}
_ALARM = {
    "kind": "kind of the alarm, as in docs/reference/alarms.md",
    "subject": "what it is about: a link, a joint, a session",
    "severity": "`warning` or `critical`",
    "text": "what is wrong",
    "remedy": "what to do about it",
}
_SESSION_STATE = "`open`, `closed`, or `aborted` as unusable"

TABLES: dict[str, Words] = {
    "boots": Words(
        "Boots",
        "One row for each start of the computer: its monotonic clock begins anew. Rows are in order of time.",
        {
            "id": "number of the boot; rises from boot to boot",
            "kernel_boot_id": "the kernel's own name of the boot",
            "booted_utc_ns": "UTC, ns, when the monotonic clock was zero, by the boot's first record",
        },
        label="kernel_boot_id",
    ),
    "daemon_runs": Words(
        "Runs of the daemon",
        "One row for each life of the daemon.",
        {
            "id": "number of the run",
            "pid": "number of its process",
            "software_version": "version of rigcal",
            "sqlite_version": "version of SQLite",
            "clean": "1 where it ended in order, 0 after a kill or a power cut",
        },
        {"started_": "start", "alive_": "last sign of life", "ended_": "end in order, NULL without one"},
    ),
    "links": Words(
        "Links",
        "One row for each CAN bus and serial line that was captured.",
        {"id": "number of the link", "name": "its name in the configuration", "kind": "`can` or `serial`"},
        label="name",
    ),
    "raw_chunks": Words(
        "Captured bytes",
        "One row for a run of captured frames or bytes of one link, compressed; `rigcal session export` writes them as "
        "logs.",
        {
            "id": "number of the chunk",
            "link_id": "the link",
            "captures": "how many frames, or pieces of serial data",
            "bytes": "sum of their data before compression",
            "chunk": "the captures: a packed binary form with a check sum",
        },
        {"first_": "the first capture", "last_": "the last capture"},
    ),
    "undecoded_chunks": Words(
        "Captures that wait to be decoded",
        "Chunks whose readings are not stored yet; empty while the daemon keeps up.",
        {"chunk_id": "the chunk"},
    ),
    "small_chunks": Words(
        "Captures that wait to be packed",
        "Chunks as they were committed; a minute later they are put together to larger ones.",
        {"chunk_id": "the chunk"},
    ),
    "channels": Words(
        "Channels",
        "One row for each joint and each signal, in each unit that its values were stored in.",
        {
            "id": "number of the channel",
            "name": "its name in the rig file",
            "unit": "of its values",
            "kind": "`joint` or `signal`",
        },
        label="name",
    ),
    "joint_samples": Words(
        "Joint readings",
        "One row for each reading of a joint: all within sessions, elsewhere one a second.",
        _SAMPLE,
        {"": "the reading"},
    ),
    "signals": Words(
        "Signal readings",
        "One row for each reading of a signal (valve currents, pressures, temperatures): all within sessions, "
        "elsewhere one a second.",
        _SAMPLE,
        {"": "the reading"},
    ),
    "fixes": Words(
        "Fixes",
        "One row for each answer of a total station, failed measurements too, as the instrument gave it.",
        {
            "id": "number of the fix",
            "station": "name of the station in the configuration",
            "status": "`ok`, or why it may not be used",
            "lock": "state of the tracking: standby, locked, searching, waiting, rotating, error, unknown",
            "hz_angle_rad": "horizontal angle, rad",
            "zenith_angle_rad": "zenith angle, rad",
            "slope_distance_m": "slope distance, m",
            "north_m": "north, m, where the instrument sends coordinates",
            "east_m": "east, m, likewise",
            "up_m": "up, m, likewise",
            "face": "face of the instrument, 1 or 2",
            "prism_constant_mm": "prism constant that the instrument applied, mm",
            "ppm": "atmospheric correction that it applied, ppm",
            "tilt_ok": "1 where its compensator was in range",
            "edm_level": "level of the returned light, in the instrument's own counts",
            "reason": "what was wrong; empty where nothing was",
            "raw": "the record as it was received",
        },
        {"": "the measurement", "last_byte_": "the last byte of the record"},
    ),
    "device_events": Words(
        "Events of devices",
        "One row for each event of a device or a link: boot-up, heartbeat lost, emergency, bus off, encoder jump.",
        {
            "id": "number of the event",
            "device": "name of the device, the joint or the link",
            "kind": "kind of the event",
            "text": "what happened",
            "code": "error code of the device, where it sent one",
        },
        {"": "the event"},
    ),
    "decode_failures": Words(
        "What could not be decoded",
        "Records that arrived and could not be decoded, alike ones in a row counted in one.",
        {
            "id": "number of the failure",
            "device": "device or link",
            "reason": "why",
            "excerpt": "the first bytes of the first of them",
            "count": "how many",
        },
        {"": "the first of them"},
    ),
    "gaps": Words(
        "Gaps",
        "One row for each stretch of time in which a channel gave nothing. The channel `daemon` stands for everything: "
        "rigcal itself did not run.",
        {
            "id": "number of the gap",
            "channel": "the channel, link or station",
            "reason": "silent, link_down, frames_lost, time_doubtful, lock_lost or not_running",
            "missed": "how many readings are missing, where it is known",
        },
        {"start_": "begin of the gap", "end_": "its end, NULL while it lasts"},
    ),
    "station_setups": Words(
        "Station set-ups",
        "One row for each place where a station stood.",
        {
            "id": "its name",
            "instrument": "the instrument",
            "serial": "its serial number",
            "tilt_arcsec": "tilt of the instrument as read, arc seconds",
            "ppm": "atmospheric correction, ppm",
            "prism_constants_json": "prism -> its constant, mm",
            "note": "remark of the operator",
            "state": "`ok`, `moved` where a control point did not close, `closed`",
        },
        {"created_": "description of the set-up"},
        label="id",
    ),
    "control_points": Words(
        "Control points",
        "One row for each control point of a set-up: a prism that does not move.",
        {"setup_id": "the set-up", "name": "name of the point", **_XYZ},
        label="name",
    ),
    "control_shots": Words(
        "Shots of control points",
        "One row for each time that a control point was measured: the mean of the fixes to it.",
        {
            "id": "number of the shot",
            "setup_id": "the set-up",
            "name": "name of the point",
            "session_id": "the session it was shot in",
            "phase": "`start` or `end` of the session",
            **_XYZ,
            "fix_ids_json": "numbers of the fixes",
            "misclosure_mm": "distance from the known place, mm; NULL in the shot that defines it",
        },
        {"": "the shot"},
    ),
    "rig_files": Words(
        "Rig files",
        "One row for each text of a rig file that a session was recorded with.",
        {"sha256": "SHA-256 of the text", "rig": "name of the rig", "text": "the file"},
        label="rig",
    ),
    "calibration_sessions": Words(
        "Calibration sessions",
        "One row for each session: from when to when an operator had a prism measured, and for what.",
        {
            "id": "its name",
            "rig": "name of the rig",
            "rig_sha256": "the rig file that it was recorded with",
            "setup_id": "the station set-up",
            "prism": "the prism that was measured",
            "operator": "who measured, as the command says",
            "kind": "single_joint, multi_joint, static_poses, or check, which is never trained on",
            "state": _SESSION_STATE,
            "note": "remark of the operator",
            "excluded": "why calibration must not use it; NULL where it may",
            "accepted_despite": "what `excluded` said when an operator accepted it",
            "accepted_by": "who accepted it",
            "accepted_after_job": "number of the newest job then, which did not know of it",
            **CALLER,
            **{f"accepted_{name}": f"of the acceptance: {meaning}" for name, meaning in CALLER.items()},
        },
        {"started_": "start", "ended_": "end, NULL while it is open", "accepted_": "acceptance by an operator"},
        label="id",
    ),
    "observations": Words(
        "Observations",
        "One row for each fix of a session with the joints at its own instant; `v_observations` has the joints as "
        "columns.",
        {
            "id": "number of the observation",
            "session_id": "the session",
            "fix_id": "the fix, where it is stored",
            "setup_id": "the station set-up",
            "prism": "the prism",
            "pose": "fixes of one standstill share it",
            **_XYZ,
            **_SIGMA,
            "dwell_s": "time since the last motion, s",
            "moving": "1 where the boom moved",
            "values_json": "joints and signals by their columns of the observations CSV",
            "excluded": "why calibration must not use it; NULL where it may",
        },
        {"": "the measurement, delay of the link taken off"},
    ),
    "prism_confirmations": Words(
        "Confirmations of the prism",
        "One row for each word that the stations of a session are on its prism, whatever it looked like.",
        {
            "id": "number of the confirmation",
            "session_id": "the session",
            "operator": "who said so",
            "turning": "1 where nobody said so but something turned the station to the prism",
            **CALLER,
        },
        {"": "the confirmation"},
    ),
    "jobs": Words(
        "Jobs",
        "One row for each piece of work that sessions cause: the gap workflow, residuals, reports, comparisons, drift.",
        {
            "id": "number of the job",
            "kind": "gap, residual, report, comparison or drift",
            "session_id": "the session that caused it",
            "state": "queued, running, done, failed, cancelled or interrupted",
            "depends_on": "the job that must be done before",
            "progress": "share that is done, 0 to 1",
            "message": "what is going on",
            "time_limit_s": "how long it may run, s",
            "pid": "number of its process",
            "attempts": "how often it was started",
            "result_json": "its result",
            "error": "why it failed",
            "through_session_id": "newest session that it works on, with all before it",
            "model_id": "model of a comparison that an operator asked for",
            "host_boot": "the kernel's boot in which it was started",
            "interruptions": "how often the end of the computer or of the daemon interrupted it",
            "live_since": "change by which the model that it compares with had gone live",
        },
        {"created_": "order", "started_": "start of the last attempt", "ended_": "end"},
    ),
    "models": Words(
        "Models",
        "One row for each calibrated model; the model itself is a directory.",
        {
            "id": "number of the model",
            "rig": "name of the rig",
            "path": "its directory",
            "manifest_sha256": "SHA-256 of its manifest when it was written",
            "stage": "geometric, effects or hybrid",
            "state": "candidate, live or retired",
            "job_id": "the job that made it",
            "metrics_json": "its errors on its training rows, and its comparison on check sessions",
            "rig_sha256": "rig file of the newest session that it was trained on",
        },
        {"created_": "making"},
    ),
    "model_states": Words(
        "Changes of models",
        "One row for each change of a model's state.",
        {
            "id": "number of the change",
            "model_id": "the model",
            "state": "what it became: candidate, live or retired",
            "operator": "who said so",
            "reason": "why",
            "replaced_id": "the model that was live before",
            "zeros_checked_through": "no change, but an operator's word that the zeros are right up to that event",
            "after_session": "number of the rig's newest session then; checks after it count",
            **CALLER,
        },
        {"": "the change"},
    ),
    "drift_checks": Words(
        "Drift of live models",
        "One row for each check session that was held against a live model.",
        {
            "id": "number of the check",
            "live_since": "change by which the model went live",
            "session_id": "the check session",
            "fixes": "number of its fixes",
            "standstills": "number of its standstills",
            "ratio": "RMS of the errors over their predicted standard deviation; NULL where the session was of no use",
            "reason": "why it was of no use",
            "upper": "cumulative sum against errors that grow",
            "lower": "cumulative sum against errors that shrink",
            "alarm": "`none`, `worse` or `better`",
        },
        {"": "the check"},
    ),
    "store_checks": Words(
        "Checks of the store",
        "One row for each time that the store was checked for damage.",
        {"id": "number of the check", "result": "`ok`, or what is damaged; NULL where it never came to its end"},
        {"started_": "start", "ended_": "end"},
    ),
    "alarms": Words(
        "Alarms",
        "One row for each fault that was told, from when to when.",
        {"id": "number of the alarm", **_ALARM},
        {"raised_": "when it was noticed", "cleared_": "when it was over, NULL while it is active"},
    ),
    "notices": Words(
        "Notices",
        "One row for each notice of an alarm to people elsewhere.",
        {
            "id": "number of the notice",
            "target": "the way out of the machine: webhook or command",
            "event": "`raised`, `cleared` or `test`",
            **_ALARM,
        },
        {"": "the event", "raised_": "the alarm", "sent_": "delivery, NULL before it"},
    ),
    "guides": Words(
        "Guides",
        "One row for each guided session: what was asked for, and how it ended.",
        {
            "id": "number of the guide",
            "rig": "name of the rig",
            "state": "`open`, `finished` or `abandoned`",
            "setup_id": "the station set-up",
            "operator": "who is led, as the command says",
            "request_json": "what was asked for: control points, prisms, plan, target",
            "taps": "number of commands that were given to it",
            **CALLER,
        },
        {"started_": "start", "ended_": "end, NULL while it is open"},
    ),
    "guide_events": Words(
        "Events of guides",
        "One row for each step of a guided session that was done, skipped or told; its state follows from these.",
        {
            "id": "number of the event",
            "guide_id": "the guide",
            "kind": "what happened",
            "details_json": "about it: the step, the pose, the reason",
            **CALLER,
        },
        {"": "the event"},
    ),
    "session_clocks": Words(
        "Clocks of sessions",
        "How the computer's clock was at a session's start and end, as its time service told.",
        {
            "session_id": "the session",
            "phase": "`start` or `end`",
            "synchronized": "1 where the clock was synchronised, 0 where it was not; NULL where nothing told",
            "offset_s": "by how much the clock was ahead, s; NULL where nothing told",
            "max_error_s": "greatest error that the time service allows for, s; NULL where nothing told",
            "source": "who told: chrony or the kernel",
            "error": "why nothing was told; empty otherwise",
        },
    ),
    "_sqlite_migrations": Words(
        "Migrations",
        "Changes of the tables that this store has gone through.",
        {
            "id": "number of the migration",
            "migration_set": "`rigcal`",
            "name": "its name",
            "applied_at": "when, UTC",
        },
    ),
}

_ORDER = {
    "boot_id": "boot of the computer; together with `monotonic_ns` the order of time, and indexed",
    "monotonic_ns": "ns on the monotonic clock of that boot",
}
_RIG_FILE = "SHA-256 of the rig file, in `rig_files`"

VIEWS: dict[str, Words] = {
    "v_observations": Words(
        "Observations, joints as columns",
        "The table that calibration reads: one row for each fix of a session with joints and signals at its instant.",
        {
            "id": "number of the observation",
            "session": "the session",
            "setup": "the station set-up",
            "prism": "the prism",
            "pose": "fixes of one standstill share it",
            "time": "ISO time of the measurement, UTC",
            **_XYZ,
            **_SIGMA,
            "dwell_s": "time since the last motion, s",
            "moving": "1 where the boom moved",
            "excluded": "why calibration must not use it; NULL where it may",
            "fix_id": "the fix in `v_fixes`",
        },
        has_channels=True,
    ),
    "v_fixes": Words(
        "Fixes, angles in degrees",
        "What the total stations sent, one row an answer, failed measurements too.",
        {
            "id": "number of the fix",
            "station": "name of the station",
            "time": "ISO time of the measurement, UTC",
            "status": "`ok`, or why it may not be used",
            "lock": "state of the tracking",
            "hz_angle_deg": "horizontal angle, degrees",
            "zenith_angle_deg": "zenith angle, degrees",
            "slope_distance_m": "slope distance, m",
            "east_m": "east, m, where the instrument sends coordinates",
            "north_m": "north, m, likewise",
            "up_m": "up, m, likewise",
            "face": "face of the instrument, 1 or 2",
            "prism_constant_mm": "prism constant that the instrument applied, mm",
            "ppm": "atmospheric correction that it applied, ppm",
            "tilt_ok": "1 where its compensator was in range",
            "reason": "what was wrong; empty where nothing was",
            **_ORDER,
        },
    ),
    "v_joints": Words(
        "Joint readings, joints as columns",
        "One row for each reading: the column of its joint has the value, the others are empty. All readings within "
        "sessions, elsewhere one a second.",
        {
            "id": "number of the reading",
            "time": "ISO time of the reading, UTC",
            "joint": "name of the joint",
            "status": "`ok`, or why the value may not be used",
            **_ORDER,
        },
        has_channels=True,
    ),
    "v_sessions": Words(
        "Sessions with their numbers of observations",
        "One row for each calibration session.",
        {
            "session": "its name",
            "rig": "name of the rig",
            "prism": "the prism that was measured",
            "kind": "single_joint, multi_joint, static_poses or check",
            "state": _SESSION_STATE,
            "started": "ISO time of its start, UTC",
            "ended": "ISO time of its end, UTC",
            "duration_s": "how long it took, s",
            "setup": "the station set-up",
            "operator": "who measured",
            "observations": "how many calibration may use",
            "excluded_observations": "how many it must not use",
            "not_used": "why calibration does not use the session; NULL where it does",
            "note": "remark of the operator",
            "rig_sha256": _RIG_FILE,
        },
    ),
    "v_jobs": Words(
        "Jobs with their times",
        "One row for each job.",
        {
            "job": "number of the job",
            "kind": "gap, residual, report, comparison or drift",
            "state": "queued, running, done, failed, cancelled or interrupted",
            "session": "newest session that it works on",
            "created": "ISO time of its order, UTC",
            "started": "ISO time of its start, UTC",
            "ended": "ISO time of its end, UTC",
            "duration_s": "how long it took, s",
            "progress": "share that is done, 0 to 1",
            "message": "what is going on",
            "attempts": "how often it was started",
            "error": "why it failed",
        },
    ),
    "v_models": Words(
        "Models with their errors",
        "One row for each calibrated model.",
        {
            "model": "number of the model",
            "rig": "name of the rig",
            "stage": "geometric, effects or hybrid",
            "state": "candidate, live or retired",
            "created": "ISO time of its making, UTC",
            "live_since": "ISO time when it last went live, UTC; NULL where it never did",
            "training_rms_mm": "RMS error of its last stage on its own training rows, mm",
            "noise_mm": "scatter of a fix, mm",
            "job": "the job that made it",
            "path": "its directory",
            "rig_sha256": _RIG_FILE,
        },
    ),
    "v_alarms": Words(
        "Alarms with their times",
        "One row for each fault that was told.",
        {
            "alarm": "number of the alarm",
            **_ALARM,
            "raised": "ISO time when it was noticed, UTC",
            "cleared": "ISO time when it was over, UTC; NULL while it is active",
            "duration_s": "how long it lasted, s",
        },
    ),
}


def channel_meaning(column: str, name: str, unit: str, *, is_joint: bool) -> str:
    """Return the meaning of a view's column that is of a joint or a signal."""
    if column == f"{name}_dir":
        return f"last direction of motion of joint {name}: -1, 0 or 1"
    if column == f"{name}_rate":
        return f"speed of joint {name}, {unit}/s"
    return f"{'joint' if is_joint else 'signal'} {name}{f', {unit}' if unit else ''}"
