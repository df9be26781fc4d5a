"""Differential evolution finds optima, stops when told to, and goes on where it was interrupted."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calibration.identification.search.islands import Evolved, Settings, evolve
from calibration.observations import Floats
from calibration.run_settings import Run
from tests.calibration.searches import (
    LOWER,
    SMALL,
    UPPER,
    Kept,
    assert_same,
    default_search,
    rastrigin,
    sphere,
    sphere_with_holes,
)


def run(seed: int = 5, settings: Settings = SMALL, start: Floats | None = None, **how: object) -> Evolved:
    with ThreadPoolExecutor(2) as pool:
        own = Run(seed, pool, **how)  # type: ignore[arg-type]  # passed through
        return evolve(rastrigin, LOWER, UPPER, run=own, settings=settings, start=start)


def test_another_seed_is_another_search() -> None:
    assert not np.array_equal(run(1).x, run(2).x)


def test_the_search_leaves_the_many_local_optima_of_rastrigin() -> None:
    found = run(0, Settings(islands=4, population=80, evaluations=12_000, epochs=10))
    assert found.cost < 1e-6
    assert np.abs(found.x).max() < 1e-3
    assert found.complete


def test_every_candidate_stays_within_the_bounds() -> None:
    def outside(population: Floats) -> Floats:
        assert ((population >= LOWER) & (population <= UPPER)).all()
        return -population.sum(axis=1)

    with ThreadPoolExecutor(2) as pool:
        found = evolve(outside, LOWER, UPPER, run=Run(0, pool), settings=SMALL)
    np.testing.assert_allclose(found.x, UPPER, atol=1e-2)


def test_candidates_without_a_cost_lose() -> None:
    with ThreadPoolExecutor(2) as pool:
        found = evolve(sphere_with_holes, LOWER, UPPER, run=Run(0, pool), settings=SMALL)
    np.testing.assert_allclose(found.x, 1.0, atol=0.05)


def test_a_given_start_is_never_lost_and_progress_ends_at_one() -> None:
    shares: list[float] = []
    tiny = Settings(islands=2, population=20, evaluations=60, epochs=2)
    found = run(0, tiny, start=np.zeros((1, 6)), progress=lambda share, _: shares.append(share))
    assert found.cost == 0.0
    assert shares == [0.5, 1.0]


def test_progress_that_raises_ends_the_search() -> None:
    def cancel(share: float, message: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(progress=cancel)


def test_islands_of_too_few_candidates_are_refused() -> None:
    with pytest.raises(ValueError, match="an island needs 4 candidates"):
        run(settings=replace(SMALL, least_population=3))


def test_a_search_that_is_told_to_stop_returns_the_best_so_far_and_says_so() -> None:
    asked = iter([False, False, True])
    stopped = run(should_stop=lambda: next(asked))
    whole = run()
    assert not stopped.complete
    assert stopped.evaluations < whole.evaluations
    assert whole.cost < stopped.cost < rastrigin(np.full((1, 6), 4.5))[0]
    assert run(should_stop=lambda: True).evaluations == 3 * 40  # it has at least looked


@pytest.mark.parametrize("epoch", range(1, 6))
def test_an_interrupted_search_goes_on_bit_by_bit(epoch: int) -> None:
    every = Kept()
    whole = run(checkpoint=every)
    assert len(every.states) == 5
    continued = Kept(every.states[epoch - 1])
    shares: list[float] = []
    assert_same(run(checkpoint=continued, progress=lambda share, _: shares.append(share)), whole)
    assert shares == [k / 5 for k in range(epoch + 1, 6)]
    for state, again in zip(every.states[epoch:], continued.states[1:], strict=True):
        assert state == again


def test_a_checkpoint_of_another_search_is_set_aside_with_a_reason() -> None:
    kept = Kept()
    with ThreadPoolExecutor(1) as pool:
        whole = default_search(pool, kept)
        state = kept.states[2]

        def other(word: str, **changed: object) -> None:
            options = {"fitness": rastrigin, "lower": LOWER, "upper": UPPER, "settings": SMALL} | changed
            seed = options.pop("seed", 5)
            fresh = evolve(**options, run=Run(seed, pool))  # type: ignore[arg-type]  # as above
            found = evolve(**options, run=Run(seed, pool, checkpoint=Kept(state)))  # type: ignore[arg-type]  # as above
            assert_same(found, fresh)
            assert found.set_aside is not None
            assert f"of another search ({word} differ" in found.set_aside

        other("seed", seed=6)
        other("settings", settings=replace(SMALL, population=41))
        other("bounds, data", upper=UPPER + 1.0)
        other("start", start=np.ones((1, 6)))
        other("data", fitness=lambda population: rastrigin(population) * (1.0 + 1e-6))
        other("data", fitness=sphere)
        continued = default_search(pool, Kept(state))
    assert_same(continued, whole)
    assert continued.set_aside is None


@pytest.mark.parametrize("damage", [lambda s: b"", lambda s: s[: len(s) // 2], lambda s: s[:900] + b"x" + s[901:]])
def test_a_damaged_checkpoint_is_set_aside(damage) -> None:  # type: ignore[no-untyped-def]  # a lambda on bytes
    kept = Kept()
    with ThreadPoolExecutor(1) as pool:
        whole = default_search(pool, kept)
        found = default_search(pool, Kept(damage(kept.states[0])))
    assert_same(found, whole)
    assert found.set_aside is not None


def test_a_full_disk_does_not_end_a_search_and_is_told_once() -> None:
    class Full(Kept):
        def save(self, state: bytes) -> None:
            raise OSError(28, "No space left on device")

    found = run(checkpoint=Full())
    assert_same(found, run())
    assert len(found.warnings) == 1
    assert "could not be written ([Errno 28] No space left on device)" in found.warnings[0]


def test_nothing_in_a_checkpoint_is_ever_unpickled() -> None:
    kept = Kept()
    with ThreadPoolExecutor(1) as pool:
        whole = default_search(pool, kept)
        out = io.BytesIO()
        np.savez(out, done=np.array([print], dtype=object))
        found = default_search(pool, Kept(out.getvalue()))
    assert_same(found, whole)
    assert found.set_aside is not None
