"""`rigcal demo --hidden`: the gap workflow searches for an effect that the simulated machine draws from its seed.

The truth is in a file that the analysis does not get. The analysis sees only observations exported from the store.
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

NO_JOBS = "\n[jobs]\nenabled = false  # `rigcal gap` is run instead, before and after the poses that it proposes\n"
TRAINING_POSES = 22  # for each prism
CHECKED = ("r", "b")  # prisms of the checks and of the proposed poses
CHECK_POSES = 4
GAP_STEPS = 40  # progress steps of `rigcal gap`, which takes about as long as this many poses
PROPOSED = 20
STORE = "rigcal.sqlite"
LONGEST_S = 1800.0  # longest simulated time from the first to the last round of the proposed poses
HIDDEN = "hidden_effect.json"

Outcome = Literal["right", "set", "missed"]


@dataclass(frozen=True)
class Truth:
    """The hidden effect.

    Attributes:
        family, where: its name and place.
        coefficients: name -> value in the simulator.
        visible_over_noise: RMS of the part that calibration cannot absorb, in units of a fix's noise.
        begin_utc_ns: time of simulated second 0, from which its times count.
    """

    family: str
    where: str
    coefficients: Mapping[str, float]
    visible_over_noise: float
    begin_utc_ns: int


def steps() -> int:
    """Return the number of progress steps, without poses that may be proposed for a set."""
    return len(PRISMS) * TRAINING_POSES + len(CHECKED) * CHECK_POSES + GAP_STEPS


def play(out: Path, rate: float, seed: int, advance: Advance) -> dict[str, Any]:
    """Run the whole demonstration and leave all files in `out`.

    Args:
        out: absolute path of a new directory.
        rate: simulated seconds per second.
        seed: determines the machine and the effect.
        advance: called with the progress.

    Raises:
        DemoError: the demonstration did not finish.
    """
    from daemon.models.gap_files import REPORT

    rig = load_rig(RIG).rig
    operator = Operator(out, rate, seed, ["--secret", str(out)], NO_JOBS)
    try:
        operator.begin()
        echo_error(f"An effect is hidden in the machine. {HIDDEN} names it; the analysis does not get that file.")
        training = [operator.record(prism, "static_poses", TRAINING_POSES, advance) for prism in PRISMS]
        checks = [operator.record(prism, "check", CHECK_POSES, advance) for prism in CHECKED]
        advance("waiting for `rigcal gap`, which searches for missing effects", 0)
        name = "gap"
        found = [_find_gap(out, rig, name, training, checks, seed)]
        advance("an answer of `rigcal gap`", GAP_STEPS)
        poses = _proposed(found[0])
        if poses:
            echo_error(f"The data cannot distinguish {_set_of(found[0])}. Measuring {len(poses)} poses that can.")
            for sentence in concessions(rig, poses):
                echo_error(sentence)
            for pause_s, rows in rounds(poses):
                advance("waiting for the next round", 0)
                operator.pause(pause_s)
                training += [operator.record(prism, "static_poses", len(rows), advance, rows) for prism in CHECKED]
            advance("waiting for `rigcal gap` again, with the additional poses", 0)
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
    """Shift the times of the truth from simulated second 0 to the time axis of the store's observations."""
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
    """Compare an answer of the workflow, as from `rigcal gap --json`, with the truth.

    Returns:
        `right` if only the hidden effect is named, `set` if it is in the indistinguishable set and no wrong effect is
        named, else `missed`.
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
    """Print the verdict and the truth."""
    gap, truth = result["gap"], result["truth"]
    echo(_verdict(gap), bold=True)
    if gap["description"]:
        echo(f"Dependence: {gap['description']}")
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
        "unidentified": "there is an error that no effect of the library explains.",
    }.get(gap["verdict"], str(gap["verdict"]))


def _set_of(gap: Mapping[str, Any]) -> str:
    return " and ".join(_name(one["family"], one["where"]) for one in gap["indistinguishable"])


def _proposed(gap: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the poses that an answer proposes."""
    if gap["verdict"] != "indistinguishable":
        return []
    return [row for experiment in gap["experiments"] for row in experiment.get("poses", ())][:PROPOSED]


def rounds(rows: Sequence[Mapping[str, Any]]) -> list[tuple[float, list[dict[str, Any]]]]:
    """Return the rounds of a plan, each as the pause before it in simulated seconds and its rows.

    Rounds are as far apart as the rows require; long plans are compressed to `LONGEST_S`.
    """
    by_time: dict[float, list[dict[str, Any]]] = {}
    for row in rows:
        by_time.setdefault(float(row.get("time_s", 0.0)), []).append(dict(row))
    times = sorted(by_time)
    share = min(1.0, LONGEST_S / (times[-1] - times[0])) if len(times) > 1 else 1.0
    pauses_s = [share * (time_s - before_s) for before_s, time_s in zip([times[0], *times], times, strict=False)]
    return [(pause_s, by_time[time_s]) for pause_s, time_s in zip(pauses_s, times, strict=True)]


def concessions(rig: Rig, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return sentences on the conditions in a plan's rows that the simulated boom cannot fulfil."""
    times = [float(row["time_s"]) for row in rows if "time_s" in row]
    out = []
    if times and max(times) - min(times) > LONGEST_S:
        asked_h = (max(times) - min(times)) / 3600.0
        out.append(f"The plan's rounds span {asked_h:.0f} h; here they span {LONGEST_S / 60.0:.0f} min.")
    done = {"pose", "prisms", "fixes", "time_s", "dwell_s", *(joint.column for joint in rig.joints)}
    done |= {f"{name}_dir" for name in rig.joint_names}
    left = sorted({name for row in rows for name in row} - done)
    if left:
        out.append(f"Conditions that the simulated boom cannot fulfil and ignores: {', '.join(left)}.")
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
