"""What each target was fed in the present state of the sources that it runs, so that a run goes on with what is left.

The file `measured.json` is committed: an hour of every target is not spent again for a change somewhere else.
"""

from __future__ import annotations

import ast
import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import grimp

from tests.fuzz.runner import Report
from tests.fuzz.target import Target
from tests.passed import ROOT

FILE = Path(__file__).with_name("measured.json")
_PACKAGES = ("calibration", "daemon", "drivers", "rigcal", "simulators", "tests")
_LIBRARIES = "requirements.lock"


class Measured:
    """Clean reports of targets, each with the state of the sources that it was measured in.

    Args:
        seed: of the inputs; what was measured with another seed does not count.
        file: where they are kept.
    """

    def __init__(self, seed: int, file: Path = FILE) -> None:
        self._seed, self._file = seed, file
        self._graph = grimp.build_graph(*_PACKAGES, cache_dir=None)
        self._states: dict[str, str] = {}

    def report(self, target: Target) -> Report:
        """Return what was measured of a target in the present state; a report of no inputs if nothing was."""
        self._states[target.name] = self.state(target)
        kept = self._read().get(target.name)
        if kept is None or (kept.pop("state"), kept.pop("seed")) != (self._states[target.name], self._seed):
            return Report(target.name)
        return Report(target.name, **kept)

    def note(self, target: Target, report: Report) -> None:
        """Keep a clean report, unless the sources have changed since `report` was asked; forget one with faults."""
        everything = self._read()
        everything.pop(target.name, None)
        state = self.state(target)
        if report.is_clean and state == self._states[target.name]:
            figures = {key: value for key, value in asdict(report).items() if key not in ("name", "faults", "deaths")}
            rounded = {key: round(value, 3) if isinstance(value, float) else value for key, value in figures.items()}
            everything[target.name] = {"state": state, "seed": self._seed, **rounded}
        self._file.write_text(json.dumps(everything, indent=1, sort_keys=True) + "\n", encoding="utf-8")

    def state(self, target: Target) -> str:
        """Return the SHA-256 of all sources that a target runs, without comments: its module, and what that imports."""
        module = target.prepare.__module__
        reached = {
            name
            for name in self._graph.find_upstream_modules(module) | {module}
            if name == module or not name.startswith("tests.fuzz.")
        }
        files: set[str] = {_LIBRARIES}
        for name in sorted(reached):
            place = Path(*name.split("."))
            files.add(f"{place}.py" if (ROOT / f"{place}.py").exists() else f"{place}/__init__.py")
        digest = hashlib.sha256()
        for file in sorted(files):
            digest.update(f"{file} {hashlib.sha256(_content(ROOT / file)).hexdigest()}\n".encode())
        return digest.hexdigest()

    def _read(self) -> dict[str, dict[str, Any]]:
        if not self._file.exists():
            return {}
        kept: dict[str, dict[str, Any]] = json.loads(self._file.read_text(encoding="utf-8"))
        return kept


def _content(path: Path) -> bytes:
    content = path.read_bytes()
    return ast.dump(ast.parse(content)).encode() if path.suffix == ".py" else content
