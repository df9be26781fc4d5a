"""Single cases that the gap workflow once got wrong: `python -m tests.bench.gap_cases`.

Each is one drawn machine whose hidden effects were missed, or named although there were none, until the workflow
changed. What it promises in general is tested in `tests/calibration/gap`; how often it holds is `rigcal bench gap`.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

from calibration.observations import parse_observations
from calibration.pipeline.find_gap import find_gap
from daemon.rig_files import load_rig
from simulators.blind.cases import draw
from simulators.blind.cells import Cell


@dataclass(frozen=True)
class Case:
    """A cell with its seed, and what makes it hard."""

    cell: Cell
    why: str


CASES = (
    Case(
        Cell("pair", ("gravity_flip_play", "joint_error_map"), 1.0, "wide", "fine", 400002),
        "beside the first effect, a fit takes the nine of 250 fixes that show the second for outliers",
    ),
    Case(
        Cell("single", ("pad_play",), 1.0, "sparse", "stepped", 650418),
        "three of 60 fixes are off by 25 to 160 mm, and a curve of a joint would follow them",
    ),
    Case(
        Cell("null", (), 0.0, "sparse", "coarse", 100314),
        "by what coarse encoders scatter no fix is far off, yet a step of the base would put two of them in place",
    ),
    Case(
        Cell("single", ("transducer_quadratic",), 0.5, "sparse", "coarse", 300062),
        "the effect must be weighed with the noise that it leaves, not with itself as noise",
    ),
    Case(
        Cell("single", ("leak_down",), 0.5, "sparse", "fine", 720331),
        "few of 60 poses stood long, and half of them hardly determines the kinematics",
    ),
    Case(
        Cell("single", ("joint_error_map",), 0.5, "sparse", "coarse", 720059),
        "a curve over 60 poses is almost as free as they are",
    ),
    Case(
        Cell("alias", ("base_settlement|base_step",), 1.0, "wide", "fine", 663007),
        "play seems to be beside either effect, and so is more probable than each",
    ),
    Case(
        Cell("alias", ("base_settlement|base_step",), 1.0, "wide", "fine", 650072),
        "the step fits a little better within a visit than between two, where it is far more likely beforehand",
    ),
    Case(
        Cell("pair", ("base_step", "payload_change"), 1.0, "wide", "fine", 400021),
        "the machine is lighter than its rig file, so the payload's compliance is just beyond the hard limit",
    ),
)


def answers(case: Case) -> tuple[set[str], set[str]]:
    """Return what the case hides and what the workflow says, as names `family@place`, or families of a set."""
    source = load_rig("swdt82")
    drawn = draw(source.rig, case.cell)
    if drawn is None:
        raise ValueError(f"{case.cell}: nothing can be drawn")
    gap = find_gap(source.rig, source.text, parse_observations(drawn.train.encode(), source.rig, "case.csv"))
    if case.cell.kind == "alias":
        return set(drawn.label["aliases"]), {candidate.family for candidate in gap.indistinguishable}
    hidden = {f"{effect['family']}@{effect['where']}" for effect in drawn.label["effects"]}
    return hidden, {f"{effect.family}@{effect.where}" for effect in gap.effects}


def main() -> None:
    """Print a line for each case; the exit status is 1 if one is wrong."""
    wrong = 0
    for case in CASES:
        started = time.monotonic()
        hidden, said = answers(case)
        wrong += hidden != said
        verdict = "right" if hidden == said else f"WRONG: {sorted(said)}"
        print(f"{case.cell.seed:7d} {time.monotonic() - started:5.1f} s  {sorted(hidden)}: {verdict}", flush=True)
    print(f"{len(CASES) - wrong} of {len(CASES)} right")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
