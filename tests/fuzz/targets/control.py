"""Every command of the control socket, with arguments of every type, against a whole daemon on a replayed rig."""

from __future__ import annotations

import json
import logging
import socket
import threading
from dataclasses import replace
from functools import cache
from pathlib import Path

from calibration.rig.description import shipped_rig
from daemon.composition import replayed
from daemon.config.config import parse_config
from daemon.control.protocol import MAX_LINE_BYTES
from daemon.host.systemd import Notifier
from daemon.rig_files import load_rig
from daemon.service import Daemon
from daemon.store.store import Store
from tests.fuzz.target import Run, Target, check_refusal, scratch_directory

GOLDEN = Path(__file__).parents[2] / "golden" / "simulated" / "standing"
_CONFIG = """rig = "swdt82"
state_directory = "."
sessions.shot_timeout_s = 1.0
jobs.enabled = false

[[can]]
channel = "can0"

[[station]]
profile = "topcon_gts8"
serial.path = "/dev/rigcal-station"
"""
_REPLAY_SPEED = 500.0  # a shot waits for its second in 2 ms


class _Rig:
    """A daemon in this process, which stays for the process's life, and a connection to its socket."""

    def __init__(self) -> None:
        logging.disable(logging.CRITICAL)
        config = parse_config(_CONFIG, scratch_directory() / "rigcal.toml")
        parts = replayed(config, load_rig("swdt82"), [GOLDEN / "boom.log", GOLDEN / "station.serial"], _REPLAY_SPEED)
        self.store = Store(config.store_path)
        self.daemon = Daemon(config, self.store, replace(parts, is_over=lambda: False))
        self._add_models()
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.daemon.run, args=(self.stop, Notifier()), daemon=True)
        self.thread.start()
        self._path = str(config.socket_path)
        self._connect()

    def close(self) -> None:
        self._disconnect()
        self.stop.set()
        self.thread.join(timeout=30)
        self.store.close()
        logging.disable(logging.NOTSET)

    def _connect(self) -> None:
        self._connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._connection.connect(self._path)
        self._stream = self._connection.makefile("rwb")

    def _disconnect(self) -> None:
        self._stream.close()
        self._connection.close()

    def ask(self, line: bytes) -> bytes:
        self._stream.write(line)
        self._stream.flush()
        answer = self._stream.readline()
        if len(line) > MAX_LINE_BYTES:
            self._disconnect()
            self._connect()
        return answer

    def _add_models(self) -> None:
        """Models whose files are gone: what there is to be done with them has to be refused."""
        now = self.daemon._parts.clock.now()
        for state in ("retired", "live", "candidate"):
            row = {"rig": "swdt82", "path": f"/nowhere/{state}", "manifest_sha256": "0" * 64, "stage": "geometric"}
            with self.store.transaction():
                instant = self.store.instant(now, "created_")
                model = self.store.insert("models", row | {"state": state, **instant})
                history = ["candidate", *["live"] * (state != "candidate"), *["retired"] * (state == "retired")]
                for each in history:
                    change = {"model_id": model, "state": each, "reason": "made", **self.store.instant(now)}
                    self.store.insert("model_states", change)


def _control() -> Run:
    rig = _Rig()

    def run(data: bytes) -> None:
        line = data.replace(b"\n", b" ") + b"\n"
        answer = json.loads(rig.ask(line))
        if not answer["ok"]:
            assert answer["status"] in (1, 2, 3)
            assert "inside the daemon" not in answer["error"], answer["error"]
            check_refusal(Exception(answer["error"]))

    run.close = rig.close  # type: ignore[attr-defined]
    return run


@cache
def commands() -> list[dict[str, object]]:
    """One sound request of each command, for the corpus."""
    points = {"cp1": [1000.0, 2000.0, 3000.0]}
    setup = {
        "id": "S1",
        "instrument": "GTS",
        "serial": "1",
        "tilt_arcsec": 1.0,
        "ppm": 0.0,
        "note": "",
        "control_points": points,
    }
    row = {joint.name: sum(joint.limits) / 2 for joint in shipped_rig("swdt82").joints}
    return [
        {"command": "status"},
        {"command": "setup.new", "arguments": setup | {"prism_constants_mm": {"r": 1.5}}},
        {"command": "setup.list", "arguments": {}},
        {
            "command": "session.start",
            "arguments": {"prism": "r", "kind": "static_poses", "setup": "S1", "operator": "A"},
        },
        {"command": "session.start", "arguments": {"prism": "s", "kind": "check", "id": "a", "note": "n"}},
        {"command": "session.shoot", "arguments": {"point": "cp1"}},
        {"command": "session.stop", "arguments": {}},
        {"command": "session.abort", "arguments": {}},
        {"command": "session.list", "arguments": {}},
        {"command": "session.show", "arguments": {"id": "s001-r"}},
        {"command": "jobs.list"},
        {"command": "jobs.cancel", "arguments": {"id": 1}},
        {"command": "jobs.retry", "arguments": {"id": 1}},
        {"command": "model.list"},
        {"command": "model.show", "arguments": {"id": 1}},
        {"command": "model.accept", "arguments": {"id": 3, "operator": "A"}},
        {"command": "model.rollback", "arguments": {"id": 1, "operator": "A"}},
        {"command": "model.zeros-checked", "arguments": {"operator": "A"}},
        {"command": "model.compare", "arguments": {"id": 3}},
        {"command": "tip", "arguments": {"prism": "r"}},
        {"command": "devices.configure", "arguments": {"machine_is_parked": True}},
        {"command": "simulation.visit", "arguments": {"poses": [row]}},
    ]


TARGETS = [Target("control", _control, "json", is_slow=True, inputs_per_process=5000)]
