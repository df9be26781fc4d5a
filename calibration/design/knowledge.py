"""What is known of a rig before poses are measured: from its build tolerances, or from a calibrated model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.design.conditions import Conditions
from calibration.effects.base import Situation
from calibration.effects.fitted import AppliedEffects, FittedEffect
from calibration.errors import UnsafeError
from calibration.identification.additions import Additions
from calibration.identification.refinement import prior_precision
from calibration.kernels.lineariser import Lineariser
from calibration.kernels.machine import Machine, root_of
from calibration.kinematics import Chain, ChainData, Linearisation
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.torques import GravityLoads

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
    def before(cls, model: CalibratedModel, setup: int) -> Knowledge:
        """What was known before the data of a calibration, with its noise; the model is where to linearise."""
        effects = [c.prior_sigma for effect in model.effects for c in effect.coefficients]
        sigma = np.append(prior_precision(model.chain, model.prior_scale) ** -0.5, effects)
        return replace(cls.of_model(model, setup), root=np.diag(sigma))

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

    def linearise(self, readings: Floats, conditions: Conditions | None = None) -> tuple[Linearisation, Floats]:
        """All prisms in every pose: the linearisation of the n * prisms fixes, prism by prism in each pose, and
        (n * prisms, 3, p + k) the derivatives by parameters and coefficients.

        Args:
            readings: (n, joints) deg or mm.
            conditions: under which the poses are taken, (n,) each; nothing is known of them by default.
        """
        prisms = len(self.chain.rig.prisms)
        true = np.repeat(readings, prisms, axis=0)
        if not self.effects:
            lin = self._lineariser(self.x, self._bound(true))
            return lin, lin.jacobian
        columns = self._applied.columns(self.situation(readings, conditions))
        lin = self._lineariser(self.x, self._bound(true + self._applied.change(columns)))
        shift = self._applied.shifted_mm(columns)
        if shift is not None:
            lin = lin._replace(position_mm=lin.position_mm + shift)
        moves = Additions((), self._applied.joint, columns.column, np.empty(0), columns.shift_mm)
        return lin, np.concatenate([lin.jacobian, moves.moved_mm(lin.joint_jacobian)], axis=2)

    def unknown_variance(self, readings: Floats, conditions: Conditions | None = None) -> Floats:
        """(n * prisms, joints) variance of the joints' values by effects that lack what they need, deg^2 or mm^2.

        Arguments as for `linearise`.
        """
        if not self.effects:
            return np.zeros((len(readings) * len(self.chain.rig.prisms), readings.shape[1]))
        return self._applied.unknown_variance(self.situation(readings, conditions))

    def unknown_mm2(self, readings: Floats, conditions: Conditions | None = None) -> Floats:
        """(n * prisms,) variance of each coordinate by effects that move the prism and lack what they need, mm^2.

        Arguments as for `linearise`.
        """
        if not self.effects:
            return np.zeros(len(readings) * len(self.chain.rig.prisms))
        return self._applied.unknown_mm2(self.situation(readings, conditions))

    def situation(self, readings: Floats, conditions: Conditions | None = None) -> Situation:
        """What effects may see of the poses (n, joints): a row for every prism in each, not measured yet."""
        rig = self.chain.rig
        n, prisms = len(readings), len(rig.prisms)
        rows = n * prisms
        nothing, empty = np.full((rows, 3), np.nan), np.full(rows, "")
        joints = dict(zip(rig.joint_names, np.repeat(readings, prisms, axis=0).T, strict=True))
        extra = {name: np.repeat(values, prisms) for name, values in (conditions or {}).items()}
        setup = np.full(rows, self.chain.setups[self.setup])
        fixes = Observations(np.tile(rig.prism_names, n), joints, nothing, nothing, setup, empty, empty, extra)
        return Situation(self.chain, self.x, fixes, self._loads, self._machine)

    def _bound(self, readings: Floats) -> ChainData:
        prisms = len(self.chain.rig.prisms)
        return ChainData(
            readings,
            np.tile(np.arange(prisms), len(readings) // prisms),
            np.full(len(readings), self.setup, dtype=np.intp),
        )

    @cached_property
    def _applied(self) -> AppliedEffects:
        return AppliedEffects(self.effects, self.chain)

    @cached_property
    def _lineariser(self) -> Lineariser:
        return Lineariser(self.chain)

    @cached_property
    def _loads(self) -> GravityLoads:
        return GravityLoads(self.chain, self.x)

    @cached_property
    def _machine(self) -> Machine:
        return Machine(self.chain, self.x)


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
