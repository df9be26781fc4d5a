"""Callers of the metrics who do not go on, or cannot be taken for a while, take nothing that others need."""

from __future__ import annotations

import resource
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from socketserver import TCPServer
from typing import Any

import pytest

from daemon.monitoring import scrape_server
from daemon.monitoring.metrics_server import MetricsServer, StatusCollector
from tests.daemon.support.acquisition import wait_until

NO_STACK_BYTES = 1 << 47  # of a thread: more than a process can have, so that none is begun


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[MetricsServer]:
    """A server of the process's own metrics, which waits for no place."""
    monkeypatch.setattr(scrape_server, "WAIT_S", 0.0)
    monkeypatch.setattr(StatusCollector, "collect", lambda _self: iter(()))
    server = MetricsServer(0, dict)
    yield server
    server.stop()


def scrape(server: MetricsServer) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=10.0) as answer:
        return bytes(answer.read())


@contextmanager
def callers(server: MetricsServer, number: int) -> Iterator[list[socket.socket]]:
    """So many connections that have asked nothing yet."""
    with ExitStack() as open_ones:
        yield [
            open_ones.enter_context(socket.create_connection(("127.0.0.1", server.port or 0), timeout=10.0))
            for _ in range(number)
        ]


def drip(connections: Sequence[socket.socket]) -> bool:
    """Send a byte on each; True once all are hung up on."""
    hung_up = 0
    for connection in connections:
        try:
            connection.send(b"G")
        except OSError:
            hung_up += 1
    return hung_up == len(connections)


def test_callers_who_ask_nothing_are_hung_up_on_and_take_no_more_than_their_places(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scrape_server._Handler, "timeout", 0.5)
    before = threading.active_count()
    with callers(server, 2 * scrape_server.MOST_AT_ONCE) as silent:
        assert threading.active_count() <= before + scrape_server.MOST_AT_ONCE
        assert [caller.recv(1) for caller in silent] == [b""] * len(silent)
        assert b"process_open_fds" in scrape(server)
    assert capfd.readouterr().err == ""


def test_callers_who_drip_are_hung_up_on_and_meanwhile_it_is_told_that_nobody_else_is_served(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scrape_server, "LONGEST_S", 1.0)
    with callers(server, scrape_server.MOST_AT_ONCE) as dripping, callers(server, 1) as (refused,):
        assert refused.recv(1) == b""
        assert "16 connections" in (server.trouble() or "")
        wait_until(lambda: drip(dripping))
        assert b"process_open_fds" in scrape(server)
        assert server.trouble() is None


def test_callers_for_whom_there_is_no_thread_take_no_place_for_good(
    server: MetricsServer, capfd: pytest.CaptureFixture[str]
) -> None:
    before = threading.stack_size(NO_STACK_BYTES)
    try:
        with callers(server, 2 * scrape_server.MOST_AT_ONCE) as refused:
            assert [caller.recv(1) for caller in refused] == [b""] * len(refused)
    finally:
        threading.stack_size(before)
    assert "no thread left" in (server.trouble() or "")
    assert b"process_open_fds" in scrape(server)
    assert server.trouble() is None
    assert capfd.readouterr().err == ""


def test_a_caller_for_whom_there_is_no_descriptor_waits_without_a_storm_and_is_served_once_there_is_one(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked_s: list[float] = []
    take = TCPServer.get_request

    def noted(self: TCPServer) -> tuple[Any, Any]:
        asked_s.append(time.monotonic())
        return take(self)

    monkeypatch.setattr(TCPServer, "get_request", noted)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with closing(socket.socket()) as caller:
        caller.settimeout(10.0)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
        try:
            caller.connect(("127.0.0.1", server.port))
            caller.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
            wait_until(lambda: len(asked_s) > 3)
            told = server.trouble()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        assert asked_s[3] - asked_s[0] >= 3 * scrape_server.PAUSE_S
        assert "Too many open files" in (told or "")
        assert caller.recv(12) == b"HTTP/1.0 200"
    wait_until(lambda: server.trouble() is None)


def test_a_server_for_which_there_is_no_thread_is_told_and_begins_once_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("daemon.monitoring.metrics_server.RETRY_S", 0.0)
    before = threading.stack_size(NO_STACK_BYTES)
    try:
        server = MetricsServer(0, dict)
    finally:
        threading.stack_size(before)
    assert "can't start new thread" in (server.trouble() or "")
    server.look()
    assert server.trouble() is None
    server.stop()


def test_a_thread_that_has_ended_is_told(server: MetricsServer) -> None:
    assert server.trouble() is None
    assert server._served is not None
    server._served[0].shutdown()
    server._served[1].join()
    assert server.trouble() == "the thread that serves the metrics has ended"
