"""The ways to identify: the default and the published ones, told apart here and nowhere else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.library import library
from calibration.gap.adopt import Adopted, adopt
from calibration.gap.remaining import remaining
from calibration.gap.search import search
from calibration.identification.refinement import Prior
from calibration.identification.search.checkpoint import Checkpoint
from calibration.identification.solve import solve
from calibration.observations import Observations
from calibration.published.first_paper import pde_paper
from calibration.published.second_paper import km, require_torques, skcm
from calibration.residual.hybrid import Kind
from calibration.rig import Rig

Progress = Callable[[float, str], None]

METHODS = ("default", "pde-paper", "km", "skcm", "rbf-tcm")
TORQUE_NETWORK = "rbf-tcm"  # the method whose learner is its own
# What a published method ends with.
OWN_LEARNERS: Mapping[str, Kind] = {"km": "none", "skcm": "none", "pde-paper": "chain"}
_OWN_EFFECTS = "the method has none of its own"


@dataclass(frozen=True)
class Options:
    """How to identify.

    Attributes:
        prior: trust the build tolerances, or estimate their scale.
        effects: `none`, `auto` or FAMILY@WHERE,...; the second paper's methods have their own.
        seed: of everything random.
        executor: runs what is independent; the result does not depend on it.
        progress: told (share done, what is going on).
        should_stop: asked during a global search; once it says so, the best so far is taken.
        checkpoint: where a global search keeps its state, and goes on from.
    """

    prior: Prior
    effects: str
    seed: int
    executor: Executor
    progress: Progress
    should_stop: Callable[[], bool] | None = None
    checkpoint: Checkpoint | None = None


def identify_by(method: str, rig: Rig, observations: Observations, options: Options) -> Adopted:
    """Kinematics and effects by one of `METHODS`.

    Raises:
        ValueError: an unknown method or effect.
        DataError: data that the method cannot use.
        UnsafeError: as the method refuses.
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not available; available: {', '.join(METHODS)}")
    if method != "default" and options.effects not in ("auto", "none"):
        raise ValueError(
            f"method {method!r} takes no effects; leave {options.effects!r} out, or use the default method"
        )
    if method == "skcm":
        return skcm(rig, observations, progress=options.progress)
    if method in ("km", TORQUE_NETWORK):
        if method == TORQUE_NETWORK:
            require_torques(rig, observations, method)
        solution = km(rig, observations, progress=options.progress)
        return Adopted(solution, solution.fit, reason=_OWN_EFFECTS)
    if method == "pde-paper":
        solution = pde_paper(
            rig,
            observations,
            prior=options.prior,
            seed=options.seed,
            executor=options.executor,
            progress=options.progress,
            should_stop=options.should_stop,
            checkpoint=options.checkpoint,
        )
        return Adopted(solution, solution.fit, reason=_OWN_EFFECTS)
    solution = solve(
        rig,
        observations,
        prior=options.prior,
        seed=options.seed,
        executor=options.executor,
        progress=lambda share, what: options.progress(0.8 * share, what),
        should_stop=options.should_stop,
        checkpoint=options.checkpoint,
    )
    options.progress(0.8, "asking for effects")
    if options.effects == "auto":
        found = search(solution, observations, library(), prior=options.prior, seed=options.seed)
        rest = remaining(found, np.random.default_rng([options.seed, 1]))
        return replace(rest.adopted, warnings=(*rest.adopted.warnings, *rest.doubts()))
    return adopt(solution, observations, options.effects, prior=options.prior)
