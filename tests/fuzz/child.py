"""The process that is fed: `python -m tests.fuzz.child MODULE TARGET SHARED FAULTS SEED FIRST COUNT SECONDS MEMORY_MB`.

Each input is written into the shared file before it is tried, so that whoever watches knows it when this process hangs
or dies. Faults are written to the folder FAULTS as they are found. The last line says how it went.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import random
import struct
import sys
import time
import traceback
import warnings
from pathlib import Path

from daemon.models.first_load import limit_memory
from tests.fuzz.mutate import SIZE_MAX, mutate
from tests.fuzz.target import Target, find_targets

# Number of the input, when it was begun (monotonic ns, 0 between inputs), by the processor's time (ns), its length
HEADER = struct.Struct("<QQQQ")
SHARED_BYTES = HEADER.size + SIZE_MAX
_ALIKE_MAX = 3  # faults at one place that are kept


def an_input(target: Target, corpus: list[bytes], seed: int, number: int) -> bytes:
    """Input `number`: first the corpus as it is, then changes of it."""
    if number < len(corpus):
        return corpus[number]
    return mutate(random.Random(f"{seed}:{target.name}:{number}"), target, corpus)


def place_of(error: BaseException) -> str:
    """What was raised and where, to tell faults apart."""
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"


def save(folder: Path, data: bytes, about: str) -> None:
    """Keep an input that found a fault, with what it found."""
    folder.mkdir(parents=True, exist_ok=True)
    name = hashlib.sha256(data).hexdigest()[:12]
    (folder / name).write_bytes(data)
    (folder / f"{name}.txt").write_text(about, encoding="utf-8", errors="backslashreplace")


def memory_mb(key: str) -> float:
    """A line of /proc/self/status, in MB."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:")) / 1024


def main() -> None:
    module, name, shared_path, faults, *numbers = sys.argv[1:]
    seed, first, count, seconds, most_mb = map(int, numbers)
    target = find_targets(module or None)[name]
    warnings.simplefilter("ignore")
    corpus = target.corpus()
    run = target.prepare()
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak so far is that of the preparation
    before_mb = memory_mb("VmRSS")
    if most_mb:
        limit_memory(most_mb << 20)
    found: dict[str, int] = {}
    slowest_ns = spent_ns = 0
    begun_ns = time.process_time_ns()
    with Path(shared_path).open("r+b") as file, mmap.mmap(file.fileno(), SHARED_BYTES) as shared:
        number = first
        while number < first + count and time.process_time_ns() < begun_ns + seconds * 1_000_000_000:
            try:
                data = an_input(target, corpus, seed, number)
            except MemoryError:  # of the change, not of the target
                number += 1
                continue
            shared[HEADER.size : HEADER.size + len(data)] = data
            began_ns = time.process_time_ns()
            shared[: HEADER.size] = HEADER.pack(number, time.monotonic_ns(), began_ns, len(data))
            try:
                run(data)
            except Exception as error:  # noqa: BLE001 - that is what is looked for
                place = place_of(error)
                found[place] = found.get(place, 0) + 1
                if found[place] <= _ALIKE_MAX:
                    save(Path(faults), data, f"{place}\n\n{traceback.format_exc()}")
            took_ns = time.process_time_ns() - began_ns
            slowest_ns, spent_ns = max(slowest_ns, took_ns), spent_ns + took_ns
            number += 1
            shared[: HEADER.size] = HEADER.pack(number, 0, 0, 0)
    result = {
        "inputs": number - first,
        "fed_s": (time.process_time_ns() - begun_ns) / 1e9,
        "spent_s": spent_ns / 1e9,
        "slowest_s": slowest_ns / 1e9,
        "faults": found,
        "peak_mb": max(0.0, memory_mb("VmHWM") - before_mb),
    }
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
