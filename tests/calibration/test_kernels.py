"""The compiled fitness is the NumPy reference, whatever the rig and wherever numba may write."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from calibration.kernels import Fitness
from calibration.rig import Rig
from tests.calibration.test_kinematics import chain_at_random, rigs


@pytest.mark.parametrize("rig", rigs(), ids=lambda r: r.name)
@pytest.mark.parametrize("robust_scale", [np.inf, 20.0])
def test_the_kernel_equals_the_reference(rig: Rig, robust_scale: float) -> None:
    chain, data, x = chain_at_random(rig, 3, n=700)
    rng = np.random.default_rng(4)
    measured = chain.positions_mm(x, data) + rng.normal(0, 10, (len(data), 3))
    weight = rng.uniform(0.5, 2.0, len(data))
    population = x * rng.uniform(0.5, 1.5, (20, len(chain)))
    squares = [weight * ((chain.positions_mm(c, data) - measured) ** 2).sum(axis=1) for c in population]
    reference = [(s / (1.0 + s / robust_scale**2)).sum() for s in squares]
    fitness = Fitness.build(chain, data, measured, weight, robust_scale)
    np.testing.assert_allclose(fitness(population), reference, rtol=1e-9)


def test_a_fitness_travels_to_another_process() -> None:
    chain, data, x = chain_at_random(rigs()[0])
    fitness = Fitness.build(chain, data, np.zeros((len(data), 3)), np.ones(len(data)))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fitness))(x[None]), fitness(x[None]))


def test_the_kernel_compiles_where_numba_finds_no_place_for_its_cache() -> None:
    script = textwrap.dedent(
        """
        from numba.core import caching
        caching.CacheImpl._locator_classes = []
        import numpy as np
        from calibration.kernels import Fitness
        from calibration.kinematics import Chain, ChainData, Placement
        from calibration.rig import shipped_rig
        chain = Chain(shipped_rig("ur10"), {"": Placement.identity()})
        data = ChainData(np.zeros((2, 6)), np.zeros(2, int), np.zeros(2, int))
        print(Fitness.build(chain, data, np.zeros((2, 3)), np.ones(2))(np.zeros((1, len(chain))))[0] > 0.0)
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, env=dict(os.environ), check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, "True"), done.stderr
