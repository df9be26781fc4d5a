"""A fleet: `python -m tests.bench.fleet [--rigs 1000] [--fixes 200] [--compare 200] [--gap]`.

Simulated rigs of one drawing (`tests.simulated.fleet`): swdt82, each built within its tolerances, random poses with a
prism in turn, 1 mm of noise on each coordinate; one length is wrong in the drawing of all, one rig in fifty has another
boom. By default kinematics are identified without a search for effects (`rigcal fleet --no-gap`); `--gap` searches.

First some of the rigs are done with one worker and with two, whose workers are killed again and again in a third run:
the answers must be the same. Then the whole fleet is done with two workers. Exit status 1: two workers do less than 1.8
times the work of one, an answer is missing or another, or the common error or an odd rig is not found.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from daemon.fleet.assess import FleetSettings
from daemon.fleet.comparison import compare
from daemon.fleet.run import RESULTS, Answer, Cluster, Told, assess_all, local_workers
from daemon.fleet.sources import find_rigs
from daemon.fleet.table import write_table
from daemon.warm_up import prepare
from tests.simulated.fleet import COMMON, ODD, simulated_rig, write_rig

BAR = 1.8
KILL_EVERY = 25  # answers


def run(
    directories: Sequence[Path], out: Path, client: Any, settings: FleetSettings, told: Told = lambda *_: None
) -> tuple[list[Answer], float]:
    """Assess rigs; return the answers and the seconds that it took."""
    sources = find_rigs(directories, None, None)
    begin = time.perf_counter()
    answers = assess_all(sources, settings, out, Cluster(client), told)
    return answers, time.perf_counter() - begin


def plain(answers: Sequence[Answer]) -> list[str]:
    """Return answers as text, to be compared."""
    return [json.dumps(answer, sort_keys=True) for answer in answers]


class Killer:
    """Kills a worker process after every few answers.

    Args:
        client: of the workers.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self.killed = 0

    def __call__(self, done: int, of: int, name: str) -> None:
        if done % KILL_EVERY == 0 and done < of:
            pids = sorted(self._client.run(os.getpid, on_error="ignore").values())
            if pids:
                os.kill(pids[self.killed % len(pids)], signal.SIGKILL)
                self.killed += 1


def scaling(directories: Sequence[Path], scratch: Path, settings: FleetSettings, rounds: int) -> bool:
    """Compare one worker with two, in turn, and with two that are killed; returns whether the bars are held."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    first: list[str] | None = None
    is_same = True
    for turn in range(rounds):
        for count in (1, 2):
            with local_workers(count) as client:
                run(directories[: 2 * count], scratch / f"warm-{turn}-{count}", client, settings)
                answers, took = run(directories, scratch / f"{turn}-{count}", client, settings)
            seconds[count].append(took)
            first = first or plain(answers)
            is_same = is_same and plain(answers) == first
            rate = 3600 * len(answers) / took
            print(
                f"  {count} worker{'s' * (count > 1)}: {len(answers)} rigs in {took:.1f} s, {rate:.0f} an hour",
                flush=True,
            )
    ratio = min(seconds[1]) / min(seconds[2])
    print(f"two workers do {ratio:.2f} times the work of one, bar {BAR}")
    with local_workers(2) as client:
        killer = Killer(client)
        answers, took = run(directories, scratch / "killed", client, settings, killer)
    is_same = is_same and plain(answers) == first
    print(f"with {killer.killed} workers killed: {len(answers)} rigs in {took:.1f} s")
    print(f"answers: {'all the same' if is_same else 'NOT the same'}")
    return ratio >= BAR and is_same


def whole(directories: Sequence[Path], odd: set[str], out: Path, settings: FleetSettings) -> bool:
    """Do the whole fleet; returns whether what is common and who is odd were found."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with local_workers(2) as client:
        answers, took = run(directories, out, client, settings)
    rate = 3600 * len(answers) / took
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(
        f"{len(answers)} rigs in {took:.0f} s with two workers, {rate:.0f} an hour; the client grew by {grown:.0f} MiB"
    )
    begin = time.perf_counter()
    fleet = compare(answers)
    (group,) = fleet.groups
    table = write_table(fleet, out)
    print(f"compared in {time.perf_counter() - begin:.1f} s; {table.name} has {table.stat().st_size / 2**20:.1f} MiB")
    print("in common: " + ", ".join(f"{q.name} {q.fleet.mean:+.2f} {q.unit}" for q in group.common[:5]))
    found = {a["name"] for n, a in enumerate(group.answers) if any(q.name == ODD for q in group.outlying(n))}
    others = {a["name"] for n, a in enumerate(group.answers) if group.outlying(n)} - odd
    print(f"odd rigs: {len(found & odd)} of {len(odd)} found, {len(others)} others of {len(answers) - len(odd)} named")
    is_common = any(quantity.name == COMMON for quantity in group.common)
    is_whole = not fleet.failed and len(list((out / RESULTS).glob("*.json"))) == len(directories)
    return is_whole and is_common and odd <= found


def main() -> int:
    """Make the fleet, and print what its computer does with it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=1000)
    parser.add_argument("--fixes", type=int, default=200)
    parser.add_argument("--compare", type=int, default=200, help="rigs by which workers are compared; 0 for none")
    parser.add_argument("--rounds", type=int, default=2, help="of one worker and two in turn; the quickest counts")
    parser.add_argument("--gap", action="store_true", help="search for effects in each rig")
    options = parser.parse_args()
    prepare()
    settings = FleetSettings(gap=options.gap)
    with tempfile.TemporaryDirectory() as directory:
        scratch = Path(directory)
        begin = time.perf_counter()
        rigs = [simulated_rig(number, options.fixes) for number in range(options.rigs)]
        directories = [write_rig(scratch / "rigs", rig) for rig in rigs]
        print(f"{len(rigs)} rigs of {options.fixes} fixes simulated in {time.perf_counter() - begin:.0f} s", flush=True)
        is_held = True
        if options.compare:
            is_held = scaling(directories[: options.compare], scratch, settings, options.rounds)
        odd = {rig.name for rig in rigs if rig.is_odd}
        return int(not (whole(directories, odd, scratch / "out", settings) and is_held))


if __name__ == "__main__":
    sys.exit(main())
