"""States of the sources in which tests passed that take too long to be run for each change.

A file beside the tests names the state; it is committed with the change that needed it. Where it is that of another
state, as on a computer that runs the tests for a change that came without it, they run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
SKIPPED = {"__pycache__"}


class Passed:
    """Which state of the sources tests have passed in.

    Args:
        name: of the file in `tests/`.
        tested: files and directories that the tests are about, relative to `root`.
        is_test: whether a Python file in `tests/` is one of the tests.
        root: of the sources.
    """

    def __init__(
        self, name: str, tested: Iterable[str], is_test: Callable[[Path], bool] = lambda _: False, root: Path = ROOT
    ) -> None:
        self.path = root / "tests" / name
        self._root, self._tested, self._is_test = root, tuple(tested), is_test
        self._asked: str | None = None

    def state(self) -> str:
        """Return the SHA-256 of the names and contents of all files that the tests are about, and of the tests."""
        files = {path for place in self._tested for path in _files(self._root / place)}
        files |= {path for path in _files(self._root / "tests") if path.suffix == ".py" and self._is_test(path)}
        digest = hashlib.sha256()
        for path in sorted(files):
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            digest.update(f"{path.relative_to(self._root).as_posix()} {content}\n".encode())
        return digest.hexdigest()

    def holds(self) -> bool:
        """Return True if the tests have passed in the present state."""
        self._asked = self.state()
        return self.path.exists() and self.path.read_text("utf-8").strip() == self._asked

    def note(self) -> None:
        """Remember that the tests have passed, unless something has changed since `holds` was asked."""
        if self._asked == self.state():
            self.path.write_text(f"{self._asked}\n", "utf-8")
        else:
            print(f"Not noted in {self.path.name}: sources have changed while the tests ran.")


def _files(place: Path) -> list[Path]:
    if place.is_file():
        return [place]
    return [path for path in place.rglob("*") if path.is_file() and not SKIPPED & set(path.parts)]
