"""The parts of a rig file: joints, rows, prisms, masses, tolerances and station.

Angles are in degrees and lengths in mm, as in the file. Rows are numbered from 1; frame i is the frame after row i.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibration.rig.columns import POSITION, SIGMA, WRITTEN, names

Vector = tuple[float, float, float]
RowParameter = Literal["alpha", "a", "d", "theta", "beta", "b"]
Driven = Literal["theta", "d", "a"]
Convention = Literal["mdh_beta_after", "mdh_beta_before", "dh"]

NEARLY_PARALLEL = math.cos(math.radians(15.0))  # at larger angles other constants can tilt an axis within tolerance
_OF_FIXES = frozenset(names((*POSITION, *SIGMA, *WRITTEN)))  # columns of a fix and of its prediction


class Part(BaseModel):
    """A table of a rig file; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Joint(Part):
    """A joint value: what one encoder or length transducer reads.

    Attributes:
        name: name as in the observations CSV (`theta1`, `L2`).
        kind: `revolute` (values in deg) or `prismatic` (mm).
        limits: lowest and highest value, deg or mm.
        sigma: random error of a reading, 1 sigma, deg or mm; enters the observation covariance.
        resolution: quantisation step of the reading, deg or mm.
        linearity: bound of the systematic error, deg, or a fraction of the stroke for `prismatic`; not noise.
        max_rate: fastest motion, deg/s or mm/s; a change of a reading that needs 0.25 s more than it took is an error.
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    kind: Literal["revolute", "prismatic"]
    limits: tuple[float, float]
    sigma: float = Field(gt=0)
    resolution: float = Field(default=0.0, ge=0)
    linearity: float = Field(default=0.0, ge=0)
    max_rate: float = Field(default=30.0, gt=0)

    @property
    def unit(self) -> Literal["deg", "mm"]:
        """Unit of the joint's values."""
        return "deg" if self.kind == "revolute" else "mm"

    @property
    def column(self) -> str:
        """Name of the joint's column in an observations CSV."""
        return f"{self.name}_{self.unit}"

    @model_validator(mode="after")
    def _limits_in_order(self) -> Joint:
        if self.limits[0] >= self.limits[1]:
            raise ValueError(f"limits are {self.limits[0]} .. {self.limits[1]}; the first must be less than the second")
        return self

    @model_validator(mode="after")
    def _column_of_its_own(self) -> Joint:
        if self.column in _OF_FIXES:
            raise ValueError(
                f"the name {self.name!r} is reserved: the column {self.column} belongs to the fix; rename the joint"
            )
        return self


class FixedTransform(Part):
    """A constant transform before a row: Trans(x,y,z) Rot(z) Rot(y) Rot(x), applied in that order.

    Attributes:
        x_mm, y_mm, z_mm: translation along the axis in the key's name.
        rz_deg, ry_deg, rx_deg: rotation about the axis in the key's name.
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0
    rz_deg: float = 0.0
    ry_deg: float = 0.0
    rx_deg: float = 0.0


class Row(Part):
    """One row of the kinematic table, nominal values.

    Conventions (`Rig.convention`):
        mdh_beta_after:  Trans(x,a) Rot(x,alpha) Trans(z,d) Rot(z,theta) Rot(y,beta)   (first paper, Eq. 1)
        mdh_beta_before: Rot(x,alpha) Trans(x,a) Rot(y,beta) Trans(y,b) Rot(z,theta) Trans(z,d)   (second paper)
        dh:              Rot(z,theta) Trans(z,d) Trans(x,a) Rot(x,alpha) Rot(y,beta)   (standard
            Denavit-Hartenberg, with Hayati's beta for a next axis that is nearly parallel)

    Attributes:
        alpha_deg, a_mm, d_mm, theta_deg, beta_deg, b_mm: constant of the row, as the convention defines it.
        drive: the joints that move `theta`, `d` or `a`: for each, a linear combination `{ joint = coefficient }`.
        identify: the constants of the row that calibration may correct. Without this key, beta is added where only
            beta can tilt an axis: where the axis is nearly parallel to the next one, or where the next row slides along
            `a` before it turns.
        before: a fixed transform between the previous frame and this row.
        after: the frame that this row continues from, by default that of the previous row; rows may branch as a tree.
        radius_mm: half the width of the link between the previous frame and this row's frame. `plan` keeps other links
            clear of it, and assumes a value if there is none.
    """

    alpha_deg: float = 0.0
    a_mm: float = 0.0
    d_mm: float = 0.0
    theta_deg: float = 0.0
    beta_deg: float = 0.0
    b_mm: float = 0.0
    drive: dict[Driven, dict[str, float]] = Field(default_factory=dict)
    identify: tuple[RowParameter, ...] = ("alpha", "a", "d", "theta")
    before: FixedTransform | None = None
    after: int | None = Field(default=None, ge=0)
    radius_mm: float | None = Field(default=None, gt=0)


class Prism(Part):
    """A reflector.

    Attributes:
        name: name as in the observations CSV.
        frame: number of the row whose frame the prism is fixed to (0: the base).
        offset_mm: position in that frame.
        offset_known: false if the mounting is unknown: the offset is then fitted even at stage nominal.
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    frame: int = Field(ge=0)
    offset_mm: Vector
    offset_known: bool = True


class Mass(Part):
    """A lumped mass.

    Attributes:
        name: the part of the machine.
        frame: number of the row whose frame the mass is fixed to (0: the base).
        kg: the mass; for a payload, the mass carried if `payload_kg` is not measured.
        centre_mm: centre of gravity in that frame; must be missing with `midway`.
        inertia_kg_m2: xx, yy, zz, xy, xz, yz about the centre, along the frame's axes; used only by exports, as gravity
            does not depend on it.
        midway: true if the centre is midway between the origins of frames `frame` and `frame` + 1.
        payload: true if this is the payload, whose mass `payload_kg` replaces.
        assumed: true if the value was neither measured nor given by the manufacturer.
    """

    name: str
    frame: int = Field(ge=0)
    kg: float = Field(ge=0)
    centre_mm: Vector | None = None
    inertia_kg_m2: tuple[float, float, float, float, float, float] | None = None
    midway: bool = False
    payload: bool = False
    assumed: bool = True

    @model_validator(mode="after")
    def _one_place(self) -> Mass:
        if (self.centre_mm is None) != self.midway:
            raise ValueError("give either centre_mm or midway = true")
        return self


class Tolerances(Part):
    """Build tolerances, 1 sigma: how far the machine may be from its nominal model.

    Attributes:
        length_mm: tolerance of a length: `a`, `d` and `b`.
        angle_deg: tolerance of an angle: `alpha` and `theta`.
        beta_deg: tolerance of `beta`.
        prism_mm: tolerance of each coordinate of a prism's offset.
    """

    length_mm: float = Field(gt=0)
    angle_deg: float = Field(gt=0)
    beta_deg: float = Field(gt=0)
    prism_mm: float = Field(gt=0)


class Station(Part):
    """Random error of a fix, 1 sigma.

    Attributes:
        angle_sigma_arcsec: error of each circle reading.
        distance_sigma_mm, distance_sigma_ppm: error of the distance: a + b * distance.
        target_sigma_mm: error of centring on the prism and vibration of the machine, along each axis.
        timing_sigma_s: uncertainty of a fix's timestamp (by design 5 ms, unless the link is known to be better).
    """

    angle_sigma_arcsec: float = Field(default=5.0, gt=0)
    distance_sigma_mm: float = Field(default=2.0, gt=0)
    distance_sigma_ppm: float = Field(default=2.0, ge=0)
    target_sigma_mm: float = Field(default=0.0, ge=0)
    timing_sigma_s: float = Field(default=0.005, ge=0)


def continues_from(rows: Sequence[Row], number: int) -> int:
    """Return the frame that row `number` continues from."""
    after = rows[number - 1].after
    return number - 1 if after is None else after


def tilting_rows(rows: Sequence[Row], convention: Convention) -> set[int]:
    """Return the numbers of the rows whose beta is the only constant that can tilt an axis.

    Such an axis is nearly parallel to the previous one, or is the direction of a slide along `a`.
    """
    tilting = set()
    for number, row in enumerate(rows, 1):
        before = continues_from(rows, number)
        if not 0 < before < number:
            continue
        last, fixed = rows[before - 1], row.before or FixedTransform()
        mount = (("z", fixed.rz_deg), ("y", fixed.ry_deg), ("x", fixed.rx_deg))
        between, tilts = {
            "dh": ((("x", last.alpha_deg), ("y", last.beta_deg), *mount), before),
            "mdh_beta_after": ((("y", last.beta_deg), *mount, ("x", row.alpha_deg)), before),
            "mdh_beta_before": ((*mount, ("x", row.alpha_deg), ("y", row.beta_deg)), number),
        }[convention]
        if abs(_turned("z", between)["z"]) > NEARLY_PARALLEL:
            tilting.add(tilts)
        # Here `a` slides along x of the previous frame, which only that frame's beta tilts out of its x-y plane.
        slides = convention == "mdh_beta_after" and "a" in row.drive
        if slides and abs(_turned("x", mount)["y"]) < NEARLY_PARALLEL:
            tilting.add(before)
    return tilting


def _turned(axis: str, turns: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Return the unit vector along `axis` after rotations, given as pairs of axis (x, y or z) and angle in deg."""
    vector = {"x": 0.0, "y": 0.0, "z": 0.0, axis: 1.0}
    for about, angle_deg in reversed(turns):
        u, v = {"x": ("y", "z"), "y": ("z", "x"), "z": ("x", "y")}[about]
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        vector[u], vector[v] = c * vector[u] - s * vector[v], s * vector[u] + c * vector[v]
    return vector
