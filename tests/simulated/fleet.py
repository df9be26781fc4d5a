"""Simulated fleets: rigs of one drawing, each built within its tolerances, with a mistake of the drawing in common."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from calibration.rig.description import parse_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

RIG = "swdt82"
COMMON = "row7.d"  # that the drawing has wrong on all rigs
COMMON_MM = 12.0
ODD = "row5.a"  # that odd rigs have otherwise: a boom that was made anew
ODD_MM = 120.0
ODD_EVERY = 50
NOISE_MM = 1.0


@dataclass(frozen=True)
class SimulatedRig:
    """A rig of the fleet.

    Attributes:
        name: of its directory.
        is_odd: not as the others.
        rig_text: the drawing, which has a mistake.
        csv: its observations.
    """

    name: str
    is_odd: bool
    rig_text: str
    csv: bytes


def drawing() -> str:
    """The drawing of all rigs."""
    return resources.files("calibration").joinpath("rigs", f"{RIG}.toml").read_text(encoding="utf-8")


def _moved(text: str, name: str, by_mm: float) -> str:
    """A drawing with one length of a row changed."""
    head, *rows = text.split("[[row]]")
    row, key = int(name[3]) - 1, f"{name[5:]}_mm"
    found = re.search(rf"^{key} = (.+)$", rows[row], re.MULTILINE)
    assert found is not None
    rows[row] = rows[row].replace(found[0], f"{key} = {float(found[1]) + by_mm}", 1)
    return "[[row]]".join([head, *rows])


def simulated_rig(
    number: int, fixes: int, sessions: int = 1, odd_every: int = ODD_EVERY, change_mm: float = 0.0
) -> SimulatedRig:
    """Make a rig: poses one after another, a prism in turn, noise of 1 mm on each coordinate.

    Before its last session its boom may become longer by `change_mm`.
    """
    is_odd = number % odd_every == odd_every - 1
    text = drawing()
    built = _moved(text, COMMON, COMMON_MM)
    if is_odd:
        built = _moved(built, ODD, ODD_MM)
    parts = []
    for session in range(sessions):
        if change_mm and session == sessions - 1:
            built = _moved(built, ODD, change_mm)
        truth = RigTruth(parse_rig(built, "built"), 10_000 + number)
        name = f"s{session + 1}" if sessions > 1 else ""
        made = simulate_observations(
            truth,
            fixes // sessions,
            number * 10 + session,
            prisms_per_pose="one",
            noise_mm=NOISE_MM,
            session=name,
        )
        header, _, rows = made.csv_text().partition("\n")
        parts.append(rows)
    return SimulatedRig(f"rig{number:04d}", is_odd, text, f"{header}\n{''.join(parts)}".encode())


def write_rig(directory: Path, rig: SimulatedRig) -> Path:
    """Write a rig's directory, as an engineer would keep it."""
    path = directory / rig.name
    path.mkdir(parents=True)
    (path / "rig.toml").write_text(rig.rig_text, encoding="utf-8")
    (path / "observations.csv").write_bytes(rig.csv)
    return path
