"""The whole daemon, as a process, on simulated devices that speak real CANopen and serial protocols."""

import json
import math
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.store.reader import Reader
from drivers.readings import CanCapture
from tests.commands import run_apart
from tests.daemon.support.daemon_process import DaemonProcess

SIM = ("--sim", "--rate", "25", "--seed", "3", "--dwell", "2.5")


SENDS_THE_TIP = """channel = "can0"
allow_transmit = true

[tip]
prism = "r"
can = { link = "boom", arbitration_id = 0x680 }
"""


def record(daemon: DaemonProcess, prism: str, kind: str, poses: int) -> dict[str, Any]:
    name = daemon.say("session.start", prism=prism, kind=kind, operator="Ada")["id"]
    daemon.say("session.shoot", point="cp1")
    early = daemon.say("session.show", id=name)["poses"]  # before the shot; a busy computer was slow to say it
    daemon.wait(f"{poses} poses", lambda: daemon.say("session.show", id=name)["poses"] >= early + poses)
    daemon.say("session.shoot", point="cp1")
    return dict(daemon.say("session.stop"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaemonProcess]:
    """A daemon that has recorded sessions on two prisms and a check, and whose jobs have ended."""
    daemon = DaemonProcess(tmp_path_factory.mktemp("rig"), *SIM, bus=SENDS_THE_TIP)
    try:
        daemon.wait("a fix", daemon.has_fix)
        daemon.say("setup.new", id="S1", instrument="simulated GTS-800A", tilt_arcsec=2.0)
        for prism in ("r", "s"):
            record(daemon, prism, "static_poses", 12)
        record(daemon, "r", "check", 3)
        daemon.wait("the jobs", lambda: _ended(daemon.say("jobs.list")))
        yield daemon
    finally:
        assert daemon.stop() == 0, daemon.log_text()


def _ended(jobs: list[dict[str, Any]]) -> bool:
    return any(j["kind"] == "report" for j in jobs) and all(j["state"] not in {"queued", "running"} for j in jobs)


@pytest.mark.long
def test_closed_sessions_become_a_model_and_a_report(finished: DaemonProcess) -> None:
    jobs = {job["kind"]: job for job in finished.say("jobs.list")}
    assert [jobs[kind]["state"] for kind in ("gap", "residual", "report")] == ["done"] * 3, jobs
    result = jobs["report"]["result"]
    assert result["held_out"]
    stages = {stage["stage"]: stage["rms_mm"] for stage in result["evaluation"]["stages"]}
    assert stages["geometric"] < stages["nominal"] / 2
    page = Path(result["report"]).read_text(encoding="utf-8")
    assert "cp1" in page


@pytest.mark.long
def test_the_model_in_the_store_is_the_one_on_the_disk(finished: DaemonProcess) -> None:
    out = finished.directory / "evaluated.csv"
    model = next(j for j in finished.say("jobs.list") if j["kind"] == "residual")["result"]["model"]
    exported = run_apart(
        "session", "export", "s001-r", "--config", str(finished.config), "--out", str(out.parent / "x")
    )
    assert exported.returncode == 0, exported.stderr
    evaluated = run_apart("evaluate", "--model", model, "--data", str(out.parent / "x" / "s001-r.csv"), "--json")
    assert evaluated.returncode == 0, evaluated.stderr
    assert json.loads(evaluated.stdout)["n"] > 12


@pytest.mark.long
def test_an_exported_session_replays_to_the_same_observations(finished: DaemonProcess, tmp_path: Path) -> None:
    for suffix in ("log", "blf"):
        out = tmp_path / suffix
        options = ("--config", str(finished.config), "--out", str(out), "--format", suffix, "--json")
        exported = run_apart("session", "export", "s002-s", *options)
        assert exported.returncode == 0, exported.stderr
        logs = [name for name in json.loads(exported.stdout)["files"] if not name.endswith((".csv", ".json"))]
        replayed = run_apart(
            *("replay", *logs, "--config", str(finished.config), "--store", str(out / "again.sqlite")),
            *("--session", str(out / "s002-s.json"), "--json"),
        )
        assert replayed.returncode == 0, replayed.stderr
        with (
            sqlite3.connect(finished.directory / "rigcal.sqlite") as live,
            sqlite3.connect(out / "again.sqlite") as again,
        ):
            sql = "SELECT round(x_mm, 3), round(y_mm, 3), round(z_mm, 3) FROM observations WHERE excluded IS NULL"
            stored = set(live.execute(f"{sql} AND session_id = 's002-s'"))
            assert stored == set(again.execute(sql))
            assert len(stored) > 20
        live.close()
        again.close()


@pytest.mark.long
def test_status_says_what_every_channel_reads(finished: DaemonProcess) -> None:
    status = run_apart("status", "--socket", str(finished.socket), "--json")
    assert status.returncode == 0, status.stderr
    told = json.loads(status.stdout)
    assert told["mode"] == "simulated"
    channels = {channel["name"]: channel for channel in told["acquisition"]["channels"]}
    assert {"theta1", "L3", "rod_feed", "boom_valve", "boom_pressure"} <= set(channels)
    assert channels["theta1"]["unit"] == "deg"
    assert all(link["dropped"] == 0 for link in told["acquisition"]["links"])
    # At many times real time a moment without the processor is a silent second, and told as such.
    finished.wait(
        "all joints", lambda: "9 of 9 joints ok" in run_apart("status", "--socket", str(finished.socket)).stdout
    )
    assert "theta1" in run_apart("status", "--all", "--socket", str(finished.socket)).stdout


@pytest.mark.long
def test_every_list_is_shown_to_people_too(finished: DaemonProcess) -> None:
    for command in (("session", "list"), ("session", "show", "s001-r"), ("setup", "list"), ("jobs", "list")):
        shown = run_apart(*command, "--socket", str(finished.socket))
        assert shown.returncode == 0, shown.stderr
        assert shown.stdout.strip()


@pytest.mark.long
def test_commands_that_make_no_sense_are_refused_with_the_contracts_status(finished: DaemonProcess) -> None:
    for command in (
        ("session", "stop"),
        ("session", "show", "nothing"),
        ("jobs", "retry", "1"),
        ("jobs", "cancel", "99"),
    ):
        refused = run_apart(*command, "--socket", str(finished.socket))
        assert refused.returncode == 2, refused.stderr
        assert len(refused.stderr.strip().splitlines()) <= 3
    parked = run_apart("devices", "configure", "--socket", str(finished.socket))
    assert parked.returncode == 2
    assert "parked" in parked.stderr


@pytest.mark.long
def test_a_second_daemon_on_the_same_store_refuses_and_touches_nothing(finished: DaemonProcess) -> None:
    second = run_apart("run", "--config", str(finished.config), *SIM)
    assert second.returncode == 1
    assert str(finished.process.pid) in second.stderr
    fixes = finished.say("status")["acquisition"]["stations"][0]["fixes"]
    finished.wait("fixes", lambda: finished.say("status")["acquisition"]["stations"][0]["fixes"] > fixes + 5)


@pytest.mark.long
def test_a_target_that_is_not_there_is_refused_at_once_and_the_rig_goes_on(finished: DaemonProcess) -> None:
    finished.say("session.start", prism="w", id="lost")
    refused = run_apart("session", "shoot", "nowhere", "--socket", str(finished.socket))
    assert refused.returncode == 2
    assert "no target 'nowhere'" in refused.stderr
    finished.wait("a pose", lambda: finished.say("session.show", id="lost")["poses"] >= 2)
    finished.say("session.abort")


@pytest.mark.long
def test_an_operator_confirms_the_prism_and_status_says_whether_it_is_suspected(finished: DaemonProcess) -> None:
    socket = ("--socket", str(finished.socket))
    refused = run_apart("session", "confirm-prism", *socket)
    assert refused.returncode == 2
    assert "no session is open" in refused.stderr
    finished.say("session.start", prism="r", id="confirmed")
    confirmed = run_apart("session", "confirm-prism", "--operator", "Ada", *socket)
    assert confirmed.returncode == 0, confirmed.stderr
    assert "Ada confirms that the station is on prism r" in confirmed.stdout
    assert finished.say("status")["session"]["prism_suspicions"] == []
    finished.say("session.abort")


@pytest.mark.long
def test_an_accepted_model_gives_the_live_tip_on_the_socket_and_on_the_bus(finished: DaemonProcess) -> None:
    socket = ("--socket", str(finished.socket))
    early, best = finished.say("model.list")
    assert (early["comparison"], best["comparison"]["live"]) == (None, None)
    assert best["comparison"]["is_better"], best
    assert json.loads(run_apart("tip", *socket, "--json").stdout)["status"] == "no_model"
    refused = run_apart("model", "accept", str(early["id"]), *socket)
    assert refused.returncode == 3
    assert "was not compared on held-out data yet" in refused.stderr
    accepted = run_apart("model", "accept", str(best["id"]), "--operator", "Ada", *socket)
    assert accepted.returncode == 0, accepted.stderr
    # The screen may be full of alarms, where the computer has too much to do to feed the simulated buses.
    assert [model["state"] for model in finished.say("model.list")] == ["candidate", "live"]
    finished.wait("the model", lambda: finished.say("tip")["status"] != "no_model")

    name = finished.say("session.start", prism="r", kind="check")["id"]
    tips: list[dict[str, Any]] = []

    def seen() -> list[float]:
        tips.append(finished.say("tip"))
        return _errors_in_sigma(finished.directory, name, tips)

    finished.wait("tips where the station measured", lambda: len(seen()) >= 5)
    finished.say("session.abort")
    assert max(seen()) < 5.0
    sent = _sent(finished.directory, 0x680)
    assert {frame.data[7] for frame in sent} >= {16, 0}, "no model at first, then positions"
    for command in (("tip",), ("model", "show"), ("model", "list")):
        shown = run_apart(*command, *socket)
        assert shown.returncode == 0, shown.stderr
        assert shown.stdout.strip()


def _errors_in_sigma(directory: Path, session: str, tips: list[dict[str, Any]]) -> list[float]:
    """Tip against fix, of every tip that was told while the boom stood where an observation was made."""
    with sqlite3.connect(f"file:{directory / 'rigcal.sqlite'}?mode=ro", uri=True) as store:
        rows = store.execute(
            "SELECT values_json, x_mm, y_mm, z_mm FROM observations WHERE session_id = ? AND excluded IS NULL",
            (session,),
        ).fetchall()
    store.close()
    fixes = [(json.loads(values), place) for values, *place in rows]
    found = []
    for tip in tips:
        for joints, place in fixes:
            if tip["station_mm"] and all(abs(joints[name] - value) < 0.05 for name, value in tip["joints"].items()):
                sigma = math.hypot(tip["sigma_mm"], 5.0)  # of tip and fix
                found.append(math.dist(tip["station_mm"], place) / sigma)
    return found


def _sent(directory: Path, identifier: int) -> list[CanCapture]:
    """What rigcal sent under an identifier and the next, as its raw captures have it."""
    with Reader(directory / "rigcal.sqlite") as reader:
        captures = [c for c in reader.captures("boom") if isinstance(c, CanCapture) and c.is_transmitted]
    return [c for c in captures if c.arbitration_id == identifier]


@pytest.mark.long
def test_the_store_lost_nothing(finished: DaemonProcess) -> None:
    with sqlite3.connect(f"file:{finished.directory / 'rigcal.sqlite'}?mode=ro", uri=True) as store:
        assert store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        lost = (
            "SELECT count(*) FROM device_events WHERE kind = 'frames_dropped' AND text LIKE '%the queue to the store%'"
        )
        assert store.execute(lost).fetchone() == (0,)
    store.close()


@pytest.mark.long
def test_a_killed_daemon_loses_no_committed_row_and_goes_on(tmp_path: Path) -> None:
    daemon = DaemonProcess(tmp_path, *SIM, jobs=False)
    try:
        daemon.wait("a fix", daemon.has_fix)
        daemon.say("setup.new", id="S1")
        name = daemon.say("session.start", prism="b")["id"]
        daemon.wait("observations", lambda: daemon.say("session.show", id=name)["observations"] > 20)
        before = daemon.say("session.show", id=name)["observations"]
    finally:
        daemon.kill()
    again = DaemonProcess(tmp_path, *SIM, jobs=False)
    try:
        again.wait("the daemon", again.answers)
        found = again.say("session.show", id=name)
        assert found["state"] == "open"
        assert found["observations"] >= before
        again.wait("more observations", lambda: again.say("session.show", id=name)["observations"] > before + 5)
        again.say("session.stop")
    finally:
        assert again.stop() == 0, again.log_text()
    with sqlite3.connect(tmp_path / "rigcal.sqlite") as store:
        assert store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert store.execute("SELECT count(*) FROM undecoded_chunks").fetchone() == (0,)
        assert store.execute("SELECT count(*) FROM gaps WHERE reason = 'not_running'").fetchone() == (1,)
    store.close()


def test_a_replay_runs_the_same_daemon_apart_from_the_rigs_own_store_and_ends_with_the_logs(tmp_path: Path) -> None:
    golden = Path(__file__).parents[1] / "golden" / "simulated" / "moving"
    files = ("--replay", str(golden / "boom.log"), str(golden / "station.serial"))
    daemon = DaemonProcess(tmp_path, *files, "--rate", "20", jobs=False)
    assert daemon.process.wait(timeout=60) == 0, daemon.log_text()
    daemon.stop()
    assert not (tmp_path / "rigcal.sqlite").exists()
    (path,) = tmp_path.glob("replay-*/rigcal.sqlite")
    with sqlite3.connect(path) as store:
        (fixes,) = store.execute("SELECT count(*) FROM fixes").fetchone()
        (samples,) = store.execute("SELECT count(*) FROM joint_samples").fetchone()
    store.close()
    lines = (golden / "readings.jsonl").read_text(encoding="utf-8").splitlines()
    assert fixes == sum('"table":"fixes"' in line for line in lines)
    assert samples == sum('"table":"joint_samples"' in line for line in lines)


@pytest.mark.long
def test_a_malformed_log_is_refused_before_anything_runs(tmp_path: Path) -> None:
    golden = Path(__file__).parents[1] / "golden" / "simulated" / "moving"
    bad = tmp_path / "bad.log"
    bad.write_text((golden / "boom.log").read_text(encoding="ascii")[:2000] + "\nnonsense\n", encoding="ascii")
    config = str(tmp_path / "rigcal.toml")
    (tmp_path / "rigcal.toml").write_bytes((golden / "rigcal.toml").read_bytes())
    for command in (
        ("run", "--config", config, "--replay", str(bad)),
        ("replay", str(bad), "--config", config, "--store", str(tmp_path / "new.sqlite")),
    ):
        refused = run_apart(*command)
        assert refused.returncode == 2
        assert "bad.log:" in refused.stderr
    assert not (tmp_path / "new.sqlite").exists()


@pytest.mark.long
def test_a_log_is_played_back_in_place_of_a_bus(tmp_path: Path) -> None:
    golden = Path(__file__).parents[1] / "golden" / "simulated" / "standing"
    daemon = DaemonProcess(tmp_path, jobs=False, bus=f'interface = "playback"\nchannel = "{golden / "boom.log"}"')
    try:
        daemon.wait("theta1", lambda: daemon.answers() and "theta1" in _channels(daemon))
        assert daemon.say("status")["mode"] == "live"
    finally:
        assert daemon.stop() == 0, daemon.log_text()


def _channels(daemon: DaemonProcess) -> set[str]:
    return {channel["name"] for channel in daemon.say("status")["acquisition"]["channels"]}
