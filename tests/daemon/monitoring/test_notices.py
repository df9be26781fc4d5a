"""Alarms leave the machine: to a real web server and a real command that fail at first, through restarts."""

from __future__ import annotations

import contextlib
import email
import email.policy
import logging
import os
import resource
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Any

import pytest

from daemon.config.config import ConfigError, parse_config
from daemon.config.sections import NotifySection
from daemon.control.protocol import request
from daemon.monitoring import delivery, outbox
from daemon.monitoring.notice import LISTED, Notice, message_of
from daemon.monitoring.outbox import Pace
from daemon.store.queries.alarms import AlarmTable
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.support.notices import FAST, SECRET, Sender, WebServer
from tests.daemon.support.sessions import disk_fails
from tests.daemon.support.store import at, table


@pytest.fixture
def web() -> Iterator[WebServer]:
    server = WebServer()
    try:
        yield server
    finally:
        server.close()


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., Sender]]:
    senders: list[Sender] = []

    def make(pace: Pace = FAST, **section: Any) -> Sender:
        senders.append(Sender(tmp_path / "rigcal.sqlite", NotifySection(**section), pace))
        return senders[-1]

    yield make
    for sender in senders:
        sender.close()


def script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


# ---- delivery --------------------------------------------------------------------------------------------------------


def test_a_server_that_fails_first_gets_every_notice_once_and_in_order(
    web: WebServer, opened: Callable[..., Sender], caplog: pytest.LogCaptureFixture
) -> None:
    web.answers = [503, 500, 302]
    sender = opened(webhook_url=web.url)
    sender.tell("raised", "boom")
    wait_until(lambda: bool(web.got))
    sender.tell("cleared", "boom")
    wait_until(lambda: len(web.events()) == 2)
    assert web.events() == [("raised", "boom"), ("cleared", "boom")]
    (message, _) = web.got
    assert message["rig"] == "swdt82"
    assert "CRITICAL link_down boom: no such port. Plug it in." in message["text"]
    wait_until(lambda: sender.status()["sent"] == 2)
    assert sender.status() == {"target": "webhook", "waiting": 0, "sent": 2, "failures": 3, "error": None}
    wait_until(lambda: all(row["sent_utc_ns"] is not None for row in table(sender.path, "notices")))
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert any("127.0.0.1 answers 503" in text for text in warnings)
    assert SECRET not in caplog.text, "the address may hold a secret"


def test_a_command_gets_an_email_on_its_input_and_its_failure_is_told(
    tmp_path: Path, opened: Callable[..., Sender]
) -> None:
    mail = tmp_path / "mail"
    fails_once = f'[ -e {tmp_path}/tried ] || {{ touch {tmp_path}/tried; echo "no route to host" >&2; exit 75; }}'
    program = script(
        tmp_path / "send", f'{fails_once}\ncat > {mail}.part && mv {mail}.part {mail}; echo "$1" > {mail}.to'
    )
    sender = opened(
        pace=replace(FAST, first_retry_s=0.3), command=[program, "someone@example.com; touch /tmp/not-a-shell"]
    )
    now = sender.clock.now()
    long = "Mehr messen. " + "Ü" * 600
    sender.notices.take(Notice("raised", "job_failed", "7", "warning", "zu wenig Übung", long, now, now))
    wait_until(lambda: bool(sender.notices.faults()))
    assert sender.notices.faults() == {"command": f"{program} ended with status 75: no route to host"}
    wait_until(lambda: not sender.notices.faults())
    message = email.message_from_bytes(mail.read_bytes(), policy=email.policy.default)
    assert str(message["Subject"]).endswith("WARNING job_failed 7")
    assert f"zu wenig Übung. {long}" in message.get_content()
    assert max(map(len, mail.read_bytes().splitlines())) <= 998, "RFC 5322"
    assert Path(f"{mail}.to").read_text(encoding="utf-8") == "someone@example.com; touch /tmp/not-a-shell\n"


def test_a_command_that_hangs_is_ended_with_its_children(
    tmp_path: Path, opened: Callable[..., Sender], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "COMMAND_TIMEOUT_S", 0.2)
    sender = opened(command=[script(tmp_path / "send", f"echo $$ > {tmp_path}/pid; sleep 600")])
    sender.tell("raised", "boom")
    wait_until(lambda: bool(sender.notices.faults()))
    assert "did not end within 0.2 s" in sender.notices.faults()["command"]
    group = int((tmp_path / "pid").read_text(encoding="utf-8"))
    sender.notices.stop()

    def is_gone() -> bool:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    wait_until(is_gone)


def test_a_command_that_says_gigabytes_takes_no_memory_and_its_last_line_is_told(
    tmp_path: Path, opened: Callable[..., Sender]
) -> None:
    program = script(tmp_path / "send", "head -c 100000000 /dev/zero; echo; echo 'no route to host' >&2; exit 75")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sender = opened(command=[program])
    sender.tell("raised", "boom")
    wait_until(lambda: bool(sender.notices.faults()))
    assert sender.notices.faults() == {"command": f"{program} ended with status 75: no route to host"}
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000, "kB"


def test_a_command_has_delivered_when_it_has_ended_whatever_it_leaves_running(
    tmp_path: Path, opened: Callable[..., Sender]
) -> None:
    program = script(tmp_path / "send", f"sleep 600 & echo $! > {tmp_path}/left")
    sender = opened(command=[program])
    sender.tell("raised", "boom")
    try:
        wait_until(lambda: sender.status()["sent"] == 1)
    finally:
        os.kill(int((tmp_path / "left").read_text(encoding="utf-8")), signal.SIGKILL)


def test_one_way_that_fails_does_not_hold_up_the_other(web: WebServer, opened: Callable[..., Sender]) -> None:
    sender = opened(webhook_url=web.url, command=["/no/such/program"])
    sender.tell("raised", "boom")
    wait_until(lambda: bool(web.got) and bool(sender.notices.faults()))
    assert sender.notices.faults() == {"command": "/no/such/program: No such file or directory"}
    assert sender.status()["error"] is None


def test_a_command_that_hangs_does_not_hold_up_the_webhook(web: WebServer, opened: Callable[..., Sender]) -> None:
    sender = opened(webhook_url=web.url, command=["/bin/sleep", "1000"])
    for number, subject in enumerate(("boom", "station"), start=1):  # the second while the command is waited for
        sender.tell("raised", subject)
        wait_until(lambda number=number: len(web.events()) == number)


@pytest.mark.parametrize(
    ("scheme", "begin"),
    [("http", b""), ("http", b"HTTP/1.1 200 OK\r\nX-Slow: "), ("https", b"\x16\x03\x03\x3f\xff")],
    ids=["status line", "headers", "TLS handshake"],
)
def test_a_receiver_that_answers_byte_by_byte_does_not_hold_up_the_other_way(
    opened: Callable[..., Sender], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scheme: str, begin: bytes
) -> None:
    monkeypatch.setattr(delivery, "WEBHOOK_TIMEOUT_S", 0.5)
    hung_up = threading.Event()

    class Trickle(BaseRequestHandler):
        def handle(self) -> None:
            with contextlib.suppress(OSError):
                self.request.sendall(begin)
                while not hung_up.wait(0.05):
                    self.request.sendall(b"H")
            hung_up.set()

    with ThreadingTCPServer(("127.0.0.1", 0), Trickle) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            mail = tmp_path / "mail"
            url = f"{scheme}://127.0.0.1:{server.server_address[1]}/hooks/{SECRET}"
            sender = opened(webhook_url=url, command=[script(tmp_path / "send", f"cat > {mail}")])
            sender.tell("raised", "boom")
            wait_until(lambda: mail.exists() and "boom" in mail.read_text(encoding="utf-8"))
            wait_until(lambda: bool(sender.notices.faults()))
            assert sender.notices.faults() == {"webhook": "127.0.0.1: no complete answer within 0.5 s"}
            assert hung_up.wait(10.0), "the connection is closed, not left open"
        finally:
            hung_up.set()
            server.shutdown()
            thread.join()


# ---- restarts, limits, full disks ------------------------------------------------------------------------------------


def test_what_could_not_be_sent_is_sent_by_the_next_run_and_only_once(opened: Callable[..., Sender]) -> None:
    web = WebServer()
    web.close()
    port = web.server_port
    sender = opened(webhook_url=web.url)
    sender.tell("raised", "boom")
    wait_until(lambda: bool(sender.notices.faults()))
    sender.tell("raised", "station")
    sender.close()
    again = WebServer(port)
    try:
        sender.open()
        wait_until(lambda: len(again.events()) == 2)
        assert again.events() == [("raised", "boom"), ("raised", "station")]
        sender.close()
        sender.open()
        sender.tell("cleared", "boom")
        wait_until(lambda: len(again.events()) == 3)
        assert again.events()[2] == ("cleared", "boom")
    finally:
        again.close()


def test_alarms_that_a_killed_run_did_not_tell_are_told_by_the_next(
    web: WebServer, opened: Callable[..., Sender]
) -> None:
    sender = opened(webhook_url=web.url)
    alarms = AlarmTable(sender.store)
    boom = alarms.add(sender.clock.now(), "link_down", "boom", severity="critical", text="gone", remedy="Plug it in.")
    sender.tell_only("raised", "station")  # its alarm is over when the next run begins, and nobody was told
    wait_until(lambda: bool(web.got))
    sender.close()
    sender.open()
    wait_until(lambda: len(web.events()) == 3)
    assert sorted(web.events()[1:]) == [("cleared", "station"), ("raised", "boom")]
    AlarmTable(sender.store).clear(boom, sender.clock.now())
    sender.close()
    sender.open()
    wait_until(lambda: ("cleared", "boom") in web.events())
    assert len(web.events()) == 4


def test_beyond_the_limit_of_an_hour_notices_wait_and_are_told_in_one(
    web: WebServer, opened: Callable[..., Sender]
) -> None:
    sender = opened(pace=replace(FAST, per_hour=2), webhook_url=web.url)
    for n in range(2):
        sender.clock.advance(1.0)
        sender.tell("raised", f"first{n}")
        wait_until(lambda n=n: sender.status()["sent"] == n + 1)
    for n in range(3):
        sender.tell("raised", f"more{n}")
    wait_until(lambda: len(table(sender.path, "notices")) == 5)
    sender.close()
    sender.open()  # the hour is not begun anew by a restart
    sender.tell("raised", "more3")
    wait_until(lambda: sender.status()["waiting"] == 4)
    assert len(web.got) == 2
    sender.close()
    sender.pace = replace(FAST, per_hour=3)
    sender.open()
    wait_until(lambda: len(web.got) == 3)
    assert [subject for _, subject in web.events()[2:]] == [f"more{n}" for n in range(4)]
    assert web.got[2]["subject"].endswith(": 4 notices, CRITICAL")


def test_alarms_of_one_fault_are_one_message(web: WebServer, opened: Callable[..., Sender]) -> None:
    sender = opened(pace=replace(FAST, gather_s=0.3), webhook_url=web.url)
    for subject in ("boom", "station"):
        sender.tell("raised", subject)
    wait_until(lambda: bool(web.got))
    assert len(web.events()) == 2


def test_a_store_that_cannot_be_written_keeps_no_notice_back(
    web: WebServer, opened: Callable[..., Sender], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.monitoring.notices.REWRITE_S", 0.05)
    sender = opened(webhook_url=web.url)
    with disk_fails():
        sender.tell_only("raised", "store")
        wait_until(lambda: bool(web.got))
        assert table(sender.path, "notices") == []
    wait_until(lambda: bool(table(sender.path, "notices")))
    (row,) = table(sender.path, "notices")
    assert row["sent_utc_ns"] is not None
    assert web.events() == [("raised", "store")]


def test_a_write_that_hangs_keeps_no_notice_back_and_none_is_left_to_be_sent_again(
    web: WebServer, opened: Callable[..., Sender]
) -> None:
    sender = opened(webhook_url=web.url)
    hangs, go_on = threading.Event(), threading.Event()

    def hang(sql: str) -> None:  # SQLite calls it just before the commit
        if sql == "COMMIT":
            hangs.set()
            go_on.wait(30.0)

    sender.store._db.conn.set_trace_callback(hang)
    try:
        sender.tell_only("raised", "store")
        wait_until(hangs.is_set)
        wait_until(lambda: web.events() == [("raised", "store")])
        sender.tell_only("raised", "boom")
        wait_until(lambda: web.events() == [("raised", "store"), ("raised", "boom")])
        assert table(sender.path, "notices") == []
    finally:
        go_on.set()
    wait_until(lambda: len(table(sender.path, "notices")) == 2)
    wait_until(lambda: all(row["sent_utc_ns"] is not None for row in table(sender.path, "notices")))
    assert [row["subject"] for row in table(sender.path, "notices")] == ["store", "boom"]


def test_a_notice_that_no_store_can_hold_is_sent_all_the_same_and_so_are_those_after_it(
    web: WebServer, opened: Callable[..., Sender]
) -> None:
    sender = opened(webhook_url=web.url)
    beyond = replace(sender.clock.now(), monotonic_ns=2**70)
    sender.notices.take(Notice("raised", "clock_behind", "clock", "critical", "a text", "Set it.", beyond, beyond))
    wait_until(lambda: web.events() == [("raised", "clock")])
    sender.tell("raised", "boom")
    wait_until(lambda: web.events() == [("raised", "clock"), ("raised", "boom")])


@pytest.mark.parametrize("fault", [(outbox, "HOUR_S"), (outbox.Outbox, "add")], ids=["sending", "taking in"])
def test_a_fault_of_the_thread_that_sends_is_told_and_keeps_nothing_back_once_it_is_over(
    web: WebServer, opened: Callable[..., Sender], monkeypatch: pytest.MonkeyPatch, fault: tuple[object, str]
) -> None:
    monkeypatch.setattr("daemon.monitoring.notices.REWRITE_S", 0.05)
    sender = opened(webhook_url=web.url)
    with monkeypatch.context() as broken:
        broken.setattr(*fault, None)
        sender.tell("raised", "boom")
        wait_until(lambda: "TypeError" in sender.notices.faults().get("webhook", ""))
    wait_until(lambda: web.events() == [("raised", "boom")])
    wait_until(lambda: sender.notices.faults() == {})


def test_only_critical_alarms_are_told_where_that_is_asked_for_also_when_a_warning_becomes_critical(
    web: WebServer, opened: Callable[..., Sender]
) -> None:
    sender = opened(webhook_url=web.url, least="critical")
    sender.tell("raised", "station", "warning")
    sender.tell("cleared", "station", "warning")
    sender.tell("raised", "boom", "warning")
    sender.tell("raised", "boom", "critical")
    wait_until(lambda: bool(web.got))
    sender.tell("cleared", "boom", "warning")
    wait_until(lambda: len(web.events()) == 2)
    assert web.events() == [("raised", "boom"), ("cleared", "boom")]


def test_a_message_lists_the_newest_and_counts_the_rest_and_is_safe_to_show() -> None:
    now = at(0)
    notices = [
        Notice("raised", "k", f"s{n}", "warning", "te\x1b[2Jxt\nline", "R.", now, now) for n in range(LISTED + 5)
    ]
    message = message_of("swdt82", notices, unlisted=7)
    assert message.subject.endswith(f"{LISTED + 12} notices")
    assert "12 earlier notices are not listed" in message.text
    assert "\x1b" not in message.text
    assert len(message.text.splitlines()) == LISTED + 3
    assert [notice["subject"] for notice in message.data["notices"]] == [f"s{n}" for n in range(5, LISTED + 5)]


# ---- the daemon ------------------------------------------------------------------------------------------------------


def test_a_daemon_tells_of_its_alarms_and_of_a_test(
    tmp_path: Path, web: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.monitoring.notices.USUAL", FAST)
    with idle_daemon(tmp_path, notify=NotifySection(webhook_url=web.url)) as config:
        told = request(config.socket_path, "alarms.test-notice")
        assert told.startswith("a test notice is being sent by webhook")
        (tmp_path / "models" / "job-1").mkdir(parents=True)  # models beside a store that never saw a job: an alarm
        wait_until(lambda: ("raised", "store") in web.events())
        assert ("test", "notices") in web.events()

        def is_all_told() -> bool:
            (target,) = request(config.socket_path, "status")["notices"]
            return (target["waiting"], target["error"]) == (0, None)

        wait_until(is_all_told)


def test_a_way_that_leads_nowhere_is_refused(tmp_path: Path) -> None:
    for section, complaint in (
        ('webhook_url = "file:///etc/passwd"', "notify.webhook_url: give the address of a web server"),
        ('webhook_url = "http://chat..example.com/"', "notify.webhook_url: give the address of a web server"),
        (f'webhook_url = "http://{"a" * 64}.example.com/"', "notify.webhook_url: give the address of a web server"),
        ('command = ["/bin/true", "a\\u0000"]', "notify.command.2: contains a zero byte"),
        ('command = ["mail"]', "notify.command: give the program's full path"),
        ("", "notify: give webhook_url, command, or both"),
        ('webhook = "x"', "notify.webhook: unknown key; allowed here: command, least, webhook_url"),
    ):
        with pytest.raises(ConfigError) as caught:
            parse_config(f'rig = "swdt82"\n[notify]\n{section}\n', tmp_path / "rigcal.toml")
        assert complaint in str(caught.value)
