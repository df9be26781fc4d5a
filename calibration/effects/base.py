"""What every effect family says of itself, and what it may look at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calibration.kinematics import Chain
from calibration.observations import Floats, Observations
from calibration.rig import Joint, Rig
from calibration.torques import GravityLoads

_VOLUME_POSES = 256
_LEAST_LOAD = 1e-6  # of the largest on any revolute joint; less is rounding

Settings = Mapping[str, float]


@dataclass(frozen=True)
class Coefficient:
    """One number that a fit finds.

    Attributes:
        name: as in every output, its unit part of it where it has one.
        unit: of its value; `1` for a plain ratio.
        sigma: plausible size, 1 sigma.
        lower, upper: hard limits; a fit beyond them is no evidence for this effect.
    """

    name: str
    unit: str
    sigma: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Situation:
    """What an effect may see: the machine and n observations.

    Attributes:
        chain, x: kinematics and its parameters (p,), for the loads; where the base stands plays no part.
        observations: n rows.
        loads: those of chain and x, where they have been prepared.
    """

    chain: Chain
    x: Floats
    observations: Observations
    loads: GravityLoads | None = None

    def __len__(self) -> int:
        return len(self.observations)

    @property
    def rig(self) -> Rig:
        """The rig description."""
        return self.chain.rig

    def reading(self, joint: str) -> Floats:
        """(n,) readings of a joint, deg or mm."""
        return self.observations.joints[joint]

    def extra(self, column: str) -> Floats:
        """(n,) an optional column, NaN where it was not measured."""
        measured = self.observations.extra.get(column)
        return np.full(len(self), np.nan) if measured is None else measured

    def torque(self, joint: str) -> Floats:
        """(n,) load on a joint, N m or N; NaN where it is not known."""
        return self._torques[:, self.chain.joint_index[joint]]

    def is_torque_measured(self, joint: str) -> bool:
        """Whether most rows have the joint's own torque column."""
        return bool(np.isfinite(self.extra(f"{joint}_Nm")).mean() > 0.5) if len(self) else False

    @cached_property
    def _torques(self) -> Floats:
        loads = self.loads or GravityLoads(self.chain, self.x)
        joints = self.observations.joints
        return loads(np.array([joints[name] for name in self.chain.joint_index]).T, self.observations.extra)

    @cached_property
    def work_volume(self) -> Situation:
        """The same machine in poses spread evenly between the limits of its joints, nothing else measured."""
        unit = qmc.Halton(len(self.rig.joints), scramble=False).random(_VOLUME_POSES)
        blank = np.full((_VOLUME_POSES, 3), np.nan)
        empty = np.full(_VOLUME_POSES, "")
        joints = {j.name: j.limits[0] + (j.limits[1] - j.limits[0]) * unit[:, i] for i, j in enumerate(self.rig.joints)}
        prism = np.full(_VOLUME_POSES, self.rig.prism_names[0])
        return replace(self, observations=Observations(prism, joints, blank, blank, empty, empty, empty))

    def greatest_torque(self, joint: str) -> float:
        """The largest load on a joint in the work volume, among the observations where there are no masses.

        0 where it is nothing beside what the other revolute joints carry.
        """
        by_joint = [self._greatest(j.name) for j in self.rig.joints if j.kind == "revolute"]
        own = self._greatest(joint)
        return own if own > _LEAST_LOAD * max(by_joint, default=0.0) else 0.0

    def _greatest(self, joint: str) -> float:
        loads = self.work_volume.torque(joint) if self.rig.masses else self.torque(joint)
        return float(np.abs(loads[np.isfinite(loads)]).max(initial=0.0))


class Family(ABC):
    """A kind of effect: one file in `calibration/effects/families`, which binds an instance to `FAMILY`.

    Attributes:
        name: as in every output.
        equation: what it does to the machine.
        source: where that is from.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]

    @abstractmethod
    def places(self, rig: Rig) -> tuple[str, ...]:
        """Where in a rig it may be: names of joint values."""

    def needs(self, where: str) -> str:
        """What it needs beside the readings of the joints, as a noun phrase; empty for nothing."""
        del where
        return ""

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        """(n,) rows that have what it needs."""
        del where
        return np.ones(len(situation), dtype=bool)

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        """The forms it may take, of which the data choose one: numbers that hold from training to prediction.

        None where the effect cannot be at this place.
        """
        del situation, where
        return ({},)

    def odds(self, settings: Settings) -> float:
        """How plausible a variant is beforehand beside the others; they share the odds of the effect."""
        del settings
        return 1.0

    @abstractmethod
    def names(self, settings: Settings) -> tuple[str, ...]:
        """Names of the coefficients of a variant; ValueError for settings that are none of this family's."""

    @abstractmethod
    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        """What a fit finds, for one of the variants."""

    @abstractmethod
    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        """(n, k) change of the joint's value, deg or mm, per unit of each coefficient.

        Zero in rows that lack what the effect needs.
        """

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Mean square of what it does to the joint's value in rows that lack what it needs, deg^2 or mm^2.

        Args:
            values: (k,) its coefficients.
            plausible: (k,) their plausible sizes in the model, 1 sigma.
            settings: the variant.
        """
        del values, plausible, settings
        return 0.0


class JointFamily(Family):
    """An effect at a single joint value of one kind.

    Attributes:
        kind: of the joints it may be at.
    """

    kind: ClassVar[Literal["revolute", "prismatic"]]

    def places(self, rig: Rig) -> tuple[str, ...]:
        return tuple(j.name for j in rig.joints if j.kind == self.kind)


def joint_of(situation: Situation, where: str) -> Joint:
    """The joint of an effect's place."""
    return situation.rig.joint(where)


def refuse_settings(settings: Settings) -> None:
    """ValueError unless there are none, for families without variants."""
    if settings:
        raise ValueError(f"there are no settings {', '.join(settings)}")
