"""Metrics in Prometheus format, derived from the daemon's status.

Each family defines how its samples follow from the object that `rigcal status --json` prints. Nothing is counted here.
Names and units follow https://prometheus.io/docs/practices/naming/. Ages are given in place of timestamps where the
status measures them on the monotonic clock, which cannot be set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Status = Mapping[str, Any]
# Values of a family's labels, and the sample's value; None if there is no such sample at present.
Sample = tuple[tuple[str, ...], float | None]


@dataclass(frozen=True)
class Family:
    """A metric.

    Attributes:
        name: counters end in `_total`.
        kind: gauge or counter.
        help: description, one sentence.
        labels: names of its labels.
        samples: returns its samples, given a status.
    """

    name: str
    kind: Literal["gauge", "counter"]
    help: str
    labels: tuple[str, ...]
    samples: Callable[[Status], Iterable[Sample]]


def _links(key: str) -> Callable[[Status], Iterator[Sample]]:
    return lambda status: (((link["name"],), link[key]) for link in status["acquisition"]["links"])


def _channels(value: Callable[[Mapping[str, Any]], float | None]) -> Callable[[Status], Iterator[Sample]]:
    return lambda status: (((one["name"], one["link"]), value(one)) for one in status["acquisition"]["channels"])


def _stations(value: Callable[[Mapping[str, Any]], float | None]) -> Callable[[Status], Iterator[Sample]]:
    return lambda status: (((one["name"],), value(one)) for one in status["acquisition"]["stations"])


def _gap_counts(key: str) -> Callable[[Status], Iterator[Sample]]:
    return lambda status: (((g["channel"], g["reason"]), g[key]) for g in status["acquisition"]["gap_counts"])


def _one(value: Callable[[Status], float | None]) -> Callable[[Status], Iterable[Sample]]:
    return lambda status: [((), value(status))]


def _session(key: str) -> Callable[[Status], Iterable[Sample]]:
    return lambda status: [] if status["session"] is None else [((status["session"]["prism"],), status["session"][key])]


def _excluded(status: Status) -> Iterable[Sample]:
    return [((reason,), n) for reason, n in (status["session"] or {"excluded": {}})["excluded"].items()]


def _live_model(status: Status) -> Iterable[Sample]:
    live = (status["models"] or {}).get("live")
    return [] if live is None else [((str(live["id"]), live["stage"]), live["created_utc_ns"] / 1e9)]


def _candidate(status: Status) -> float:
    candidate = (status["models"] or {}).get("candidate")
    return 0.0 if candidate is None else float(candidate["is_acceptable"])


def _latency(key: str) -> Callable[[Status], Iterable[Sample]]:
    return lambda s: [((s["latency"]["session"],), s["latency"][key])] if s["latency"] else []


def _clock(status: Status) -> Mapping[str, Any]:
    return status["clock"] or {}


def _drift(status: Status) -> Mapping[str, Any]:
    return (status["gap"] or {}).get("drift") or {}


def _drift_sum(status: Status) -> float | None:
    drift = _drift(status)
    return drift["upper"] / drift["decision"] if drift else None


def _misclosures(status: Status) -> Iterator[Sample]:
    for shot in status["control_shots"]:
        if shot["misclosure_mm"] is not None:
            yield (shot["setup"], shot["point"]), shot["misclosure_mm"] / 1000.0


def _alarm_counts(status: Status) -> Iterator[Sample]:
    active = status["alarms"]["active"]
    for severity in ("warning", "critical"):
        yield (severity,), float(sum(alarm["severity"] == severity for alarm in active))


def _notices(key: str) -> Callable[[Status], Iterator[Sample]]:
    return lambda status: (((one["target"],), one[key]) for one in status["notices"])


def _is(flag: object) -> float | None:
    return None if flag is None else float(bool(flag))


FAMILIES: tuple[Family, ...] = (
    Family(
        "rigcal_build_info",
        "gauge",
        "Always 1; the labels show version, rig and mode.",
        ("version", "rig", "mode"),
        lambda s: [((s["version"], s["rig"], s["mode"]), 1.0)],
    ),
    # ---- links
    Family(
        "rigcal_link_up",
        "gauge",
        "1 while the link's port is open; absent until the link has reported its state.",
        ("link",),
        lambda s: (((link["name"],), _is(link["up"])) for link in s["acquisition"]["links"]),
    ),
    Family(
        "rigcal_link_captures_total",
        "counter",
        "Frames or reads of a link that were stored; its rate is `rate(rigcal_link_captures_total[1m])`.",
        ("link",),
        _links("captures"),
    ),
    Family(
        "rigcal_link_queue_length",
        "gauge",
        "Captures of a link that are waiting to be stored.",
        ("link",),
        _links("queued"),
    ),
    Family(
        "rigcal_link_queue_dropped_total",
        "counter",
        "Captures of a link that were lost because the queue to the store was full.",
        ("link",),
        _links("dropped"),
    ),
    Family(
        "rigcal_link_restarts_total",
        "counter",
        "How often the loop that reads a link failed and was restarted.",
        ("link",),
        _links("restarts"),
    ),
    Family(
        "rigcal_link_error_frames_total", "counter", "CAN error frames of a link.", ("link",), _links("error_frames")
    ),
    Family(
        "rigcal_can_frames_missed_total",
        "counter",
        "Missing CAN frames, detected by the counter in frames with this identifier.",
        ("link", "identifier"),
        lambda s: (((f["link"], f["identifier"]), f["missed"]) for f in s["acquisition"]["frames"]),
    ),
    # ---- gaps, losses, events
    Family(
        "rigcal_gap_open_seconds",
        "gauge",
        "Duration of a gap that is still open.",
        ("channel", "reason"),
        lambda s: (((g["channel"], g["reason"]), g["age_s"]) for g in s["acquisition"]["gaps"]),
    ),
    Family(
        "rigcal_gaps_total",
        "counter",
        "Periods without data from a channel, station or link, by reason.",
        ("channel", "reason"),
        _gap_counts("count"),
    ),
    Family(
        "rigcal_gap_missed_total",
        "counter",
        "Readings or frames missing in these gaps, as far as known. For a link and the reason frames_lost: all that "
        "the kernel, the adapter or a full queue dropped.",
        ("channel", "reason"),
        _gap_counts("missed"),
    ),
    Family(
        "rigcal_decode_failures_total",
        "counter",
        "Captures of a device that could not be decoded; the captures are kept.",
        ("device",),
        lambda s: (((device,), n) for device, n in s["acquisition"]["decode_failures"].items()),
    ),
    Family(
        "rigcal_device_events_total",
        "counter",
        "Events of devices and links, by kind.",
        ("device", "kind"),
        lambda s: (((e["device"], e["kind"]), e["count"]) for e in s["acquisition"]["event_counts"]),
    ),
    # ---- channels and stations
    Family(
        "rigcal_channel_ok",
        "gauge",
        "1 while a joint or signal has a fresh, good reading.",
        ("channel", "link"),
        _channels(lambda channel: float(channel["status"] == "ok")),
    ),
    Family(
        "rigcal_channel_last_reading_age_seconds",
        "gauge",
        "Time since the last reading of a joint or signal.",
        ("channel", "link"),
        _channels(lambda channel: channel["age_s"]),
    ),
    Family(
        "rigcal_station_locked",
        "gauge",
        "1 while a station is locked to a prism; absent while the station is silent or does not report its lock.",
        ("station",),
        _stations(lambda one: None if one["lock"] == "unknown" else float(one["lock"] == "locked")),
    ),
    Family(
        "rigcal_station_ok",
        "gauge",
        "1 while a station's last fix is fresh and good.",
        ("station",),
        _stations(lambda one: float(one["status"] == "ok")),
    ),
    Family(
        "rigcal_station_fixes_total", "counter", "Fixes of a station.", ("station",), _stations(lambda s: s["fixes"])
    ),
    Family(
        "rigcal_station_last_good_fix_age_seconds",
        "gauge",
        "Time since a station's last good fix.",
        ("station",),
        _stations(lambda one: one["good_age_s"]),
    ),
    Family(
        "rigcal_station_latency_seconds",
        "gauge",
        "Latency of the station's fixes relative to the joint readings in addition to link_delay_s, from the newest "
        "session that determined it.",
        ("session",),
        _latency("seconds"),
    ),
    Family(
        "rigcal_station_latency_error_seconds",
        "gauge",
        "Standard error of rigcal_station_latency_seconds.",
        ("session",),
        _latency("standard_error_s"),
    ),
    # ---- the store
    Family(
        "rigcal_writer_lag_seconds",
        "gauge",
        "Age of the oldest capture of a batch when it was stored, 99th percentile of the last minute.",
        (),
        _one(lambda s: s["acquisition"]["writer_lag_p99_s"]),
    ),
    Family(
        "rigcal_decoding_behind",
        "gauge",
        "1 while captures in the store are waiting to be decoded.",
        (),
        _one(lambda s: _is(s["acquisition"]["is_behind"])),
    ),
    Family(
        "rigcal_store_writable",
        "gauge",
        "0 while nothing can be written to the store.",
        (),
        _one(lambda s: float(s["acquisition"]["error"] is None)),
    ),
    Family(
        "rigcal_store_sound",
        "gauge",
        "0 if the store is damaged, replaced or missing.",
        (),
        _one(lambda s: float(s["store_health"]["state"] in ("ok", "checking"))),
    ),
    Family(
        "rigcal_store_free_bytes",
        "gauge",
        "Free space on the disk of the store.",
        (),
        _one(lambda s: s["store_health"]["free_bytes"]),
    ),
    # ---- the computer's clock
    Family(
        "rigcal_clock_synchronized",
        "gauge",
        "1 while a time service synchronises the computer's clock; absent if unknown.",
        (),
        _one(lambda s: _is(_clock(s).get("is_synchronized"))),
    ),
    Family(
        "rigcal_clock_offset_seconds",
        "gauge",
        "By how much the computer's clock is ahead of its time service's estimate.",
        (),
        _one(lambda s: _clock(s).get("offset_s")),
    ),
    Family(
        "rigcal_clock_max_error_seconds",
        "gauge",
        "Largest possible error of the computer's clock, as reported by its time service or the kernel.",
        (),
        _one(lambda s: _clock(s).get("max_error_s")),
    ),
    # ---- sessions, jobs, models
    Family(
        "rigcal_session_open",
        "gauge",
        "1 while a session is open.",
        (),
        _one(lambda s: float(s["session"] is not None)),
    ),
    Family(
        "rigcal_session_observations",
        "gauge",
        "Observations of the open session that calibration may use.",
        ("prism",),
        _session("observations"),
    ),
    Family("rigcal_session_poses", "gauge", "Poses of the open session.", ("prism",), _session("poses")),
    Family(
        "rigcal_session_excluded_observations",
        "gauge",
        "Observations of the open session that calibration must not use, by reason.",
        ("reason",),
        _excluded,
    ),
    Family(
        "rigcal_control_point_misclosure_meters",
        "gauge",
        "Distance of a control point's newest shot from its known position, for the current set-up.",
        ("setup", "point"),
        _misclosures,
    ),
    Family(
        "rigcal_jobs",
        "gauge",
        "Jobs in the store, by kind and state.",
        ("kind", "state"),
        lambda s: (((j["kind"], j["state"]), j["count"]) for j in s["job_counts"]),
    ),
    Family(
        "rigcal_model_created_timestamp_seconds",
        "gauge",
        "When the live model was made; its age is `time() - rigcal_model_created_timestamp_seconds`.",
        ("model", "stage"),
        _live_model,
    ),
    Family(
        "rigcal_model_candidate_acceptable",
        "gauge",
        "1 while a model is waiting for an operator to accept it.",
        (),
        _one(_candidate),
    ),
    Family(
        "rigcal_check_error_ratio",
        "gauge",
        "RMS error of the live model in the newest check session divided by its formal sigma; about 1 if all is well.",
        (),
        _one(lambda s: _drift(s).get("ratio")),
    ),
    Family(
        "rigcal_check_drift_ratio",
        "gauge",
        "Accumulated evidence that the machine has drifted from the live model, relative to the threshold for drift.",
        (),
        _one(_drift_sum),
    ),
    # ---- alarms
    Family("rigcal_alarms", "gauge", "Active alarms, by severity.", ("severity",), _alarm_counts),
    Family(
        "rigcal_alarm_active",
        "gauge",
        "1 for each active alarm; docs/reference/alarms.md lists the kinds.",
        ("kind", "subject", "severity"),
        lambda s: (((a["kind"], a["subject"], a["severity"]), 1.0) for a in s["alarms"]["active"]),
    ),
    Family(
        "rigcal_alarms_looked_age_seconds",
        "gauge",
        "Time since alarms were last evaluated; the daemon is blocked if this exceeds a few seconds.",
        (),
        _one(lambda s: s["alarms"]["looked_age_s"]),
    ),
    Family(
        "rigcal_notices_waiting",
        "gauge",
        "Notices of alarms that are not delivered yet, by target.",
        ("target",),
        _notices("waiting"),
    ),
    Family(
        "rigcal_notice_messages_total",
        "counter",
        "Messages with notices that were delivered.",
        ("target",),
        _notices("sent"),
    ),
    Family("rigcal_notice_failures_total", "counter", "Deliveries that failed.", ("target",), _notices("failures")),
)
