"""What every effect family says of itself, and what it may look at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.halton import halton
from calibration.kernels.machine import Facing, Located, Machine
from calibration.kinematics import Chain, ChainData
from calibration.observations import Floats, Observations
from calibration.rig import Joint, Rig
from calibration.torques import GravityLoads

_VOLUME_POSES = 256
_LEAST_LOAD = 1e-6  # of the largest on any revolute joint; less is rounding
_LEAST_NM = 1e-6  # a milligram on a lever of 100 mm: less is no load

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
class FittedCoefficient:
    """One number that a fit found.

    Attributes:
        name, unit: as the family's `Coefficient`.
        value, standard_error: posterior.
        prior_sigma: plausible size, as the family's `Coefficient`; a fit may have used a multiple (`Choice.scale`).
    """

    name: str
    unit: str
    value: float
    standard_error: float
    prior_sigma: float


@dataclass(frozen=True)
class Situation:
    """What an effect may see: the machine and n observations.

    Attributes:
        chain, x: kinematics and its parameters (p,). How the base stands to the station's vertical counts in loads.
        observations: n rows.
        prepared_loads, prepared_machine: those of chain and x, where they have been prepared.
        levelled: whether gravity is along the station's vertical; as the rig file says otherwise.
    """

    chain: Chain
    x: Floats
    observations: Observations
    prepared_loads: GravityLoads | None = None
    prepared_machine: Machine | None = None
    levelled: bool = True

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

    def torque_parts(self, joint: str) -> Floats:
        """(n, parts) by what the load on a joint changes when a weight, or its distance, is `MASS_SIGMA` larger."""
        return self._parts[:, self.chain.joint_index[joint]]

    def payload_torque(self, joint: str) -> Floats:
        """(n,) what the payload of each row adds to the load on a joint, N m or N; 0 where it is not known."""
        return self._payload_torques[:, self.chain.joint_index[joint]]

    def payload_parts(self, joint: str) -> Floats:
        """(n, parts) of that, as `torque_parts`."""
        return self._payload_parts[:, self.chain.joint_index[joint]]

    @cached_property
    def located(self) -> Located:
        """Where prisms and frames are by the kinematics and the readings, without any effect."""
        return self.machine.locate(self.data)

    @cached_property
    def facing(self) -> Facing:
        """Which way the prisms face, and what each drive of a row does to them."""
        return self.machine.face(self.data)

    @cached_property
    def prism_frame(self) -> NDArray[np.intp]:
        """(n,) the frame that each fix's prism is mounted on."""
        frames = np.array([prism.frame for prism in self.rig.prisms], dtype=np.intp)
        return frames[self.data.prism]

    @cached_property
    def rotation(self) -> Floats:
        """(n, 3, 3) from the base frame to the station's."""
        return self.machine.rotations(self.data)

    def to_station(self, vectors: Floats) -> Floats:
        """(n, 3, k) vectors of the base frame turned into the station's."""
        return self.rotation @ vectors

    @cached_property
    def down(self) -> Floats:
        """(n, 3) unit vectors of gravity in the base frame."""
        loads = self.loads
        return loads.down[self.data.setup] if self.levelled else np.repeat(loads.direction, len(self), axis=0)

    @cached_property
    def loads(self) -> GravityLoads:
        """The weights of the machine."""
        return self.prepared_loads or GravityLoads(self.chain, self.x)

    @cached_property
    def machine(self) -> Machine:
        """The chain at its parameters."""
        return self.prepared_machine or Machine(self.chain, self.x)

    @cached_property
    def data(self) -> ChainData:
        """The observations bound to the chain."""
        return self.chain.bind(self.observations)

    @cached_property
    def _torques(self) -> Floats:
        return self.loads(self.data.readings, self.observations.extra, self.down)

    @cached_property
    def _parts(self) -> Floats:
        return self.loads.parts(self.data.readings, self.observations.extra, self.down)

    @cached_property
    def _payloads(self) -> tuple[dict[str, Floats], dict[str, Floats]]:
        kg = np.nan_to_num(self.extra("payload_kg"))
        return {"payload_kg": kg}, {"payload_kg": np.zeros_like(kg)}

    @cached_property
    def _payload_torques(self) -> Floats:
        with_payload, without = (self.loads(self.data.readings, extra, self.down) for extra in self._payloads)
        return np.nan_to_num(with_payload - without)  # not a number where there are no masses

    @cached_property
    def _payload_parts(self) -> Floats:
        with_payload, without = (self.loads.parts(self.data.readings, extra, self.down) for extra in self._payloads)
        return with_payload - without

    @cached_property
    def work_volume(self) -> Situation:
        """The same machine in poses spread evenly between the limits of its joints, nothing else measured."""
        unit = halton(len(self.rig.joints), _VOLUME_POSES)
        blank = np.full((_VOLUME_POSES, 3), np.nan)
        empty = np.full(_VOLUME_POSES, "")
        joints = {j.name: j.limits[0] + (j.limits[1] - j.limits[0]) * unit[:, i] for i, j in enumerate(self.rig.joints)}
        prism = np.full(_VOLUME_POSES, self.rig.prism_names[0])
        setup = np.full(_VOLUME_POSES, next(iter(self.chain.setups), ""))
        return replace(self, observations=Observations(prism, joints, blank, blank, setup, empty, empty))

    @cached_property
    def as_designed(self) -> Situation:
        """The same observations of a machine that is as its rig file has it."""
        x = np.zeros_like(self.x)
        return replace(self, x=x, prepared_loads=None, prepared_machine=None, levelled=False)

    def greatest_torque(self, joint: str) -> float:
        """The largest load on a joint in the work volume, among the observations where there are no masses.

        0 where it is nothing beside what the other revolute joints carry, by design: the little that a vertical axis
        carries because it was not built quite so depends on more than is known.
        """
        designed = self.as_designed
        by_joint = [designed._greatest(j.name) for j in self.rig.joints if j.kind == "revolute"]
        carries = designed._greatest(joint) > _LEAST_LOAD * max(by_joint, default=0.0)
        return self._greatest(joint) if carries else 0.0

    def _greatest(self, joint: str) -> float:
        loads = self.work_volume.torque(joint) if self.rig.masses else self.torque(joint)
        greatest = float(np.abs(loads[np.isfinite(loads)]).max(initial=0.0))
        return greatest if greatest > _LEAST_NM else 0.0


class Family(ABC):
    """A kind of effect: one file in `calibration/effects/families`, which binds an instance to `FAMILY`.

    Attributes:
        name: as in every output.
        equation: what it does to the machine.
        source: where that is from.
        confused_with: families that look alike in most data.
        revealed_by: the motion or experiment that shows it apart from those, a phrase.
        goes_with: the load that it depends on: `torque` of its own joint, measured or computed, `weights`, which are
            always computed, or nothing.
        column: the optional column that it needs, `{where}` in it for its place; empty for none. Families that need
            anything else say so in `needs` and `known`.
        limit_sigma: by what share the hard limits may be off, where they are not numbers but what a load makes of them.
        goes_by_travel: whether it grows with the path that its joint travels.
        moves_machine: whether it moves prisms in the base frame; it does not where only fixes err, or where the base
            moves and all the machine with it.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]]
    revealed_by: ClassVar[str]
    goes_with: ClassVar[Literal["", "torque", "weights"]] = ""
    column: ClassVar[str] = ""
    limit_sigma: ClassVar[float] = 0.0
    goes_by_travel: ClassVar[bool] = False
    moves_machine: ClassVar[bool] = True

    @abstractmethod
    def places(self, rig: Rig) -> tuple[str, ...]:
        """Where in a rig it may be: names of joint values."""

    def needs(self, where: str) -> str:
        """What it needs beside the readings of the joints, as a noun phrase; empty for nothing."""
        return f"the column {self.column.format(where=where)}" if self.column else ""

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        """(n,) rows that have what it needs."""
        if not self.column:
            return np.ones(len(situation), dtype=bool)
        return np.isfinite(situation.extra(self.column.format(where=where)))

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        """The forms it may take, of which the data choose one: numbers that hold from training to prediction.

        None where the effect cannot be at this place.
        """
        del situation, where
        return ({},)

    def refined(self, situation: Situation, where: str, settings: Settings) -> tuple[Settings, ...]:
        """Finer forms about one that was chosen, that one among them; none where `variants` has all there are."""
        del situation, where, settings
        return ()

    def settled(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """What a model takes of such finer forms, for the probabilities (m,) that the data give them."""
        return forms[int(np.argmax(probability))]

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """What outputs list: what was fitted, less what only shapes it, with numbers that its settings hold."""
        del settings
        return coefficients

    def reported_limits(self) -> Mapping[str, tuple[float, float]]:
        """Hard limits of the numbers that `reported` lists in place of coefficients, by name."""
        return {}

    def strained(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        """Whether a fit of the coefficients (k,) has what only shapes the effect beyond its limits by more than chance.

        A form that is strained is none; simpler ones of the same effect may be.
        """
        del settings, values, standard_errors
        return False

    def odds(self, settings: Settings) -> float:
        """How plausible a variant is beforehand beside the others; they share the odds of the effect."""
        del settings
        return 1.0

    def form(self, settings: Settings) -> str:
        """Which of several forms a variant has, a phrase for people; empty where that is no news to them."""
        del settings
        return ""

    def goes_by_order(self, settings: Settings) -> bool:
        """Whether what it does in a row depends on the rows before it, so that they must be given together."""
        del settings
        return False

    @abstractmethod
    def names(self, settings: Settings) -> tuple[str, ...]:
        """Names of the coefficients of a variant; ValueError for settings that are none of this family's."""

    @abstractmethod
    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        """What a fit finds, for one of the variants."""

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Mean square of what it does in rows that lack what it needs.

        To the joint's value, deg^2 or mm^2; of a prism family to each coordinate, mm^2.

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

    @abstractmethod
    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        """(n, k) change of the joint's value, deg or mm, per unit of each coefficient.

        Zero in rows that lack what the effect needs.
        """


class PrismFamily(Family):
    """An effect that moves the prism, or its fix, where no joint value errs: a beam, the base, the station, a clock.

    Attributes:
        place: where it is, on every rig; those that a rig has none or several places for say so in `places`.
    """

    place: ClassVar[str]

    def places(self, rig: Rig) -> tuple[str, ...]:
        del rig
        return (self.place,)

    @abstractmethod
    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        """(n, 3, k) displacement of the prism in the station's frame per unit of each coefficient, mm.

        Zero in rows that lack what the effect needs.
        """


def joint_of(situation: Situation, where: str) -> Joint:
    """The joint of an effect's place."""
    return situation.rig.joint(where)


def refuse_settings(settings: Settings) -> None:
    """ValueError unless there are none, for families without variants."""
    if settings:
        raise ValueError(f"there are no settings {', '.join(settings)}")
