"""The compiled fitness is the NumPy reference, whatever the rig, the data's order and wherever numba may write."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.kinematics.chain_reduction import reduce_chain
from calibration.kinematics.fitness import Fitness, evaluate
from calibration.kinematics.population_loops import fitness as compiled_fitness
from calibration.numerics.matrices import gram
from calibration.observations import Floats
from calibration.rig.description import Rig, parse_rig, shipped_rig
from tests.calibration.kinematics.test_kinematics import chain_at_random, rigs

MADE = Path(__file__).parents[2] / "rigs"
RIGS = [*rigs(), *(parse_rig((MADE / f"{name}.toml").read_text(), name) for name in ("lift_arm", "torso"))]
LIFTED = """
name = "lifted"
convention = "dh"
tolerances = { length_mm = 1, angle_deg = 0.1, beta_deg = 0.1, prism_mm = 1 }
joint = [
    { name = "lift", kind = "prismatic", limits = [0, 800], sigma = 0.1 },
    { name = "q1", kind = "revolute", limits = [-90, 90], sigma = 0.01 },
    { name = "q2", kind = "revolute", limits = [-90, 90], sigma = 0.01 },
    { name = "reach", kind = "prismatic", limits = [0, 500], sigma = 0.1 },
    { name = "out", kind = "prismatic", limits = [0, 500], sigma = 0.1 },
]
prism = [
    { name = "column", frame = 1, offset_mm = [100, 0, 0] },
    { name = "knee", frame = 3, offset_mm = [0, 50, 0] },
    { name = "tip", frame = 5, offset_mm = [100, -50, 20] },
]
[[row]]
d_mm = 500
drive = { d = { lift = 1.0 } }
[[row]]
alpha_deg = 90
drive = { theta = { q1 = 1.0 } }
[[row]]
a_mm = 400
drive = { theta = { q2 = 1.0 }, a = { reach = 1.0 }, d = { reach = 0.1, out = -0.2 } }
[[row]]
alpha_deg = 90
a_mm = 150
drive = { theta = { q1 = -1.0, q2 = -1.0 } }
[[row]]
d_mm = 300
alpha_deg = 10
drive = { d = { out = 1.0 }, a = { reach = -0.3 } }
"""


def reference(
    chain: Chain, data: ChainData, measured: Floats, weight: Floats, population: Floats, scale: float = np.inf
) -> Floats:
    squares = np.array([weight * ((chain.positions_mm(x, data) - measured) ** 2).sum(axis=1) for x in population])
    total: Floats = (squares / (1.0 + squares / scale**2)).sum(axis=1)
    return total


def problem(rig: Rig, seed: int = 3, n: int = 700) -> tuple[Chain, ChainData, Floats, Floats, Floats]:
    """Chain, data, measured positions, weights and 20 candidates about the truth."""
    chain, data, x = chain_at_random(rig, seed, n)
    rng = np.random.default_rng(seed + 1)
    measured = chain.positions_mm(x, data) + rng.normal(0, 10, (n, 3))
    return chain, data, measured, rng.uniform(0.5, 2.0, n), x * rng.uniform(0.5, 1.5, (20, len(chain)))


@pytest.mark.parametrize("rig", [*RIGS, parse_rig(LIFTED, "lifted")], ids=lambda r: r.name)
@pytest.mark.parametrize("robust_scale", [np.inf, 20.0])
@pytest.mark.slow
def test_the_kernel_equals_the_reference(rig: Rig, robust_scale: float) -> None:
    chain, data, measured, weight, population = problem(rig)
    population[0] = 0.0  # neighbouring axes that are exactly parallel
    fitness = Fitness.build(chain, data, measured, weight, robust_scale)
    expected = reference(chain, data, measured, weight, population, robust_scale)
    np.testing.assert_allclose(fitness(population), expected, rtol=1e-9)


@pytest.mark.parametrize("rig", RIGS, ids=lambda r: r.name)
def test_prisms_seen_from_one_pose_may_be_missing_or_repeated(rig: Rig) -> None:
    chain, data, _, weight, population = problem(rig)
    rng = np.random.default_rng(5)
    data = data.select(np.sort(rng.integers(0, 20, len(data))))  # readings that recur, with any prisms
    data = ChainData(data.readings, rng.integers(0, len(rig.prisms), len(data)), data.setup)
    measured = chain.positions_mm(population[1], data) + rng.normal(0, 10, (len(data), 3))
    fitness = Fitness.build(chain, data, measured, weight)
    np.testing.assert_allclose(fitness(population), reference(chain, data, measured, weight, population), rtol=1e-9)


def test_all_prisms_from_more_poses_than_a_chunk_holds() -> None:
    chain, data, x = chain_at_random(shipped_rig("swdt82"), 6, n=777)
    data = ChainData(np.repeat(data.readings, 4, axis=0), np.tile(np.arange(4), 777), np.repeat(data.setup, 4))
    measured, weight = np.zeros((len(data), 3)), np.ones(len(data))
    fitness = Fitness.build(chain, data, measured, weight)
    np.testing.assert_allclose(fitness(x[None]), reference(chain, data, measured, weight, x[None]), rtol=1e-9)


@pytest.mark.parametrize("rig", RIGS, ids=lambda r: r.name)
def test_candidates_may_consist_of_some_parameters_with_the_others_fixed(rig: Rig) -> None:
    chain, data, measured, weight, population = problem(rig)
    free = np.random.default_rng(0).random(len(chain)) < 0.6
    at = population[3]
    fitness = Fitness.build(chain, data, measured, weight, free=free, at=at)
    expected = reference(chain, data, measured, weight, np.where(free, population, at))
    np.testing.assert_allclose(fitness(population[:, free]), expected, rtol=1e-9)
    fixed = Fitness.build(chain, data, measured, weight, free=np.zeros(len(chain), dtype=bool), at=at)
    expected = reference(chain, data, measured, weight, at[None])
    np.testing.assert_allclose(fixed(np.empty((1, 0))), expected, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("rig", RIGS, ids=lambda r: r.name)
def test_float32_is_right_to_a_few_millionths(rig: Rig) -> None:
    chain, data, measured, weight, population = problem(rig)
    fitness = Fitness.build(chain, data, measured, weight, 1000.0, precision="float32")
    expected = reference(chain, data, measured, weight, population, 1000.0)
    np.testing.assert_allclose(fitness(population), expected, rtol=2e-5)
    assert not np.array_equal(fitness(population), expected)


def test_float32_does_not_suffer_from_a_distant_origin() -> None:
    chain, data, x = chain_at_random(shipped_rig("swdt82"), 3, n=400)
    far = {name: Placement(p.rotation, p.translation_mm + 5e6) for name, p in chain.placements.items()}
    chain = Chain(chain.rig, far)
    measured = chain.positions_mm(x, data) + np.random.default_rng(0).normal(0, 3, (len(data), 3))
    weight = np.ones(len(data))
    fitness = Fitness.build(chain, data, measured, weight, precision="float32")
    np.testing.assert_allclose(fitness(x[None]), reference(chain, data, measured, weight, x[None]), rtol=1e-4)


@pytest.mark.parametrize("robust_scale", [np.inf, 20.0])
def test_pairs_add_the_error_of_their_direction(robust_scale: float) -> None:
    chain, data, measured, weight, population = problem(shipped_rig("swdt82"))
    rng = np.random.default_rng(1)
    pairs, pair_weight = rng.integers(0, len(data), (100, 2)), rng.uniform(0.5, 2.0, 100)
    plain = Fitness.build(chain, data, measured, weight, robust_scale)
    paired = Fitness.build(chain, data, measured, weight, robust_scale, pairs=pairs, pair_weight=pair_weight)
    added = []
    for x in population:
        error = chain.positions_mm(x, data) - measured
        squares = pair_weight * ((error[pairs[:, 0]] - error[pairs[:, 1]]) ** 2).sum(axis=1)
        added.append((squares / (1.0 + squares / robust_scale**2)).sum())
    np.testing.assert_allclose(paired(population), plain(population) + added, rtol=1e-9)


@pytest.mark.parametrize("turns", [1.0, 1e3, 1e5])
def test_angles_of_many_turns_are_angles(turns: float) -> None:
    chain, data, measured, weight, population = problem(shipped_rig("ur10"), n=50)
    population[:, [p.unit == "rad" for p in chain.parameters]] *= 2.0 * np.pi * turns
    fitness = Fitness.build(chain, data, measured, weight)
    np.testing.assert_allclose(fitness(population), reference(chain, data, measured, weight, population), rtol=1e-8)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("parameter", ["row2.a", "row2.alpha", "base[a].rx"])
def test_a_candidate_that_overflows_stays_visible(
    precision: Literal["float64", "float32"], value: float, parameter: str
) -> None:
    chain, data, measured, weight, population = problem(shipped_rig("ys100"), n=50)
    population[7, chain.index(parameter)] = value
    cost = Fitness.build(chain, data, measured, weight, precision=precision)(population)
    assert np.flatnonzero(~np.isfinite(cost)).tolist() == [7]


@pytest.mark.parametrize("pieces", [1, 2, 7, 300])
def test_pieces_and_workers_change_nothing(pieces: int) -> None:
    chain, data, measured, weight, population = problem(shipped_rig("swdt82"), n=100)
    population = np.random.default_rng(0).permutation(np.repeat(population, 10, axis=0) * 1.001)
    fitness = Fitness.build(chain, data, measured, weight)
    with ThreadPoolExecutor(2) as executor:
        np.testing.assert_array_equal(evaluate(fitness, population, executor, pieces), fitness(population))
    np.testing.assert_array_equal(fitness(population[13:14]), fitness(population)[13:14])


def test_candidates_with_another_number_of_parameters_are_refused() -> None:
    chain, data, measured, weight, population = problem(shipped_rig("ur10"), n=50)
    fitness = Fitness.build(chain, data, measured, weight)
    with pytest.raises(ValueError, match=f"they need {len(chain)} columns"):
        fitness(population[:, :-1])


def test_a_fitness_travels_to_another_process() -> None:
    chain, data, measured, weight, population = problem(shipped_rig("swdt82"), n=100)
    fitness = Fitness.build(chain, data, measured, weight)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fitness))(population), fitness(population))


def test_arrays_that_cannot_be_written_do_not_compile_anything_anew() -> None:
    chain, data, measured, weight, population = problem(shipped_rig("swdt82"), n=100)
    fitness = Fitness.build(chain, data, measured, weight)
    expected = fitness(population)
    compiled = len(compiled_fitness.signatures), len(reduce_chain.signatures)
    buffers: list[pickle.PickleBuffer] = []
    stream = pickle.dumps(fitness, protocol=5, buffer_callback=buffers.append)
    received = pickle.loads(stream, buffers=[bytes(b.raw()) for b in buffers])
    population.setflags(write=False)
    np.testing.assert_array_equal(received(population), expected)
    assert (len(compiled_fitness.signatures), len(reduce_chain.signatures)) == compiled


@pytest.mark.long
def test_the_kernel_compiles_where_numba_finds_no_place_for_its_cache() -> None:
    script = textwrap.dedent(
        """
        from numba.core import caching
        caching.CacheImpl._locator_classes = []
        import numpy as np
        from calibration.kinematics.fitness import Fitness
        from calibration.kinematics.chain import Chain, ChainData, Placement
        from calibration.rig.description import shipped_rig
        chain = Chain(shipped_rig("ur10"), {"": Placement.identity()})
        data = ChainData(np.zeros((2, 6)), np.zeros(2, int), np.zeros(2, int))
        print(Fitness.build(chain, data, np.zeros((2, 3)), np.ones(2))(np.zeros((1, len(chain))))[0] > 0.0)
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, env=dict(os.environ), check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, "True"), done.stderr


@pytest.mark.parametrize("rare", [0, 80, 200])
def test_products_of_columns_are_the_same_however_many_are_mostly_zero(rare: int) -> None:
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(300, 200))
    columns = rng.permutation(200)[:rare]
    rows[:, columns] *= rng.random((300, rare)) < 0.05
    np.testing.assert_allclose(gram(rows), rows.T @ rows, rtol=0.0, atol=1e-10)
