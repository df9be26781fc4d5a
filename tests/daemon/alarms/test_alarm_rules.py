"""Every rule raises its alarm from evidence and clears it without; every kind is in docs/reference/alarms.md."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.acquisition.status.decode_failures import DecodeStatus
from daemon.acquisition.status.snapshot import (
    AcquisitionStatus,
    ChannelStatus,
    EventStatus,
    FrameStatus,
    GapCount,
    LinkStatus,
    StationStatus,
)
from daemon.alarms.alarm import Alarm
from daemon.alarms.evidence import Evidence
from daemon.alarms.library import library
from daemon.models.live_model import LiveModelHealth
from daemon.service import BEAT_S
from daemon.sessions.prisms.guard import Suspicion
from daemon.store.health import HealthState, StoreHealth
from daemon.store.queries.jobs import FailedJob
from daemon.store.queries.sessions import OpenSessionRow
from daemon.store.queries.setups import SetupRow
from daemon.store.upkeep.housekeeping import KeepingState
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import EventKind, Status
from drivers.stations.config import StationConfig
from drivers.stations.serial_port import SerialConfig

NOW = Stamp(1_790_000_000 * NS_PER_S, 5000 * NS_PER_S, "boot")
SESSION = OpenSessionRow("s001-r", NOW.shifted(-100 * NS_PER_S))
DOCS = Path(__file__).parents[3] / "docs" / "reference"


def link(up: bool | None = True, name: str = "boom", **more: Any) -> LinkStatus:
    return LinkStatus(name, up, **{"since_s": 1000.0, **more})


def channel(
    status: str = "ok", name: str = "theta1", kind: Any = "joint", last: str | None = "ok", age_s: float = 0.1
) -> ChannelStatus:
    value = 1.0 if status == "ok" else None
    return ChannelStatus(
        name, "deg", value, status, None if last is None else age_s, last, "boom", kind, status == "silent"
    )


def station(status: str = "ok", lock: str = "locked", good_age_s: float | None = 0.1, **more: Any) -> StationStatus:
    more = {"is_silent": status == "silent", **more}
    return StationStatus("station", status, lock, "", 0.1, 5, "ok", "locked", good_age_s, **more)


def event(
    kind: EventKind, device: str = "boom", number: int = 1, code: int | None = None, age_s: float = 5
) -> EventStatus:
    return EventStatus(device, kind.value, f"{device}: {kind.value}", code, NOW.utc_ns, age_s, number)


def known(
    *events: EventStatus,
    links: Sequence[LinkStatus] = (link(),),
    channels: Sequence[ChannelStatus] = (channel(),),
    stations: Sequence[StationStatus] = (station(),),
    decoding: Sequence[DecodeStatus] = (),
    frames_s: Sequence[float] = (0.1,),
    error: str | None = None,
    is_behind: bool = False,
    is_write_hung: bool = False,
    gap_counts: Sequence[GapCount] = (),
    **more: Any,
) -> Evidence:
    acquisition = AcquisitionStatus(
        links=[*links, link(name="station")] if not any(one.name == "station" for one in links) else [*links],
        channels=[*channels],
        stations=[*stations],
        last_events=[*events],
        decoding=[*decoding],
        frames=[FrameStatus("boom", f"{i:03X}", "", 5, None, age_s, None) for i, age_s in enumerate(frames_s)],
        error=error,
        is_behind=is_behind,
        is_write_hung=is_write_hung,
        gap_counts=[*gap_counts],
    )
    return Evidence(NOW, **{"running_s": 1000.0, "acquisition": acquisition, **more})


def opened(seconds_ago: int) -> OpenSessionRow:
    return replace(SESSION, started=NOW.shifted(-seconds_ago * NS_PER_S))


def store_health(
    state: HealthState = "ok",
    text: str = "",
    free_bytes: int | None = None,
    *,
    is_low: bool = False,
    log_fault: str = "",
) -> StoreHealth:
    return StoreHealth(state, text, NOW, free_bytes, is_low, log_fault)


def missing(lately: int, share: float) -> GapCount:
    return GapCount("theta1", "frames_lost", 40, 500, lately, share)


def failures(lately: int, share: float) -> DecodeStatus:
    return DecodeStatus("theta1", 500, "the frame has 3 bytes, the value needs 4", 400, lately, share)


SILENT = channel("silent", age_s=40)
QUIET = channel("silent", "boom_valve", "signal", age_s=40)
E = EventKind

# kind -> evidence that raises it and the subjects it names; evidence in which it is over.
CASES: dict[str, list[tuple[Evidence, list[str], Evidence]]] = {
    "link_down": [
        (known(links=[link(False, reason="unplugged")]), ["boom"], known()),
        (known(links=[link(None)]), ["boom"], known(links=[link(None)], running_s=2.0)),
    ],
    "simulated_rig_ended": [
        (known(links=[link(False)], has_simulation_ended=True), ["simulation"], known()),
    ],
    "link_restarted": [
        (known(links=[link(restarted_age_s=5)]), ["boom"], known(links=[link(restarted_age_s=301)])),
    ],
    "queue_full": [(known(links=[link(dropped_age_s=1)]), ["boom"], known(links=[link(dropped_age_s=6)]))],
    "time_doubtful": [(known(event(E.TIME_DOUBTFUL)), ["boom"], known(event(E.TIME_DOUBTFUL, age_s=301)))],
    "frames_lost": [(known(event(E.FRAMES_DROPPED)), ["boom"], known(event(E.FRAMES_DROPPED, age_s=301)))],
    "frames_missing": [
        (known(gap_counts=[missing(10, 0.02)]), ["theta1"], known(gap_counts=[missing(10, 0.005)])),
        (known(gap_counts=[missing(60, 1.0)]), ["theta1"], known(gap_counts=[missing(9, 1.0)])),
    ],
    "decode_failures": [
        (known(decoding=[failures(10, 0.02)]), ["theta1"], known(decoding=[failures(10, 0.005)])),
        (known(decoding=[failures(60, 0.9)]), ["theta1"], known(decoding=[failures(9, 0.9)])),
        # a station that measures on request, and is not silent without records: a record in 20 s, all malformed
        (known(decoding=[failures(3, 1.0)]), ["theta1"], known(decoding=[failures(2, 1.0)])),
    ],
    "decoder_defective": [
        (known(links=[link(decoder_failed_age_s=5)]), ["boom"], known(links=[link(decoder_failed_age_s=601)])),
    ],
    "bus_off": [
        (
            known(event(E.BUS_OFF, age_s=20), channels=[SILENT]),
            ["boom"],
            known(event(E.BUS_OFF, age_s=20), event(E.BUS_ERROR_ACTIVE, number=2), channels=[SILENT]),
        ),
        (
            known(event(E.BUS_OFF, age_s=20), channels=[SILENT]),
            ["boom"],
            known(event(E.BUS_OFF, age_s=20), channels=[channel()]),
        ),
    ],
    "bus_error_passive": [
        (
            known(event(E.BUS_ERROR_PASSIVE, number=3), event(E.BUS_ERROR_ACTIVE, number=2)),
            ["boom"],
            known(event(E.BUS_ERROR_PASSIVE), event(E.LINK_UP, number=2)),
        )
    ],
    "heartbeat_lost": [
        (
            known(event(E.HEARTBEAT_LOST, "theta1")),
            ["theta1"],
            known(event(E.HEARTBEAT_LOST, "theta1"), event(E.HEARTBEAT_RESTORED, "theta1", 2)),
        ),
        (
            known(event(E.HEARTBEAT_LOST, "theta1")),
            ["theta1"],
            known(event(E.HEARTBEAT_LOST, "theta1"), channels=[SILENT, channel(name="theta3")]),
        ),
    ],
    "duplicate_node": [
        (
            known(event(E.DUPLICATE_NODE, "theta1")),
            ["theta1"],
            known(event(E.DUPLICATE_NODE, "theta1"), event(E.DUPLICATE_NODE_GONE, "theta1", 2)),
        ),
        (
            known(event(E.DUPLICATE_NODE, "theta1")),
            ["theta1"],
            known(event(E.DUPLICATE_NODE, "theta1"), links=[link(False)]),
        ),
    ],
    "emergency": [
        (
            known(event(E.EMERGENCY, "theta1", code=0x5000)),
            ["theta1"],
            known(event(E.EMERGENCY, "theta1", code=0x5000), event(E.EMERGENCY_CLEARED, "theta1", 2)),
        )
    ],
    "device_alarm": [
        (known(event(E.ALARM, "theta1", code=1)), ["theta1"], known(event(E.ALARM, "theta1", code=0))),
        (
            known(event(E.ALARM, "theta1"), event(E.CONFIGURED, "theta1", 0)),
            ["theta1"],
            known(event(E.ALARM, "theta1"), event(E.CONFIGURED, "theta1", 2)),
        ),
        (  # a device that its set-up found wrong boots as the same device
            known(event(E.ALARM, "theta1"), event(E.BOOT_UP, "theta1", 2)),
            ["theta1"],
            known(event(E.ALARM, "theta1"), event(E.BOOT_UP, "theta1", 2), event(E.CONFIGURED, "theta1", 3)),
        ),
        (
            known(event(E.ALARM, "theta1", code=1), event(E.CONFIGURED, "theta1", 2)),
            ["theta1"],
            known(event(E.ALARM, "theta1", code=1), event(E.BOOT_UP, "theta1", 2)),
        ),
        (  # a set-up that failed and was repeated ends nothing that the device reports itself
            known(event(E.ALARM, "theta1", 1, code=1), event(E.ALARM, "theta1", 2), event(E.CONFIGURED, "theta1", 3)),
            ["theta1"],
            known(event(E.ALARM, "theta1", 2), event(E.CONFIGURED, "theta1", 3), event(E.ALARM, "theta1", 4, code=0)),
        ),
    ],
    "device_warning": [
        (  # what the device reports itself lasts, and is one alarm with what rigcal reports
            known(event(E.WARNING, "theta1", 1, code=16), event(E.WARNING, "theta1", 2)),
            ["theta1"],
            known(event(E.WARNING, "theta1", 1, code=0), event(E.BOOT_UP, "theta1", 2)),
        ),
        (known(event(E.WARNING, "theta1", code=16)), ["theta1"], known(event(E.WARNING, "theta1", code=0))),
        (
            known(event(E.WARNING, "station")),
            ["station"],
            known(event(E.WARNING, "station"), links=[link(), link(name="station", since_s=1.0)]),
        ),
    ],
    "link_silent": [
        (
            known(channels=[SILENT, QUIET], frames_s=[40.0, 41.0]),
            ["boom"],
            known(channels=[SILENT, QUIET], frames_s=[40.0], links=[link(since_s=2.0)]),
        ),
        (
            known(channels=[SILENT, channel(name="slow", age_s=40.0)], frames_s=[40.0]),
            ["boom"],
            known(channels=[SILENT, channel(name="theta3")]),
        ),
        (
            known(channels=[channel("silent", n, last=None) for n in "ab"], frames_s=[]),
            ["boom"],
            known(channels=[channel("silent", n, last=None) for n in "ab"]),
        ),
    ],
    "joint_silent": [
        (
            known(channels=[SILENT, channel(name="theta3")]),
            ["theta1"],
            known(channels=[replace(SILENT, is_silent=False), channel(name="theta3")]),  # its frames wait for the disk
        ),
        (
            known(channels=[SILENT, QUIET, channel(name="theta3"), channel("silent", "theta4", last=None)]),
            ["theta1", "theta4"],
            known(),
        ),
        (
            known(channels=[SILENT, channel(name="theta3")]),
            ["theta1"],
            known(channels=[channel("link_down"), channel("link_down", "theta3")], links=[link(False)]),
        ),
    ],
    "signal_silent": [
        (known(channels=[channel(), QUIET]), ["boom_valve"], known(channels=[SILENT, QUIET], frames_s=[40.0]))
    ],
    "joint_not_usable": [
        (
            known(channels=[channel(s, s) for s in Status if s != Status.OK]),
            [str(s) for s in Status if s != Status.OK],
            known(channels=[channel(s) for s in ("ok", "silent", "link_down", "starting")]),
        ),
        (
            known(event(E.ALARM, "theta1", code=0), channels=[channel("device_alarm")]),
            ["theta1"],
            known(event(E.ALARM, "theta1", code=1), channels=[channel("device_alarm")]),
        ),
        (
            known(event(E.DUPLICATE_NODE_GONE, "theta1"), channels=[channel("device_alarm")]),
            ["theta1"],
            known(event(E.DUPLICATE_NODE, "theta1"), channels=[channel("device_alarm")]),
        ),
    ],
    "signal_not_usable": [
        (known(channels=[channel("not_available", "boom_valve", "signal")]), ["boom_valve"], known()),
    ],
    "station_silent": [
        (
            known(stations=[station("silent", "unknown")]),
            ["station"],
            known(stations=[station("silent", "unknown", is_silent=False)]),  # its fixes wait to be decoded
        ),
    ],
    "station_not_locked": [
        (
            known(stations=[station("not_available", "searching")], session=SESSION),
            ["station"],
            known(stations=[station("not_available", "searching")]),
        ),
        (
            known(stations=[station("not_available", "waiting")], session=SESSION),
            ["station"],
            known(session=SESSION),
        ),
    ],
    "station_tilted": [
        (
            known(stations=[station("out_of_range", tilt_ok=False)]),
            ["station"],
            known(stations=[station(tilt_ok=True)]),
        ),
    ],
    "instrument_error": [
        (
            known(event(E.INSTRUMENT_ERROR, "station", age_s=60), stations=[station(good_age_s=70)]),
            ["station"],
            known(event(E.INSTRUMENT_ERROR, "station", age_s=60)),
        ),
        (
            known(event(E.INSTRUMENT_ERROR, "station", age_s=20)),
            ["station"],
            known(
                event(E.INSTRUMENT_ERROR, "station", age_s=20),
                stations=[station(good_age_s=None)],
                links=[link(), link(False, "station")],
            ),
        ),
    ],
    "prism_jump": [
        (
            known(session=SESSION, suspicions=[Suspicion("station", NOW, 9.5)]),
            ["station"],
            known(event(E.PRISM_JUMP, "station"), session=SESSION),
        )
    ],
    "other_prism_constant": [
        (
            known(
                session=SESSION, newest_excluded="the station applies a prism constant of 30 mm, but applied 0 mm at"
            ),
            ["s001-r"],
            known(session=SESSION, newest_excluded="moving"),
        ),
    ],
    "fixes_elsewhere": [
        (
            known(session=SESSION, newest_excluded="another prism or a reflection: more fixes lie 0.20 m away"),
            ["s001-r"],
            known(session=SESSION, newest_excluded="moving"),
        ),
        (
            known(session=SESSION, newest_excluded="another prism or a reflection: as many fixes lie 0.20 m away"),
            ["s001-r"],
            known(
                session=SESSION,
                newest_excluded="another prism or a reflection: as many fixes lie 0.20 m away",
                suspicions=[Suspicion("station", NOW, 9.5)],
            ),
        ),
    ],
    "prisms_not_compared": [(known(prisms_fault="no memory"), ["prisms"], known())],
    "decoding_behind": [(known(is_behind=True), ["decoding"], known())],
    "not_storing": [(known(error="disk full"), ["store"], known())],
    "store_hangs": [(known(is_write_hung=True), ["store"], known())],
    "store_unsound": [(known(store=store_health("missing", "the file is gone")), ["store"], known())],
    "store_new": [(known(is_store_new=True), ["store"], known())],
    "store_short_of_room": [
        (known(keeping=KeepingState(is_short=True)), ["store"], known(keeping=KeepingState())),
        (known(keeping=KeepingState(is_short=True, has_nothing_left=True)), ["store"], known()),
    ],
    "backup_overdue": [
        (
            known(keeping=KeepingState(has_backups=True, backup_error="no room")),
            ["backup"],
            known(keeping=KeepingState(has_backups=True)),
        ),
        (
            known(keeping=KeepingState(has_backups=True, newest_backup_utc_ns=NOW.utc_ns - 4 * 86_400 * NS_PER_S)),
            ["backup"],
            known(keeping=KeepingState(has_backups=True, newest_backup_utc_ns=NOW.utc_ns - 86_400 * NS_PER_S)),
        ),
    ],
    "store_log_grows": [
        (known(store=store_health(log_fault="process 7 (python3) reads")), ["store"], known(store=store_health())),
    ],
    "disk_nearly_full": [
        (known(store=store_health(is_low=True)), ["store"], known(store=store_health(free_bytes=10**10))),
        (known(store=store_health(free_bytes=10**8)), ["store"], known(store=store_health(free_bytes=10**9))),
    ],
    "setup_moved": [(known(setup=SetupRow("S2", "moved")), ["S2"], known(setup=SetupRow("S3", "ok")))],
    "session_without_fixes": [
        (
            known(session=opened(601), stations=[station(good_age_s=None)]),
            ["s001-r"],
            known(session=opened(601)),
        ),
        (
            known(session=opened(9000), stations=[station(good_age_s=601)]),
            ["s001-r"],
            known(session=opened(9000), stations=[station(good_age_s=None)], running_s=60.0),
        ),
    ],
    "session_open_long": [
        (known(session=opened(86_401)), ["s001-r"], known(session=opened(86_399))),
    ],
    "session_not_trained": [(known(untrained_sessions={"s001-r": "no control point was shot"}), ["s001-r"], known())],
    "zero_lost": [
        (
            known(model=LiveModelHealth(1, ("theta1",)), session=replace(SESSION, jumped=("theta1", "theta3"))),
            ["theta1", "theta3"],
            known(model=LiveModelHealth(1), session=SESSION),
        )
    ],
    "job_failed": [(known(failed_jobs=(FailedJob(7, "gap", "too poor"),)), ["7"], known())],
    "model_drifted": [
        (known(model=LiveModelHealth(2, drifted_with="s009-r")), ["model 2"], known(model=LiveModelHealth(3))),
    ],
    "model_of_rejected_session": [
        (known(model=LiveModelHealth(2, rejected="s001-r")), ["model 2"], known(model=LiveModelHealth(2))),
    ],
    "model_unusable": [
        (known(model=LiveModelHealth(2, defect="damaged")), ["model 2"], known(model=LiveModelHealth(2)))
    ],
    "model_not_loaded": [
        (known(model=LiveModelHealth(2, hindrance="no memory")), ["model 2"], known(model=LiveModelHealth(2)))
    ],
    "clock_stepped": [
        (known(event(E.CLOCK_STEP, "clock")), ["clock"], known(event(E.CLOCK_STEP, "clock", age_s=901))),
    ],
    "clock_behind": [
        (replace(known(), now=Stamp(0, 0, "boot")), ["clock"], known()),
        (known(previous_run=NOW.shifted(3600 * NS_PER_S)), ["clock"], known(previous_run=NOW.shifted(-NS_PER_S))),
    ],
    "control_dead": [(known(control_faults={"control.sock": "taken away"}), ["control.sock"], known())],
    "metrics_unserved": [(known(metrics_fault="the port is taken"), ["metrics"], known())],
    "notices_undelivered": [(known(notice_faults={"webhook": "no route"}), ["webhook"], known())],
    "clock_unsynchronized": [(known(clock_lost=NOW.shifted(-1000 * NS_PER_S)), ["clock"], known())],
    "gain_meter_hangs": [(known(meter_fault="it did not answer in time"), ["guide"], known())],
    "thread_ended": [(known(ended_threads={"tip": "a fault"}), ["tip"], known())],
    "not_watched": [(known(unwatched={"the jobs": "a fault"}), ["the jobs"], known())],
}


def raised(kind: str, evidence: Evidence) -> list[Alarm]:
    (rule,) = (rule for rule in library() if rule.kind == kind)
    return list(rule(evidence))


@pytest.mark.parametrize("kind", CASES)
def test_a_rule_raises_its_alarm_and_clears_it(kind: str) -> None:
    for wrong, subjects, right in CASES[kind]:
        alarms = raised(kind, wrong)
        assert [alarm.subject for alarm in alarms] == subjects
        assert all(alarm.text and alarm.remedy for alarm in alarms)
        assert raised(kind, right) == []


def test_every_rule_has_a_case_here() -> None:
    assert set(CASES) == {rule.kind for rule in library()}


def test_nothing_known_raises_nothing() -> None:
    assert [alarm for rule in library() for alarm in rule(Evidence(NOW))] == []
    assert [alarm for rule in library() for alarm in rule(known())] == []


def test_a_full_disk_does_not_send_anyone_to_the_cables_of_devices_that_are_not_decoded_meanwhile() -> None:
    def kinds(is_silent: bool) -> list[str]:
        waiting = known(
            channels=[replace(one, is_silent=is_silent) for one in (SILENT, QUIET)],
            frames_s=[40.0],
            stations=[station("silent", "unknown", is_silent=is_silent)],
            error="disk full",
        )
        return [a.kind for rule in library() for a in rule(waiting)]

    assert kinds(is_silent=False) == ["not_storing"]
    assert sorted(kinds(is_silent=True)) == ["link_silent", "not_storing", "station_silent"], (
        "silent before it was full"
    )


def test_a_checked_zero_is_not_called_invalid_while_the_open_session_stands_still_since_the_jump() -> None:
    stopped = known(model=LiveModelHealth(1), session=replace(SESSION, jumped=("theta3",)))
    (found,) = raised("zero_lost", stopped)
    assert found.text.endswith("the open session takes no more fixes")


def test_a_silent_station_is_one_alarm_although_it_did_not_answer_a_command() -> None:
    unanswered = event(E.INSTRUMENT_ERROR, "station")
    silent = known(unanswered, stations=[station("silent", "unknown", good_age_s=30)])
    assert [a.kind for rule in library() for a in rule(silent)] == ["station_silent"]


def test_a_silent_station_is_an_alarm_within_5_s_wherever_it_falls_silent_between_two_looks() -> None:
    (rule,) = (rule for rule in library() if rule.kind == "station_silent")
    looks = 1 + math.ceil(rule.after_s / BEAT_S)  # the first that finds it, and those until it has stood so long
    station = StationConfig(serial=SerialConfig(path="/dev/ttyUSB0"))
    assert station.silence_timeout_s + looks * BEAT_S <= 5.0


def test_an_unplugged_bus_is_one_alarm_and_so_is_a_bus_that_is_cut_beyond_the_adapter() -> None:
    names = [f"theta{n}" for n in range(1, 9)]
    events = [event(E.HEARTBEAT_LOST, name, n) for n, name in enumerate(names)]
    unplugged = known(*events, links=[link(False)], channels=[channel("link_down", name) for name in names])
    cut = known(*events, channels=[channel("silent", name, age_s=9) for name in names], frames_s=[9.0])
    for evidence, kind in ((unplugged, "link_down"), (cut, "link_silent")):
        assert [alarm.key for rule in library() for alarm in rule(evidence)] == [(kind, "boom")]


def test_a_station_that_is_away_between_sessions_is_a_warning_and_in_one_critical() -> None:
    cases: tuple[dict[str, Any], ...] = (
        {"stations": [station("silent", "unknown")]},
        {"links": [link(), link(False, "station")], "stations": [station("link_down", "unknown")]},
    )
    for wrong in cases:
        idle, busy = known(**wrong), known(**wrong, session=SESSION)
        assert [alarm.severity for rule in library() for alarm in rule(idle)] == ["warning"]
        assert [alarm.severity for rule in library() for alarm in rule(busy)] == ["critical"]


def test_what_an_instrument_says_comes_without_control_characters_and_bounded() -> None:
    loud = replace(event(E.INSTRUMENT_ERROR, "station"), text="\x1b[2J\ud800" + "x" * 10_000)
    (alarm,) = raised("instrument_error", known(loud))
    assert alarm.text.startswith(r"\x1b[2J\ud800xxx")
    assert len(alarm.text) == 300
    assert alarm.text.endswith("xxx…")
    (wordy,) = raised("link_down", known(links=[link(False, reason="refused " * 100)]))
    assert wordy.text.endswith("refused refused…")
    assert len(wordy.text) <= 300


def test_links_that_a_simulated_rig_has_left_behind_are_explained_by_its_end() -> None:
    ended = known(links=[link(False), link(False, name="station")], has_simulation_ended=True)
    (alarm,) = (alarm for rule in library() for alarm in rule(ended) if alarm.severity == "critical")
    assert alarm.kind == "simulated_rig_ended"
    assert "start it again with a new simulated rig: `rigcal run --sim`" in alarm.remedy


def test_every_kind_is_in_the_documentation_with_what_to_do() -> None:
    written = (DOCS / "alarms.md").read_text(encoding="utf-8")
    for rule in library():
        assert f"## {rule.kind}\n" in written
        assert rule.remedy in written
        assert rule.meaning in written
        assert len(rule.meaning) > 20


def test_an_alarm_says_its_subject_once_and_in_what_to_type() -> None:
    rules = {rule.kind: rule for rule in library()}
    (job,) = rules["job_failed"](known(failed_jobs=(FailedJob(7, "gap", "too poor"),)))
    assert "`rigcal jobs retry 7`" in job.remedy
    (lost,) = rules["frames_lost"](known(replace(event(E.FRAMES_DROPPED), text="boom: 3 frames lost")))
    assert (lost.subject, lost.text) == ("boom", "3 frames lost")


def test_no_remedy_recommends_a_command_that_is_refused_in_the_state_that_raises_the_alarm() -> None:
    (unusable,) = raised("model_unusable", known(model=LiveModelHealth(1, defect="damaged")))
    assert "`rigcal model rollback`" not in unusable.remedy, "it is refused where the live model has no predecessor"
    commands = ("model list", "model rollback NUMBER", "model compare NUMBER", "model accept NUMBER")
    assert all(f"`rigcal {command}`" in unusable.remedy for command in commands)
    (moved,) = raised("setup_moved", known(setup=SetupRow("S2", "moved"), session=SESSION))
    stops = [moved.remedy.index(f"`rigcal session {command}`") for command in ("guide --stop REASON", "stop")]
    assert max(stops) < moved.remedy.index("`rigcal setup new`"), "it is refused while a guide or session is open"
