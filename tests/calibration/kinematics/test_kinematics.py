"""Kinematics against plain matrix products and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calibration.errors import DataError
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.kinematics.compiled_chain import CompiledChain
from calibration.observations import Floats
from calibration.rig.description import Rig, Row, parse_rig, shipped_rig
from tests.calibration.conftest import rig_text
from tests.calibration.kinematics.numpy_chain import NumpyChain

COUPLED = """
name = "torso"
convention = "mdh_beta_before"
tolerances = { length_mm = 1, angle_deg = 0.1, beta_deg = 0.1, prism_mm = 1 }
joint = [
    { name = "q1", kind = "revolute", limits = [-90, 90], sigma = 0.01 },
    { name = "lift", kind = "prismatic", limits = [0, 800], sigma = 0.1 },
    { name = "q2", kind = "revolute", limits = [-90, 90], sigma = 0.01 },
]
prism = [
    { name = "base", frame = 0, offset_mm = [10, 20, 30] },
    { name = "tip", frame = 4, offset_mm = [100, -50, 20], offset_known = false },
    { name = "other", frame = 6, offset_mm = [20, 10, 40] },
]
[[row]]
d_mm = 500
theta_deg = 30
drive = { theta = { q1 = 1.0 }, d = { lift = 1.0 } }
[[row]]
before = { x_mm = 5, y_mm = 6, z_mm = 7, rz_deg = 10, ry_deg = 20, rx_deg = 30 }
alpha_deg = 80
a_mm = 300
beta_deg = 3
b_mm = 12
identify = ["alpha", "a", "beta", "b", "theta", "d"]
drive = { theta = { q2 = -1.0 } }
[[row]]
alpha_deg = -20
drive = { theta = { q1 = -1.0, q2 = -0.5, lift = 0.01 } }
identify = ["theta"]
[[row]]
a_mm = 250
drive = { a = { lift = 0.5 } }
[[row]]  # a second arm, whose joint nobody reads: q4 = -(q1 + q2)
after = 2
a_mm = 220
alpha_deg = 60
drive = { theta = { q1 = -1.0, q2 = -1.0 } }
[[row]]
a_mm = 180
d_mm = 30
"""


def rigs() -> list[Rig]:
    return [shipped_rig("swdt82"), shipped_rig("ys100"), shipped_rig("ur10"), parse_rig(COUPLED, "torso.toml")]


def rotation(axis: str, degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {
        "x": np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]]),
        "y": np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]]),
        "z": np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    }[axis]


def translation(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Floats:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def row_matrix(rig: Rig, number: int, row: Row, readings: dict[str, float], deviation: dict[str, float]) -> Floats:
    """One row's 4 x 4 matrix, spelled out from the conventions of the rig description."""

    def constant(name: str, nominal: float) -> float:
        shift = deviation.get(f"row{number}.{name}", 0.0)
        driven = sum(k * readings[j] for j, k in row.drive.get(name, {}).items())  # type: ignore[call-overload]  # a str
        return nominal + driven + (math.degrees(shift) if name in ("alpha", "theta", "beta") else shift)

    alpha, a = rotation("x", constant("alpha", row.alpha_deg)), translation(x=constant("a", row.a_mm))
    theta, d = rotation("z", constant("theta", row.theta_deg)), translation(z=constant("d", row.d_mm))
    beta, b = rotation("y", constant("beta", row.beta_deg)), translation(y=constant("b", row.b_mm))
    before = np.eye(4)
    if row.before is not None:
        f = row.before
        before = translation(f.x_mm, f.y_mm, f.z_mm) @ rotation("z", f.rz_deg) @ rotation("y", f.ry_deg)
        before = before @ rotation("x", f.rx_deg)
    return {
        "mdh_beta_after": lambda: before @ a @ alpha @ d @ theta @ beta,
        "mdh_beta_before": lambda: before @ alpha @ a @ beta @ b @ theta @ d,
        "dh": lambda: before @ theta @ d @ a @ alpha @ beta,
    }[rig.convention]()


def chain_at_random(rig: Rig, seed: int = 0, n: int = 30) -> tuple[Chain, ChainData, Floats]:
    rng = np.random.default_rng(seed)
    turn = (rotation("z", 70) @ rotation("y", -80) @ rotation("x", 130))[:3, :3]
    chain = Chain(
        rig, {"a": Placement(turn, rng.normal(size=3) * 1e3), "b": Placement(turn.T, rng.normal(size=3) * 1e3)}
    )
    readings = np.column_stack([rng.uniform(*j.limits, n) for j in rig.joints])
    data = ChainData(readings, rng.integers(0, len(rig.prisms), n), rng.integers(0, 2, n))
    size = np.where([p.unit == "mm" for p in chain.parameters], 20.0, 0.02)
    return chain, data, rng.normal(size=len(chain)) * size


@pytest.mark.parametrize("rig", rigs(), ids=lambda r: r.name)
def test_positions_are_the_product_of_the_rows_matrices(rig: Rig) -> None:
    chain, data, x = chain_at_random(rig)
    deviation = {p.name: float(v) for p, v in zip(chain.parameters, x, strict=True)}
    positions, frames = chain.positions_mm(x, data), CompiledChain(chain, x).locate(data).frames_mm
    for i in range(len(data)):
        setup = chain.setups[data.setup[i]]
        placement = chain.placements[setup]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = (
            placement.rotation,
            placement.translation_mm + x[chain.base_index(data.setup[i])][:3],
        )
        tilt = np.eye(4)
        for axis in "zyx":
            tilt = tilt @ rotation(axis, math.degrees(deviation[f"base[{setup}].r{axis}"]))
        pose[:3, :3] = tilt[:3, :3] @ pose[:3, :3]
        prism = rig.prisms[data.prism[i]]
        readings = dict(zip(rig.joint_names, data.readings[i], strict=True))
        arm = [np.eye(4)]
        for number, row in enumerate(rig.rows, 1):
            before = arm[-1] if row.after is None else arm[row.after]
            arm.append(before @ row_matrix(rig, number, row, readings, deviation))
            np.testing.assert_allclose(frames[i, number], arm[-1][:3, 3], atol=1e-8)
        offset = np.array(
            [o + deviation[f"prism.{prism.name}.{k}"] for o, k in zip(prism.offset_mm, "xyz", strict=True)]
        )
        np.testing.assert_allclose(positions[i], (pose @ arm[prism.frame] @ [*offset, 1.0])[:3], atol=1e-8)


@pytest.mark.parametrize("rig", rigs(), ids=lambda r: r.name)
def test_the_parameter_jacobian_agrees_with_finite_differences(rig: Rig) -> None:
    chain, data, x = chain_at_random(rig, 1)
    jacobian = chain.linearise(x, data).jacobian
    for k, parameter in enumerate(chain.parameters):
        step = np.zeros(len(chain))
        step[k] = 1e-2 if parameter.unit == "mm" else 1e-6
        slope = (chain.positions_mm(x + step, data) - chain.positions_mm(x - step, data)) / (2 * step[k])
        np.testing.assert_allclose(jacobian[:, :, k], slope, atol=2e-5, err_msg=parameter.name)


@pytest.mark.parametrize("rig", rigs(), ids=lambda r: r.name)
def test_the_joint_jacobian_agrees_with_finite_differences(rig: Rig) -> None:
    chain, data, x = chain_at_random(rig, 2)
    jacobian = chain.linearise(x, data).joint_jacobian
    for k in range(len(rig.joints)):
        step = np.zeros(len(rig.joints))
        step[k] = 1e-4
        ahead = ChainData(data.readings + step, data.prism, data.setup)
        behind = ChainData(data.readings - step, data.prism, data.setup)
        slope = (chain.positions_mm(x, ahead) - chain.positions_mm(x, behind)) / 2e-4
        np.testing.assert_allclose(jacobian[:, :, k], slope, atol=2e-5, err_msg=rig.joints[k].name)


@pytest.mark.parametrize("rig", rigs(), ids=lambda r: r.name)
def test_the_compiled_chain_equals_the_one_in_numpy(rig: Rig) -> None:
    chain, data, x = chain_at_random(rig, 3, 60)
    expected = NumpyChain(chain).linearise(x, data)
    np.testing.assert_allclose(chain.positions_mm(x, data), expected.position_mm, rtol=0.0, atol=1e-9)
    for found, reference in zip(chain.linearise(x, data), expected, strict=True):
        np.testing.assert_allclose(found, reference, rtol=1e-9, atol=1e-9 * np.abs(reference).max())


def test_parameters_have_the_papers_count_names_and_tolerances() -> None:
    chain = Chain(shipped_rig("swdt82"), {"": Placement.identity()})
    kinds = [p.kind for p in chain.parameters]
    assert (kinds.count("row"), kinds.count("prism"), kinds.count("base")) == (38, 12, 6)
    sigma = {p.name: p.prior_sigma for p in chain.parameters}
    assert sigma["row4.beta"] == pytest.approx(math.radians(0.1))
    assert sigma["row9.d"] == 5.0
    assert sigma["prism.r.y"] == 3.0
    assert math.isinf(sigma["base.rz"])
    assert chain.parameters[chain.index("row4.theta")].unit == "rad"
    unknown = Chain(shipped_rig("ur10"), {})
    assert unknown.parameters[unknown.index("prism.tmac.x")].is_flat


def test_binding_refuses_a_set_up_without_a_placement(session) -> None:  # type: ignore[no-untyped-def]  # fixture
    chain = Chain(session.rig, {"elsewhere": Placement.identity()})
    with pytest.raises(DataError, match="set-up '' is unknown; known: 'elsewhere'"):
        chain.bind(session.training)


def test_the_shipped_text_is_what_the_shipped_rig_is_read_from() -> None:
    assert parse_rig(rig_text("ys100"), "ys100.toml") == shipped_rig("ys100")
