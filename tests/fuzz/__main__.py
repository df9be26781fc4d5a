"""`python -m tests.fuzz [TARGET...] [--inputs N] [--seconds S] [--seed K] [--jobs J] [--faults DIR] [--again]`.

A target that was measured in the present state of its sources goes on from there (`measured.py`).
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Lock

from tests.fuzz.measured import Measured
from tests.fuzz.runner import HANG_S, MEMORY_MB, Report, run_target
from tests.fuzz.target import Target, find_targets

_INPUTS, _SECONDS = 1_000_000, 3600.0


def main() -> int:
    targets = find_targets()
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Feed decoders, readers and commands.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"all by default: {', '.join(targets)}")
    parser.add_argument("--inputs", type=int, default=_INPUTS, help="for each target (default: %(default)s)")
    parser.add_argument(
        "--seconds",
        type=float,
        default=_SECONDS,
        help="at most, of the processor's time (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="targets at a time (default: 1)")
    parser.add_argument("--faults", type=Path, default=Path("fuzz-faults"), help="folder for inputs that find faults")
    parser.add_argument("--again", action="store_true", help="also what was measured in this state already")
    asked = parser.parse_args()
    unknown = sorted(set(asked.targets) - set(targets))
    if unknown:
        parser.error(f"there is no target {unknown[0]!r}; there are {', '.join(targets)}")
    measured = Measured(asked.seed)
    options = {"inputs": asked.inputs, "seconds": asked.seconds, "seed": asked.seed, "faults": asked.faults}
    run = partial(_run, measured=measured, lock=Lock(), is_new=asked.again, **options)
    print(f"{'target':<20}{'inputs':>10}{'us each':>10}{'slowest s':>11}{'crashes':>9}{'hangs':>7}{'peak MB':>9}")
    with ThreadPoolExecutor(asked.jobs) as pool:
        reports = list(pool.map(run, (targets[name] for name in asked.targets or targets)))
    bad = [report.name for report in reports if not report.is_clean]
    print(f"faults in {', '.join(bad)}; inputs in {asked.faults}" if bad else "no faults")
    print(f"a hang is over {HANG_S:g} s, memory over {MEMORY_MB} MB beyond the target's own is a crash")
    return 1 if bad else 0


def _run(
    target: Target,
    *,
    measured: Measured,
    lock: Lock,
    is_new: bool,
    inputs: int,
    seconds: float,
    seed: int,
    faults: Path,
) -> Report:
    def note(report: Report) -> None:
        with lock:
            measured.note(target, report)

    with lock:
        before = measured.report(target)
    report = run_target(
        target,
        faults / target.name,
        inputs=inputs,
        seconds=seconds,
        seed=seed,
        report=Report(target.name) if is_new else before,
        each=note,
    )
    each_us = report.spent_s / max(1, report.inputs) * 1e6
    row = f"{report.name:<20}{report.inputs:>10}{each_us:>10.1f}{report.slowest_s:>11.2f}"
    row += f"{report.crashes:>9}{report.hangs:>7}{report.peak_mb:>9.0f}"
    told = [f"\n    {how}: {count}" for how, count in (report.faults + report.deaths).most_common()]
    print(row + "".join(told), flush=True)
    return report


if __name__ == "__main__":
    sys.exit(main())
