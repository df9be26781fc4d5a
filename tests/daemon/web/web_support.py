"""The page as its users meet it: `rigcal web`, a process of its own, and a client that sends what a test says."""

from __future__ import annotations

import http.client
import json
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

DEADLINE_S = 60.0


class Answer(NamedTuple):
    """What came back."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def data(self) -> Any:
        return json.loads(self.body)


class WebProcess:
    """`rigcal web` on a port of its own, for the daemon of a configuration; options as on the command line."""

    def __init__(self, config: Path, *options: str) -> None:
        command = [sys.executable, "-m", "daemon.cli.main", "web", "--port", "0", "--config", str(config), *options]
        self._log = config.with_name("web.log").open("a", encoding="utf-8")
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self._log, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert "the page is at" in line, config.with_name("web.log").read_text(encoding="utf-8")
        self.address = line.split()[-1].rstrip("/")
        parts = urlsplit(self.address)
        self.host, self.port = str(parts.hostname), int(parts.port or 0)
        self.tls = ssl._create_unverified_context() if parts.scheme == "https" else None

    def connection(self) -> http.client.HTTPConnection:
        host = "127.0.0.1" if self.host == "0.0.0.0" else self.host
        if self.tls is not None:
            return http.client.HTTPSConnection(host, self.port, timeout=DEADLINE_S, context=self.tls)
        return http.client.HTTPConnection(host, self.port, timeout=DEADLINE_S)

    def send(self, method: str, path: str, body: bytes | None = None, **headers: str) -> Answer:
        connection = self.connection()
        try:
            connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
            answer = connection.getresponse()
            return Answer(answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read())
        finally:
            connection.close()

    def get(self, path: str, **headers: str) -> Answer:
        return self.send("GET", path, **headers)

    def post(self, path: str, data: Any, **headers: str) -> Answer:
        own = {"Origin": self.own_origin, "Content_Type": "application/json"}
        return self.send("POST", path, json.dumps(data).encode(), **(own | headers))

    @property
    def own_origin(self) -> str:
        connection = self.connection()
        return f"{'https' if self.tls else 'http'}://{connection.host}:{self.port}"

    def command(self, name: str, *, cookie: str = "", operator: str = "", **arguments: Any) -> Answer:
        headers = {"Cookie": cookie} if cookie else {}
        return self.post("/api/command", {"command": name, "arguments": arguments, "operator": operator}, **headers)

    def events(self, **headers: str) -> Iterator[dict[str, Any]]:
        """States as they come; the stream is closed with the generator."""
        connection = self.connection()
        try:
            connection.request("GET", "/api/live", headers=headers)
            answer = connection.getresponse()
            assert answer.status == 200, answer.read()
            while line := answer.readline():
                if line.startswith(b"data: "):
                    yield json.loads(line[6:])
        finally:
            connection.close()

    def cpu_s(self) -> float:
        """CPU time of the process, s."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / 100.0

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(timeout=DEADLINE_S)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
            assert self.process.stdout is not None
            self.process.stdout.close()
            self._log.close()


def wait_for(what: str, events: Iterator[dict[str, Any]], found: Any) -> dict[str, Any]:
    """The first state of which `found` is true."""
    deadline = time.monotonic() + DEADLINE_S
    for event in events:
        if found(event):
            return event
        assert time.monotonic() < deadline, f"waited for {what}"
    raise AssertionError(f"the stream ended before {what}")
