"""Measured robots from public repositories: what is named, and errors of held-out rows stage by stage.

    python -m tests.bench.measured_arms --iiwa DIR --irb120 DIR --drilling-robot DIR [--splits K]

DIR is a checkout of github.com/Zhangzhongqiu/robot-calibration (KUKA iiwa 7 with joint torques, two runs without a load
and two with one), of github.com/icelinker/Robot-Calibration-LaserTracker (ABB IRB 120, three reflectors), and of
github.com/Hilti-Research/construction_robot_stationing_datasets (a drilling robot: an arm on a lifting column, two
inclinometers, a total station, on a level floor and on six other floors). None has a licence by which their data could
be here; a robot whose checkout is not given is skipped. A random half of the poses trains, the other half is held out.
`--splits` takes so many halves, as halves differ by more than a few hundredths of a millimetre.
"""

from __future__ import annotations

import argparse
import csv
import io
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.model.intervals import SetupErrors
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import calibrate
from calibration.rig.description import Rig, parse_rig

Floats = NDArray[np.float64]

_IRB120 = [(0, -90, 290, 0), (270, 0, 0, -90), (70, -90, 0, 0), (0, 90, 302, 0), (0, -90, 0, 0), (0, 0, 72, 180)]
_IRB120_MASSES = [(1, 3.909), (2, 2.944), (3, 1.328), (4, 0.546), (5, 0.4)]
IIWA = [
    (0, -90, 340, 0),
    (0, 90, 0, 0),
    (0, 90, 400, 0),
    (0, -90, 0, 0),
    (0, -90, 400, 0),
    (0, 90, 0, 0),
    (0, 0, 126, 0),
]
IIWA_MASSES = [(2, 7.54), (4, 5.65), (6, 3.13)]
_IIWA_RUNS = {
    "0 kg": ("0kg/20161216_run1_0kg.csv", 1),
    "1.25 kg": ("1.25kg/20161216_run2_1.25kg.csv", 1),
    "2.5 kg": ("2.5kg/20161216_run3_2.5kg.csv", 1),
    "all joints": ("20161118_run_1.csv", 20),
}
_DRILLING_ROBOT = """name = "drilling robot"
convention = "mdh_beta_after"
gravity = [0, 0, -1]
tolerances = { length_mm = 1.0, angle_deg = 0.2, beta_deg = 0.1, prism_mm = 100.0 }
station = { angle_sigma_arcsec = 10.0, distance_sigma_mm = 0.75, distance_sigma_ppm = 2.0, target_sigma_mm = 0.3 }
prism = [{ name = "tool", frame = 7, offset_mm = [-100.91, -1.02, 335.66], offset_known = false }]
signal = [
    { name = "tilt_base_x", unit = "deg" },
    { name = "tilt_base_y", unit = "deg" },
    { name = "tilt_tip_x", unit = "deg" },
    { name = "tilt_tip_y", unit = "deg" },
]
joint = [
    { name = "column", kind = "prismatic", limits = [1480, 3972], sigma = 0.1, max_rate = 200.0 },
    { name = "q1", kind = "revolute", limits = [-360, 360], sigma = 0.002, max_rate = 120.0 },
    { name = "q2", kind = "revolute", limits = [-360, 360], sigma = 0.002, max_rate = 120.0 },
    { name = "q3", kind = "revolute", limits = [-160, 160], sigma = 0.002, max_rate = 180.0 },
    { name = "q4", kind = "revolute", limits = [-360, 360], sigma = 0.002, max_rate = 225.0 },
    { name = "q5", kind = "revolute", limits = [-360, 360], sigma = 0.002, max_rate = 225.0 },
    { name = "q6", kind = "revolute", limits = [-360, 360], sigma = 0.002, max_rate = 225.0 },
]
row = [
    { d_mm = 231, theta_deg = 90, drive = { d = { column = 1.0 } } },
    { alpha_deg = 90, d_mm = 256.5, drive = { theta = { q1 = 1.0 } } },
    { alpha_deg = -90, d_mm = 34.5, theta_deg = -90, drive = { theta = { q2 = 1.0 } } },
    { a_mm = 620, theta_deg = 90, drive = { theta = { q3 = 1.0 } } },
    { alpha_deg = 90, d_mm = 559, drive = { theta = { q4 = 1.0 } } },
    { alpha_deg = -90, drive = { theta = { q5 = 1.0 } } },
    { alpha_deg = 90, d_mm = 121, drive = { theta = { q6 = 1.0 } } },
]
mass = [
    { name = "column top", frame = 1, kg = 14, centre_mm = [0, 0, -841] },
    { name = "tip mount", frame = 1, kg = 6, centre_mm = [0, 0, -15] },
    { name = "arm base", frame = 1, kg = 4.12, centre_mm = [0, -152.5, -4.8] },
    { name = "link 1", frame = 2, kg = 7.8, centre_mm = [0.119, 42.8, -6.383] },
    { name = "link 2", frame = 3, kg = 10.83, centre_mm = [259.73, -0.053, 157.82] },
    { name = "link 3", frame = 4, kg = 3.68, centre_mm = [-0.015, -6.702, 44.608] },
    { name = "link 4", frame = 5, kg = 3.82, centre_mm = [0.071, 91.879, -182.52] },
    { name = "link 5", frame = 6, kg = 2.82, centre_mm = [-0.273, 3.651, 32.088] },
    { name = "link 6", frame = 7, kg = 1.16, centre_mm = [-0.292, 0.007, -53.9] },
    { name = "tool", frame = 7, kg = 3, centre_mm = [0, 0, 250] },
]
"""
_OF_BASE = 40  # fixes that a base is fitted to at another set-up


@dataclass(frozen=True)
class Case:
    """One data set, split.

    Attributes:
        title, rig, rig_text: of the machine.
        train, held_out: its two halves.
        elsewhere: at other set-ups, by their names; the first fixes of each are for its base.
    """

    title: str
    rig: Rig
    rig_text: str
    train: Observations
    held_out: Observations
    elsewhere: dict[str, Observations] = field(default_factory=dict)


def rig_text(
    name: str, rows: Sequence[tuple[float, ...]], masses: Sequence[tuple[float, ...]], prisms: Sequence[str]
) -> str:
    """Return a rig file: a tracker, DH rows of (a, alpha, d, theta), masses midway between frames."""
    parts = [
        f'name = "{name}"\nconvention = "dh"\ngravity = [0, 0, -1]',
        "[tolerances]\nlength_mm = 1.0\nangle_deg = 0.2\nbeta_deg = 0.1\nprism_mm = 100.0",
        "[station]\nangle_sigma_arcsec = 1.0\ndistance_sigma_mm = 0.01\ndistance_sigma_ppm = 0.5",
    ]
    parts += [
        f'[[joint]]\nname = "q{n}"\nkind = "revolute"\nlimits = [-360, 360]\nsigma = 0.0005\nmax_rate = 180.0'
        for n in range(1, len(rows) + 1)
    ]
    parts += [
        f"[[row]]\na_mm = {a}\nalpha_deg = {alpha}\nd_mm = {d}\ntheta_deg = {theta}\n"
        f"drive = {{ theta = {{ q{n} = 1.0 }} }}"
        for n, (a, alpha, d, theta) in enumerate(rows, 1)
    ]
    parts += [
        f'[[prism]]\nname = "{p}"\nframe = {len(rows)}\noffset_mm = [0, 0, 0]\noffset_known = false' for p in prisms
    ]
    parts += [f'[[mass]]\nname = "link {frame}"\nframe = {frame}\nkg = {kg}\nmidway = true' for frame, kg in masses]
    return "\n\n".join(parts) + "\n"


def iiwa(folder: Path, split: int) -> Iterator[Case]:
    """Yield the runs of the 7-joint arm, with measured torques and with those that follow from its masses."""
    text = rig_text("iiwa7", IIWA, IIWA_MASSES, ["tool"])
    for title, (path, first) in _IIWA_RUNS.items():
        lines = list(csv.reader((folder / path).read_text().splitlines()))[1:]
        values = np.array([[float(v) for v in line] for line in lines if len(line) > 20][first:])
        angles, torques, position = np.rad2deg(values[:, 1:8]), values[:, 8:15], values[:, [18, 22, 26]]
        for measured in (True, False):
            columns = {f"q{n}_deg": angles[:, n - 1] for n in range(1, 8)}
            columns |= {f"q{n}_Nm": torques[:, n - 1] for n in range(1, 8)} if measured else {}
            loads = "torques" if measured else "masses"
            yield _case(f"iiwa 7, {title}, {loads}", text, [("tool", columns, position)], split)


def irb120(folder: Path, split: int) -> Iterator[Case]:
    """Yield the small arm with its joints as commanded and as read back."""
    text = rig_text("irb120", _IRB120, _IRB120_MASSES, ["smr1", "smr2", "smr3"])
    measured = folder / "3-Full Measurement/Output/Backup"
    positions = [np.loadtxt(measured / f"measured_SMR_{n}.txt") for n in (1, 2, 3)]
    joints = {
        "commanded": np.loadtxt(folder / "3-Full Measurement/Input/generated_joints.txt"),
        "read back": np.loadtxt(measured / "measured_joints.txt"),
    }
    for title, angles in joints.items():
        columns = {f"q{n}_deg": angles[:, n - 1] for n in range(1, 7)}
        seen = [(f"smr{n}", columns, at) for n, at in enumerate(positions, 1)]
        yield _case(f"IRB 120, {title}", text, seen, split)


def drilling_robot(folder: Path, split: int) -> Iterator[Case]:
    """Yield the drilling robot on its level floor, in the order of time, and on other floors, in random order."""
    columns, position_mm = _floor(folder / "data/datasets/flat.yaml")
    case = _case("drilling robot, level floor", _DRILLING_ROBOT, [("tool", columns, position_mm)], split)
    elsewhere = {}
    for path in sorted((folder / "data/datasets").glob("*.yaml")):
        if path.stem != "flat":
            rows = _observations([("tool", *_floor(path))], case.rig, path.stem)
            elsewhere[path.stem] = rows.select(np.random.default_rng(split).permutation(len(rows)))
    yield replace(case, elsewhere=elsewhere)


def _floor(path: Path) -> tuple[dict[str, Floats], Floats]:
    """Return the columns, and the positions (n, 3), of the drilling robot on one floor, in the order of time."""
    import yaml

    text = path.read_text(encoding="utf-8")
    heights = yaml.load(text, yaml.CSafeLoader)["column_heights"].values()
    every = [space for height in heights for space in height["solution_spaces"].values()]
    kinds = ("stationing_measurements", "evaluation_measurements")
    taken = sorted((m for space in every for kind in kinds for m in space[kind]), key=lambda m: float(m["time"]))
    joints = np.array([m["joint_states"] for m in taken])
    time_s = np.array([m["time"] for m in taken])
    columns = {"time_s": time_s - time_s[0], "column_mm": 1e3 * joints[:, 0]}
    columns |= {f"q{n}_deg": np.rad2deg(joints[:, n]) for n in range(1, 7)}
    for name, sensor in (("base", "tilt_sensor_base_accel"), ("tip", "tilt_sensor_column_accel")):
        x, y, z = np.array([m[sensor] for m in taken]).T
        columns |= {
            f"tilt_{name}_x_deg": np.rad2deg(np.arctan2(x, z)),
            f"tilt_{name}_y_deg": np.rad2deg(np.arctan2(y, z)),
        }
    return columns, 1e3 * np.array([m["prism_position"] for m in taken])


def _case(title: str, text: str, prisms: Sequence[tuple[str, dict[str, Floats], Floats]], split: int) -> Case:
    """Return a data set of (prism, columns, positions) of the same poses, split by poses, number `split`."""
    rig = parse_rig(text, title)
    count = len(prisms[0][2])
    is_train = np.isin(np.arange(count), np.random.default_rng(split).permutation(count)[: count // 2])
    rows = _observations(prisms, rig, "here")
    of_train = np.repeat(is_train, len(prisms))
    return Case(title, rig, text, rows.select(of_train), rows.select(~of_train))


def _observations(prisms: Sequence[tuple[str, dict[str, Floats], Floats]], rig: Rig, setup: str) -> Observations:
    """Return the rows of (prism, columns, positions) of the same poses, those of a pose one after the other."""
    out = io.StringIO()
    out.write(",".join(["prism", "setup", *prisms[0][1], "x_mm", "y_mm", "z_mm"]) + "\n")
    for row in range(len(prisms[0][2])):
        for prism, columns, position in prisms:
            fields = [*(values[row] for values in columns.values()), *position[row]]
            out.write(f"{prism},{setup}," + ",".join(f"{value:.7f}" for value in fields) + "\n")
    return parse_observations(out.getvalue().encode(), rig, rig.name)


def main() -> None:
    """Print one line for every data set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iiwa", type=Path, metavar="DIR")
    parser.add_argument("--irb120", type=Path, metavar="DIR")
    parser.add_argument("--drilling-robot", type=Path, metavar="DIR")
    parser.add_argument("--only", default="", help="data sets whose title has this")
    parser.add_argument("--splits", type=int, default=1, metavar="K", help="how many halves (default: 1)")
    given = parser.parse_args()
    if not (given.iiwa or given.irb120 or given.drilling_robot):
        print("skipped: no checkout is given (--iiwa DIR, --irb120 DIR, --drilling-robot DIR)")
    print("held-out RMS in mm: n as designed, g geometry, e with effects, h with the residual")
    print("share in 90 % intervals (and balls); at other set-ups the fixes that place the base do not count")
    hybrid: dict[str, list[float]] = {}
    for split in range(1, given.splits + 1):
        cases = [iiwa(given.iiwa, split)] if given.iiwa else []
        cases += [irb120(given.irb120, split)] if given.irb120 else []
        cases += [drilling_robot(given.drilling_robot, split)] if given.drilling_robot else []
        for case in chain.from_iterable(cases):
            if given.only in case.title:
                lines, h_mm = _measured(case)
                hybrid.setdefault(case.title, []).append(h_mm)
                print("\n".join(lines), flush=True)
    if given.splits > 1:
        print(f"\nh, mean of {given.splits} halves")
        for title, errors_mm in hybrid.items():
            print(f"{title:32}  {np.mean(errors_mm):.3f}  from {min(errors_mm):.3f} to {max(errors_mm):.3f}")


def _measured(case: Case) -> tuple[list[str], float]:
    """Return a data set's lines, and the error of the last stage, mm."""
    began = time.process_time()
    model, _ = calibrate(case.rig, case.rig_text, case.train)
    cpu_s = time.process_time() - began
    numbers, h_mm = _errors(model, case.held_out)
    named = ", ".join(f"{e.family}@{e.where}" for e in model.effects) or "nothing"
    lines = [f"{case.title:32}  {numbers}  {cpu_s:.0f} s of CPU  {named}"]
    for name, rows in case.elsewhere.items():
        is_base = np.arange(len(rows)) < _OF_BASE
        placed = with_refitted_base(model, rows.select(is_base))
        placed = replace(placed, intervals=SetupErrors.of(placed, rows.select(is_base)).intervals)
        numbers, _ = _errors(placed, rows.select(~is_base))
        lines.append(f"  {name + f', base by {_OF_BASE} fixes':30}  {numbers}")
    return lines, h_mm


def _errors(model: CalibratedModel, rows: Observations) -> tuple[str, float]:
    """Return the errors of every stage on rows that the model has not seen, as a text, and that of the last, mm."""
    predictor = Predictor.of(model)
    predicted = predictor.predict(replace(rows, position_mm=np.full_like(rows.position_mm, np.nan)))
    stages = {
        "n": predictor.nominal_mm(rows),
        "g": predictor.geometric_mm(rows),
        "e": predictor.effects_mm(rows),
        "h": predicted.position_mm,
    }
    errors = {name: float(np.sqrt(((rows.position_mm - at) ** 2).sum(axis=1).mean())) for name, at in stages.items()}
    error_mm = rows.position_mm - predicted.position_mm
    inside = predicted.coverage(error_mm)
    numbers = "  ".join(f"{name} {value:.3f}" for name, value in errors.items())
    return f"{numbers}  {np.mean(inside.axes):.0%} ({inside.radius:.0%})", errors["h"]


if __name__ == "__main__":
    main()
