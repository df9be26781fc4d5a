"""The rig description: joints, rows, prisms, masses, channels and station, read from a TOML file.

A rig file is data; nothing here computes kinematics. Rows are numbered from 1 as in the papers; frame i is the frame
after row i. Files keep degrees and mm, and so does this description.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails

from calibration.errors import RigError
from calibration.rig.channels import Channel, Signal
from calibration.rig.columns import POSITION, SIGMA, WRITTEN, names
from calibration.rig.signals import Taken, signal_faults, signal_lines, signal_of
from calibration.rig.toml import parse_toml

Vector = tuple[float, float, float]
RowParameter = Literal["alpha", "a", "d", "theta", "beta", "b"]
Driven = Literal["theta", "d", "a"]
Convention = Literal["mdh_beta_after", "mdh_beta_before", "dh"]

BEYOND_BUILDING = 4.0  # build tolerances: no correction by building alone is larger
ANOTHER_VALUE = 10.0  # build tolerances: so far off, the file's value is another machine's and tells nothing
_MOST = 300  # joints, rows, prisms, masses, channels or signals
_NEARLY_PARALLEL = math.cos(math.radians(15.0))  # beyond it the other constants turn an axis within their tolerances
_OF_FIXES = frozenset(names((*POSITION, *SIGMA, *WRITTEN)))  # columns of a fix and of its prediction


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Joint(_Part):
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


class FixedTransform(_Part):
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


class Row(_Part):
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


class Prism(_Part):
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


class Mass(_Part):
    """A lumped mass.

    Attributes:
        name: which part of the machine.
        frame: fixed to the frame after this row.
        kg: mass; a payload's is what is carried unless `payload_kg` is measured.
        centre_mm: centre of gravity in that frame; none with `midway`.
        midway: the centre is midway between the origins of frames `frame` and `frame` + 1.
        payload: this is the payload that `payload_kg` replaces.
        assumed: not measured and not from the maker.
    """

    name: str
    frame: int = Field(ge=0)
    kg: float = Field(ge=0)
    centre_mm: Vector | None = None
    midway: bool = False
    payload: bool = False
    assumed: bool = True

    @model_validator(mode="after")
    def _one_place(self) -> Mass:
        if (self.centre_mm is None) != self.midway:
            raise ValueError("give either centre_mm or midway = true")
        return self


class Tolerances(_Part):
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


class Station(_Part):
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


class Rig(_Part):
    """A machine: everything that calibration, drivers and simulators need to know of it.

    `Rig.read` reads a rig file, or a rig that comes with the program.

    Attributes:
        name: of the machine.
        convention: order of the transforms in a row.
        gravity: its direction in the base frame, of any length.
        joints: the joint values, `[[joint]]` in the file.
        rows: the kinematic table, `[[row]]`.
        prisms: reflectors, `[[prism]]`.
        masses: lumped masses, `[[mass]]`.
        channels: where readings and signals come from, `[[channel]]`.
        signals: further columns of observations files, `[[signal]]`.
        tolerances: build tolerances.
        station: random error of a fix.
    """

    name: str
    convention: Convention
    gravity: Vector = (0.0, 0.0, -1.0)
    joints: tuple[Joint, ...] = Field(alias="joint", min_length=1, max_length=_MOST)
    rows: tuple[Row, ...] = Field(alias="row", min_length=1, max_length=_MOST)
    prisms: tuple[Prism, ...] = Field(alias="prism", min_length=1, max_length=_MOST)
    masses: tuple[Mass, ...] = Field(alias="mass", default=(), max_length=_MOST)
    channels: tuple[Channel, ...] = Field(alias="channel", default=(), max_length=_MOST)
    signals: tuple[Signal, ...] = Field(alias="signal", default=(), max_length=_MOST)
    tolerances: Tolerances
    station: Station = Station()

    _text: str = PrivateAttr("")

    @field_validator("rows")
    @classmethod
    def _beta_where_axes_are_parallel(cls, rows: tuple[Row, ...], info: ValidationInfo) -> tuple[Row, ...]:
        tilting = _tilting_rows(rows, info.data["convention"]) if "convention" in info.data else set()
        return tuple(
            row.model_copy(update={"identify": (*row.identify, "beta")})
            if number in tilting and "identify" not in row.model_fields_set
            else row
            for number, row in enumerate(rows, 1)
        )

    @field_validator("gravity")
    @classmethod
    def _points_somewhere(cls, gravity: Vector) -> Vector:
        if not any(gravity):
            raise ValueError("no direction; [0, 0, -1] is down along the base's z")
        return gravity

    @model_validator(mode="after")
    def _names_differ(self) -> Rig:
        for what, called in (
            ("joint", [j.name for j in self.joints]),
            ("prism", [p.name for p in self.prisms]),
            ("channel", [c.name for c in self.channels]),
            ("signal", [s.name for s in self.signals]),
            ("signal", [s.column for s in self.signals]),
        ):
            doubled = sorted({n for n in called if called.count(n) > 1})
            if doubled:
                raise ValueError(f"two {what}s are called {doubled[0]!r}")
        for fault in signal_faults(self.signals, self.taken):
            raise ValueError(fault)
        return self

    @model_validator(mode="after")
    def _joints_fit(self) -> Rig:
        driven = {name for _, _, name, _ in self.couplings()}
        known = {j.name for j in self.joints}
        for number, _, name, coefficient in self.couplings():
            if name not in known:
                raise ValueError(f"row {number}: driven by unknown joint {name!r}; joints: {', '.join(sorted(known))}")
            if coefficient == 0.0:
                raise ValueError(f"row {number}: joint {name!r} drives it by 0; leave it out, or give how far it moves")
        if known - driven:
            raise ValueError(f"joint {sorted(known - driven)[0]!r} drives no row")
        for channel in self.channels:
            joint = next((j for j in self.joints if j.name == channel.name), None)
            if joint is not None and channel.unit != joint.unit:
                raise ValueError(f"channel {channel.name!r} is in {channel.unit}, its joint in {joint.unit}")
        return self

    @model_validator(mode="after")
    def _rows_fit(self) -> Rig:
        unused = {"mdh_beta_before": set(), "mdh_beta_after": {"b"}, "dh": {"b"}}[self.convention]
        for number, row in enumerate(self.rows, 1):
            if row.after is not None and row.after >= number:
                raise ValueError(f"row {number}: it continues from frame {row.after}, which does not come before it")
            wrong = unused & ({*row.identify} | ({"b"} if row.b_mm else set()) | ({"beta"} if row.beta_deg else set()))
            if wrong:
                raise ValueError(f"row {number}: convention {self.convention!r} has no {sorted(wrong)[0]}")
        return self

    @model_validator(mode="after")
    def _frames_fit(self) -> Rig:
        last = len(self.rows)
        for prism in self.prisms:
            if prism.frame > last:
                raise ValueError(f"prism {prism.name!r}: frame {prism.frame} is beyond the last row {last}")
        for mass in self.masses:
            if mass.frame + mass.midway > last:
                raise ValueError(f"mass {mass.name!r}: frame {mass.frame} is beyond the last row {last}")
            if mass.midway and self.path(mass.frame + 1)[:-1] != self.path(mass.frame):
                raise ValueError(f"mass {mass.name!r}: row {mass.frame + 1} does not continue from frame {mass.frame}")
        return self

    @property
    def text(self) -> str:
        """The TOML that the rig was read from; "" for one that was built in a program."""
        return self._text

    @classmethod
    def read(cls, path_or_shipped_name: str | Path) -> Rig:
        """Read a rig file, or a rig that comes with the program (`shipped_rigs`).

        Args:
            path_or_shipped_name: path of a TOML file, or a name such as `swdt82`.

        Raises:
            RigError: no such rig or file, or the file is malformed.
        """
        if str(path_or_shipped_name) in shipped_rigs():
            return shipped_rig(str(path_or_shipped_name))
        path = Path(path_or_shipped_name)
        if not path.is_file():
            shipped = ", ".join(shipped_rigs())
            raise RigError(str(path), "", f"neither a shipped rig ({shipped}) nor a rig file")
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
            raise RigError(str(path), "", f"cannot be read: {reason}") from error
        return parse_rig(text, path.name)

    def with_signals(self, *columns: str) -> Rig:
        """Return the rig with further signals, as if its file had a `[[signal]]` for each; models of it keep them.

        Args:
            columns: columns of observations tables, `<name>_<unit>` or `<name>`: `tilt_x_deg`.

        Raises:
            RigError: a column that cannot be a signal's, or that the rig has already.
            ValueError: the rig was not read from a text.
        """
        if not self.text:
            raise ValueError("the rig was not read from a text, to which the signals could be added; use Rig.read")
        lines = [self.text.rstrip("\n")]
        for column in columns:
            try:
                lines += ["", *signal_lines(signal_of(column, self.taken.names))]
            except ValueError as error:
                raise RigError(f"rig {self.name!r}", "signal", str(error)) from error
        return parse_rig("\n".join((*lines, "")), f"rig {self.name!r}")

    def differences(self, other: Rig) -> tuple[str, ...]:
        """Return the attributes in which another rig is another machine: neither its text nor its signals."""
        return tuple(
            name
            for name in type(self).model_fields
            if name != "signals" and getattr(self, name) != getattr(other, name)
        )

    def couplings(self) -> Iterator[tuple[int, Driven, str, float]]:
        """Iterate over every (row number from 1, driven constant, joint name, coefficient)."""
        for number, row in enumerate(self.rows, 1):
            for driven, combination in row.drive.items():
                for name, coefficient in combination.items():
                    yield number, driven, name, coefficient

    def path(self, frame: int) -> tuple[int, ...]:
        """Return the numbers of the rows between the base and a frame, the base's end first; none for frame 0."""
        numbers: list[int] = []
        while frame > 0:
            numbers.append(frame)
            frame = _continues_from(self.rows, frame)
        return tuple(reversed(numbers))

    def joint(self, name: str) -> Joint:
        """Return the joint called `name`; KeyError if there is none."""
        return {j.name: j for j in self.joints}[name]

    def prism(self, name: str) -> Prism:
        """Return the prism called `name`; KeyError if there is none."""
        return {p.name: p for p in self.prisms}[name]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joint values, in file order."""
        return tuple(j.name for j in self.joints)

    @property
    def prism_names(self) -> tuple[str, ...]:
        """Names of the prisms, in file order."""
        return tuple(p.name for p in self.prisms)

    @property
    def taken(self) -> Taken:
        """Names and columns that no signal can have."""
        return Taken.by(self.joint_names, self.prism_names, self.channels)


_SECTIONS: dict[str, type[BaseModel]] = {
    "": Rig,
    "joint": Joint,
    "row": Row,
    "row.before": FixedTransform,
    "prism": Prism,
    "mass": Mass,
    "signal": Signal,
    "tolerances": Tolerances,
    "station": Station,
}


def _continues_from(rows: Sequence[Row], number: int) -> int:
    after = rows[number - 1].after
    return number - 1 if after is None else after


def _tilting_rows(rows: Sequence[Row], convention: Convention) -> set[int]:
    """Return the rows whose beta alone tilts an axis: one nearly parallel to that before it, or a slide."""
    tilting = set()
    for number, row in enumerate(rows, 1):
        before = _continues_from(rows, number)
        if not 0 < before < number:
            continue
        last, fixed = rows[before - 1], row.before or FixedTransform()
        mount = (("z", fixed.rz_deg), ("y", fixed.ry_deg), ("x", fixed.rx_deg))
        between, tilts = {
            "dh": ((("x", last.alpha_deg), ("y", last.beta_deg), *mount), before),
            "mdh_beta_after": ((("y", last.beta_deg), *mount, ("x", row.alpha_deg)), before),
            "mdh_beta_before": ((*mount, ("x", row.alpha_deg), ("y", row.beta_deg)), number),
        }[convention]
        if abs(_turned("z", between)["z"]) > _NEARLY_PARALLEL:
            tilting.add(tilts)
        # Here `a` slides along x of the frame before, which nothing but its beta turns out of its x and y.
        slides = convention == "mdh_beta_after" and "a" in row.drive
        if slides and abs(_turned("x", mount)["y"]) < _NEARLY_PARALLEL:
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


def parse_rig(text: str, source: str) -> Rig:
    """Read a rig description from its text.

    Args:
        text: TOML.
        source: file name for messages.

    Raises:
        RigError: malformed TOML, unknown keys, impossible values, parts that do not fit each other.
    """
    try:
        raw = parse_toml(text)
    except ValueError as error:
        raise RigError(source, "", f"not valid TOML: {error}") from error
    try:
        rig = Rig.model_validate(raw)
    except ValidationError as error:
        # A misspelt key is unknown and missing; the spelling tells more.
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        where = ".".join(str(p + 1) if isinstance(p, int) else str(p) for p in first["loc"])
        raise RigError(source, where, _reason(first)) from error
    rig._text = text
    return rig


def _reason(error: ErrorDetails) -> str:
    """Return the fault that one of pydantic's errors is about."""
    if error["type"] == "missing":
        return "missing; it is required"
    if error["type"] == "extra_forbidden":
        *inside, _ = (part for part in error["loc"] if isinstance(part, str))
        section = _SECTIONS.get(".".join(inside))
        allowed = [field.alias or name for name, field in section.model_fields.items()] if section else []
        return "unknown key" + (f"; there are {', '.join(allowed)}" if allowed else "")
    return error["msg"].removeprefix("Value error, ")


def shipped_rigs() -> tuple[str, ...]:
    """Return the names of the rigs that come with the program."""
    files = resources.files("calibration").joinpath("rigs").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


def shipped_rig(name: str) -> Rig:
    """Return a rig that comes with the program; RigError if there is none of that name."""
    if name not in shipped_rigs():
        raise RigError(name, "", f"no such rig; shipped: {', '.join(shipped_rigs())}, or give a path to a TOML file")
    text = resources.files("calibration").joinpath("rigs", f"{name}.toml").read_text(encoding="utf-8")
    return parse_rig(text, f"{name}.toml")
