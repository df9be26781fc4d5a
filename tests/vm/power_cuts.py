"""Power cuts of the service while it records, at any instant: no row that was committed may be missing.

The service records a simulated rig on a disk whose every write QEMU logs. A witness asks it how many captures are
stored, and writes each answer past all caches to a sector of the same disk, so that the log itself says what was
promised before any cut. Then the disk is rebuilt as many cuts would have left it, and the store on it is opened as the
service opens it.

The control is the same service with SQLite's `synchronous = OFF`: it must lose rows, or the test would see nothing.
"""

from __future__ import annotations

import random
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from daemon.store import Store
from daemon.store.errors import StoreError
from daemon.store.reader import Reader
from tests.vm.image import PYTHON, Image
from tests.vm.machine import Machine, MachineError
from tests.vm.service import CONFIG, PLACE, Service
from tests.vm.write_log import WriteLog

DISK_BYTES = 256 << 20
MARK = DISK_BYTES - 4096  # behind the file system
FILE_SYSTEM = "250M"
RECORD_S, CONTROL_S = 100.0, 30.0  # the first for long enough that chunks are packed as well
SEED = 1
UNSAFE = """from daemon.store.connection import Connection
prepare = Connection._prepare
def unsafe(self, connection):
    prepare(self, connection)
    connection.execute("PRAGMA synchronous = OFF")
Connection._prepare = unsafe
"""
RUN = "import sys\nfrom daemon.cli.main import main\nsys.exit(main())\n"
WITNESS = """import json, mmap, os, socket, sys, time
disk = os.open(sys.argv[1], os.O_RDWR | os.O_DIRECT)
page = mmap.mmap(-1, 4096)
until, seen = time.monotonic() + float(sys.argv[3]), 0
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(sys.argv[2])
    stream = connection.makefile("rwb")
    while time.monotonic() < until:
        stream.write(b'{"command": "status"}\\n')
        stream.flush()
        links = json.loads(stream.readline())["result"]["acquisition"]["links"]
        seen = sum(link["captures"] for link in links)
        page[:12] = b"%012d" % seen
        os.pwritev(disk, [page], int(sys.argv[4]))
        time.sleep(0.2)
print(seen)
"""


@dataclass(frozen=True)
class Cuts:
    """What cuts have shown.

    Attributes:
        tried: how many.
        bad: after how many rows that were promised were missing, or the store was damaged.
        most_lost: rows.
        promised: rows in the end.
        first_fault: a sentence on the first bad one.
    """

    tried: int
    bad: int
    most_lost: int
    promised: int
    first_fault: str = ""


def power_cuts(image: Image, directory: Path, cuts: int, say: Callable[[str], None]) -> tuple[Cuts, Cuts]:
    """Record on two disks, one of them the control's, and cut the power of each.

    Args:
        image: what is booted.
        directory: for disks and logs.
        cuts: how many of each.
        say: told what is done.

    Returns:
        Those of the service, those of the control.
    """
    disks = {"service": "/dev/vdb", "control": "/dev/vdc"}
    more = [word for name in disks for word in _logged_disk(directory, name)]
    with Machine(image, directory / "machine", more) as machine:
        service = Service(machine)
        service.install()
        service.start_rig("vcan0")
        for name, disk in disks.items():
            say(f"recording on the disk of the {name}")
            _record(service, name, disk, CONTROL_S if name == "control" else RECORD_S)
        machine.run("sync")
    found = []
    for name in disks:
        say(f"cutting the power of the {name}")
        found.append(_cut(directory, name, cuts))
    return found[0], found[1]


def _logged_disk(directory: Path, name: str) -> list[str]:
    directory.mkdir(parents=True, exist_ok=True)
    disk, log = directory / f"{name}.disk", directory / f"{name}.log"
    for path, size in ((disk, DISK_BYTES), (log, 4 << 30)):  # sparse
        with path.open("wb") as file:
            file.truncate(size)
    nodes = [f"driver=file,filename={disk},node-name={name}-disk", f"driver=file,filename={log},node-name={name}-log"]
    nodes += [f"driver=blklogwrites,file={name}-disk,log={name}-log,log-super-update-interval=1,node-name={name}"]
    options = [word for node in nodes for word in ("-blockdev", node)]
    return [*options, "-device", f"virtio-blk-pci,drive={name}"]


def _record(service: Service, name: str, disk: str, seconds: float) -> None:
    machine, place = service.machine, f"/media/{name}"
    machine.run(f"mke2fs -q -t ext4 {disk} {FILE_SYSTEM} && mkdir -p {place} && mount {disk} {place}")
    machine.run(f"chown rigcal:rigcal {place} && sync")
    config = f'state_directory = "{place}"\n{CONFIG.format(rig=PLACE, channel="vcan0")}\n[jobs]\nenabled = false\n'
    machine.write(f"/etc/rigcal/{name}.toml", config)
    program = (UNSAFE if name == "control" else "") + RUN
    machine.write(f"/usr/local/lib/{name}.py", program)
    unit = (
        "systemd-run -q --collect -p User=rigcal -p SupplementaryGroups=dialout -p Type=notify -p TimeoutStartSec=600"
    )
    start = f"{PYTHON} -I /usr/local/lib/{name}.py run --config /etc/rigcal/{name}.toml"
    machine.run(f"{unit} --unit={name} {start}", 900.0)
    witness = f"{disk} {place}/control.sock {seconds} {MARK}"
    machine.run(f"python3 -I -c {shlex.quote(WITNESS)} {witness}", seconds + 120.0)
    machine.run(f"systemctl kill -s KILL {name}")


def _cut(directory: Path, name: str, cuts: int) -> Cuts:
    log, rng = WriteLog(directory / f"{name}.log"), random.Random(SEED)
    marks = [number for number, entry in enumerate(log.entries) if entry.at == MARK and entry.size]
    if not marks:
        raise MachineError(f"the witness of the {name} has written nothing")
    points = sorted(rng.sample(range(marks[0], len(log.entries)), min(cuts, len(log.entries) - marks[0])))
    base, trial = directory / "base.disk", directory / "trial.disk"
    with base.open("wb") as file:
        file.truncate(DISK_BYTES)
    bad, lost, faults, done, promised = 0, [0], [""], 0, 0
    with base.open("r+b") as whole:
        for cut in points:
            flushed = log.last_flush(cut) + 1
            log.apply(whole, done, flushed)
            done = flushed
            whole.flush()
            subprocess.run(["cp", "--sparse=always", "--reflink=auto", base, trial], check=True)
            with trial.open("r+b") as torn:
                log.apply_part(torn, flushed, cut + 1, rng)
            last = max(number for number in marks if number <= cut)
            promised = int(log.data(log.entries[last])[:12])
            try:
                with _taken_out(trial, directory / "store") as store:
                    there, fault = _captures(store), ""
            except (StoreError, MachineError) as error:
                there, fault = 0, str(error)
            if fault or there < promised:
                bad += 1
                lost.append(promised - there)
                faults.append(f"cut at {cut}: {promised} rows promised, {there} there; {fault}")
    log.close()
    return Cuts(len(points), bad, max(lost), promised, faults[1] if bad else "")


@contextmanager
def _taken_out(disk: Path, place: Path) -> Iterator[Path]:
    """Replay the file system's journal as a boot does, and take the store out of it."""
    checked = subprocess.run(["e2fsck", "-fy", disk], capture_output=True, text=True, check=False)
    if checked.returncode > 1:
        raise MachineError(f"the file system is damaged: {checked.stdout.strip()[-200:]}")
    place.mkdir()
    try:
        for suffix in ("", "-wal"):
            target = place / f"rigcal.sqlite{suffix}"
            subprocess.run(
                ["debugfs", "-R", f"dump /rigcal.sqlite{suffix} {target}", disk], capture_output=True, check=True
            )
        yield place / "rigcal.sqlite"
    finally:
        shutil.rmtree(place)


def _captures(path: Path) -> int:
    """Open a store as the service does, check it, and count its captures, each of which is decoded."""
    if not path.is_file():
        return 0
    Store(path).close()
    with Reader(path) as reader:
        verdict = next(reader.rows("PRAGMA integrity_check"))
        if list(verdict.values()) != ["ok"]:
            raise StoreError(f"integrity check: {verdict}")
        return sum(1 for _ in reader.captures())
