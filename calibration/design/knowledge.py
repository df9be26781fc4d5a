"""Prior knowledge of a rig before poses are measured: from its build tolerances, or from a calibrated model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.design.conditions import Conditions
from calibration.effects.context import EffectContext
from calibration.effects.fitted import AppliedEffects, FittedEffect
from calibration.errors import UnsafeError
from calibration.identification.linear_model import prior_precision
from calibration.kinematics.chain import Chain, Linearisation
from calibration.kinematics.compiled_chain import CompiledChain
from calibration.kinematics.torques import GravityModel
from calibration.model.model import CalibratedModel
from calibration.numerics.matrices import root_of
from calibration.observations import Floats, Observations

_BASE = 6  # parameters of a set-up's base


@dataclass(frozen=True)
class Knowledge:
    """Prior knowledge of a rig: parameters and coefficients with their covariance.

    Attributes:
        chain, x: kinematics and its parameters (p,).
        setup: index of the set-up at which the poses will be measured.
        root: (p + k, p + k) root of the covariance of parameters and effect coefficients, root @ root'.
        excess_variance: variance of the fixes beyond that of station and readings, mm^2 per axis.
        effects: effects of the model, with k coefficients in total.
    """

    chain: Chain
    x: Floats
    setup: int
    root: Floats
    excess_variance: float = 0.0
    effects: tuple[FittedEffect, ...] = ()

    @classmethod
    def of_rig(cls, chain: Chain) -> Knowledge:
        """Return the knowledge from build tolerances alone, at the first set-up of the chain."""
        return cls(chain, np.zeros(len(chain)), 0, np.diag(prior_precision(chain, 1.0) ** -0.5))

    @classmethod
    def before(cls, model: CalibratedModel, setup: int) -> Knowledge:
        """Return the prior knowledge of a calibrated model, linearised at its solution and with its noise."""
        effects = [c.prior_sigma for effect in model.effects for c in effect.coefficients]
        sigma = np.append(prior_precision(model.chain, model.prior_scale) ** -0.5, effects)
        return replace(cls.of_model(model, setup), root=np.diag(sigma))

    @classmethod
    def of_model(cls, model: CalibratedModel, setup: int) -> Knowledge:
        """Return the knowledge after a calibration, at one of its set-ups."""
        excess = model.excess_sigma_mm**2 + model.repeat_sigma_mm**2
        return cls(model.chain, model.values, setup, root_of(model.covariance), excess, model.effects)

    def at_new_setup(self, chain: Chain) -> Knowledge:
        """Return the knowledge of this machine at a new set-up, whose base has only its prior covariance."""
        body, p = self.chain.base_start, len(self.chain)
        kept = np.r_[:body, p : len(self.root)]
        covariance = np.diag(np.append(prior_precision(chain, 1.0) ** -1.0, np.zeros(len(kept) - body)))
        own = np.r_[:body, len(chain) : len(covariance)]
        covariance[np.ix_(own, own)] = self.root[kept] @ self.root[kept].T
        x = np.concatenate([self.x[:body], np.zeros(len(chain) - body)])
        return replace(self, chain=chain, x=x, setup=0, root=root_of(covariance))

    @property
    def parameters(self) -> int:
        """Number of parameters on which the set-up's fixes depend: those of the machine and of the set-up's base."""
        return len(self.chain) - _BASE * (len(self.chain.setups) - 1)

    def without(self, names: Collection[str]) -> Knowledge:
        """Return this knowledge without the effects called `names`, each `family@where`."""
        kept_effects = tuple(e for e in self.effects if str(e) not in names)
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

    def linearise(self, readings: Floats, conditions: Conditions | None = None) -> Linearisation:
        """Linearise the fixes of all prisms in every pose.

        Args:
            readings: (n, joints) deg or mm.
            conditions: conditions of the poses, (n,) each; unknown by default.

        Returns:
            The linearisation of n * prisms fixes, ordered by pose and then by prism. Its Jacobian has p + k columns:
            parameters, then coefficients.
        """
        context = self.context(readings, conditions)
        columns = self._applied.columns(context)
        return columns.linearise(lambda data: self.chain.linearise(self.x, data), context.data, self._applied.values)

    def unknown_variance(self, readings: Floats, conditions: Conditions | None = None) -> Floats:
        """(n * prisms, joints) variance of joint values due to effects whose inputs are missing, deg^2 or mm^2.

        Arguments as for `linearise`.
        """
        return self._applied.unknown_variance(self.context(readings, conditions))

    def unknown_mm2(self, readings: Floats, conditions: Conditions | None = None) -> Floats:
        """(n * prisms,) variance per coordinate due to effects that move the prism and whose inputs are missing, mm^2.

        Arguments as for `linearise`.
        """
        return self._applied.unknown_mm2(self.context(readings, conditions))

    def context(self, readings: Floats, conditions: Conditions | None = None) -> EffectContext:
        """Return the effect context of poses: one row without a measurement for each pose and prism.

        Arguments as for `linearise`.
        """
        rig = self.chain.rig
        n, prisms = len(readings), len(rig.prisms)
        rows = n * prisms
        nothing, empty = np.full((rows, 3), np.nan), np.full(rows, "")
        joints = dict(zip(rig.joint_names, np.repeat(readings, prisms, axis=0).T, strict=True))
        extra = {name: np.repeat(values, prisms) for name, values in (conditions or {}).items()}
        setup = np.full(rows, self.chain.setups[self.setup])
        fixes = Observations(np.tile(rig.prism_names, n), joints, nothing, nothing, setup, empty, empty, extra)
        return EffectContext(self.chain, self.x, fixes, self._loads, self._machine)

    @cached_property
    def _applied(self) -> AppliedEffects:
        return AppliedEffects(self.effects, self.chain)

    @cached_property
    def _loads(self) -> GravityModel:
        return GravityModel(self.chain, self.x)

    @cached_property
    def _machine(self) -> CompiledChain:
        return CompiledChain(self.chain, self.x)


def setup_of(model: CalibratedModel, name: str | None = None) -> int:
    """Return the index of a set-up of a model.

    Args:
        model: the model.
        name: name of the set-up; by default the set-up whose base is known best.

    Raises:
        UnsafeError: the model has no set-up of this name.
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
