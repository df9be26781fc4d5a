"""What is known of a rig before poses are measured: from its build tolerances, or from a calibrated model."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import AppliedEffects, FittedEffect
from calibration.errors import UnsafeError
from calibration.identification.refinement import prior_precision
from calibration.kernels.lineariser import Lineariser
from calibration.kinematics import Chain, ChainData, Linearisation
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.rig import Rig

_BASE = 6  # parameters of a set-up's base


@dataclass(frozen=True)
class Knowledge:
    """What is known of a rig before the poses are measured.

    Attributes:
        chain, x: kinematics and its parameters (p,).
        setup: index of the set-up at which the poses will be measured.
        root: (p + k, p + k) covariance of the parameters and of the coefficients of effects = root @ root'.
        excess_variance: mm^2 per axis that fixes scatter beyond station and readings.
        effects: named physics that the model has, k coefficients.
    """

    chain: Chain
    x: Floats
    setup: int
    root: Floats
    excess_variance: float = 0.0
    effects: tuple[FittedEffect, ...] = ()

    @classmethod
    def of_rig(cls, chain: Chain) -> Knowledge:
        """Build tolerances alone, at the first set-up of the chain."""
        return cls(chain, np.zeros(len(chain)), 0, np.diag(prior_precision(chain, 1.0) ** -0.5))

    @classmethod
    def of_model(cls, model: CalibratedModel, setup: int) -> Knowledge:
        """What a calibration left, at one of its set-ups."""
        excess = model.excess_sigma_mm**2 + model.repeat_sigma_mm**2
        return cls(model.chain, model.values, setup, root_of(model.covariance), excess, model.effects)

    def at_new_setup(self, chain: Chain) -> Knowledge:
        """The same machine before a station whose chain has one set-up, about whose base nothing is known."""
        body, p = self.chain.base_start, len(self.chain)
        kept = np.r_[:body, p : len(self.root)]
        covariance = np.diag(np.append(prior_precision(chain, 1.0) ** -1.0, np.zeros(len(kept) - body)))
        own = np.r_[:body, len(chain) : len(covariance)]
        covariance[np.ix_(own, own)] = self.root[kept] @ self.root[kept].T
        x = np.concatenate([self.x[:body], np.zeros(len(chain) - body)])
        return replace(self, chain=chain, x=x, setup=0, root=root_of(covariance))

    @property
    def parameters(self) -> int:
        """How many parameters of the chain the set-up's fixes can show: the machine's, and those of its own base."""
        return len(self.chain) - _BASE * (len(self.chain.setups) - 1)

    def without(self, names: Collection[str]) -> Knowledge:
        """The same, with nothing known of the effects called `names`, each `family@where`, nor of their being there."""
        kept_effects = tuple(e for e in self.effects if f"{e.family}@{e.where}" not in names)
        if kept_effects == self.effects:
            return self
        kept = np.ones(len(self.root), dtype=bool)
        first = len(self.chain)
        for effect in self.effects:
            last = first + len(effect.coefficients)
            kept[first:last] = effect in kept_effects
            first = last
        rows = self.root[kept]
        return replace(self, root=root_of(rows @ rows.T), effects=kept_effects)

    def linearise(self, readings: Floats, direction: Floats | None = None) -> tuple[Linearisation, Floats]:
        """All prisms in every pose: the linearisation of the n * prisms fixes, prism by prism in each pose, and
        (n * prisms, 3, p + k) the derivatives by parameters and coefficients.

        Args:
            readings: (n, joints) deg or mm.
            direction: (n, joints) from which side each joint comes, -1 or 1; nothing is known of it by default.
        """
        prisms = len(self.chain.rig.prisms)
        columns = self._applied.columns(self._situation(readings, direction))
        true = readings + self._applied.change(columns)
        data = ChainData(
            np.repeat(true, prisms, axis=0),
            np.tile(np.arange(prisms), len(readings)),
            np.full(len(readings) * prisms, self.setup, dtype=np.intp),
        )
        lin = self._lineariser(self.x, data)
        if not self.effects:
            return lin, lin.jacobian
        by_coefficient = lin.joint_jacobian[:, :, self._applied.joint] * np.repeat(columns, prisms, axis=0)[:, None, :]
        return lin, np.concatenate([lin.jacobian, by_coefficient], axis=2)

    def unknown_variance(self, readings: Floats, direction: Floats | None = None) -> Floats:
        """(n * prisms, joints) variance of the joints' values by effects that lack what they need, deg^2 or mm^2.

        Arguments as for `linearise`.
        """
        variance = self._applied.unknown_variance(self._situation(readings, direction))
        return np.repeat(variance, len(self.chain.rig.prisms), axis=0)

    @cached_property
    def _applied(self) -> AppliedEffects:
        return AppliedEffects(self.effects, self.chain)

    @cached_property
    def _lineariser(self) -> Lineariser:
        return Lineariser(self.chain)

    def _situation(self, readings: Floats, direction: Floats | None) -> Situation:
        rig = self.chain.rig
        columns = {} if direction is None else directions(rig, direction)
        return Situation(self.chain, self.x, observations_at(rig, readings, columns))


def setup_of(model: CalibratedModel, name: str | None = None) -> int:
    """Index of one of the model's set-ups: the one called `name`, or else the one whose base is known best.

    Raises:
        UnsafeError: none is called so.
    """
    setups = model.chain.setups
    if name is None:
        first = model.chain.base_start
        blocks = [slice(first + _BASE * i, first + _BASE * (i + 1)) for i in range(len(setups))]
        return int(np.argmin([np.linalg.slogdet(model.covariance[block, block])[1] for block in blocks]))
    if name not in setups:
        known = ", ".join(repr(s) for s in setups)
        raise UnsafeError(f"set-up {name!r} is unknown to the model (known: {known}); name one of these")
    return setups.index(name)


def directions(rig: Rig, direction: Floats) -> dict[str, Floats]:
    """From which side every joint comes (n, joints), as columns of observations."""
    return {f"{name}_dir": direction[:, i] for i, name in enumerate(rig.joint_names)}


def observations_at(rig: Rig, readings: Floats, extra: Mapping[str, Floats] | None = None) -> Observations:
    """Poses (n, joints) as observations of the rig's first prism, not measured yet."""
    n = len(readings)
    nothing, empty = np.full((n, 3), np.nan), np.full(n, "")
    joints = dict(zip(rig.joint_names, readings.T, strict=True))
    return Observations(
        np.full(n, rig.prism_names[0]), joints, nothing, nothing, empty, empty, empty, dict(extra or {})
    )


def root_of(covariance: Floats) -> Floats:
    """(q, q) a root of a covariance that may be singular."""
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0.0] = 1.0
    value, vector = np.linalg.eigh(covariance / scale[:, None] / scale)
    root: Floats = scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
    return root
