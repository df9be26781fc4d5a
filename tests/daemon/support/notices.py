"""A web server that notices are posted to, and a store whose notices are sent."""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Literal

from daemon.config.sections import NotifySection
from daemon.monitoring.notice import Notice
from daemon.monitoring.notices import Notices
from daemon.monitoring.outbox import Pace
from daemon.store import Store
from daemon.store.queries.alarms import AlarmTable
from daemon.store.queries.notices import NoticeTable
from drivers.clock import ManualClock
from tests.daemon.support.store import at

FAST = Pace(gather_s=0.02, first_retry_s=0.02, longest_retry_s=0.1, per_hour=1000)
SECRET = "T0ken"


class WebServer(ThreadingHTTPServer):
    """Takes what is posted; answers with the next of `answers`, and then with 200."""

    def __init__(self, port: int = 0) -> None:
        self.answers: list[int] = []
        self.got: list[dict[str, Any]] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                status = server.answers.pop(0) if server.answers else 200
                if status == 200:
                    server.got.append(body)
                self.send_response(status)
                if status == 302:
                    self.send_header("Location", "/elsewhere")
                self.end_headers()

            def do_GET(self) -> None:
                server.got.append({"text": "a redirection was followed"})
                self.send_response(200)
                self.end_headers()

            def log_message(self, *arguments: object) -> None:
                pass

        super().__init__(("127.0.0.1", port), Handler)
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/hooks/{SECRET}"

    def close(self) -> None:
        self.shutdown()
        self._thread.join()
        self.server_close()

    def events(self) -> list[tuple[str, str]]:
        return [(notice["event"], notice["subject"]) for message in self.got for notice in message["notices"]]


class Sender:
    """A store whose notices are sent; closed and opened again by tests."""

    def __init__(self, path: Path, section: NotifySection, pace: Pace = FAST) -> None:
        self.path, self.section, self.pace = path, section, pace
        self.clock = ManualClock(at(0))
        self.rows: dict[str, int] = {}
        self.open()

    def open(self) -> None:
        self.store = Store(self.path)
        active = AlarmTable(self.store).active()
        self.notices = Notices(self.section, NoticeTable(self.store), active, "swdt82", self.clock, pace=self.pace)
        self.notices.start()

    def close(self) -> None:
        self.notices.stop()
        self.store.close()

    def tell(self, event: Literal["raised", "cleared"], subject: str, severity: Any = "critical") -> None:
        """As the board of alarms does, which writes the alarm to the store as well."""
        now = self.clock.now()
        if event == "raised":
            about = {"severity": severity, "text": "no such port", "remedy": "Plug it in."}
            self.rows[subject] = AlarmTable(self.store).add(now, "link_down", subject, **about)
        else:
            AlarmTable(self.store).clear(self.rows.pop(subject), now)
        self.tell_only(event, subject, severity)

    def tell_only(self, event: Literal["raised", "cleared"], subject: str, severity: Any = "critical") -> None:
        now = self.clock.now()
        self.notices.take(Notice(event, "link_down", subject, severity, "no such port", "Plug it in.", now, now))

    def status(self) -> dict[str, Any]:
        return self.notices.status()[0]
