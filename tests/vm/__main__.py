"""The package on a real Debian 12 in QEMU, without KVM: `make vmtest`, `python -m tests.vm --only NAME`.

Boots the image once for each row of checks, and once more for power cuts: as many machines at once as there are
processors. Prints a line for each check with its figure, and ends with status 1 where one failed. Where the sources are
those of tests/vm.passed there is nothing to show.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from tests.passed import Passed
from tests.vm.checks import ROWS, Check
from tests.vm.image import CACHE, PYTHON, Image, NoDebianError, image, missing, packaged_changes
from tests.vm.machine import Machine, MachineError
from tests.vm.power_cuts import power_cuts
from tests.vm.service import Service

PASSED = Passed("vm.passed", ("deploy", "drivers", "daemon", "requirements.lock", "tests/vm", "tests/passed.py"))
HOST_PACKAGES = ("qemu-system-x86", "qemu-utils", "mmdebstrap", "e2fsprogs", "kmod", "cpio", "busybox-static")
CUTS = 60
POWER_CUTS = "power_cuts_lose_no_committed_row"
PROCESSOR = """import llvmlite.binding as llvm
print(llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())"""


class Table:
    """Lines with a name, what came of it, how long it took here, and a figure; several threads may show some.

    Args:
        until_s: when all ends, on the monotonic clock.

    Attributes:
        failed: names of those that failed.
        left_out: how many were not shown to their end by then.
    """

    def __init__(self, until_s: float = math.inf) -> None:
        self._until_s = until_s
        self.failed: list[str] = []
        self.left_out = 0
        self._one_at_a_time = threading.Lock()

    @property
    def is_over(self) -> bool:
        """Whether its time is."""
        return time.monotonic() > self._until_s

    @contextmanager
    def running(self, machine: Machine) -> Iterator[None]:
        """Cut a machine's power when the time is over."""
        if math.isinf(self._until_s):
            yield
            return
        timer = threading.Timer(self._until_s - time.monotonic(), machine.end)
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def leave_out(self, number: int) -> None:
        """Count some that are not shown for want of time."""
        with self._one_at_a_time:
            self.left_out += number

    def show(self, name: str, work: Callable[[], str]) -> bool:
        """Do something that is a line; returns whether it succeeded, or was left out for want of time."""
        if self.is_over:
            self.leave_out(1)
            return True
        began = time.monotonic()
        try:
            verdict, figure = "ok", work()
        except (MachineError, LookupError, TypeError, ValueError, OSError, subprocess.SubprocessError) as error:
            if self.is_over:
                self.leave_out(1)
                return True
            verdict, figure = "FAILED", f"{type(error).__name__}: {error}"
        with self._one_at_a_time:
            if verdict == "FAILED":
                self.failed.append(name)
            print(f"{name.replace('_', ' '):<55} {verdict:<6} {time.monotonic() - began:5.0f} s  {figure}", flush=True)
        return verdict == "ok"


def say(what: str) -> None:
    """Tell what is done."""
    print(f"  {what}", flush=True)


def processor_of(made: Image) -> dict[str, str]:
    """Return the processor's name and features, as numba sees them in the machine."""
    with tempfile.TemporaryDirectory(dir=CACHE) as scratch, Machine(made, Path(scratch)) as machine:
        name, _, features = machine.run(f"{PYTHON} -I -c '{PROCESSOR}'", 600.0).strip().partition(" ")
    return {"name": name, "features": features}


def show_all(made: Image, rows: Sequence[Sequence[Check]], cuts: int, table: Table) -> None:
    """Show everything, in as many machines at once as there are processors."""
    with tempfile.TemporaryDirectory(dir=CACHE, prefix="run-") as scratch:
        parts: list[Callable[[], object]] = [
            partial(_row, made, Path(scratch) / f"row-{n}", row, table) for n, row in enumerate(rows) if row
        ]
        if cuts:
            parts.append(partial(table.show, POWER_CUTS, partial(_cuts, made, Path(scratch) / "power", cuts)))
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
            for shown in [threads.submit(part) for part in parts]:
                shown.result()


def _row(made: Image, scratch: Path, checks: Sequence[Check], table: Table) -> None:
    """Boot a machine, and show checks in it one after the other."""
    if table.is_over:
        table.leave_out(len(checks))
        return
    with Machine(made, scratch) as machine, table.running(machine):
        say(f"booted in {machine.booted_s:.0f} s")
        service = Service(machine)
        shown: list[bool] = []
        try:
            service.install()
            for check in checks:
                shown.append(table.show(check.__name__, partial(check, service)))
                if not shown[-1]:
                    service.mend()
        except (MachineError, OSError):  # its power was cut between two checks
            if not table.is_over:
                raise
            table.leave_out(len(checks) - len(shown))
        if not all(shown) and not table.is_over:
            print(machine.tried("journalctl -b -u rigcal -n 60 --no-pager -o short-monotonic").output, flush=True)


def _cuts(made: Image, scratch: Path, cuts: int) -> str:
    ours, control = power_cuts(made, scratch, cuts, say)
    figure = f"{ours.bad} of {ours.tried} bad, {ours.promised} rows; control: {control.bad} of {control.tried} bad"
    if ours.bad or ours.tried < cuts:
        raise MachineError(f"{figure}; {ours.first_fault}")
    if not control.bad:
        raise MachineError(f"{figure}: without synchronous writes none was lost, so the test sees nothing")
    return f"{figure}, at most {control.most_lost} rows lost"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.vm", description=__doc__)
    parser.add_argument("--only", action="append", metavar="NAME", default=[], help="checks whose name has this in it")
    parser.add_argument("--minutes", type=float, default=math.inf, help="end after so many, whatever has been shown")
    parser.add_argument("--cuts", type=int, metavar="N", help=f"power cuts ({CUTS})")
    return parser.parse_args()


def main() -> int:
    """Command line."""
    options = _options()
    if PASSED.holds() and not options.only and options.cuts is None:
        print("The tests in a virtual machine passed in this state of the sources (tests/vm.passed).")
        return 0
    if missing() and os.geteuid() == 0:
        subprocess.run(["apt-get", "update", "-qq"], check=False)
        subprocess.run(["apt-get", "install", "-y", "-qq", *HOST_PACKAGES], check=False, stdout=subprocess.DEVNULL)
    if lacking := missing():
        print(f"skipped: the tests in a virtual machine need {', '.join(lacking)}")
        return 0
    if changed := packaged_changes():
        print(f"The package is made of the last commit; commit first:\n{changed}", file=sys.stderr)
        return 2
    began = time.monotonic()
    wanted = [name.replace(" ", "_") for name in options.only] or [""]
    rows = [[check for check in row if any(word in check.__name__ for word in wanted)] for row in ROWS]
    cuts = (options.cuts or CUTS) if any(word in POWER_CUTS for word in wanted) else 0
    table = Table(time.monotonic() + 60.0 * options.minutes)
    try:
        made = image(say, processor_of)
    except NoDebianError as error:
        print(f"skipped: the tests in a virtual machine need a Debian: {error}")
        return 0
    show_all(made, rows, cuts, table)
    took_min = (time.monotonic() - began) / 60
    print(f"{len(table.failed)} failed, {table.left_out} left out for want of time, in {took_min:.0f} min", flush=True)
    if not options.only and not table.failed and not table.left_out:
        PASSED.note()
    return 1 if table.failed else 0


if __name__ == "__main__":
    sys.exit(main())
