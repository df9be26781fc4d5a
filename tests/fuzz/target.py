"""What a target is, and where targets are found: every module in `targets` has a list of them."""

from __future__ import annotations

import atexit
import importlib
import os
import pkgutil
import random
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.fuzz import targets as folder

CORPUS = Path(__file__).parent / "corpus"
MESSAGE_MAX = 2100  # characters of a refusal, with what says where it comes from

Run = Callable[[bytes], None]


@dataclass(frozen=True)
class Target:
    """Something that takes bytes from elsewhere.

    Attributes:
        name: also of its corpus.
        prepare: gives the function that takes one input; what it raises is a fault. Called once a process.
        kind: how inputs are changed: as bytes, as lines of text, as JSON.
        words: that mean something in an input.
        change: in place of the general changes: random numbers, an input, the corpus.
        repair: makes check sums right again, most of the time.
        is_slow: an input takes over 50 us, so that time rather than a number of inputs says when it is enough.
        inputs_per_process: a fresh process after so many, for targets that keep state.
    """

    name: str
    prepare: Callable[[], Run]
    kind: Literal["bytes", "text", "json"] = "bytes"
    words: tuple[bytes, ...] = ()
    change: Callable[[random.Random, bytes, list[bytes]], bytes] | None = None
    repair: Callable[[random.Random, bytes], bytes] | None = None
    is_slow: bool = False
    inputs_per_process: int = 1_000_000

    def corpus(self) -> list[bytes]:
        """Its kept inputs, in the order of their names."""
        return [path.read_bytes() for path in sorted((CORPUS / self.name).glob("*")) if path.is_file()]


def find_targets(module: str | None = None) -> dict[str, Target]:
    """Targets by name: of one module, or of all in the folder."""
    names = [module] if module else [f"{folder.__name__}.{m.name}" for m in pkgutil.iter_modules(folder.__path__)]
    found = [target for name in names for target in importlib.import_module(name).TARGETS]
    return {target.name: target for target in sorted(found, key=lambda t: t.name)}


def check_refusal(error: Exception, place: str = "") -> None:
    """A refusal is one sentence that fits on a screen, and says which file it is about."""
    text = str(error)
    assert place in text, f"{place} is not named: {text}"
    assert 0 < len(text) <= MESSAGE_MAX, f"a refusal of {len(text)} characters: {text[:200]}"


def memory_directory() -> str | None:
    """Where files live in memory, None where nowhere: a disk would be what is tried."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def scratch_directory() -> Path:
    """A directory of this process's own, until it ends; a process that is killed leaves it to the runner's TMPDIR."""
    inside = None if "TMPDIR" in os.environ else memory_directory()
    directory = Path(tempfile.mkdtemp(prefix="rigcal-fuzz-", dir=inside))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return directory
