"""An exported session replays to the observations that were made live, whatever was lost or came late."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from calibration.rig.description import shipped_rig
from daemon.acquisition.acquisition import Acquisition
from daemon.cli.main import main
from daemon.composition import decoders, joiner, motion_limits
from daemon.config.config import read_config
from daemon.rig_files import load_rig
from daemon.service import declare_channels
from daemon.sessions.export.session_file import read_session_file
from daemon.sessions.manager import SessionManager
from daemon.sessions.station_setups import StationSetups
from daemon.store.reader import Reader
from daemon.store.store import Store
from drivers.clock import NS_PER_S, ManualClock, Stamp
from drivers.errors import DescriptionError
from drivers.readings import CanCapture, Capture, Fix, SerialCapture
from drivers.stall_detector import LATE_S
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.survey import position_mm
from simulators.devices.stations.total_station import StationSettings
from simulators.rig.truth import RigTruth
from simulators.rig_simulator import RigSimulator, SimulatorSettings
from tests.daemon.support.acquisition import ListLink, wait_until
from tests.golden.regenerate import CONFIG
from tests.simulated.captures import Step, generate
from tests.simulated.scripted_host import ScriptedHost

STATION = "link_delay_s = 0.02\n"
SECONDS = 28.0  # no longer than samples are kept for fixes that come late
MOVES_S = (7.0, 14.0, 21.0)
STOPS_S = ((7.5, 10.0), (14.5, 15.5), (25.0, 25.4))  # the first two while the boom drives
SESSION_S = (3.0, 26.0)
QUEUE = 60  # frames that wait at a port while nobody reads
HOUR_NS = 3600 * NS_PER_S


@pytest.fixture(scope="module")
def recorded() -> tuple[Capture, ...]:
    """What crossed both links of a rig that drives to four poses and stands at each."""
    settings = SimulatorSettings(
        bus_master="machine",
        sync_period_s=0.05,
        signal_period_s=0.1,
        station=StationSettings(profile="topcon_gts8", push_interval_s=0.25),
    )
    simulator = RigSimulator(RigTruth(shipped_rig("swdt82"), 7), 7, settings)
    poses: tuple[dict[str, float], ...] = (
        {"theta1": 40.0, "theta3": 60.0, "L2": 600.0},
        {"theta1": 10.0, "theta3": 110.0, "L2": 1500.0},
        {"theta4": 5.0, "theta5": 20.0, "L3": 900.0},
    )
    moves = [Step(at_s, pose=pose, speed=0.9) for at_s, pose in zip(MOVES_S, poses, strict=True)]
    return generate(simulator, ScriptedHost(), SECONDS, ManualClock(), plan=[Step(0.0, aim="r"), *moves]).captures


def seconds(capture: Capture, of: Sequence[Capture]) -> float:
    return capture.stamp.since(of[0].stamp) / NS_PER_S


def as_recorded(captures: Sequence[Capture]) -> list[Capture]:
    return list(captures)


def nobody_read(captures: Sequence[Capture]) -> list[Capture]:
    """The program was stopped: what the ports held came at once, and the rest is lost."""
    read: list[Capture] = []
    for capture in captures:
        stop = next((s for s in STOPS_S if s[0] <= seconds(capture, captures) < s[1]), None)
        if stop is None:
            read.append(capture)
        elif isinstance(capture, CanCapture):
            late = captures[0].stamp.shifted(round(stop[1] * NS_PER_S))
            if sum(c.stamp == late for c in read) < QUEUE:
                read.append(replace(capture, stamp=late))
    return sorted(read, key=lambda capture: capture.stamp.monotonic_ns)


def read_late_and_marked(captures: Sequence[Capture]) -> list[Capture]:
    """The program was stopped: what came meanwhile is read at once, and is marked with what follows soon after."""
    read: list[Capture] = []
    for capture in captures:
        at_s = seconds(capture, captures)
        stop = next((s for s in STOPS_S if s[0] <= at_s < s[1] + LATE_S), None)
        if stop is None or capture.is_transmitted:
            read.append(capture)
        else:
            wait_ns = max(0, round((stop[1] - at_s) * NS_PER_S))
            read.append(replace(capture, stamp=capture.stamp.shifted(wait_ns).doubted()))
    return sorted(read, key=lambda capture: capture.stamp.monotonic_ns)


def frames_were_lost(captures: Sequence[Capture]) -> list[Capture]:
    return [c for c in captures if not any(s[0] <= seconds(c, captures) < s[1] for s in STOPS_S)]


def clock_was_set(back_ns: int) -> Callable[[Sequence[Capture]], list[Capture]]:
    """The computer's clock was set in the middle of the session."""

    def happens(captures: Sequence[Capture]) -> list[Capture]:
        return [
            replace(c, stamp=Stamp(c.stamp.utc_ns - back_ns, c.stamp.monotonic_ns, c.stamp.boot_id))
            if seconds(c, captures) > SECONDS / 2
            else c
            for c in captures
        ]

    return happens


def live(
    directory: Path, captures: Sequence[Capture], *, station_first: bool, begin: Stamp | None = None, **setup: object
) -> list[dict[str, Any]]:
    """A session's observations as the daemon makes them, the links read one after the other."""
    begin = begin or captures[0].stamp
    (directory / "rigcal.toml").write_text(CONFIG.format(profile="passive", options=STATION), encoding="utf-8")
    config = read_config(directory / "rigcal.toml")
    source, clock = load_rig(config.rig), ManualClock(captures[0].stamp)
    with closing(Store(config.store_path)) as store:
        store.begin_run(clock.now())
        declare_channels(store, source.rig)
        setups = StationSetups(source.rig, store, clock, config.sessions.control_tolerance_mm)
        setups.new_command({"id": "S1", **setup})
        keeper = SessionManager(
            source.rig,
            source.text,
            store,
            setups,
            joiner(config, source.rig),
            config.sessions,
            clock,
            run_id=1,
            limits=motion_limits(config),
        )
        clock.set(begin.shifted(round(SESSION_S[0] * NS_PER_S)))
        keeper.start_command({"prism": "r", "id": "s1"})
        can = [c for c in captures if isinstance(c, CanCapture)]
        serial = [c for c in captures if isinstance(c, SerialCapture)]
        first = ListLink("station", serial) if station_first else ListLink("boom", can)
        last = ListLink("boom", can, first.done) if station_first else ListLink("station", serial, first.done)
        acquisition = Acquisition(
            [first, last],
            decoders(config, source),
            store,
            clock,
            batch_seconds=0.01,
            on_records=keeper.on_records,
            also_store=keeper.pending.store,
        )
        acquisition.start()
        wait_until(first.done.is_set)
        clock.set(begin.shifted(round(SESSION_S[1] * NS_PER_S)))
        keeper.stop_command({})
        wait_until(last.done.is_set)
        acquisition.stop()
        store.end_run(clock.now())
    return observations(config.store_path)


def replayed(directory: Path) -> list[dict[str, Any]]:
    """The observations that the exported session gives."""
    config, store = directory / "rigcal.toml", directory / "again.sqlite"
    exported = run("session", "export", "s1", "--config", config, "--out", directory / "out")["files"]
    logs = [name for name in exported if name.endswith((".log", ".serial"))]
    run("replay", *logs, "--session", directory / "out" / "s1.json", "--config", config, "--store", store)
    return observations(store)


def run(*arguments: object) -> dict[str, Any]:
    result = CliRunner().invoke(main, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


def observations(store: Path) -> list[dict[str, Any]]:
    with Reader(store) as reader:
        rows = list(reader.rows("SELECT x_mm, y_mm, z_mm, dwell_s, pose, excluded, values_json FROM observations"))
    return [
        {**row, "pose": row["pose"] and row["pose"].split(".")[1], "values_json": json.loads(row["values_json"])}
        for row in rows
    ]


def alike(live: dict[str, Any], again: dict[str, Any]) -> bool:
    """Whether two observations are the same, but for what a log rounds: instants to the microsecond."""
    exact = ("x_mm", "y_mm", "z_mm", "pose", "excluded")
    return all(live[key] == again[key] for key in exact) and numbers(again) == pytest.approx(
        numbers(live), rel=1e-4, abs=1e-3
    )


def numbers(row: dict[str, Any]) -> dict[str, float]:
    """What is known of the machine at an observation."""
    return row["values_json"] | ({} if row["dwell_s"] is None else {"dwell_s": row["dwell_s"]})


@pytest.mark.long
@pytest.mark.parametrize("station_first", [True, False])
@pytest.mark.parametrize(
    "happens",
    [
        as_recorded,
        nobody_read,
        read_late_and_marked,
        frames_were_lost,
        pytest.param(clock_was_set(HOUR_NS), id="clock_was_set_back"),
        pytest.param(clock_was_set(-HOUR_NS), id="clock_was_set_forward"),
    ],
)
def test_a_replay_gives_the_observations_that_were_made_live(
    tmp_path: Path,
    recorded: Sequence[Capture],
    happens: Callable[[Sequence[Capture]], list[Capture]],
    station_first: bool,
) -> None:
    made = live(tmp_path, happens(recorded), station_first=station_first)
    again = replayed(tmp_path)
    assert len(made) == len(again)
    assert [(a, b) for a, b in zip(made, again, strict=True) if not alike(a, b)] == []
    kept = [row for row in made if row["excluded"] is None]
    assert len({row["pose"] for row in kept}) == 1 + len(MOVES_S)
    assert len(kept) > 20


@pytest.fixture(scope="module")
def marked(recorded: Sequence[Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a session with captures of doubtful time was recorded, exported and replayed."""
    directory = tmp_path_factory.mktemp("marked")
    live(directory, read_late_and_marked(recorded), station_first=True)
    replayed(directory)
    return directory


def test_captures_of_doubtful_time_are_stored_and_used_for_nothing(marked: Path, recorded: Sequence[Capture]) -> None:
    with Reader(marked / "rigcal.sqlite") as reader:
        expected = sum(capture.stamp.is_doubtful for capture in read_late_and_marked(recorded))
        assert sum(capture.stamp.is_doubtful for capture in reader.captures()) == expected > 100
        joined = "SELECT fixes.status FROM observations JOIN fixes ON fixes.id = fix_id WHERE fixes.status != 'ok'"
        assert list(reader.rows(joined)) == []


def test_captures_of_doubtful_time_are_doubtful_again_in_a_replay(marked: Path) -> None:
    kept, again = (statuses(marked / name) for name in ("rigcal.sqlite", "again.sqlite"))
    assert kept == again
    assert kept["fixes", "time_doubtful"] > 10
    assert kept["joint_samples", "time_doubtful"] > 100
    told = read_session_file(marked / "out" / "s1.json")
    assert set(told.doubtful) == {"boom", "station"}
    assert len(told.doubtful["boom"].runs) == len(STOPS_S)


def test_what_a_device_said_before_the_logs_begin_holds_in_a_replay(
    tmp_path: Path, recorded: Sequence[Capture]
) -> None:
    emergency = CanCapture("boom", recorded[0].stamp, 0x080 + 32, bytes.fromhex("0050810000000000"))
    boots = {(0x700 + 32, bytes(1))}  # they would end it
    later = [
        replace(capture, stamp=capture.stamp.shifted(100 * NS_PER_S))
        for capture in recorded
        if not (isinstance(capture, CanCapture) and (capture.arbitration_id, capture.data) in boots)
    ]
    made = live(tmp_path, [emergency, *later], station_first=False, begin=later[0].stamp)
    again = replayed(tmp_path)
    kept, repeated = (statuses(tmp_path / name) for name in ("rigcal.sqlite", "again.sqlite"))
    assert kept == repeated
    assert kept["joint_samples", "device_alarm"] > 100
    assert [row["excluded"] for row in made] == [row["excluded"] for row in again]
    assert not any(row["excluded"] is None for row in made), "a joint is missing"


def test_a_log_that_is_not_the_session_s_is_refused_as_its_marks_would_be_misplaced(
    marked: Path, tmp_path: Path
) -> None:
    log, told, store = tmp_path / "s1-boom.log", marked / "out" / "s1.json", tmp_path / "again.sqlite"
    log.write_text("".join((marked / "out" / log.name).read_text().splitlines(keepends=True)[1:]))
    arguments = ["replay", log, "--session", told, "--config", marked / "rigcal.toml", "--store", store]
    result = CliRunner().invoke(main, [*map(str, arguments)])
    assert result.exit_code == 2
    assert "give the log exported with that file" in result.output.replace("\n", " ")
    assert not store.exists()


def statuses(store: Path) -> Counter[tuple[str, str]]:
    """Table and status -> how many rows of the session."""
    found: Counter[tuple[str, str]] = Counter()
    with Reader(store) as reader:
        for table in ("fixes", "joint_samples", "signals"):
            for row in reader.rows(f"SELECT status, count(*) AS n FROM {table} GROUP BY status"):
                found[table, row["status"]] = row["n"]
    return found


def test_a_replay_knows_the_control_points(tmp_path: Path, recorded: Sequence[Capture]) -> None:
    decoder = StationDecoder(StationConfig.model_validate({"profile": "passive", "serial": {"path": "/dev/station"}}))
    fixes = [record for capture in recorded for record in decoder.feed(capture) if isinstance(record, Fix)]
    place = next(place for fix in fixes if (place := position_mm(fix)) is not None)
    made = live(tmp_path, recorded, station_first=True, control_points={"cp1": list(place)})
    again = replayed(tmp_path)
    assert "doubtful" not in json.loads((tmp_path / "out" / "s1.json").read_bytes())  # files are as ever without doubts
    assert [row["excluded"] for row in made] == [row["excluded"] for row in again]
    assert sum(row["excluded"] == "a control point, not the prism" for row in made) > 10


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (None, "cannot be read"),
        ("[]", "is not the file of an exported session"),
        ('{"prism": "r", "kind": "check", "since_utc_ns": 0, "until_utc_ns": 1}', "control_points: Field required"),
    ],
)
def test_a_session_file_that_is_none_is_refused_in_a_sentence(tmp_path: Path, text: str | None, reason: str) -> None:
    told = tmp_path / "told.json"
    if text is not None:
        told.write_text(text, encoding="utf-8")
    with pytest.raises(DescriptionError, match=reason):
        read_session_file(told)
