"""The SocketCAN benchmark counts every frame, and tells what the kernel lost from what rigcal dropped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.traffic import multicast_works

ROOT = Path(__file__).parents[3]


@pytest.mark.long
def test_a_short_benchmark_drops_nothing_and_no_stamp_goes_back() -> None:
    if not multicast_works(20_000 + os.getpid() % 20_000):
        pytest.skip("this host has no multicast")
    command = [sys.executable, "-m", "tests.bench.socketcan", "--seconds", "0.5", "--spinners", "1", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    rigcal, python_can = report["results"]
    assert report["sent"] == 4001
    assert rigcal["received"] + rigcal["lost_in_kernel"] == 4001
    assert (rigcal["dropped"], rigcal["doubtful"], rigcal["repeated"], rigcal["steps_back"]) == (0, 0, 0, 0)
    assert rigcal["early_max_ms"] < 1.0
    assert python_can["received"] + python_can["dropped"] == 4001
