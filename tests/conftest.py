"""What every test may rely on, whatever started the suite, and whose lines `make test GATES=yes` counts."""

from __future__ import annotations

import importlib
import io
import pkgutil
import signal
from collections.abc import Generator
from pathlib import Path

import pytest
from coverage import Coverage

import calibration
import daemon.store
import drivers

# Where what is gated is tested for its own sake. Elsewhere its lines do not count: what is reached by the way
# is not tested, and tracing doubles the time of everything that is written in Python.
COUNTED = (
    "tests/drivers/",
    "tests/golden/",
    "tests/daemon/store/",
    "tests/daemon/acquisition/test_redecoding.py",
    "tests/daemon/models/test_comparisons.py",
    "tests/daemon/models/test_registry.py",
    "tests/daemon/sessions/test_session_store_order.py",
    "tests/daemon/sessions/test_sessions.py",
    "tests/calibration/",
)
assert all((Path(__file__).parents[1] / place).exists() for place in COUNTED)

# A shell without job control starts what it sends to the background with SIGINT ignored, nohup starts all with SIGHUP
# ignored, and so do their children; tests that interrupt a process need them heard.
for heard, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(heard) is signal.SIG_IGN:
        signal.signal(heard, handler)


GATE_LINES = pytest.StashKey[list[str]]()

# What `make test GATES=yes` asks of each package, in per cent of lines.
GATES = {("drivers/*", "daemon/store/*"): 95.0, ("calibration/*",): 90.0}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--gates", action="store_true", help="fail if a package's coverage is below its gate")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Gate each package by itself; pytest-cov knows one gate for all, and pytest's summary stays the last line."""
    if not session.config.getoption("gates") or hasattr(session.config, "workerinput"):
        return
    reader = Coverage()
    reader.load()
    lines = []
    for include, least in GATES.items():
        reached = reader.report(include=list(include), file=io.StringIO())
        verdict = "reached" if reached >= least else "FAILED"
        lines.append(f"coverage of {', '.join(include)}: {reached:.1f} %, gate {least:.0f} % {verdict}")
        if reached < least:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
    session.config.stash[GATE_LINES] = lines


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for line in config.stash.get(GATE_LINES, []):
        terminalreporter.write_line(line)


def pytest_sessionstart() -> None:
    """Import what is gated while lines count, so that no test that does not count is the first to import a module."""
    if Coverage.current() is None:
        return
    for package in (drivers, daemon.store, calibration):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            importlib.import_module(module.name)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    coverage = None if item.nodeid.startswith(COUNTED) else Coverage.current()
    if coverage is None:
        return (yield)
    coverage.stop()
    try:
        return (yield)
    finally:
        coverage.start()
