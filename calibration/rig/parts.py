"""The parts of a rig: joints, rows, prisms, masses, tolerances and station, as a rig file has them.

Files keep degrees and mm, and so do these. Rows are numbered from 1; frame i is the frame after row i.
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

NEARLY_PARALLEL = math.cos(math.radians(15.0))  # beyond it the other constants turn an axis within their tolerances
_OF_FIXES = frozenset(names((*POSITION, *SIGMA, *WRITTEN)))  # columns of a fix and of its prediction


class Part(BaseModel):
    """A table of a rig file; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Joint(Part):
    """A joint value: what one encoder or length transducer reads.

    Attributes:
        name: as in the observations CSV (`theta1`, `L2`).
        kind: `revolute` (values in deg) or `prismatic` (mm).
        limits: lowest and highest value, deg or mm.
        sigma: random error of a reading, 1 sigma, deg or mm; enters the observation covariance.
        resolution: quantisation step of the reading, deg or mm.
        linearity: systematic error bound, deg, or a fraction of the stroke for `prismatic`; no noise.
        max_rate: fastest motion, deg/s or mm/s; a faster jump is no motion.
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
            raise ValueError(f"limits must rise, got {self.limits[0]} .. {self.limits[1]}")
        return self

    @model_validator(mode="after")
    def _column_of_its_own(self) -> Joint:
        if self.column in _OF_FIXES:
            raise ValueError(f"no joint can be called {self.name!r}: its column {self.column} is one of the fix's")
        return self


class FixedTransform(Part):
    """A constant transform before a row: Trans(x,y,z) Rot(z) Rot(y) Rot(x), applied in that order.

    Attributes:
        x_mm, y_mm, z_mm: shift.
        rz_deg, ry_deg, rx_deg: turns.
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
        alpha_deg, a_mm, d_mm, theta_deg, beta_deg, b_mm: constant of the row, as its convention has it.
        drive: for `theta`, `d` or `a`: which joints move it, as a linear combination `{ joint = coefficient }`.
        identify: which of the row's constants calibration may correct; in a rig, a row that says nothing also has beta
            where it alone can tilt an axis: where that is nearly parallel to the next, or the next row slides along `a`
            before it turns.
        before: a fixed transform between the previous frame and this row.
        after: the frame that this row continues from, where it is not the one before it: rows may branch as a tree.
        radius_mm: half the width of the link from the frame before to this row's; `plan` keeps others clear of it, and
            assumes one without this.
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
        name: as in the observations CSV.
        frame: fixed to the frame after this row (0: the base).
        offset_mm: place in that frame.
        offset_known: false for a target whose mounting is unknown: it is fitted even at stage nominal.
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    frame: int = Field(ge=0)
    offset_mm: Vector
    offset_known: bool = True


class Mass(Part):
    """A lumped mass.

    Attributes:
        name: which part of the machine.
        frame: fixed to the frame after this row.
        kg: mass; a payload's is what is carried unless `payload_kg` is measured.
        centre_mm: centre of gravity in that frame; none with `midway`.
        inertia_kg_m2: xx, yy, zz, xy, xz, yz about the centre, along the frame's axes; kept for exports, as gravity
            does not need it.
        midway: the centre is midway between the origins of frames `frame` and `frame` + 1.
        payload: this is the payload that `payload_kg` replaces.
        assumed: not measured and not from the maker.
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
        length_mm: of a length, `a`, `d` and `b`.
        angle_deg: of an angle, `alpha` and `theta`.
        beta_deg: of `beta`.
        prism_mm: of each coordinate of a prism's offset.
    """

    length_mm: float = Field(gt=0)
    angle_deg: float = Field(gt=0)
    beta_deg: float = Field(gt=0)
    prism_mm: float = Field(gt=0)


class Station(Part):
    """Random error of a fix, 1 sigma.

    Attributes:
        angle_sigma_arcsec: each circle.
        distance_sigma_mm, distance_sigma_ppm: a + b * distance.
        target_sigma_mm: centring on the prism and vibration of the machine, each axis.
        timing_sigma_s: uncertainty of a fix's instant (design: 5 ms unless the link is known better).
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
    """Return the rows whose beta alone tilts an axis: one nearly parallel to that before it, or a slide."""
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
        # Here `a` slides along x of the frame before, which nothing but its beta turns out of its x and y.
        slides = convention == "mdh_beta_after" and "a" in row.drive
        if slides and abs(_turned("x", mount)["y"]) < NEARLY_PARALLEL:
            tilting.add(before)
    return tilting


def _turned(axis: str, turns: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Return the unit vector along an axis after turns about x, y or z by so many degrees."""
    vector = {"x": 0.0, "y": 0.0, "z": 0.0, axis: 1.0}
    for about, angle_deg in reversed(turns):
        u, v = {"x": ("y", "z"), "y": ("z", "x"), "z": ("x", "y")}[about]
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        vector[u], vector[v] = c * vector[u] - s * vector[v], s * vector[u] + c * vector[v]
    return vector
