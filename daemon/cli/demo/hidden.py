"""`rigcal demo --hidden`: the gap workflow looks for an effect that the simulated machine draws by its seed.

The truth is in a file that the analysis is not given. The analysis sees observations as they are exported from the
store.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from calibration.rig.description import Rig
from daemon.cli.demo.operator import DEADLINE_S, PRISMS, RIG, Advance, DemoError, Operator
from daemon.cli.terminal import echo, echo_error, echo_table
from daemon.rig_files import load_rig
from daemon.sessions.session_data import sessions_csv
from daemon.store.queries.observations import first_observation
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S

NO_JOBS = "\n[jobs]\nenabled = false  # the workflow is asked by rigcal gap, before and after the poses it proposes\n"
TRAINING_POSES = 22  # of each prism
CHECKED = ("r", "b")  # prisms of the checks, and of the poses that are proposed
CHECK_POSES = 4
GAP_STEPS = 40  # of progress, for what takes about as long as so many poses
PROPOSED = 20
STORE = "rigcal.sqlite"
LONGEST_S = 1800.0  # simulated, that the rounds of the proposed poses may be apart, first to last
HIDDEN = "hidden_effect.json"

Outcome = Literal["right", "set", "missed"]


@dataclass(frozen=True)
class Truth:
    """The hidden effect.

    Attributes:
        family, where: its name and place.
        coefficients: name -> value, as the simulator has it.
        visible_over_noise: RMS of the part that calibration cannot absorb, in units of a fix's noise.
        begin_utc_ns: simulated second 0, from which its instants count.
    """

    family: str
    where: str
    coefficients: Mapping[str, float]
    visible_over_noise: float
    begin_utc_ns: int


def steps() -> int:
    """Number of progress steps, without poses that a set may ask for."""
    return len(PRISMS) * TRAINING_POSES + len(CHECKED) * CHECK_POSES + GAP_STEPS


def play(out: Path, rate: float, seed: int, advance: Advance) -> dict[str, Any]:
    """Play the whole game; everything is left in `out`.

    Args:
        out: a new directory, absolute.
        rate: simulated seconds per second.
        seed: which machine, and which effect.
        advance: told of progress.

    Raises:
        DemoError: it did not come to its end.
    """
    from daemon.models.gap_files import REPORT

    rig = load_rig(RIG).rig
    operator = Operator(out, rate, seed, ["--secret", str(out)], NO_JOBS)
    try:
        operator.begin()
        echo_error(f"An effect is hidden in the machine. {HIDDEN} names it; the analysis is not given that file.")
        training = [operator.record(prism, "static_poses", TRAINING_POSES, advance) for prism in PRISMS]
        checks = [operator.record(prism, "check", CHECK_POSES, advance) for prism in CHECKED]
        advance("waiting for `rigcal gap`, which looks for missing physics", 0)
        name = "gap"
        found = [_find_gap(out, rig, name, training, checks, seed)]
        advance("an answer of `rigcal gap`", GAP_STEPS)
        poses = _proposed(found[0])
        if poses:
            echo_error(f"The data cannot tell {_set_of(found[0])} apart. Measuring {len(poses)} poses that can.")
            for sentence in concessions(rig, poses):
                echo_error(sentence)
            for pause_s, rows in rounds(poses):
                advance("waiting for the next round", 0)
                operator.pause(pause_s)
                training += [operator.record(prism, "static_poses", len(rows), advance, rows) for prism in CHECKED]
            advance("waiting for `rigcal gap` again, with the further poses", 0)
            name = "gap-again"
            found.append(_find_gap(out, rig, name, training, checks, seed))
    finally:
        operator.close()
    content = (out / HIDDEN).read_bytes()
    truth = _timed_as(Truth(**json.loads(content)), out / STORE)
    answer = found[-1]
    return {
        "seed": seed,
        "commitment": hashlib.sha256(content).hexdigest(),
        "outcome": outcome(answer, truth),
        "truth": {"family": truth.family, "where": truth.where, "coefficients": dict(truth.coefficients)},
        "visible_over_noise": truth.visible_over_noise,
        "verdicts": [told["verdict"] for told in found],
        "poses_measured_for_a_set": len(poses),
        "gap": answer,
        "report": str(out / name / REPORT),
    }


def _timed_as(truth: Truth, store: Path) -> Truth:
    """Count the instants of the truth as the store's observations do, and not from simulated second 0."""
    if "time_s" not in truth.coefficients:
        return truth
    with Reader(store) as reader:
        first = first_observation(reader)
    if first is None:
        return truth
    later_s = (first["utc_ns"] - truth.begin_utc_ns) / NS_PER_S
    time_s = truth.coefficients["time_s"] - later_s
    return replace(truth, coefficients={**truth.coefficients, "time_s": time_s})


def outcome(gap: Mapping[str, Any], truth: Truth) -> Outcome:
    """Compare an answer of the workflow, as `rigcal gap --json` gives it, with the truth.

    `right` names it and nothing else; `set` has it among those that the data cannot tell apart, and named nothing that
    is not there.
    """
    effects = {(effect["family"], effect["where"]) for effect in gap["effects"]}
    pending = {(one["family"], one["where"]) for one in gap["indistinguishable"]}
    hidden = {(truth.family, truth.where)}
    if effects == hidden and not pending:
        return "right"
    if hidden <= pending and effects <= hidden:
        return "set"
    return "missed"


def show(result: Mapping[str, Any]) -> None:
    """Print the truth beside the verdict."""
    gap, truth = result["gap"], result["truth"]
    echo(_verdict(gap), bold=True)
    if gap["description"]:
        echo(f"On what it depends: {gap['description']}")
    rows = []
    own = next((e for e in gap["effects"] if (e["family"], e["where"]) == (truth["family"], truth["where"])), None)
    for name, value in truth["coefficients"].items():
        told = (own or {"coefficients": {}})["coefficients"].get(name)
        cells = ("", "") if told is None else (f"{told['value']:.4g}", f"{told['standard_error']:.2g} {told['unit']}")
        rows.append([name, f"{value:.4g}", *cells])
    echo_table(("", "hidden", "found", "+-"), rows, title="The hidden effect", text_columns=(0,))
    name = _name(truth["family"], truth["where"])
    sizes = f"visible at {result['visible_over_noise']:.1f} times the noise of a fix"
    lines = {
        "right": f"Right: it is {name}, {sizes}.",
        "set": f"A set that contains it: it is {name}, {sizes}.",
        "missed": f"Missed: it is {name}, {sizes}.",
    }
    echo(lines[result["outcome"]], bold=True)
    echo(f"report: {os.path.relpath(result['report'])}")


def _name(family: str, where: str) -> str:
    from daemon.report.words import place_name

    return place_name(family, where)


def _verdict(gap: Mapping[str, Any]) -> str:
    if gap["verdict"] == "named":
        return f"The verdict: {' and '.join(_name(e['family'], e['where']) for e in gap['effects'])}."
    if gap["verdict"] == "indistinguishable":
        return f"The verdict: one of {_set_of(gap)}."
    return "The verdict: " + {
        "none": "simulation and measurement agree within the noise.",
        "unidentified": "something is missing that no effect of the library explains.",
    }.get(gap["verdict"], str(gap["verdict"]))


def _set_of(gap: Mapping[str, Any]) -> str:
    return " and ".join(_name(one["family"], one["where"]) for one in gap["indistinguishable"])


def _proposed(gap: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the poses that an answer proposes."""
    if gap["verdict"] != "indistinguishable":
        return []
    return [row for experiment in gap["experiments"] for row in experiment.get("poses", ())][:PROPOSED]


def rounds(rows: Sequence[Mapping[str, Any]]) -> list[tuple[float, list[dict[str, Any]]]]:
    """Rows of a plan by the round that they are measured in, each with the pause before it, simulated seconds.

    Rounds are as far apart as the rows say, or as a demonstration can wait for.
    """
    by_time: dict[float, list[dict[str, Any]]] = {}
    for row in rows:
        by_time.setdefault(float(row.get("time_s", 0.0)), []).append(dict(row))
    times = sorted(by_time)
    share = min(1.0, LONGEST_S / (times[-1] - times[0])) if len(times) > 1 else 1.0
    pauses_s = [share * (time_s - before_s) for before_s, time_s in zip([times[0], *times], times, strict=False)]
    return [(pause_s, by_time[time_s]) for pause_s, time_s in zip(pauses_s, times, strict=True)]


def concessions(rig: Rig, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the conditions in a plan's rows that the simulated boom cannot bring about."""
    times = [float(row["time_s"]) for row in rows if "time_s" in row]
    out = []
    if times and max(times) - min(times) > LONGEST_S:
        asked_h = (max(times) - min(times)) / 3600.0
        out.append(f"The plan asks for rounds over {asked_h:.0f} h; here they are over {LONGEST_S / 60.0:.0f} min.")
    done = {"pose", "prisms", "fixes", "time_s", "dwell_s", *(joint.column for joint in rig.joints)}
    done |= {f"{name}_dir" for name in rig.joint_names}
    left = sorted({name for row in rows for name in row} - done)
    if left:
        out.append(f"What the simulated boom cannot do, and leaves: {', '.join(left)}.")
    return out


def _find_gap(
    out: Path, rig: Rig, name: str, training: Sequence[str], checks: Sequence[str], seed: int
) -> dict[str, Any]:
    """Run `rigcal gap` on sessions of the store, exported as files."""
    files = {}
    with Reader(out / STORE) as reader:
        for kind, sessions in (("observations", training), ("checks", checks)):
            files[kind] = out / f"{name}-{kind}.csv"
            files[kind].write_bytes(sessions_csv(reader, rig, sessions))
    command = [sys.executable, "-m", "daemon.cli.main", "gap", "--rig", RIG, "--data", str(files["observations"])]
    command += ["--holdout", str(files["checks"]), "--out", str(out / name), "--seed", str(seed), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    if done.returncode != 0:
        raise DemoError(f"rigcal gap ended with status {done.returncode}: {done.stderr.strip()[-500:]}")
    told: dict[str, Any] = json.loads(done.stdout)
    return told
