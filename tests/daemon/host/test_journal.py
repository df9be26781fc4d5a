"""Log lines in the journal and elsewhere: real processes, with standard error in a file that JOURNAL_STREAM names."""

import logging
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.jobs.child import JobChild
from daemon.jobs.order import Order, Outcome
from daemon.store.store import Store

LOGS = """
import logging, sys, threading, warnings
from daemon.host.systemd import set_up_logging
set_up_logging()
log = logging.getLogger("rigcal")
log.info("all is well")
log.warning("set-up %s moved", "a\\n<0>b\\x1b[2J\\u202e")
try:
    raise ValueError("two\\nlines")
except ValueError:
    log.exception("it failed")
warnings.warn("a library warns")
thread = threading.Thread(target=lambda: 1 / 0, name="worker")
thread.start()
thread.join()
"""


def run(directory: Path, *command: str, journal: bool = True) -> list[str]:
    """What a process writes on standard error, line by line."""
    path = directory / "stderr"
    with path.open("w") as errors:
        found = os.fstat(errors.fileno())
        # Children of the service inherit the variable: it counts only for the stream that it names.
        stream = f"{found.st_dev}:{found.st_ino}" if journal else f"{found.st_dev}:{found.st_ino + 1}"
        subprocess.run(command, stderr=errors, env=os.environ | {"JOURNAL_STREAM": stream}, check=False)
    return path.read_text(encoding="utf-8").splitlines()


def test_lines_in_the_journal_carry_priorities_and_no_time(tmp_path: Path) -> None:
    lines = run(tmp_path, sys.executable, "-c", LOGS)
    assert lines[0] == "<6>rigcal: all is well"
    assert lines[1] == r"<4>rigcal: set-up a\n<0>b\x1b[2J\u202e moved"
    assert lines[2] == "<3>rigcal: it failed"
    assert lines[3] == "<3>    Traceback (most recent call last):"
    assert all(re.match(r"<[23467]>", line) for line in lines), lines
    assert any(line.startswith("<4>py.warnings: ") and "a library warns" in line for line in lines)
    assert "<2>daemon.host.ended_threads: thread worker has ended" in lines


def test_lines_elsewhere_carry_the_time_and_no_priority(tmp_path: Path) -> None:
    lines = run(tmp_path, sys.executable, "-c", LOGS, journal=False)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO rigcal: all is well", lines[0])
    assert re.fullmatch(r"\S+ \S+ WARNING rigcal: set-up a\\n<0>b\\x1b\[2J\\u202e moved", lines[1])
    assert all(re.match(r"\d{4}-| {4}", line) for line in lines), lines


def test_what_is_quoted_begins_no_line_of_its_own(tmp_path: Path) -> None:
    for journal in (True, False):
        lines = run(tmp_path, sys.executable, "-c", LOGS, journal=journal)
        assert not any(line.startswith(("<0>", "lines")) for line in lines)


def test_why_the_service_does_not_start_is_an_error_of_the_journal(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.toml")
    lines = run(tmp_path, sys.executable, "-m", "daemon.cli.main", "run", "--config", missing)
    assert lines == [f"<3>Error: {missing}: cannot be read: No such file or directory"]


# ---- jobs ------------------------------------------------------------------------------------------------------------


def follow(order: Order, *command: str) -> Outcome:
    with JobChild(order, command) if command else JobChild(order) as child:
        while True:
            said = child.next_message(60.0)
            assert said is not None
            if isinstance(said, Outcome):
                return said


def order(directory: Path, sessions: Sequence[str] = ()) -> Order:
    return Order("gap", 7, str(directory / "none.sqlite"), str(directory), tuple(sessions), seed=1)


def said(caplog: pytest.LogCaptureFixture) -> list[tuple[int, str]]:
    return [(r.levelno, r.getMessage()) for r in caplog.records if r.name == "daemon.jobs.child"]


def test_a_jobs_lines_are_logged_as_important_as_they_are(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = """
import sys
sys.stdin.readline()
sys.stderr.buffer.write(b"<6>info\\n<4>warning\\n<3>error\\na library\\xff\\n<9>odd\\n")
sys.stderr.flush()
print('{"result": {}}', flush=True)
"""
    with caplog.at_level(logging.DEBUG):
        assert follow(order(tmp_path), sys.executable, "-c", script).state == "done"
    assert said(caplog) == [
        (logging.INFO, "job 7: info"),
        (logging.WARNING, "job 7: warning"),
        (logging.ERROR, "job 7: error"),
        (logging.WARNING, "job 7: a library\N{REPLACEMENT CHARACTER}"),
        (logging.WARNING, "job 7: <9>odd"),
    ]


def test_a_real_job_that_stumbles_leaves_its_traceback_as_errors(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Store(tmp_path / "none.sqlite").close()
    with caplog.at_level(logging.INFO):
        unknown = replace(order(tmp_path), session_ids=("s001-r",))  # no session: a fault inside, not of the data
        assert follow(unknown).state == "failed"
    lines = said(caplog)
    assert (logging.ERROR, "job 7: __main__: gap failed") in lines
    assert any(level == logging.ERROR and "Traceback" in text for level, text in lines)


def test_a_job_whose_sessions_are_used_no_more_fails_with_a_sentence(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Store(tmp_path / "none.sqlite").close()
    outcome = follow(order(tmp_path))
    assert outcome.state == "failed"
    assert "none that the job was queued for can be used any more" in str(outcome.error)
    assert not any("Traceback" in text for _, text in said(caplog))
