"""Watches the process that is fed: one that hangs or dies is ended, its input is kept, and the rest goes on."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzz.child import HEADER, SHARED_BYTES, save
from tests.fuzz.target import Target, memory_directory

HANG_S = 5.0
MEMORY_MB = 500
_POLL_S = 0.1
_WAITS = 12  # hangs that do not use the processor: other processes may keep it busy
_SLICE_S = (
    300.0  # of the processor's time, that one process is fed: what it reports is lost if it is ended from outside
)
_START_S = 300.0  # to prepare a target: kernels may have to be compiled


@dataclass
class Report:
    """How a target did.

    Attributes:
        name: of the target.
        inputs: how many were tried.
        fed_s: of the processor's time, with what it takes to make the inputs.
        spent_s: of the processor's time, in the target itself.
        slowest_s: the slowest input.
        faults: what was raised and where -> how often.
        deaths: how the process died -> how often.
        hangs: inputs that took longer than HANG_S.
        peak_mb: memory beyond what the target has at rest.
    """

    name: str
    inputs: int = 0
    fed_s: float = 0.0
    spent_s: float = 0.0
    slowest_s: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    deaths: Counter[str] = field(default_factory=Counter)
    hangs: int = 0
    peak_mb: float = 0.0

    @property
    def is_clean(self) -> bool:
        """No input found a fault."""
        return not self.faults and not self.deaths and not self.hangs and self.peak_mb <= MEMORY_MB

    @property
    def crashes(self) -> int:
        """Inputs that raised what they must not, or killed the process."""
        return self.faults.total() + self.deaths.total()


def run_target(
    target: Target,
    faults: Path,
    *,
    inputs: int,
    seconds: float,
    seed: int = 1,
    module: str = "",
    hang_s: float = HANG_S,
    memory_mb: int = MEMORY_MB,
    report: Report | None = None,
    each: Callable[[Report], None] = lambda _: None,
) -> Report:
    """Feed a target until it has had so many inputs, or so many seconds of the processor's time.

    Args:
        target: which.
        faults: folder for inputs that find faults.
        inputs, seconds: whichever comes first.
        seed: of the inputs.
        module: where the target is defined; by default it is looked for in the folder of targets.
        hang_s: an input may take no longer of the processor's time.
        memory_mb: beyond what the target has at rest.
        report: of an earlier run with the same seed, which goes on.
        each: called with the report after every process.
    """
    report = report or Report(target.name)
    while report.inputs < inputs and report.fed_s < seconds:
        count = min(inputs - report.inputs, target.inputs_per_process)
        slice_s = math.ceil(min(_SLICE_S, seconds - report.fed_s))
        _run_process(target, report, faults, [seed, report.inputs, count, slice_s, memory_mb], module, hang_s)
        each(report)
    return report


def _run_process(target: Target, report: Report, faults: Path, numbers: list[int], module: str, hang_s: float) -> None:
    first = numbers[1]
    with (
        tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory_directory()) as scratch,
        tempfile.TemporaryFile() as errors,
    ):
        shared = Path(scratch) / "shared"
        shared.write_bytes(bytes(SHARED_BYTES))
        command = [sys.executable, "-m", "tests.fuzz.child", module, target.name, str(shared), str(faults)]
        process = subprocess.Popen(
            [*command, *map(str, numbers)],
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,
            env=os.environ | {"TMPDIR": scratch},
        )
        number, data, is_hung = _watch(process, shared, hang_s)
        assert process.stdout is not None
        told = process.stdout.read()
        process.stdout.close()
        if process.returncode == 0:
            result = json.loads(told.splitlines()[-1])
            report.inputs += result["inputs"]
            report.fed_s += result["fed_s"]
            report.spent_s += result["spent_s"]
            report.slowest_s = max(report.slowest_s, result["slowest_s"])
            report.faults.update(result["faults"])
            report.peak_mb = max(report.peak_mb, result["peak_mb"])
            return
        errors.seek(0)
        said = errors.read()[-4000:].decode("utf-8", "replace")
        if data is None:
            raise RuntimeError(f"{target.name}: the process ended between inputs: {said}")
        report.inputs = number + 1 if number >= first else report.inputs + 1
        if is_hung:
            report.hangs += 1
            report.slowest_s = max(report.slowest_s, hang_s)
            save(faults, data, f"took longer than {hang_s:g} s")
        else:
            how = f"ended with status {process.returncode}"
            report.deaths[how] += 1
            save(faults, data, f"{how}\n\n{said}")


def _watch(process: subprocess.Popen[bytes], shared: Path, hang_s: float) -> tuple[int, bytes | None, bool]:
    """Wait for the end of the process; the input that it was at, None between inputs; whether it had to be ended."""
    begun_ns = time.monotonic_ns()
    with shared.open("rb", buffering=0) as file:
        while True:
            ended = process.poll() is not None
            file.seek(0)
            number, began_ns, processor_ns, length = HEADER.unpack(file.read(HEADER.size))
            data = file.read(length) if began_ns else None
            if ended:
                return number, data, False
            waited_s = (time.monotonic_ns() - (began_ns or begun_ns)) / 1e9
            if began_ns:
                is_over = waited_s > hang_s and _processor_s(process.pid) - processor_ns / 1e9 > hang_s
                is_over = is_over or waited_s > _WAITS * hang_s
            else:
                is_over = number == 0 and waited_s > _START_S
            if is_over:
                process.kill()
                process.wait()
                return number, data, began_ns > 0
            time.sleep(_POLL_S)


def _processor_s(pid: int) -> float:
    """The processor's time that a process has had."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
