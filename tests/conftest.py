"""What every test may rely on, whatever started the suite, and whose lines `make test` counts."""

from __future__ import annotations

import signal
from collections.abc import Generator
from pathlib import Path

import pytest
from coverage import Coverage

# Where drivers and store are tested for their own sake. Elsewhere their lines do not count: what is reached by the way
# is not tested, and tracing doubles the time of everything that is written in Python.
COUNTED = ("tests/drivers/", "tests/golden/", "tests/daemon/store/")
assert all((Path(__file__).parents[1] / folder).is_dir() for folder in COUNTED)

# A shell without job control starts what it sends to the background with SIGINT ignored, and so do its children; tests
# that interrupt a process need it heard.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


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
