"""The keeper of the labels, seen from the benchmark: a process that draws cases and keeps what is hidden in them.

It writes the observations of every case, and the labels under a one-time pad that it alone holds; the SHA-256 of the
labels is given before anything is analysed. It hands the pad out against the finished answers, and only then draws
the twins (the same machines and noise without their effects) that the scoring needs.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

# -P keeps the current directory off the process's path: what lies there is no code of ours.
KEEPER_COMMAND = (sys.executable, "-P", "-m", "simulators.keeper")
LABELS = "labels.sealed"
WRONG_OPTIONS = 2


class KeeperError(Exception):
    """The keeper refused, or handed out labels that are not those it had committed itself to."""


class NoSuchCasesError(KeeperError):
    """There are no cases as they were asked for; the message says what there is."""


@dataclass(frozen=True)
class Case:
    """What anyone may know of a case.

    Attributes:
        name: of the case; says nothing of its content.
        train: observations to analyse.
        held_out: readings of further poses, without positions.
        without: families to leave out of the library.
    """

    name: str
    train: Path
    held_out: Path
    without: tuple[str, ...]


class Keeper:
    """A running keeper; a context manager that ends it.

    Args:
        options: of `python -m simulators.keeper`.
        directory: where it writes.
        command: what to run.

    Attributes:
        commitment: SHA-256 of the labels, hexadecimal.
        cases: in no order that tells anything.

    Raises:
        NoSuchCasesError: it has no cases of these options.
        KeeperError: it did not start.
    """

    def __init__(self, options: Sequence[str], directory: Path, command: Sequence[str] = KEEPER_COMMAND) -> None:
        self._directory = directory
        self._process = subprocess.Popen(
            [*command, *options, "--out", str(directory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            sealed = self._hear("sealed")
        except KeeperError:
            self.close()
            raise
        self.commitment = str(sealed["commitment"])
        self.cases = tuple(
            Case(c["case"], directory / c["train"], directory / c["held_out"], tuple(c["without"]))
            for c in sealed["cases"]
        )

    def __enter__(self) -> Keeper:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def measure(self, case: str, poses: Sequence[Mapping[str, object]]) -> Path:
        """Observations of a case with further poses measured, as a plan's rows ask for them."""
        return self._directory / str(self._do("measure", "measured", case=case, poses=list(poses))["train"])

    def unseal(self, answers: Path) -> dict[str, Any]:
        """The labels, against the file of the answers; KeeperError if they are not those committed to."""
        told = self._do("unseal", "unsealed", answers=str(answers))
        expected = hashlib.sha256(answers.read_bytes()).hexdigest()
        if told["answers"] != expected:
            raise KeeperError(f"{answers} changed while it was handed in")
        sealed = (self._directory / LABELS).read_bytes()
        pad = (self._directory / told["pad"]).read_bytes()
        labels = bytes(a ^ b for a, b in zip(sealed, pad, strict=True))
        if hashlib.sha256(labels).hexdigest() != self.commitment:
            raise KeeperError(f"{self._directory / LABELS} does not hold the labels that were committed to")
        found: dict[str, Any] = json.loads(labels)
        return found

    def twins(self) -> dict[str, Path]:
        """Case -> observations of the same machine with the same noise and no effect; after unsealing only."""
        return {name: self._directory / path for name, path in self._do("twins", "twins")["cases"].items()}

    def close(self) -> None:
        """End the process."""
        if self._process.returncode is None:
            self._process.communicate()

    def _do(self, what: str, answer: str, **arguments: object) -> dict[str, Any]:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": what, **arguments}) + "\n")
            self._process.stdin.flush()
        except OSError as error:
            raise KeeperError(f"the keeper has ended: {error}") from error
        return self._hear(answer)

    def _hear(self, wanted: str) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            _, words = self._process.communicate()
            kind = NoSuchCasesError if self._process.returncode == WRONG_OPTIONS else KeeperError
            raise kind(words.strip() or "the keeper has ended without a word")
        said: dict[str, Any] = json.loads(line)
        if said["event"] != wanted:
            raise KeeperError(f"the keeper: {said.get('text', said)}")
        return said
