"""Expected accuracy from the rows measured so far, and its improvement by the next poses.

The measured rows are fitted as for a model without effects. The covariance of that fit, with the noise that it found,
gives the expected accuracy over the work volume. The Jacobians of poses not yet measured give the improvement by them.
Before there are enough rows for a model, build tolerances constrain the parameters that the rows do not determine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.design.accuracy import ExpectedAccuracy, predicted_accuracy
from calibration.design.candidates import Candidates, draw, near, work_volume
from calibration.design.exchange import covariance_of
from calibration.design.knowledge import Knowledge
from calibration.design.poses import plan, whitened
from calibration.design.visibility import Bodies, Site, in_view, placement, site
from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples
from calibration.identification.solve import place
from calibration.kinematics.chain import Chain, Placement
from calibration.numerics.matrices import root_of
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

LEAST_POSES = 4  # fewer do not determine the station's place
FORECAST = 5  # number of further poses for which the meter predicts the accuracy
VOLUME = 400  # poses of the work volume; a larger sample changes the RMS by less than 2 %
_CANDIDATES = 3000
_CHUNK = 10  # poses per chunk, ordered for short motion within it; the most informative chunk comes first
_SEED = 0
_NEARER = 0.7  # a round must lower the errors to this share, otherwise it is the last
_MEDIAN_NORM = 1.54  # median norm of a 3-D normal distribution of unit variance


@dataclass(frozen=True)
class Measured:
    """Knowledge of a rig from measured rows, before a model is made from them.

    Attributes:
        knowledge: parameters and covariance of the fit, at the set-up in question. Where `is_placed` is False, the base
            is assumed and has its prior covariance; without any rows, all is from build tolerances.
        at: station and floor.
        is_placed: True if the rows determine the station's place.
        lacking: size of the joint errors that the model is known to lack, as returned by `joint_error_scale`.
        fixes: average number of fixes of a prism at a standstill.
    """

    knowledge: Knowledge
    at: Site
    is_placed: bool
    lacking: float = 0.0
    fixes: float = 1.0

    @property
    def rig(self) -> Rig:
        """The rig description."""
        return self.knowledge.chain.rig

    @cached_property
    def volume(self) -> Floats:
        """(v, joints) poses of the work volume, drawn with a fixed seed."""
        return work_volume(self.knowledge, self.at, np.random.default_rng(_SEED), VOLUME)

    def accuracy(self, root: Floats | None = None) -> ExpectedAccuracy:
        """Expected accuracy over the work volume; `root` replaces the root of the present covariance if given."""
        root = self.knowledge.root if root is None else root
        return predicted_accuracy(self.knowledge, root, self.volume, joint_error_scale=self.lacking)

    def after(self, readings: Floats, prism: str) -> Floats:
        """Root of the covariance after a prism is measured in further poses (n, joints)."""
        seen = np.zeros((len(readings), len(self.rig.prisms)), dtype=bool)
        seen[:, self.rig.prism_names.index(prism)] = True
        poses = Candidates(readings, {"fixes": np.full(len(readings), self.fixes)}, seen)
        with threadpool_limits(1, user_api="blas"):
            return np.asarray(self.knowledge.root @ root_of(covariance_of(whitened(self.knowledge, poses))))


def from_rows(rig: Rig, observations: Observations | None, setup: str, *, lacking: float = 0.0) -> Measured:
    """Estimate a rig's parameters and the station's place from measured rows.

    Until the set-up has enough poses, the rows of other set-ups determine the machine, and the station is assumed to
    stand where it sees most.

    Args:
        rig: the rig description.
        observations: rows measured so far, at any set-ups; None if there are none.
        setup: the present set-up.
        lacking: as in `Measured`.

    Raises:
        UnsafeError: the rows cannot determine the base (all positions on a line).
    """
    placed = [] if observations is None else _placed(observations)
    if observations is None or not placed:
        blank = Chain(rig, {"": Placement.identity()})
        at = site(blank, np.zeros(len(blank)))
        return Measured(Knowledge.of_rig(Chain(rig, {setup: placement(at)})), at, is_placed=False, lacking=lacking)
    rows = observations.select(np.isin(observations.setup, placed))
    with threadpool_limits(1, user_api="blas"):
        chain, samples, start = place(rig, rows)
        nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
        fit = _fit_all_prisms(chain, samples, nominal.x)
    excess = fit.excess_variance + samples.repeat_variance
    fixes = len(rows) / max(1, len(_standstills(rows)))
    if setup in placed:
        known = Knowledge(chain, fit.x, chain.setups.index(setup), root_of(fit.covariance), excess)
        at = site(chain, fit.x, setup=known.setup)
        return Measured(known, at, is_placed=True, lacking=lacking, fixes=fixes)
    blank = Chain(rig, {"": Placement.identity()})
    x = np.zeros(len(blank))
    x[: blank.base_start] = fit.x[: blank.base_start]
    at = site(blank, x)
    elsewhere = Knowledge(chain, fit.x, 0, root_of(fit.covariance), excess)
    here = elsewhere.at_new_setup(Chain(rig, {setup: placement(at)}))
    return Measured(here, at, is_placed=False, lacking=lacking, fixes=fixes)


def _fit_all_prisms(chain: Chain, samples: Samples, x: Floats) -> Fit:
    """Fit from the nominal model without rejecting any prism as a whole.

    The first poses of a new prism may be off by centimetres, while many poses of an earlier prism fit within
    millimetres. The refinement alone would reject all fixes of the new prism as outliers permanently. Therefore the
    noise is first set to the error of the worst prism, and lowered as the fit improves.
    """
    noise_mm = math.inf
    while (worst_mm := _worst_prism_mm(chain, samples, x)) < _NEARER * noise_mm:
        noise_mm = worst_mm
        x = refine(chain, samples, x, excess_variance=noise_mm**2).x
    return refine(chain, samples, x)


def _worst_prism_mm(chain: Chain, samples: Samples, x: Floats) -> float:
    """Return the standard deviation per axis of the worst prism, from the median of its errors."""
    error_mm = np.linalg.norm(chain.positions_mm(x, samples.data) - samples.position_mm, axis=1)
    prism = samples.data.prism
    return max(float(np.median(error_mm[prism == one])) for one in np.unique(prism)) / _MEDIAN_NORM


def _placed(observations: Observations) -> list[str]:
    """Return the set-ups with enough poses to determine the station's place."""
    setups = np.unique(observations.setup).tolist()
    return [s for s in setups if len(_standstills(observations.select(observations.setup == s))) >= LEAST_POSES]


def _standstills(observations: Observations) -> set[tuple[str, str, str]]:
    return set(zip(observations.session.tolist(), observations.pose.tolist(), observations.prism.tolist(), strict=True))


def chosen_poses(measured: Measured, prism: str, count: int, seed: int) -> Floats:
    """Choose poses that lower the expected error over the work volume most, the most informative first.

    Args:
        measured: knowledge from the rows so far.
        prism: the prism to measure; it is in view in all poses.
        count: number of poses.
        seed: random seed of the candidates.

    Returns:
        (n, joints) poses, n <= count; every ten in turn are ordered for short motion.
    """
    rng = np.random.default_rng([_SEED, seed])
    knowledge, at = measured.knowledge, measured.at
    index = knowledge.chain.rig.prism_names.index(prism)
    drawn = draw(knowledge, at, rng, _CANDIDATES)
    drawn = drawn.select(np.flatnonzero(drawn.seen[:, index]))
    alone = np.zeros_like(drawn.seen)
    alone[:, index] = True
    candidates = Candidates(drawn.readings, {"fixes": np.full(len(drawn), measured.fixes)}, alone)
    found = np.empty((0, len(knowledge.chain.rig.joints)))
    while len(found) < count and len(candidates) > _CHUNK:
        nearby = partial(near, knowledge, at, rng)
        part = plan(knowledge, candidates, min(_CHUNK, count - len(found)), volume=measured.volume, nearby=nearby)
        found = np.concatenate([found, part.poses.readings])
        knowledge = replace(knowledge, root=part.root)
    return found


def random_poses(measured: Measured, prism: str, count: int, seed: int) -> Floats:
    """Draw poses uniformly among those in which a prism is in view.

    Args:
        measured: knowledge from the rows so far.
        prism: the prism to measure.
        count: number of poses.
        seed: random seed.

    Returns:
        (n, joints) poses, n <= count, deg or mm.
    """
    knowledge = measured.knowledge
    drawn = work_volume(knowledge, measured.at, np.random.default_rng([_SEED, 1, seed]), 20 * count)
    seen = in_view(Bodies.of(knowledge.chain, knowledge.x, drawn), measured.at)
    found: Floats = drawn[seen[:, knowledge.chain.rig.prism_names.index(prism)]][:count]
    return found


def reached(rig: Rig, readings: Floats) -> dict[str, tuple[float, float]]:
    """Return joint -> lowest and highest reading in poses (n, joints), n > 0."""
    low, high = readings.min(axis=0), readings.max(axis=0)
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(rig.joint_names)}


def volume_share(volume: Floats, ranges: Mapping[str, tuple[float, float]]) -> float:
    """Return the share of the work volume's poses inside all ranges.

    Args:
        volume: (v, joints) poses of the work volume, deg or mm.
        ranges: joint -> lowest and highest value, in the order of the joints.
    """
    edges = np.array(list(ranges.values()))
    inside = ((volume >= edges[:, 0]) & (volume <= edges[:, 1])).all(axis=1)
    return float(inside.mean())


def rms_mm(accuracy: ExpectedAccuracy, prisms: tuple[str, ...]) -> float:
    """Return the expected RMS 3-D error of some prisms over the work volume."""
    which = [accuracy.rig.prism_names.index(prism) for prism in prisms]
    return math.sqrt(float(np.mean(accuracy.rms_3d_mm[:, which] ** 2)))
