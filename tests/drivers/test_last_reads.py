"""The last reads of a link that is to stop."""

from __future__ import annotations

import threading

import pytest

from drivers import last_reads
from drivers.last_reads import LastReads, more_may_wait


def test_a_link_reads_on_after_it_is_to_stop_until_nothing_waits() -> None:
    stop = threading.Event()
    reads = LastReads(stop)
    assert not reads.have_begun()
    assert not reads.are_over(is_emptied=True), "it is not to stop yet"
    stop.set()
    assert not reads.are_over(is_emptied=True), "that read was made before"
    assert reads.have_begun()
    assert not reads.are_over(is_emptied=False)
    assert reads.are_over(is_emptied=True)


def test_a_port_that_is_never_empty_is_not_read_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(last_reads, "LAST_READS_S", 0.0)
    stop = threading.Event()
    stop.set()
    reads = LastReads(stop)
    assert reads.have_begun()
    assert reads.are_over(is_emptied=False)


def test_more_may_wait_behind_a_read_that_a_terminal_filled() -> None:
    assert more_may_wait(bytes(4095))
    assert not more_may_wait(b"one record\r\n")
