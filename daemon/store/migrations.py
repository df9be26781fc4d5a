"""The store's schema, as migrations that are applied in order and never changed once released.

Conventions: every table is STRICT. An instant is stored in three columns, `utc_ns`, `monotonic_ns` and `boot_id`
(-> boots), with a prefix where a row has several instants (`started_utc_ns`, ...). NULL means a bad or missing value; a
status or reason column shows which. Columns that end in `_json` contain JSON text.
"""

from __future__ import annotations

import hashlib

from sqlite_utils import Database, Migrations

MIGRATIONS = Migrations("rigcal")
_CALLER = ("caller_user TEXT", "caller_uid INTEGER", "caller_pid INTEGER")


def _instant(prefix: str = "", *, optional: bool = False) -> str:
    null = "" if optional else " NOT NULL"
    return (
        f"{prefix}utc_ns INTEGER{null}, {prefix}monotonic_ns INTEGER{null}, "
        f"{prefix}boot_id INTEGER{null} REFERENCES boots(id)"
    )


def _one_of(column: str, *allowed: str) -> str:
    return f"{column} TEXT NOT NULL CHECK ({column} IN ({', '.join(repr(value) for value in allowed)}))"


def _create(db: Database, *statements: str) -> None:
    for statement in statements:
        db.execute(statement)


def _add_columns(db: Database, table: str, prefix: str, *columns: str) -> None:
    _create(db, *(f"ALTER TABLE {table} ADD COLUMN {prefix}{column}" for column in columns))


@MIGRATIONS()
def m001_runs_and_raw_captures(db: Database) -> None:
    """Boots, runs of the daemon, links, and every captured byte."""
    _create(
        db,
        # One row per boot of a host. booted_utc_ns: UTC at which its monotonic clock was zero, by its first record.
        """CREATE TABLE boots (id INTEGER PRIMARY KEY, kernel_boot_id TEXT NOT NULL UNIQUE,
            booted_utc_ns INTEGER NOT NULL) STRICT""",
        # One row per run of the daemon. alive_: when it was last known to be alive; clean: it shut down cleanly.
        f"""CREATE TABLE daemon_runs (id INTEGER PRIMARY KEY, pid INTEGER NOT NULL, software_version TEXT NOT NULL,
            sqlite_version TEXT NOT NULL, {_instant("started_")}, {_instant("alive_")},
            {_instant("ended_", optional=True)}, clean INTEGER NOT NULL DEFAULT 0 CHECK (clean IN (0, 1))) STRICT""",
        f"""CREATE TABLE links (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE,
            {_one_of("kind", "can", "serial")}) STRICT""",
        # captures: number of captures; bytes: their payload before compression; chunk: see captures.py.
        f"""CREATE TABLE raw_chunks (id INTEGER PRIMARY KEY, link_id INTEGER NOT NULL REFERENCES links(id),
            {_instant("first_")}, {_instant("last_")}, captures INTEGER NOT NULL, bytes INTEGER NOT NULL,
            chunk BLOB NOT NULL) STRICT""",
        "CREATE INDEX raw_chunks_by_time ON raw_chunks(link_id, first_utc_ns)",
        # Chunks whose records are not stored yet. A separate table, because changing a flag in a row with a blob would
        # write the blob again.
        "CREATE TABLE undecoded_chunks (chunk_id INTEGER PRIMARY KEY REFERENCES raw_chunks(id)) STRICT",
    )


@MIGRATIONS()
def m002_records(db: Database) -> None:
    """The records that are decoded from captures."""
    sample = f"""(id INTEGER PRIMARY KEY, channel_id INTEGER NOT NULL REFERENCES channels(id), {_instant()},
        value REAL, status TEXT NOT NULL, raw_counts INTEGER, CHECK ((status = 'ok') = (value IS NOT NULL))) STRICT"""
    _create(
        db,
        # A channel whose unit changes becomes a new channel, so that stored values keep their unit.
        f"""CREATE TABLE channels (id INTEGER PRIMARY KEY, name TEXT NOT NULL, unit TEXT NOT NULL,
            {_one_of("kind", "joint", "signal")}, UNIQUE (name, unit, kind)) STRICT""",
        f"CREATE TABLE joint_samples {sample}",
        "CREATE INDEX joint_samples_by_time ON joint_samples(channel_id, utc_ns)",
        f"CREATE TABLE signals {sample}",
        "CREATE INDEX signals_by_time ON signals(channel_id, utc_ns)",
        f"""CREATE TABLE fixes (id INTEGER PRIMARY KEY, station TEXT NOT NULL, {_instant()}, {_instant("last_byte_")},
            status TEXT NOT NULL, lock TEXT NOT NULL, hz_angle_rad REAL, zenith_angle_rad REAL, slope_distance_m REAL,
            north_m REAL, east_m REAL, up_m REAL, face INTEGER, prism_constant_mm REAL, ppm REAL,
            tilt_ok INTEGER CHECK (tilt_ok IN (0, 1)), edm_level INTEGER, reason TEXT NOT NULL,
            raw BLOB NOT NULL) STRICT""",
        "CREATE INDEX fixes_by_time ON fixes(station, utc_ns)",
        "CREATE INDEX fixes_by_instant ON fixes(station, boot_id, monotonic_ns)",
        f"""CREATE TABLE device_events (id INTEGER PRIMARY KEY, device TEXT NOT NULL, {_instant()}, kind TEXT NOT NULL,
            text TEXT NOT NULL, code INTEGER) STRICT""",
        "CREATE INDEX device_events_by_time ON device_events(utc_ns)",
        # count: number of equal failures in a row, the first of them at this instant; excerpt: first bytes of the first
        # failure (raw_chunks contains all bytes).
        f"""CREATE TABLE decode_failures (id INTEGER PRIMARY KEY, device TEXT NOT NULL, {_instant()},
            reason TEXT NOT NULL, excerpt BLOB NOT NULL, count INTEGER NOT NULL) STRICT""",
        "CREATE INDEX decode_failures_by_time ON decode_failures(utc_ns)",
        # end_ is NULL while the gap lasts. The channel `daemon` stands for all channels: rigcal itself was not running.
        f"""CREATE TABLE gaps (id INTEGER PRIMARY KEY, channel TEXT NOT NULL, reason TEXT NOT NULL,
            {_instant("start_")}, {_instant("end_", optional=True)}, missed INTEGER,
            UNIQUE (channel, reason, start_boot_id, start_monotonic_ns)) STRICT""",
        "CREATE INDEX gaps_by_time ON gaps(start_utc_ns)",
        "CREATE INDEX gaps_open ON gaps(channel) WHERE end_utc_ns IS NULL",
    )


@MIGRATIONS()
def m003_sessions(db: Database) -> None:
    """Station set-ups, calibration sessions and their observations."""
    _create(
        db,
        # prism_constants_json: {prism: mm}.
        f"""CREATE TABLE station_setups (id TEXT PRIMARY KEY NOT NULL, instrument TEXT NOT NULL, serial TEXT NOT NULL,
            {_instant("created_")}, tilt_arcsec REAL, ppm REAL,
            prism_constants_json TEXT NOT NULL DEFAULT '{{}}' CHECK (json_valid(prism_constants_json)),
            note TEXT NOT NULL DEFAULT '', {_one_of("state", "ok", "moved", "closed")}) STRICT""",
        """CREATE TABLE control_points (setup_id TEXT NOT NULL REFERENCES station_setups(id), name TEXT NOT NULL,
            x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, PRIMARY KEY (setup_id, name)) STRICT""",
        f"""CREATE TABLE calibration_sessions (id TEXT PRIMARY KEY NOT NULL, rig TEXT NOT NULL,
            rig_sha256 TEXT NOT NULL, rig_text TEXT NOT NULL, setup_id TEXT REFERENCES station_setups(id),
            prism TEXT NOT NULL, operator TEXT NOT NULL,
            {_one_of("kind", "single_joint", "multi_joint", "static_poses", "check")},
            {_one_of("state", "open", "closed", "aborted")}, note TEXT NOT NULL DEFAULT '',
            {_instant("started_")}, {_instant("ended_", optional=True)}) STRICT""",
        "CREATE INDEX calibration_sessions_by_state ON calibration_sessions(state, started_utc_ns)",
        # Mean of the fixes to one control point; misclosure_mm: its distance from the point's known place.
        f"""CREATE TABLE control_shots (id INTEGER PRIMARY KEY, setup_id TEXT NOT NULL, name TEXT NOT NULL,
            session_id TEXT REFERENCES calibration_sessions(id), {_one_of("phase", "start", "end")}, {_instant()},
            x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL,
            fix_ids_json TEXT NOT NULL CHECK (json_valid(fix_ids_json)), misclosure_mm REAL,
            FOREIGN KEY (setup_id, name) REFERENCES control_points(setup_id, name)) STRICT""",
        "CREATE INDEX control_shots_by_session ON control_shots(session_id)",
        # utc_ns ..: instant at which the fix was measured, without the link delay. values_json: the row's numeric
        # columns of the observations CSV. excluded: why calibration must not use it, NULL if it may.
        f"""CREATE TABLE observations (id INTEGER PRIMARY KEY,
            session_id TEXT NOT NULL REFERENCES calibration_sessions(id), fix_id INTEGER REFERENCES fixes(id),
            setup_id TEXT REFERENCES station_setups(id), prism TEXT NOT NULL, pose TEXT, {_instant()},
            x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, sigma_x_mm REAL, sigma_y_mm REAL,
            sigma_z_mm REAL, dwell_s REAL, moving INTEGER NOT NULL CHECK (moving IN (0, 1)),
            values_json TEXT NOT NULL CHECK (json_valid(values_json)), excluded TEXT) STRICT""",
        "CREATE INDEX observations_by_session ON observations(session_id, utc_ns)",
    )


@MIGRATIONS()
def m004_jobs_and_models(db: Database) -> None:
    """Jobs caused by sessions, and the resulting models."""
    _create(
        db,
        f"""CREATE TABLE jobs (id INTEGER PRIMARY KEY, kind TEXT NOT NULL,
            session_id TEXT REFERENCES calibration_sessions(id),
            {_one_of("state", "queued", "running", "done", "failed", "cancelled", "interrupted")},
            depends_on INTEGER REFERENCES jobs(id), progress REAL NOT NULL DEFAULT 0, message TEXT NOT NULL DEFAULT '',
            {_instant("created_")}, {_instant("started_", optional=True)}, {_instant("ended_", optional=True)},
            time_limit_s REAL, pid INTEGER, attempts INTEGER NOT NULL DEFAULT 0,
            result_json TEXT CHECK (result_json IS NULL OR json_valid(result_json)), error TEXT) STRICT""",
        "CREATE INDEX jobs_by_state ON jobs(state, id)",
        "CREATE INDEX jobs_by_session ON jobs(session_id)",
        f"""CREATE TABLE models (id INTEGER PRIMARY KEY, rig TEXT NOT NULL, path TEXT NOT NULL,
            manifest_sha256 TEXT NOT NULL, stage TEXT NOT NULL, {_one_of("state", "candidate", "live", "retired")},
            job_id INTEGER REFERENCES jobs(id), {_instant("created_")},
            metrics_json TEXT NOT NULL DEFAULT '{{}}' CHECK (json_valid(metrics_json))) STRICT""",
        "CREATE UNIQUE INDEX models_one_live ON models(rig) WHERE state = 'live'",
        "CREATE INDEX models_by_rig ON models(rig, created_utc_ns)",
    )


@MIGRATIONS()
def m005_jobs_cover_sessions(db: Database) -> None:
    """Sessions that a job works on, by their order, because times of different boots cannot be compared."""
    _create(
        db,
        # The newest session that was closed when the job was queued; the job works on it and on all earlier ones.
        "ALTER TABLE jobs ADD COLUMN through_session_id TEXT REFERENCES calibration_sessions(id)",
        "UPDATE jobs SET through_session_id = session_id",
        "CREATE INDEX jobs_by_coverage ON jobs(through_session_id, kind)",
        "CREATE INDEX calibration_sessions_by_kind ON calibration_sessions(rig, state, kind)",
    )


@MIGRATIONS()
def m006_models_go_live(db: Database) -> None:
    """Who made which model live, and when; a comparison requested by an operator names its model."""
    _create(
        db,
        # Every change of a model's state. replaced_id: the model that was live before the one that went live.
        # zeros_checked_through: not a change; an operator confirms that the joints' zeros are those of the model's
        # training, despite all jumps up to that device event. NULL in a change.
        f"""CREATE TABLE model_states (id INTEGER PRIMARY KEY, model_id INTEGER NOT NULL REFERENCES models(id),
            {_one_of("state", "candidate", "live", "retired")}, {_instant()}, operator TEXT NOT NULL DEFAULT '',
            reason TEXT NOT NULL, replaced_id INTEGER REFERENCES models(id),
            zeros_checked_through INTEGER) STRICT""",
        "CREATE INDEX model_states_by_model ON model_states(model_id, id)",
        "CREATE INDEX device_events_of_jumps ON device_events(boot_id, monotonic_ns) WHERE kind = 'preset_jump'",
        """INSERT INTO model_states (model_id, state, utc_ns, monotonic_ns, boot_id, reason)
            SELECT id, state, created_utc_ns, created_monotonic_ns, created_boot_id, 'made' FROM models ORDER BY id""",
        "ALTER TABLE jobs ADD COLUMN model_id INTEGER REFERENCES models(id)",
    )


@MIGRATIONS()
def m007_checks_show_drift(db: Database) -> None:
    """Comparisons of check sessions with the live model, and the cumulative sums of errors after each."""
    _create(
        db,
        # Number of the rig's newest session when a model went live: later checks are counted. NULL in other changes,
        # and in changes from before this migration.
        "ALTER TABLE model_states ADD COLUMN after_session INTEGER",
        # live_since: the change by which the model went live; each such change resets the sums. ratio: RMS of the
        # errors over their predicted sigma, NULL if the session could not be used; reason states why. upper, lower: as
        # in calibration.numerics.statistics.
        f"""CREATE TABLE drift_checks (id INTEGER PRIMARY KEY, live_since INTEGER NOT NULL REFERENCES model_states(id),
            session_id TEXT NOT NULL REFERENCES calibration_sessions(id), {_instant()}, fixes INTEGER NOT NULL,
            standstills INTEGER NOT NULL, ratio REAL, reason TEXT NOT NULL DEFAULT '', upper REAL NOT NULL,
            lower REAL NOT NULL, {_one_of("alarm", "none", "worse", "better")},
            UNIQUE (live_since, session_id)) STRICT""",
        # Identification is now part of the gap workflow; jobs that have not run yet, or may be retried, run as that.
        "UPDATE jobs SET kind = 'gap' WHERE kind = 'identification'",
    )


@MIGRATIONS()
def m008_one_open_session(db: Database) -> None:
    """At most one session of a rig is open."""
    _create(
        db,
        # Several were left open if a session was started after the end of another could not be stored. The newest stays
        # open; fixes of newer sessions may be stored as observations of the others.
        """UPDATE calibration_sessions AS old SET state = 'aborted',
            note = ltrim(old.note || '; ', '; ') || 'aborted by rigcal: it was still open when session ' || newest.id
                || ' was started, and may hold fixes of that one',
            ended_utc_ns = newest.started_utc_ns, ended_monotonic_ns = newest.started_monotonic_ns,
            ended_boot_id = newest.started_boot_id
            FROM calibration_sessions AS newest
            WHERE old.state = 'open' AND newest.rig = old.rig AND old.rowid < newest.rowid AND newest.rowid =
                (SELECT max(rowid) FROM calibration_sessions WHERE state = 'open' AND rig = old.rig)""",
        "CREATE UNIQUE INDEX calibration_sessions_one_open ON calibration_sessions(rig) WHERE state = 'open'",
    )


@MIGRATIONS()
def m009_uncontrolled_sessions(db: Database) -> None:
    """Sessions that calibration must not use, until an operator accepts them."""
    # As for an observation: why calibration must not use it, NULL if it may. Decided when the session is closed.
    _add_columns(db, "calibration_sessions", "", "excluded TEXT")
    # An operator has accepted the session despite the reason in `excluded`; after_job: number of the newest job at that
    # time, which did not use the session.
    decision = ("by TEXT NOT NULL DEFAULT ''", *_instant(optional=True).split(", "), "after_job INTEGER")
    _add_columns(db, "calibration_sessions", "accepted_", "despite TEXT", *decision)
    _create(
        db,
        "DROP INDEX calibration_sessions_by_kind",
        "CREATE INDEX calibration_sessions_used ON calibration_sessions(rig, state, kind) WHERE excluded IS NULL",
        """CREATE INDEX calibration_sessions_accepted ON calibration_sessions(rig, kind, accepted_after_job)
            WHERE accepted_after_job IS NOT NULL""",
        # All columns that a session's summary needs of its observations, in order of measurement.
        "DROP INDEX observations_by_session",
        """CREATE INDEX observations_by_session
            ON observations(session_id, boot_id, monotonic_ns, utc_ns, excluded, pose)""",
    )


@MIGRATIONS()
def m010_prism_confirmations(db: Database) -> None:
    """Confirmations that a session's stations are on its prism: suspected fixes are used from then on."""
    _create(
        db,
        # turning: not confirmed by an operator; a program turned the station to the prism, and the station may have
        # measured its earlier target for a while.
        f"""CREATE TABLE prism_confirmations (id INTEGER PRIMARY KEY,
            session_id TEXT NOT NULL REFERENCES calibration_sessions(id), {_instant()},
            operator TEXT NOT NULL DEFAULT '', turning INTEGER NOT NULL CHECK (turning IN (0, 1))) STRICT""",
        "CREATE INDEX prism_confirmations_by_session ON prism_confirmations(session_id)",
    )


@MIGRATIONS()
def m011_store_health(db: Database) -> None:
    """Checks of the store itself, and interruptions of jobs by a shutdown of the computer."""
    _create(
        db,
        # result: `ok`, or a description of the damage; NULL while a check runs, and if it did not finish.
        f"""CREATE TABLE store_checks (id INTEGER PRIMARY KEY, {_instant("started_")},
            {_instant("ended_", optional=True)}, result TEXT) STRICT""",
        # host_boot: the kernel's boot in which the job was started, independent of the rig's clock (a simulated clock
        # has its own boots). interruptions: number of interruptions that do not count as attempts.
        "ALTER TABLE jobs ADD COLUMN host_boot TEXT",
        "ALTER TABLE jobs ADD COLUMN interruptions INTEGER NOT NULL DEFAULT 0",
    )


@MIGRATIONS()
def m012_comparisons_know_the_live_model(db: Database) -> None:
    """A comparison of a named model refers to the change by which the other model had gone live."""
    _create(
        db,
        "ALTER TABLE jobs ADD COLUMN live_since INTEGER REFERENCES model_states(id)",
        "CREATE INDEX jobs_by_model ON jobs(model_id, live_since) WHERE model_id IS NOT NULL",
    )


@MIGRATIONS()
def m013_alarms(db: Database) -> None:
    """Alarms: faults, since when, and what to do about them."""
    _create(
        db,
        # raised_: when the alarm was raised; cleared_ is NULL while it is active.
        f"""CREATE TABLE alarms (id INTEGER PRIMARY KEY, kind TEXT NOT NULL, subject TEXT NOT NULL,
            {_one_of("severity", "warning", "critical")}, text TEXT NOT NULL, remedy TEXT NOT NULL,
            {_instant("raised_")}, {_instant("cleared_", optional=True)}) STRICT""",
        "CREATE UNIQUE INDEX alarms_one_active ON alarms(kind, subject) WHERE cleared_utc_ns IS NULL",
    )


@MIGRATIONS()
def m014_who_said_so(db: Database) -> None:
    """The user whose process gave a command, as reported by the kernel, in addition to the operator it names."""
    # NULL if no command caused the row, and in rows from before this migration. caller_user: "" if the computer had no
    # name for caller_uid.
    _add_columns(db, "calibration_sessions", "", *_CALLER)
    _add_columns(db, "calibration_sessions", "accepted_", *_CALLER)
    _add_columns(db, "prism_confirmations", "", *_CALLER)
    _add_columns(db, "model_states", "", *_CALLER)


@MIGRATIONS()
def m015_large_chunks(db: Database) -> None:
    """An index of captures by time, and a list of the small chunks that can be packed into large ones."""
    _create(
        db,
        # Chunks as committed by acquisition. A separate table for the same reason as undecoded_chunks.
        "CREATE TABLE small_chunks (chunk_id INTEGER PRIMARY KEY REFERENCES raw_chunks(id)) STRICT",
        "INSERT INTO small_chunks SELECT id FROM raw_chunks",
        # All columns that a query by time needs before it reads a chunk.
        "DROP INDEX raw_chunks_by_time",
        """CREATE INDEX raw_chunks_by_end
            ON raw_chunks(last_boot_id, last_monotonic_ns, first_boot_id, first_monotonic_ns, link_id)""",
        # One index for queries by time: rows that may be deleted, and rows that are replaced by decoding again.
        "DROP INDEX joint_samples_by_time",
        "DROP INDEX signals_by_time",
        "DROP INDEX decode_failures_by_time",
        *(
            f"CREATE INDEX {table}_by_instant ON {table}(boot_id, monotonic_ns)"
            for table in ("joint_samples", "signals", "decode_failures")
        ),
        # Deleting a fix searches the observations, because of the foreign key.
        "CREATE INDEX observations_by_fix ON observations(fix_id) WHERE fix_id IS NOT NULL",
        "DROP INDEX fixes_by_time",  # no query uses these
        "DROP INDEX device_events_by_time",
        "DROP INDEX gaps_by_time",
    )


@MIGRATIONS()
def m020_notices(db: Database) -> None:
    """Notices of alarms to people elsewhere: sent and pending ones."""
    _create(
        db,
        # target: webhook or command. utc_ns ..: when the alarm was raised or cleared, or a test was requested; raised_:
        # when it was raised. sent_ is NULL until the notice is delivered, by itself or in a summary.
        f"""CREATE TABLE notices (id INTEGER PRIMARY KEY, target TEXT NOT NULL,
            {_one_of("event", "raised", "cleared", "test")}, kind TEXT NOT NULL, subject TEXT NOT NULL,
            {_one_of("severity", "warning", "critical")}, text TEXT NOT NULL, remedy TEXT NOT NULL,
            {_instant()}, {_instant("raised_")}, {_instant("sent_", optional=True)}) STRICT""",
        "CREATE INDEX notices_waiting ON notices(target, id) WHERE sent_utc_ns IS NULL",
        "CREATE INDEX notices_sent ON notices(target, sent_utc_ns) WHERE sent_utc_ns IS NOT NULL",
        "CREATE INDEX notices_by_alarm ON notices(target, kind, subject, id)",
    )


@MIGRATIONS()
def m024_guides(db: Database) -> None:
    """Guided sessions: the request of each guide, and all its events, from which its state is derived."""
    caller = ", ".join(_CALLER)
    _create(
        db,
        # taps: number of commands given to the guide.
        f"""CREATE TABLE guides (id INTEGER PRIMARY KEY, rig TEXT NOT NULL,
            {_one_of("state", "open", "finished", "abandoned")},
            setup_id TEXT NOT NULL REFERENCES station_setups(id),
            operator TEXT NOT NULL, request_json TEXT NOT NULL, taps INTEGER NOT NULL, {_instant("started_")},
            {_instant("ended_", optional=True)}, {caller}) STRICT""",
        "CREATE UNIQUE INDEX guides_one_open ON guides(rig) WHERE state = 'open'",
        # kind, details_json: see daemon/guide/job.py. caller_: NULL if the guide continued by itself.
        f"""CREATE TABLE guide_events (id INTEGER PRIMARY KEY, guide_id INTEGER NOT NULL REFERENCES guides(id),
            kind TEXT NOT NULL, details_json TEXT NOT NULL, {_instant()}, {caller}) STRICT""",
        "CREATE INDEX guide_events_by_guide ON guide_events(guide_id)",
    )


@MIGRATIONS()
def m028_session_clocks(db: Database) -> None:
    """State of the computer's clock at a session's start and end, as reported by its time service."""
    _create(
        db,
        # synchronized: NULL if unknown. offset_s: by how much the clock was ahead; NULL if unknown.
        f"""CREATE TABLE session_clocks (session_id TEXT NOT NULL REFERENCES calibration_sessions(id),
            {_one_of("phase", "start", "end")}, synchronized INTEGER CHECK (synchronized IN (0, 1)), offset_s REAL,
            max_error_s REAL, source TEXT NOT NULL, error TEXT NOT NULL,
            PRIMARY KEY (session_id, phase)) STRICT, WITHOUT ROWID""",
    )


@MIGRATIONS()
def m030_rig_files(db: Database) -> None:
    """Every rig file is stored once, under its hash; sessions and models refer to it."""
    _create(
        db,
        """CREATE TABLE rig_files (sha256 TEXT PRIMARY KEY NOT NULL, rig TEXT NOT NULL, text TEXT NOT NULL) STRICT""",
        "ALTER TABLE calibration_sessions ADD COLUMN rig_file TEXT REFERENCES rig_files(sha256)",
        # Rig file of the newest session that the model was trained on; NULL if its job's result names no session.
        "ALTER TABLE models ADD COLUMN rig_sha256 TEXT REFERENCES rig_files(sha256)",
    )
    # Computed from the stored text, because the stored hash was never checked.
    for rig, text in db.execute("SELECT rig, rig_text FROM calibration_sessions GROUP BY rig_text").fetchall():
        sha256 = hashlib.sha256(text.encode()).hexdigest()
        db.execute("INSERT INTO rig_files (sha256, rig, text) VALUES (?, ?, ?)", [sha256, rig, text])
        db.execute("UPDATE calibration_sessions SET rig_file = ? WHERE rig_text = ?", [sha256, text])
    _create(
        db,
        "ALTER TABLE calibration_sessions DROP COLUMN rig_text",
        "ALTER TABLE calibration_sessions DROP COLUMN rig_sha256",
        "ALTER TABLE calibration_sessions RENAME COLUMN rig_file TO rig_sha256",
        """UPDATE models SET rig_sha256 =
            (SELECT session.rig_sha256 FROM jobs, json_each(jobs.result_json, '$.sessions') AS of_job
                JOIN calibration_sessions AS session ON session.id = of_job.value
                WHERE jobs.id = models.job_id ORDER BY session.rowid DESC LIMIT 1)""",
    )


@MIGRATIONS()
def m031_states_of_devices(db: Database) -> None:
    """An index for the last event of each device, which is read at every start."""
    db.execute("CREATE INDEX device_events_of_states ON device_events(device, kind, boot_id, monotonic_ns)")


@MIGRATIONS()
def m032_rejected_sessions(db: Database) -> None:
    """Closed sessions that an operator has rejected, with an instant while that holds; observations before a shot."""
    decision = ("by TEXT NOT NULL DEFAULT ''", *_instant(optional=True).split(", "), *_CALLER)
    _add_columns(db, "calibration_sessions", "rejected_", "reason TEXT", *decision)
    _add_columns(db, "control_shots", "", "observations_through INTEGER")


def unknown_migrations(db: Database) -> list[str]:
    """Return the migrations in `db` that this program does not know; then a newer program made it."""
    empty = Database(memory=True)
    known = {migration.name for migration in MIGRATIONS.pending(empty)}
    empty.close()
    return sorted({migration.name for migration in MIGRATIONS.applied(db)} - known)


def pending_migrations(db: Database) -> list[str]:
    """Return the migrations that `db` does not have yet; then an older program made it."""
    return [migration.name for migration in MIGRATIONS.pending(db)]
