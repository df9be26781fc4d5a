"""The first paper's differential evolution and objective are what the paper says they are."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import DataError
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.observations import Floats
from calibration.published.paper_evolution import PaperSettings, evolve_paper
from calibration.published.paper_objective import PaperObjective
from calibration.rig.description import shipped_rig
from calibration.run_settings import Run
from tests.calibration.searches import PAPER, Kept, assert_same, paper_search, rastrigin, sphere, sphere_with_holes

LOWER, UPPER = np.full(6, -5.0), np.full(6, 5.0)


class Recorder:
    """A fitness that keeps the populations it was asked about."""

    def __init__(self) -> None:
        self.asked: list[Floats] = []

    def __call__(self, population: Floats) -> Floats:
        self.asked.append(population.copy())
        return rastrigin(population)


def generations(settings: PaperSettings, lower: Floats = LOWER, upper: Floats = UPPER) -> list[tuple[Floats, Floats]]:
    """(parents, trials) of every generation, the parents by greedy selection from what was evaluated."""
    recorder = Recorder()
    with ThreadPoolExecutor(1) as pool:
        evolve_paper([recorder], rastrigin, lower, upper, run=Run(3, pool), settings=settings)
    parents, found = recorder.asked[0], []
    for trials in recorder.asked[1 : settings.generations + 1]:
        found.append((parents, trials))
        better = rastrigin(trials) < rastrigin(parents)
        parents = np.where(better[:, None], trials, parents)
    return found


def mutants(population: Floats, factor: float, lower: Floats, upper: Floats, parent: int) -> Floats:
    """(k, p) every v = x_p1 + F (x_p2 - x_p3) of different others, reflected at the bounds."""
    others = [i for i in range(len(population)) if i != parent]
    triples = np.array(list(itertools.permutations(others, 3)))
    one, two, three = population[triples].transpose(1, 0, 2)
    v = one + factor * (two - three)
    v = np.where(v < lower, np.minimum(upper, 2 * lower - v), v)
    return np.where(v > upper, np.maximum(lower, 2 * upper - v), v)


def test_trials_are_the_papers_mutants_reflected_at_the_bounds() -> None:
    settings = PaperSettings(population=6, generations=12, scale_factor=0.9, subpopulations=1)
    lower, upper = np.array([-5.0, -0.2, 1.0]), np.array([5.0, 0.3, 1.5])
    reflected = 0
    for parents, trials in generations(settings, lower, upper):
        assert ((trials >= lower) & (trials <= upper)).all()
        for parent, trial in enumerate(trials):
            candidates = mutants(parents, 0.9, lower, upper, parent)
            assert np.abs(candidates - trial).max(axis=1).min() < 1e-12
            free = mutants(parents, 0.9, lower - 1e9, upper + 1e9, parent)
            reflected += np.abs(free - trial).max(axis=1).min() > 1e-12
    assert reflected > 10


def test_binomial_crossover_takes_each_dimension_at_its_rate_and_one_always() -> None:
    for rate in (0.0, 0.3):
        settings = PaperSettings(population=400, generations=3, crossover=rate, subpopulations=1)
        taken = np.concatenate([trials != parents for parents, trials in generations(settings)])
        assert taken.any(axis=1).all()
        expected = (1 + 5 * rate) / 6  # the forced one, and the others by chance
        np.testing.assert_allclose(taken.mean(axis=0), expected, atol=0.06)


def test_the_population_starts_uniformly_within_the_bounds() -> None:
    lower, upper = np.array([-5.0, 10.0]), np.array([5.0, 30.0])
    settings = PaperSettings(population=5000, generations=1)
    with ThreadPoolExecutor(1) as pool:
        recorder = Recorder()
        evolve_paper([recorder], rastrigin, lower, upper, run=Run(0, pool), settings=settings)
    share = (np.concatenate(recorder.asked[: settings.subpopulations]) - lower) / (upper - lower)
    assert len(share) == 5000
    for column in share.T:
        np.testing.assert_allclose(np.histogram(column, 10, (0.0, 1.0))[0], 500, atol=100)


def test_the_settings_are_the_papers_by_default() -> None:
    settings = PaperSettings()
    assert (settings.population, settings.generations) == (30_000, 400)
    assert (settings.scale_factor, settings.crossover) == (0.5, 1.0)


def test_the_search_finds_the_optimum_around_holes() -> None:
    settings = PaperSettings(population=100, generations=150)
    with ThreadPoolExecutor(2) as pool:
        found = evolve_paper([sphere_with_holes], sphere, LOWER, UPPER, run=Run(0, pool), settings=settings)
    np.testing.assert_allclose(found.x, 1.0, atol=1e-3)


def test_subpopulations_change_nothing_not_even_after_an_interruption() -> None:
    kept = Kept()
    with ThreadPoolExecutor(2) as pool:
        whole = paper_search(pool, kept)
        for state in kept.states:
            continued = evolve_paper(
                [sphere, rastrigin],
                rastrigin,
                LOWER,
                UPPER,
                run=Run(5, pool, checkpoint=Kept(state)),
                settings=replace(PAPER, subpopulations=7),
            )
            assert_same(continued, whole)
            assert continued.set_aside is None


def test_the_winner_of_the_repeated_searches_is_the_one_that_all_data_prefer() -> None:
    def far(population: Floats) -> Floats:
        return sphere(population + 3.0)

    settings = PaperSettings(population=40, generations=60)
    with ThreadPoolExecutor(2) as pool:
        found = evolve_paper([far, sphere, far], sphere, LOWER, UPPER, run=Run(0, pool), settings=settings)
    np.testing.assert_allclose(found.x, 1.0, atol=0.1)
    assert found.cost == sphere(found.x[None])[0]
    assert found.evaluations == 3 * 40 * 61


def test_a_search_that_is_told_to_stop_returns_the_best_so_far_and_says_so() -> None:
    shares: list[float] = []
    settings = PaperSettings(population=40, generations=10)
    with ThreadPoolExecutor(2) as pool:
        found = evolve_paper(
            [sphere, sphere],
            sphere,
            LOWER,
            UPPER,
            run=Run(0, pool, progress=lambda share, _: shares.append(share), should_stop=lambda: len(shares) == 13),
            settings=settings,
        )
    assert not found.complete
    assert shares == pytest.approx([k / 20 for k in range(1, 14)])
    assert found.evaluations == 40 * (11 + 4)


def test_a_population_of_fewer_than_four_is_refused() -> None:
    settings = PaperSettings(population=3)
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(ValueError, match="of 3 candidates; at least 1 search of 4 is needed"),
    ):
        evolve_paper([sphere], sphere, LOWER, UPPER, run=Run(0, pool), settings=settings)


def objective(**changed: object) -> PaperObjective:
    """Twelve poses of the boom; prism b is seen in every third, the last has no label."""
    rig = shipped_rig("swdt82")
    chain = Chain(rig, {"": Placement.identity()})
    rng = np.random.default_rng(0)
    rows = [
        (pose, prism) for pose in range(12) for prism in range(4) if not (rig.prism_names[prism] == "b" and pose % 3)
    ]
    poses, prisms = np.array(rows).T
    readings = np.column_stack([rng.uniform(*joint.limits, 12) for joint in rig.joints])[poses]
    data = ChainData(readings, prisms, np.zeros(len(rows), dtype=np.intp))
    label = np.char.add("s", poses.astype(str))
    label[poses == 11] = ""
    measured = chain.positions_mm(np.zeros(len(chain)), data) + rng.normal(0.0, 20.0, (len(rows), 3))
    options = {"weight": {"r": 2.0, "s": 1.0, "b": 0.5}, "attitude": ("r", "s"), "attitude_weight": 0.7} | changed
    return PaperObjective(chain, data, measured, label, **options)  # type: ignore[arg-type]  # passed through


@pytest.mark.long
def test_the_objective_is_equation_19_with_the_attitude() -> None:
    paper = objective()
    rng = np.random.default_rng(1)
    size = np.where([p.unit == "mm" for p in paper.chain.parameters], 50.0, 0.02)
    population = rng.normal(size=(5, len(paper.chain))) * size
    names, expected = paper.chain.rig.prism_names, []
    for x in population:
        error = paper.chain.positions_mm(x, paper.data) - paper.position_mm
        square = (error**2).sum(axis=1)
        total = sum(mu * square[paper.data.prism == names.index(name)].mean() for name, mu in paper.weight.items())
        attitude = []
        for pose in np.unique(paper.pose[paper.pose != ""]):
            r, s = ((paper.pose == pose) & (paper.data.prism == names.index(name)) for name in "rs")
            attitude.append(((error[r] - error[s]) ** 2).sum())
        assert len(attitude) == 11
        expected.append(total + 0.7 * np.mean(attitude))
    np.testing.assert_allclose(paper.fitness()(population), expected, rtol=1e-9)


def test_the_objective_names_what_the_data_lack() -> None:
    paper = objective()
    only_r = np.flatnonzero(paper.data.prism == paper.chain.rig.prism_names.index("r"))
    with pytest.raises(DataError, match="no pose has fixes of both 'r' and 's'"):
        objective(weight={"r": 1.0}).fitness(only_r)
    with pytest.raises(DataError, match="prism 's' has weight 1 in the objective but no fix"):
        paper.fitness(only_r)
    with pytest.raises(DataError, match="no prism 'q'"):
        objective(weight={"q": 1.0}).fitness()


def test_shuffled_parts_keep_the_fixes_of_a_pose_together() -> None:
    paper = objective()
    parts = paper.shuffled(20, 0.5, seed=4)
    assert len({tuple(part) for part in parts}) > 15
    for part in parts:
        inside = np.isin(np.arange(len(paper.data)), part)
        for pose in np.unique(paper.pose[paper.pose != ""]):
            assert inside[paper.pose == pose].all() or not inside[paper.pose == pose].any()
    for part, again in zip(parts, paper.shuffled(20, 0.5, seed=4), strict=True):
        np.testing.assert_array_equal(part, again)
    np.testing.assert_array_equal(paper.shuffled(1, 1.0, seed=0)[0], np.arange(len(paper.data)))


def test_no_shuffled_part_lacks_a_prism_or_the_attitude() -> None:
    paper = objective()
    for part in paper.shuffled(30, 0.1, seed=1):
        paper.fitness(part)
        assert len(part) < 13
