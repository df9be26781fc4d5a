"""The process of the gain meter, as the daemon sees it."""

from __future__ import annotations

import sys
import threading
from contextlib import closing

import pytest

from daemon.guide import meter_link
from daemon.guide.meter_link import Answer, MeterLink, Place
from daemon.host.ended_threads import EndedThreads
from tests.daemon.support.acquisition import wait_until

PLACE = Place("rigcal.sqlite", None, "")
DIES_IN_AN_ANSWER = """import sys
for _ in range(2):
    sys.stdin.readline()
sys.stdout.write('{"result": {"poses"')
"""


def test_a_process_that_ends_in_the_midst_of_an_answer_is_told_to_who_has_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(meter_link, "METER_COMMAND", (sys.executable, "-c", DIES_IN_AN_ANSWER))
    answers: list[Answer] = []
    told = threading.Event()

    def take(answer: Answer) -> None:
        answers.append(answer)
        told.set()

    with EndedThreads() as ended, closing(MeterLink(PLACE)) as link:
        link.ask({"do": "plan"}, take)
        assert told.wait(10.0)
        wait_until(lambda: not link.is_alive)
    assert answers == [{"error": "the gain meter's process has ended; it is being restarted"}]
    assert ended.found() == {}
