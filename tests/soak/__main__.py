"""`python -m tests.soak [--minutes 30] [--rate 4] [--seed K] [--report FILE]`: exit status 1 if a bar was missed."""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import threading
import time
from dataclasses import asdict
from pathlib import Path

from calibration.rig.description import shipped_rig
from daemon.control.server import ControlServer
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S
from tests.soak.consistency import inconsistencies, untruths
from tests.soak.daemon_process import DaemonProcess, Usage
from tests.soak.evidence import Watch, judge, turning, without_session
from tests.soak.faults import LINK, STATION, Mischief
from tests.soak.losses import account, read_wire_log, stored_gaps, stored_items
from tests.soak.memory import growth
from tests.soak.operator import Operator
from tests.soak.report import Report
from tests.soak.rig_process import RigProcess

SAMPLE_S = 5.0
KILLS = (0.04, 0.1, 0.97)  # shares of the time: one life is long enough to be watched for leaks
WARM_UP_S = 300.0
USUAL_MINUTES = 30.0
TAIL_NS = NS_PER_S  # what is sent within the last second before the daemon is told to stop need not be stored


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=USUAL_MINUTES, help="real time")
    parser.add_argument("--rate", type=float, default=4.0, help="simulated seconds per real second")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the report here as well")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep store and logs in this directory")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rigcal-soak-") as temporary:
        directory = temporary if options.keep is None else options.keep
        Path(directory).mkdir(parents=True, exist_ok=True)
        report = soak(Path(directory).resolve(), options.minutes, options.rate, options.seed)
    text = report.text()
    print(text)
    if options.report is not None:
        options.report.write_text(text + "\n", encoding="utf-8")
    return 1 if report.faults() else 0


def soak(directory: Path, minutes: float, rate: float, seed: int) -> Report:
    """Run a soak; shorter ones than usual are denser, and their warm-up is shorter."""
    rig = RigProcess(directory, rate, seed)
    hands = ControlServer(directory / "operator.sock", {"aim": lambda arguments: rig.aim(arguments["target"])})
    daemon = DaemonProcess(directory, rig, directory / "operator.sock")
    machine = shipped_rig("swdt82")
    watch = Watch(daemon, rig)
    mischief = Mischief(machine, rig, daemon, watch, seed, density=1.0 if minutes >= USUAL_MINUTES / 3 else 2.0)
    operator = Operator(daemon, rig, seed)
    samples: list[Usage] = []
    stop, stop_hands = threading.Event(), threading.Event()
    ended = ""
    try:
        rig.aim("r")
        daemon.start()
        threads = [
            threading.Thread(target=watch.look, args=(stop_hands,), name="look"),
            threading.Thread(target=watch.ask, args=(stop_hands,), name="ask"),
            threading.Thread(target=rig.drive, args=(stop_hands, random.Random(seed)), name="drive"),
            threading.Thread(target=operator.work, args=(stop,), name="operator"),
            threading.Thread(target=mischief.run, args=(stop,), name="mischief"),
        ]
        for thread in threads:
            thread.start()
        ended = _pass_time(minutes * 60, daemon, mischief, samples)
        stop.set()
        threads[-1].join()
        threads[-2].join()
        rig.clock.sleep(6.0)  # the last faults end, the watch sees it
        stop_hands.set()
        for thread in threads:
            thread.join()
        until_ns = rig.now_ns()
        stopped = daemon.stop() if daemon.is_alive() else (None, 0.0)
    finally:
        stop.set()
        stop_hands.set()
        daemon.close()
        hands.close()
        rig.close()
    (directory / "usage.json").write_text(json.dumps([asdict(sample) for sample in samples]), encoding="utf-8")
    wire = read_wire_log(rig.wire_log)
    with Reader(daemon.store) as reader:
        gaps = stored_gaps(reader)
        sent = {LINK: wire.frames, STATION: wire.station}
        accounts = {
            link: account(link, sent[link], stored_items(reader.captures(link)), gaps, until_ns - TAIL_NS)
            for link in sent
        }
        faults = inconsistencies(reader)
        observations, examples = untruths(reader, machine, wire, rate)
        unwatched = [*mischief.blackouts, *without_session(reader, until_ns), *turning(rig.turns_ns)]
    return Report(
        minutes=minutes,
        rate=rate,
        seed=seed,
        accounts=accounts,
        growth=growth(samples, WARM_UP_S * min(1.0, minutes / USUAL_MINUTES)),
        verdicts=judge(watch.cases, unwatched, rate, until_ns),
        inconsistencies=faults,
        observations=observations,
        examples=examples,
        stop=stopped,
        answers_s=watch.answers_s,
        done=operator.done,
        refused=operator.refused,
        ended=ended,
    )


def _pass_time(real_s: float, daemon: DaemonProcess, mischief: Mischief, samples: list[Usage]) -> str:
    """Watch what the daemon uses, and kill it now and then; why it ended early, "" if it did not."""
    begin = time.monotonic()
    kills = [begin + share * real_s for share in KILLS]
    while time.monotonic() < begin + real_s:
        time.sleep(min(SAMPLE_S, real_s / 60))
        if not daemon.is_alive():
            return f"the daemon ended by itself; see {daemon.directory}/daemon.log"
        usage = daemon.usage(mischief.hanging)
        if usage is not None:
            samples.append(usage)
        if kills and time.monotonic() >= kills[0]:
            kills.pop(0)
            mischief.kill_daemon()
    return ""


if __name__ == "__main__":
    sys.exit(main())
