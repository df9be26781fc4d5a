"""How fast a store grows: `python -m tests.bench.store_growth [--minutes 10] [--keep FILE]`.

A simulated rig drives from pose to pose for so many minutes of its time: joints at 50 Hz with noise in the last bits of
their encoders, signals at 100 Hz, a station that speaks ten times a second, stamps that scatter as a kernel's do. What
acquisition does with it is done here without waiting: a commit every 50 ms, decoding, thinning, packing. At the end
every capture is read again and compared. Exit status 1: a capture is missing or another, or a bar is missed.
"""

from __future__ import annotations

import argparse
import contextlib
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from daemon.acquisition.link_decoders import LinkDecoders
from daemon.acquisition.thinning import Thinning
from daemon.composition import decoders
from daemon.config.config import parse_config
from daemon.rig_files import load_rig
from daemon.service import declare_channels
from daemon.store import Reader, Store
from daemon.store.upkeep.packing import SPAN_NS, Packing
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import CanCapture, Capture, SerialCapture
from simulators.devices.stations.total_station import StationSettings
from simulators.rig.truth import RigTruth
from simulators.rig_simulator import RigSimulator, SimulatorSettings

CONFIG = 'rig = "swdt82"\nstate_directory = "."\n[[can]]\nchannel = "can0"\n[[station]]\nserial.path = "/dev/station"\n'
JOINTS_S, SIGNALS_S, FIXES_S, COMMIT_S = 0.02, 0.01, 0.1, 0.05
FRAME_NS = 230_000  # 4 bytes at 500 kbit/s
LATE_NS = 15_000.0  # mean delay of a stamp
POSE_S, DWELL_S = 10.0, 3.0
FIRST_MB_H, LATER_MB_H = 40.0, 18.0
UTC_0_NS = 1_700_000_000 * NS_PER_S


def traffic(seconds: float, seed: int) -> Iterator[list[Capture]]:
    """Yield what each 50 ms bring on both links."""
    rig = load_rig("swdt82").rig
    settings = SimulatorSettings(
        sync_period_s=JOINTS_S, signal_period_s=SIGNALS_S, station=StationSettings(push_interval_s=FIXES_S)
    )
    simulator, rng = RigSimulator(RigTruth(rig, seed), seed, settings), np.random.default_rng(seed)
    simulator.aim("r", 0.0)
    last_ns, now_s, next_pose_s, commit_s = 0, 0.0, 0.0, COMMIT_S
    batch: list[Capture] = []
    while now_s < seconds:
        if now_s >= next_pose_s:
            pose = {joint.name: float(rng.uniform(*joint.limits)) for joint in rig.joints}
            simulator.move(pose, now_s, dwell_s=DWELL_S)
            next_pose_s += POSE_S
        out = simulator.poll(now_s)
        for frame in out.frames:
            last_ns = max(round(now_s * NS_PER_S), last_ns + FRAME_NS) + int(rng.exponential(LATE_NS))
            stamp = Stamp(UTC_0_NS + last_ns, last_ns, "bench")
            batch.append(CanCapture("boom", stamp, frame.arbitration_id, frame.data, frame.is_extended))
        if out.station:
            at_ns = round(now_s * NS_PER_S) + int(rng.exponential(10 * LATE_NS))
            batch.append(SerialCapture("station", Stamp(UTC_0_NS + at_ns, at_ns, "bench"), out.station))
        now_s = max(simulator.next_deadline(), now_s + 1e-6)
        while now_s >= commit_s:
            yield batch
            batch, commit_s = [], commit_s + COMMIT_S
    yield batch


def used_bytes(path: Path) -> dict[str, int]:
    """Return the bytes in use of every table and index, the largest first."""
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        found = db.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name ORDER BY 2 DESC").fetchall()
    return dict(found)


def main() -> int:
    """Print what an hour takes, fresh and packed, by table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    seconds = 60.0 * options.minutes
    source, settings = load_rig("swdt82"), parse_config(CONFIG, Path.cwd())
    sent: list[Capture] = []
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "rigcal.sqlite"
        with contextlib.closing(Store(path)) as store:
            declare_channels(store, source.rig)
            decoding = LinkDecoders(decoders(settings, source))
            thinning, packing = Thinning(lambda _: False), Packing(store)
            empty = used_bytes(path)
            for batch in traffic(seconds, options.seed):
                ids = store.append_captures(batch)
                with store.transaction():
                    store.insert_records(thinning.kept(decoding.feed_and_tick(batch)))
                    store.mark_decoded(ids)
                sent += batch
            fresh = used_bytes(path)
            while packing.pack_next():
                pass
            packed = used_bytes(path)
        with Reader(path) as reader:
            is_whole = all(
                list(reader.captures(link)) == [c for c in sent if c.link == link] for link in ("boom", "station")
            )
    rate = 3600.0 / seconds / 1e6
    print(f"{len(sent) / seconds:.0f} captures a second; MB an hour:")
    for name in fresh:
        small, large = ((own.get(name, 0) - empty.get(name, 0)) * rate for own in (fresh, packed))
        if max(small, large) > 0.05:
            print(f"  {name:32s} in small chunks {small:7.2f}   packed {large:7.2f}")
    small, large = ((sum(own.values()) - sum(empty.values())) * rate for own in (fresh, packed))
    print(f"  {'all':32s} in small chunks {small:7.2f}   packed {large:7.2f}")
    first = large + small * SPAN_NS / NS_PER_S / 3600.0
    print(f"a store's first hour, whose last minute lies in small chunks: {first:.1f} MB, bar {FIRST_MB_H:.0f}")
    print(f"an hour later on: {large:.1f} MB, bar {LATER_MB_H:.0f}")
    print(f"captures: {'each byte and stamp is there' if is_whole else 'NOT those that were sent'}")
    return int(not is_whole or first > FIRST_MB_H or large > LATER_MB_H)


if __name__ == "__main__":
    sys.exit(main())
