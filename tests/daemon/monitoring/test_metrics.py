"""The metrics are the daemon's status in another form, on the loopback interface alone."""

from __future__ import annotations

import errno
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from daemon.acquisition.status.board import StatusBoard
from daemon.composition import live
from daemon.config.config import ConfigError, parse_config
from daemon.control.protocol import request
from daemon.host.systemd import network_hint
from daemon.monitoring import metrics_server
from daemon.monitoring.metrics import FAMILIES
from daemon.monitoring.metrics_server import MetricsServer
from daemon.rig_files import load_rig
from daemon.service import Daemon
from daemon.store import Store
from drivers.clock import ManualClock
from drivers.readings import DeviceEvent, EventKind, Gap, GapReason
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import running as run_daemon

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden" / "simulated" / "standing" / "boom.log"

CONFIG = """rig = "swdt82"
state_directory = "."
[[can]]
interface = "playback"
channel = "{log}"
[[station]]
serial.path = "no-such-port"
[jobs]
enabled = false
[metrics]
port = {port}
"""

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@contextmanager
def running(directory: Path, port: int) -> Iterator[Path]:
    """A daemon that reads a captured bus and no station; its control socket."""
    config = parse_config(CONFIG.format(log=GOLDEN, port=port), directory / "rigcal.toml")
    store = Store(config.store_path)
    daemon = Daemon(config, store, live(config, load_rig("swdt82")))
    with run_daemon(daemon, store):
        yield config.socket_path


def scrape(port: int, host: str = "127.0.0.1") -> Samples:
    with urllib.request.urlopen(f"http://{host}:{port}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def value(samples: Samples, name: str, **labels: str) -> float | None:
    return samples.get((name, tuple(sorted(labels.items()))))


def test_a_daemon_on_a_bus_serves_what_its_status_says(tmp_path: Path) -> None:
    port = free_port()
    with running(tmp_path, port) as control:

        def told() -> dict[str, Any]:
            return dict(request(control, "status"))

        def is_heard() -> bool:
            kinds = {alarm["kind"] for alarm in told()["alarms"]["active"]}
            return told()["acquisition"]["links"][0]["captures"] > 50 and "link_down" in kinds

        wait_until(is_heard)
        before, samples, after = told(), scrape(port), told()
        captures = value(samples, "rigcal_link_captures_total", link="boom")
        assert captures is not None
        assert before["acquisition"]["links"][0]["captures"] <= captures <= after["acquisition"]["links"][0]["captures"]
        assert value(samples, "rigcal_link_up", link="boom") == 1.0
        assert value(samples, "rigcal_link_up", link="station") == 0.0
        assert value(samples, "rigcal_channel_ok", channel="theta1", link="boom") == 1.0
        assert value(samples, "rigcal_station_locked", station="station") is None, "nothing is known of it"
        alarm = {"kind": "link_down", "subject": "station", "severity": "warning"}
        assert value(samples, "rigcal_alarm_active", **alarm) == 1.0
        assert value(samples, "rigcal_alarms", severity="critical") == 0.0
        free = value(samples, "rigcal_store_free_bytes")
        assert free is not None
        assert free > 0
        assert (value(samples, "rigcal_gap_open_seconds", channel="station", reason="link_down") or 0.0) > 0.0
        assert value(samples, "rigcal_build_info", version=before["version"], rig="swdt82", mode="live") == 1.0
        assert value(samples, "process_resident_memory_bytes")
        with pytest.raises(urllib.error.URLError):
            scrape(port, "127.0.0.2")
    with pytest.raises(urllib.error.URLError):
        scrape(port)


def test_every_family_has_samples_of_a_status_that_has_everything() -> None:
    alarm = {"kind": "k", "subject": "s", "severity": "critical"}
    status: dict[str, Any] = {
        "version": "1",
        "rig": "r",
        "mode": "live",
        "alarms": {"active": [alarm], "looked_age_s": 0.5},
        "notices": [{"target": "webhook", "waiting": 1, "sent": 2, "failures": 3}],
        "latency": {"session": "a", "seconds": 0.05, "standard_error_s": 0.01},
        "clock": {"is_synchronized": True, "offset_s": -2e-4, "max_error_s": 5e-3},
        "session": {"prism": "r", "observations": 4, "poses": 2, "excluded": {"moving": 3}},
        "control_shots": [{"setup": "S1", "point": "cp1", "misclosure_mm": 2.5}],
        "job_counts": [{"kind": "gap", "state": "done", "count": 2}],
        "models": {"live": {"id": 3, "stage": "hybrid", "created_utc_ns": 10**18}, "candidate": None},
        "gap": {"drift": {"ratio": 1.1, "upper": 2.0, "decision": 4.0}},
        "store_health": {"state": "ok", "free_bytes": 5},
        "acquisition": {
            "links": [
                {"name": "boom", "up": True, "captures": 1, "queued": 0, "dropped": 0, "restarts": 0, "error_frames": 0}
            ],
            "frames": [{"link": "boom", "identifier": "181", "missed": 7}],
            "channels": [{"name": "theta1", "link": "boom", "status": "ok", "age_s": 0.1}],
            "stations": [{"name": "st", "lock": "locked", "status": "ok", "fixes": 4, "good_age_s": 0.2}],
            "decode_failures": {"boom": 1},
            "gaps": [{"channel": "st", "reason": "silent", "age_s": 3.0}],
            "gap_counts": [{"channel": "st", "reason": "silent", "count": 2, "missed": 9}],
            "event_counts": [{"device": "st", "kind": "lock_lost", "count": 1}],
            "writer_lag_p99_s": 0.1,
            "is_behind": False,
            "error": None,
        },
    }
    samples = {family.name: list(family.samples(status)) for family in FAMILIES}
    assert [name for name, found in samples.items() if not found or found[0][1] is None] == []
    assert all(len(labels) == len(f.labels) for f in FAMILIES for labels, _ in samples[f.name])
    assert samples["rigcal_control_point_misclosure_meters"] == [(("S1", "cp1"), 0.0025)]
    assert samples["rigcal_check_drift_ratio"] == [((), 0.5)]


def test_names_follow_the_conventions() -> None:
    names = [family.name for family in FAMILIES]
    assert len(set(names)) == len(names)
    assert all(family.name.endswith("_total") == (family.kind == "counter") for family in FAMILIES)


def test_a_port_that_is_taken_is_told_and_served_once_it_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server, "RETRY_S", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = int(other.getsockname()[1])
        server = MetricsServer(port, dict)
        assert "Address already in use" in (server.trouble() or "")
    server.look()
    try:
        assert (server.trouble(), server.port) == (None, port)
    finally:
        server.stop()


def test_a_service_whose_unit_forbids_the_network_says_how_to_open_it() -> None:
    with pytest.raises(OSError, match="not supported") as refused:
        socket.socket(socket.AF_APPLETALK, socket.SOCK_STREAM)  # as a unit's RestrictAddressFamilies answers
    assert refused.value.errno == errno.EAFNOSUPPORT
    assert "network.conf" in network_hint(refused.value, {"INVOCATION_ID": "1"})
    assert network_hint(refused.value, {}) == ""
    assert network_hint(ConnectionRefusedError(errno.ECONNREFUSED, "refused"), {"INVOCATION_ID": "1"}) == ""


def test_gaps_are_counted_once_with_what_is_missing_in_them_and_events_by_kind() -> None:
    clock = ManualClock()
    board, start = StatusBoard(clock), clock.now()
    silent, lost = GapReason.SILENT, GapReason.FRAMES_LOST
    board.recorded([Gap("theta1", silent, start)])
    clock.advance(2.0)
    board.recorded([Gap("theta1", silent, start, clock.now(), 40), Gap("boom", lost, start, clock.now(), 7)])
    board.recorded([Gap("boom", lost, clock.now(), clock.now(), 3), Gap("theta1", silent, clock.now())])
    board.recorded([DeviceEvent("boom", start, EventKind.FRAMES_DROPPED, "lost", 7)] * 2)
    told = board.snapshot([], [])
    counts = {(gap.channel, gap.reason): (gap.count, gap.missed) for gap in told.gap_counts}
    assert counts == {("theta1", "silent"): (2, 40), ("boom", "frames_lost"): (2, 10)}
    assert [(event.device, event.kind, event.count) for event in told.event_counts] == [("boom", "frames_dropped", 2)]


def test_an_impossible_port_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"metrics\.port: must be 65535 or less, found 70000"):
        parse_config('rig = "swdt82"\n[metrics]\nport = 70000\n', tmp_path / "rigcal.toml")
