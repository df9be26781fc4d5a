"""Each export format, loaded in the tool it is for, is the model as far as it says."""

import io
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from calibration.design.visibility import Bodies
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library, parse_effects
from calibration.effects.regime import Regime
from calibration.export.correction_grid import Machine, trained_ranges
from calibration.export.formats import chosen_formats, export_files
from calibration.export.formats.c_header import written_effects
from calibration.export.model_export import Export, without_parts
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.rig.exchange.from_table import draft_of_table
from tests.calibration.conftest import Session
from tests.robots import Pinocchio

EXACT_MM = 1e-9
FORWARD_US = 5.0  # a pose at most, with seven effects; computers differ by a factor of two
INVERSE = 8.0  # forward calculations at most, that an inverse takes as long as
COMPILER = shutil.which("gcc") or shutil.which("cc")
MAIN = r"""
#include <stdio.h>
#include <time.h>
#include "rigcal_model.h"
#define MOST 10000
#define FEW 250
static double q[MOST][RIGCAL_JOINTS], back[MOST][RIGCAL_JOINTS], place[MOST][RIGCAL_PRISMS][3];
static int steps[MOST];
static double elapsed_us(struct timespec a, struct timespec b)
{
    return (b.tv_sec - a.tv_sec) * 1e6 + (b.tv_nsec - a.tv_nsec) / 1e3;
}
/* Of a few poses each time, the least of all rounds: whatever else runs on the computer is not measured. */
int main(void)
{
    struct timespec begin, end;
    const int prism = RIGCAL_PRISMS - 1;
    const int n = (int)fread(q, sizeof q[0], MOST, stdin);
    double forward_us = 0.0, inverse_us = 0.0, closure = 0.0;
    int missed = 0;
    for (int first = 0; first < n; first += FEW) {
        const int last = first + FEW < n ? first + FEW : n;
        double least_us = 1e9;
        for (int round = 0; round < 5; round++) {
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &begin);
            for (int i = first; i < last; i++) rigcal_forward(q[i], NULL, place[i]);
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
            least_us = fmin(least_us, elapsed_us(begin, end));
        }
        forward_us += least_us / n;
    }
    fwrite(place, sizeof place[0], n, stdout);
    for (int first = 0; first < n; first += FEW) {
        const int last = first + FEW < n ? first + FEW : n;
        double least_us = 1e9;
        for (int round = 0; round < 20; round++) {
            for (int i = first; i < last; i++)
                for (int j = 0; j < RIGCAL_JOINTS; j++)
                    back[i][j] = q[i][j] + (j % 2 ? -0.002 : 0.002) * (rigcal_upper[j] - rigcal_lower[j]);
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &begin);
            for (int i = first; i < last; i++) steps[i] = rigcal_inverse(1, &prism, place[i][prism], NULL, back[i]);
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
            least_us = fmin(least_us, elapsed_us(begin, end));
        }
        inverse_us += least_us / n;
    }
    for (int i = 0; i < n; i++) {
        double again[RIGCAL_PRISMS][3];
        if (steps[i] < 0) { missed++; continue; }
        rigcal_forward(back[i], NULL, again);
        for (int k = 0; k < 3; k++) closure = fmax(closure, fabs(again[prism][k] - place[i][prism][k]));
    }
    fprintf(stderr, "%.17g %.17g %.17g %d\n", forward_us, inverse_us, closure, missed);
    return 0;
}
"""

GAP = r"""
#include <stdio.h>
#include <stdlib.h>
#include "rigcal_model.h"
static double load(const double q[])
{
    rigcal_frame_t at[RIGCAL_MOTIONS];
    rigcal_pose(q, NULL, at);
    return rigcal_load(at, rigcal_load1, TURNED);
}
static double between(int j, double share) { return rigcal_lower[j] + share * (rigcal_upper[j] - rigcal_lower[j]); }
int main(void)
{
    const int prism = RIGCAL_PRISMS - 1;
    int targets = 0, missed = 0;
    double closure = 0.0;
    srand(5);
    for (int i = 0; i < 200000; i++) {
        double q[RIGCAL_JOINTS], place[RIGCAL_PRISMS][3], again[RIGCAL_PRISMS][3];
        double low = rigcal_lower[TURNED], high = rigcal_upper[TURNED], at_low;
        for (int j = 0; j < RIGCAL_JOINTS; j++) q[j] = between(j, 0.1 + 0.8 * (rand() / (double)RAND_MAX));
        q[TURNED] = low;
        at_low = load(q);
        q[TURNED] = high;
        if (at_low * load(q) > 0.0) continue;
        for (int halving = 0; halving < 60; halving++) {
            q[TURNED] = (low + high) / 2.0;
            if (load(q) * at_low > 0.0) low = q[TURNED];
            else high = q[TURNED];
        }
        rigcal_forward(q, NULL, place);
        targets++;
        for (int j = 0; j < RIGCAL_JOINTS; j++) q[j] += (j % 2 ? -0.002 : 0.002) * (rigcal_upper[j] - rigcal_lower[j]);
        if (rigcal_inverse(1, &prism, place[prism], NULL, q) < 0) { missed++; continue; }
        rigcal_forward(q, NULL, again);
        for (int k = 0; k < 3; k++) closure = fmax(closure, fabs(again[prism][k] - place[prism][k]));
    }
    printf("%d %d %.17g\n", targets, missed, closure);
    return 0;
}
"""


def with_effects(
    model: CalibratedModel, effects: str, variant: int = -1, regime: Regime | None = None
) -> CalibratedModel:
    """The model with effects of plausible sizes, one of their variants each."""
    low, high = trained_ranges(model)
    rng = np.random.default_rng(5)
    rows = Machine(model, 0).rows(model.rig.prism_names[-1], rng.uniform(low, high, (60, len(low))))
    extra = {"time_s": np.arange(60) * 10.0, "temperature_degC": np.linspace(5.0, 20.0, 60)}
    extra |= {"dwell_s": np.linspace(1.0, 300.0, 60)}
    context = EffectContext(model.chain, model.values, replace(rows, extra=extra))
    found = []
    for name, where in parse_effects(effects, model.rig):
        family = library()[name]
        settings = family.variants(context, where)[variant]
        sigma = np.array([c.sigma for c in family.coefficients(context, where, settings)])
        values = sigma * rng.normal(0.0, 1.0, len(sigma))
        found.append(Choice(name, where, settings, regime=regime).fitted(context, values, 0.1 * sigma))
    covariance = np.zeros((len(model.values) + sum(len(effect.coefficients) for effect in found),) * 2)
    return replace(model, effects=tuple(found), covariance=covariance)


def poses_of(model: CalibratedModel, n: int) -> np.ndarray:
    low, high = trained_ranges(model)
    return np.random.default_rng(3).uniform(low, high, (n, len(low)))


def kinematics_mm(model: CalibratedModel, poses: np.ndarray) -> np.ndarray:
    machine = Machine(without_parts(model, ()), Export(model, "").setup)
    return np.stack([machine.corrected_mm(prism, poses) for prism in model.rig.prism_names], axis=1)


@dataclass(frozen=True)
class RunInC:
    """Places by the C header (n, prisms, 3); us a pose, forward and back; how far and how often its inverse misses."""

    places_mm: np.ndarray
    forward_us: float
    inverse_us: float
    closure_mm: float
    missed: int


def compiled(program: str, model: CalibratedModel, directory: Path) -> Path:
    """The program, compiled with the model's header beside it."""
    if COMPILER is None:
        pytest.skip("no C compiler")
    for name, data in export_files(Export(model, "0" * 64), ["c-header"]).items():
        (directory / name).write_bytes(data)
    (directory / "main.c").write_text(program, encoding="utf-8")
    strict = ["-std=c99", "-D_POSIX_C_SOURCE=199309L", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    subprocess.run([COMPILER, *strict, "main.c", "-o", "main", "-lm"], cwd=directory, check=True)
    return directory / "main"


def run_c(model: CalibratedModel, directory: Path, n: int) -> RunInC:
    """The model's header at `n` poses."""
    program = compiled(MAIN, model, directory)
    done = subprocess.run([program], input=poses_of(model, n).tobytes(), capture_output=True, check=True)
    *numbers, missed = done.stderr.split()
    forward_us, inverse_us, closure_mm = map(float, numbers)
    places_mm = np.frombuffer(done.stdout).reshape(n, -1, 3)
    return RunInC(places_mm, forward_us, inverse_us, closure_mm, int(missed))


def c_error_mm(model: CalibratedModel, directory: Path, n: int = 300) -> float:
    """By how much the header is off the model without what the header leaves out."""
    export = Export(model, "")
    machine = Machine(without_parts(model, written_effects(export)), export.setup)
    places = run_c(model, directory, n).places_mm
    wanted = [machine.corrected_mm(prism, poses_of(model, n)) for prism in model.rig.prism_names]
    return float(np.abs(places - np.stack(wanted, axis=1)).max())


BOOM = (
    "boom_droop@boom,pad_play@boom,joint_compliance@theta4,joint_compliance@theta1,lateral_compliance@theta3,"
    "linkage_coupling@theta1,encoder_harmonic@theta5"
)


def test_c_of_ten_thousand_poses_is_the_model_in_a_few_us(session: Session, tmp_path: Path) -> None:
    model = with_effects(session.model, BOOM, 0)
    found = run_c(model, tmp_path, 10_000)
    machine = Machine(model, 0)
    for index, prism in enumerate(model.rig.prism_names):
        wanted = machine.corrected_mm(prism, poses_of(model, 10_000))
        np.testing.assert_allclose(found.places_mm[:, index], wanted, rtol=0.0, atol=EXACT_MM)
    assert found.forward_us < FORWARD_US
    assert found.inverse_us < INVERSE * found.forward_us
    assert (found.closure_mm <= EXACT_MM, found.missed) == (True, 0)


def test_the_inverse_in_c_goes_round_the_gap_that_play_leaves(session: Session, tmp_path: Path) -> None:
    """Targets where the load on a joint turns round: the shortest way may end between the two sides of its play."""
    model = with_effects(session.model, "gravity_flip_play@theta8", -1)
    program = GAP.replace("TURNED", str(model.rig.joint_names.index("theta8")))
    done = subprocess.run([compiled(program, model, tmp_path)], capture_output=True, text=True, check=True)
    targets, missed, closure_mm = map(float, done.stdout.split())
    assert targets > 3_000
    assert (missed, closure_mm <= EXACT_MM) == (0, True)


@pytest.mark.long
@pytest.mark.parametrize(
    ("effects", "variant"),
    [
        ("boom_droop@boom", -1),
        ("passive_compliance@row2", -1),
        ("lateral_compliance@theta3", -1),
        ("joint_compliance@theta4", 1),
        ("joint_compliance@theta4", 3),
        ("joint_compliance@theta4", -1),
        ("gravity_flip_play@theta4", 0),
        ("gravity_flip_play@theta8", -1),
        ("transducer_scale@L2,transducer_quadratic@L3,transducer_index_jump@L2,zero_step@theta5", 0),
        (
            "angle_scale@theta3,encoder_harmonic@theta6,joint_error_map@theta7,backlash@theta4,thermal_expansion@boom",
            -1,
        ),
    ],
)
def test_every_effect_that_c_has_is_the_models(session: Session, tmp_path: Path, effects: str, variant: int) -> None:
    model = with_effects(session.model, effects, variant)
    assert written_effects(Export(model, "")) == model.effects
    assert c_error_mm(model, tmp_path) <= EXACT_MM


@pytest.mark.parametrize("regime", [Regime("theta4_deg", True, 20.0), Regime("torque(theta4)", False, -3e4)])
def test_a_part_of_the_data_is_a_condition_in_c(session: Session, tmp_path: Path, regime: Regime) -> None:
    assert c_error_mm(with_effects(session.model, "angle_scale@theta3", 0, regime), tmp_path) <= EXACT_MM


def test_what_c_leaves_out_is_said_with_its_error(session: Session, tmp_path: Path) -> None:
    model = with_effects(session.model, "angle_scale@theta3,leak_down@theta4,solar_bow@theta4,station_scale@station", 0)
    (form,) = chosen_formats(["c-header"])
    left_out = form.left_out(Export(model, "0" * 64))
    assert left_out.parts == ("leak_down@theta4", "solar_bow@theta4")
    assert "station_scale@station moves fixes or the base" in left_out.not_measured[0]
    assert any("without leak_down@theta4 is not measured here" in sentence for sentence in left_out.sentences)
    text = form.content(Export(model, "0" * 64)).decode()
    assert all(sentence in " ".join(text.split()) for sentence in left_out.sentences)
    assert c_error_mm(model, tmp_path) <= EXACT_MM


def test_the_error_of_leaving_effects_out_is_what_they_do(session: Session) -> None:
    model = with_effects(session.model, "joint_compliance@theta4,encoder_harmonic@theta3", 0)
    found = Export(model, "").kinematics_alone
    poses = poses_of(model, 2_000)
    whole = np.stack([Machine(model, 0).corrected_mm(prism, poses) for prism in model.rig.prism_names], axis=1)
    off = np.linalg.norm(whole - kinematics_mm(model, poses), axis=2)
    assert found.rms_mm == pytest.approx(np.sqrt((off**2).mean()), rel=0.1)
    assert 0.0 < found.rms_mm < found.p95_mm < found.max_mm
    assert Export(session.model, "").kinematics_alone.parts == ()


def test_urdf_in_pinocchio_and_yourdfpy_is_the_kinematics(session: Session) -> None:
    import yourdfpy

    model = with_effects(session.model, "joint_compliance@theta4", 0)
    text = export_files(Export(model, "0" * 64), ["urdf"])["model.urdf"].decode()
    assert "It leaves out joint_compliance@theta4." in text
    poses = poses_of(model, 20)
    wanted = kinematics_mm(model, poses)
    places = Pinocchio(text, model.rig.joints).places_mm(model.rig.prism_names, poses)
    np.testing.assert_allclose(places, wanted, rtol=0.0, atol=EXACT_MM)
    robot = yourdfpy.URDF.load(io.BytesIO(text.encode()), load_meshes=False)
    joints = zip(model.rig.joints, poses[0], strict=True)
    robot.update_cfg({j.name: np.radians(v) if j.kind == "revolute" else v / 1e3 for j, v in joints})
    found = [robot.get_transform(prism, "base")[:3, 3] * 1e3 for prism in model.rig.prism_names]
    np.testing.assert_allclose(found, wanted[0], rtol=0.0, atol=1e-8)


def test_xacro_expands_to_the_urdf_with_a_prefix(session: Session, tmp_path: Path) -> None:
    import xacro

    files = export_files(Export(session.model, "0" * 64), ["xacro", "urdf"])
    (tmp_path / "model.xacro").write_bytes(files["model.xacro"])
    text = xacro.process_file(str(tmp_path / "model.xacro"), mappings={"prefix": "left_"}).toxml()
    joints = [joint.model_copy(update={"name": f"left_{joint.name}"}) for joint in session.rig.joints]
    poses = poses_of(session.model, 5)
    places = Pinocchio(text, joints).places_mm([f"left_{name}" for name in session.rig.prism_names], poses)
    np.testing.assert_allclose(places, kinematics_mm(session.model, poses), rtol=0.0, atol=EXACT_MM)


def test_the_table_is_the_same_machine_when_it_is_imported(session: Session) -> None:
    text = export_files(Export(session.model, "0" * 64), ["dh-csv"])["dh.csv"].decode()
    rig = draft_of_table(text, "dh.csv").rig()
    assert (rig.joint_names, rig.prism_names) == (session.rig.joint_names, session.rig.prism_names)
    poses = poses_of(session.model, 20)
    chain = Chain(rig, {"": Placement.identity()})
    found = Bodies.of(chain, np.zeros(len(chain)), poses).prisms_mm
    np.testing.assert_allclose(found, kinematics_mm(session.model, poses), rtol=0.0, atol=EXACT_MM)


def test_the_mat_file_is_the_kinematics_by_the_ten_lines_that_it_describes(session: Session) -> None:
    told = loadmat(io.BytesIO(export_files(Export(session.model, "0" * 64), ["matlab"])["model.mat"]))
    assert "T{k} = T{parent(k)}" in str(told["about"])
    for q, wanted in zip(told["check_q"], told["check_prisms"], strict=True):
        frames = [np.eye(4)]
        for k, parent in enumerate(told["parent"].ravel()):
            size, axis, motion = told["drive"][k] @ q, told["axis"].ravel()[k] - 1, np.eye(4)
            if told["kind"].ravel()[k] == 2:
                motion[axis, 3] = size
            elif told["kind"].ravel()[k] == 1:
                u, v = (axis + 1) % 3, (axis + 2) % 3
                motion[u, u] = motion[v, v] = np.cos(size)
                motion[v, u], motion[u, v] = np.sin(size), -np.sin(size)
            frames.append(frames[parent] @ told["fixed"][:, :, k] @ motion)
        for p, motion_of_prism in enumerate(told["prism_motion"].ravel()):
            place = frames[motion_of_prism] @ [*told["prism_place"][p], 1.0]
            np.testing.assert_allclose(place[:3], wanted[:, p], rtol=0.0, atol=EXACT_MM)


def test_parquet_is_the_grid_with_its_description(session: Session) -> None:
    from pyarrow import parquet

    export = Export(session.model, "0" * 64, ("w", "r"), 512)
    table = parquet.read_table(io.BytesIO(export_files(export, ["parquet"])["corrections.parquet"]))
    assert b"between the nodes" in table.schema.metadata[b"rigcal"]
    assert table.num_rows == 2 * len(export.grid.readings)
    rows = table.to_pydict()
    first = [rows[f"{axis}_corrected_mm"][0] for axis in "xyz"]
    np.testing.assert_array_equal(first, export.grid.corrected_mm["w"][0])
    assert rows["theta1_deg"][: len(export.grid.readings)] == export.grid.readings[:, 0].tolist()
