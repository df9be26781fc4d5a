"""`python -m simulators.keeper`: draws cases with hidden effects, and keeps what is hidden until answers are there.

Commands and answers are JSON objects, one a line. At the start the keeper writes the observations of every case, and
the labels XORed with a random pad as long as they are, which is in its memory alone; the SHA-256 of the labels is told
at once, so that they cannot be changed later.

    {"event": "sealed", "commitment": SHA256, "cases": [{"case", "train", "held_out", "without"}...]}
    {"do": "measure", "case", "poses": [row...]}  ->  {"event": "measured", "case", "train"}    before unsealing only
    {"do": "unseal", "answers": FILE}             ->  {"event": "unsealed", "answers": SHA256, "pad"}    once
    {"do": "twins"}                               ->  {"event": "twins", "cases": {CASE: CSV}}    after unsealing only

Anything that cannot be done is answered {"event": "refused", "text"}. The end of standard input ends the keeper.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import secrets
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from calibration.errors import RigError
from calibration.rig import Rig
from simulators.cases import RULES, Drawn, draw, families, has_twin, measured, twin
from simulators.cells import ALIASES, KINDS, NOISES, POSES, REPORTED_FROM, SIZES, Cell, Selection, full_plan, short_plan
from simulators.effects.spec import OUTSIDE
from simulators.rigs import load_rig

SEALED, PAD = "labels.sealed", "labels.pad"

# Runs a function on each of many cells.
Map = Callable[[Callable[[Cell], Any], Iterable[Cell]], Iterator[Any]]


class Refused(Exception):  # noqa: N818 - an answer, and no failure of the program
    """What was asked for cannot be done, or not now."""


class Keeper:
    """Cases and the pad of their labels.

    Args:
        rig: that all cases are of.
        plan: cells to draw.
        directory: where observations and sealed labels go.
        shuffle: puts a list into an order that tells nothing.
        pad: so many random bytes.
        each: runs a function on each of many cells.
    """

    def __init__(
        self,
        rig: Rig,
        plan: Sequence[Cell],
        directory: Path,
        shuffle: Callable[[list[str]], None],
        pad: Callable[[int], bytes],
        each: Map,
    ) -> None:
        self._rig, self._directory, self._each = rig, directory, each
        names = [f"case-{number:05d}" for number in range(len(plan))]
        shuffle(names)
        self._cells: dict[str, Cell] = {}
        self._public: list[dict[str, Any]] = []
        labels: list[dict[str, Any]] = []
        dropped: Counter[str] = Counter()
        for name, cell, drawn in zip(names, plan, each(partial(draw, rig), plan), strict=True):
            if drawn is None:
                dropped[f"{cell.families[0]} {cell.poses} {cell.noise} {cell.size:g}x"] += 1
            else:
                self._cells[name] = cell
                labels.append({"case": name, **drawn.label})
                self._public.append(self._publish(name, drawn))
        sealed = {"rules": list(RULES), "dropped": dropped, "labels": labels}
        self._labels = json.dumps(sealed).encode()
        self._pad = pad(len(self._labels))
        self._is_open = False

    def seal(self) -> dict[str, Any]:
        """Write the sealed labels, and tell their hash and all that may be known of the cases."""
        sealed = bytes(a ^ b for a, b in zip(self._labels, self._pad, strict=True))
        (self._directory / SEALED).write_bytes(sealed)
        commitment = hashlib.sha256(self._labels).hexdigest()
        cases = sorted(self._public, key=lambda case: str(case["case"]))
        return {"event": "sealed", "commitment": commitment, "cases": cases}

    def do(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out a command; Refused where that cannot be."""
        match command:
            case {"do": "measure", "case": str(name), "poses": list(poses)} if name in self._cells:
                return self._measure(name, poses)
            case {"do": "unseal", "answers": str(path)}:
                return self._unseal(Path(path))
            case {"do": "twins"}:
                return self._twins()
            case _:
                raise Refused(f"{command} is no command, or of no case")

    def _publish(self, name: str, drawn: Drawn) -> dict[str, Any]:
        train = self._write(f"{name}.csv", drawn.train)
        held_out = self._write(f"{name}-held-out.csv", drawn.held_out)
        return {"case": name, "train": train, "held_out": held_out, "without": list(drawn.without)}

    def _measure(self, name: str, poses: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        if self._is_open:
            raise Refused("nothing is measured after the labels are unsealed")
        try:
            text = measured(self._rig, self._cells[name], poses)
        except (KeyError, ValueError) as error:
            raise Refused(f"{name}: these poses cannot be measured: {error}") from error
        return {"event": "measured", "case": name, "train": self._write(f"{name}-measured.csv", text)}

    def _unseal(self, path: Path) -> dict[str, Any]:
        try:
            answers = path.read_bytes()
        except OSError as error:
            raise Refused(f"{path}: {error.strerror}; labels are handed out against answers") from error
        (self._directory / PAD).write_bytes(self._pad)
        self._is_open = True
        return {"event": "unsealed", "answers": hashlib.sha256(answers).hexdigest(), "pad": PAD}

    def _twins(self) -> dict[str, Any]:
        if not self._is_open:
            raise Refused("a case beside its twin without effects shows what is hidden: unseal first")
        wanted = {name: cell for name, cell in self._cells.items() if has_twin(cell)}
        texts = self._each(partial(twin, self._rig), wanted.values())
        written = {name: self._write(f"{name}-twin.csv", text) for name, text in zip(wanted, texts, strict=True)}
        return {"event": "twins", "cases": written}

    def _write(self, name: str, text: str) -> str:
        (self._directory / name).write_text(text, encoding="utf-8")
        return name


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m simulators.keeper", description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("--rig", required=True, help="a shipped rig's name or a path to a TOML file")
    add("--out", type=Path, required=True, help="directory for observations and sealed labels")
    add("--first", type=int, default=REPORTED_FROM, help="seed of the first case")
    add("--short", action="store_true", help="a few cases of every kind")
    add("--cells", default="", help="kinds of case: KIND,...")
    add("--poses", default="", help="kinds of poses: KIND,...")
    add("--noises", default="", help="kinds of noise: KIND,...")
    add("--effects", default="", help="families of single effects: FAMILY,...")
    add("--sizes", default="", help="visible sizes of single effects: SIZE,...")
    add("--repeats", type=int, default=1, help="cases of every cell")
    add("--workers", type=int, default=os.cpu_count() or 1, help="processes that draw")
    return parser


def _plan(rig: Rig, options: argparse.Namespace) -> tuple[Cell, ...]:
    """The cells that the options ask for; ValueError where they ask for what is not there."""
    known = families(rig)
    selection = Selection(
        kinds=_chosen("cells", options.cells, KINDS),
        poses=_chosen("poses", options.poses, POSES),
        noises=_chosen("noises", options.noises, NOISES),
        families=_chosen("effects", options.effects, known),
        sizes=tuple(float(size) for size in _chosen("sizes", options.sizes, [f"{size:g}" for size in SIZES])),
    )
    if options.first < 0 or options.repeats < 1 or options.workers < 1:
        raise ValueError("first must not be negative, repeats and workers at least 1")
    given = known, tuple(OUTSIDE), ALIASES, options.first
    whole = short_plan(*given) if options.short else full_plan(*given, repeats=options.repeats)
    if options.first < REPORTED_FROM <= whole[-1].seed:
        raise ValueError(f"seeds from {options.first} run into those to report, which begin at {REPORTED_FROM}")
    plan = tuple(cell for cell in whole if selection.keeps(cell))
    if not plan:
        raise ValueError("no case is left of those options")
    return plan


def _chosen(option: str, text: str, known: Sequence[str]) -> tuple[str, ...]:
    """What an option lists; all there is where it lists nothing."""
    wanted = [part.strip() for part in text.split(",") if part.strip()]
    if unknown := [part for part in wanted if part not in known]:
        raise ValueError(f"--{option} {unknown[0]}: known are {', '.join(known)}")
    return tuple(wanted or known)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw, seal, and answer commands until standard input ends; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        rig = load_rig(options.rig)
        plan = _plan(rig, options)
    except (RigError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn"), _prepare_drawing) as pool:
        each = partial(pool.map, chunksize=4)
        keeper = Keeper(rig, plan, options.out, random.SystemRandom().shuffle, secrets.token_bytes, each)
        try:
            _say(keeper.seal())
            for line in sys.stdin:
                _say(_answer(keeper, line))
        except BrokenPipeError:  # nobody listens to the answers any more
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _answer(keeper: Keeper, line: str) -> dict[str, Any]:
    try:
        return keeper.do(json.loads(line))
    except (Refused, ValueError) as error:
        return {"event": "refused", "text": str(error)}


def _prepare_drawing() -> None:
    """In a process that draws: leave the other cores to the others, and do not outlive the keeper."""
    threadpool_limits(1)
    keeper = multiprocessing.parent_process()
    assert keeper is not None
    threading.Thread(target=_follow, args=(keeper,), name="keeper", daemon=True).start()


def _follow(keeper: BaseProcess) -> None:
    keeper.join()
    os._exit(1)


def _say(message: Mapping[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
