"""The rig description: joints, rows, prisms, masses, channels and station, read from a TOML file.

A rig file is data; this module does not compute kinematics. Rows are numbered from 1 as in the papers; frame i is the
frame after row i. Angles are in degrees and lengths in mm, as in the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from pydantic import BaseModel, Field, PrivateAttr, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic_core import ErrorDetails

from calibration.errors import RigError, check_type
from calibration.rig.channels import Channel, Signal
from calibration.rig.decoding import decoded_otherwise, with_decoding
from calibration.rig.files import rig_path, shipped_rigs
from calibration.rig.parts import (
    Convention,
    Driven,
    FixedTransform,
    Joint,
    Mass,
    Part,
    Prism,
    Row,
    RowParameter,
    Station,
    Tolerances,
    Vector,
    continues_from,
    tilting_rows,
)
from calibration.rig.signals import Taken, signal_faults, signal_lines, signal_of
from calibration.rig.toml import line_of, parse_toml
from calibration.rig.toml_errors import place, reason
from calibration.rig.words import counted

__all__ = [
    "ANOTHER_VALUE",
    "BEYOND_BUILDING",
    "Convention",
    "FixedTransform",
    "Joint",
    "Mass",
    "Prism",
    "Rig",
    "Row",
    "RowParameter",
    "Station",
    "Tolerances",
    "check_rig",
    "parse_rig",
    "read_rig",
    "shipped_rig",
    "shipped_rigs",
]

BEYOND_BUILDING = 4.0  # build tolerances: build errors alone never need a larger correction
ANOTHER_VALUE = 10.0  # build tolerances: a value so far off belongs to a different machine and carries no information
_MOST = 300  # joints, rows, prisms, masses, channels or signals


class Rig(Part):
    """A machine: everything that calibration, drivers and simulators need to know about it.

    `Rig.read` reads a rig file or a shipped rig.

    Attributes:
        name: name of the machine.
        convention: order of the transforms in a row.
        gravity: direction of gravity in the base frame, of any length.
        joints: the joint values, `[[joint]]` in the file.
        rows: the kinematic table, `[[row]]`.
        prisms: reflectors, `[[prism]]`.
        masses: lumped masses, `[[mass]]`.
        channels: sources of readings and signals, `[[channel]]`.
        signals: further columns of observations files, `[[signal]]`.
        tolerances: build tolerances.
        station: random error of a fix.
        decoding: channel -> how its DBC or EDS file decodes its value. The daemon adds this to the rigs that it stores
            with sessions and models; a rig file does not need it.
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
    decoding: dict[str, str] = Field(default_factory=dict, max_length=_MOST)

    _text: str = PrivateAttr("")

    @field_validator("rows")
    @classmethod
    def _beta_where_axes_are_parallel(cls, rows: tuple[Row, ...], info: ValidationInfo) -> tuple[Row, ...]:
        tilting = tilting_rows(rows, info.data["convention"]) if "convention" in info.data else set()
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
            raise ValueError("must not be zero; [0, 0, -1] points down, along the base's -z axis")
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
                raise ValueError(f"two {what}s are called {doubled[0]!r}; rename or remove one")
        for fault in signal_faults(self.signals, self.taken):
            raise ValueError(fault)
        return self

    @model_validator(mode="after")
    def _joints_fit(self) -> Rig:
        driven = {name for _, _, name, _ in self.couplings()}
        known = {j.name for j in self.joints}
        for number, _, name, coefficient in self.couplings():
            if name not in known:
                raise ValueError(
                    f"row {number}: driven by unknown joint {name!r}; the joints are {', '.join(sorted(known))}"
                )
            if coefficient == 0.0:
                raise ValueError(
                    f"row {number}: the coefficient of joint {name!r} is 0; correct it, or remove the joint from drive"
                )
        if known - driven:
            raise ValueError(
                f"joint {sorted(known - driven)[0]!r} drives no row; add it to drive of a row, or remove the joint"
            )
        for channel in self.channels:
            joint = next((j for j in self.joints if j.name == channel.name), None)
            if joint is not None and channel.unit != joint.unit:
                raise ValueError(
                    f"channel {channel.name!r} is in {channel.unit}, but its joint is in {joint.unit}; correct either"
                )
        self._require_places_of_their_own([channel for channel in self.channels if channel.name in known])
        return self

    @staticmethod
    def _require_places_of_their_own(channels: Iterable[Channel]) -> None:
        taken: dict[tuple[tuple[str, object], ...], str] = {}
        for channel in channels:
            other = taken.setdefault(tuple(channel.place().items()), channel.name)
            if other != channel.name:
                raise ValueError(
                    f"joints {other!r} and {channel.name!r} are read from the same place on the bus; "
                    f"correct the channel of one of them"
                )

    @model_validator(mode="after")
    def _rows_fit(self) -> Rig:
        unused = {"mdh_beta_before": set(), "mdh_beta_after": {"b"}, "dh": {"b"}}[self.convention]
        for number, row in enumerate(self.rows, 1):
            if row.after is not None and row.after >= number:
                raise ValueError(f"row {number}: after is {row.after}, but must be 0 or the number of an earlier row")
            wrong = unused & ({*row.identify} | ({"b"} if row.b_mm else set()) | ({"beta"} if row.beta_deg else set()))
            if wrong:
                raise ValueError(f"row {number}: convention {self.convention!r} has no {sorted(wrong)[0]}; remove it")
        return self

    @model_validator(mode="after")
    def _frames_fit(self) -> Rig:
        last = len(self.rows)
        for prism in self.prisms:
            if prism.frame > last:
                raise ValueError(f"prism {prism.name!r}: frame {prism.frame} is too large; the rig has {last} rows")
        for mass in self.masses:
            if mass.frame + mass.midway > last:
                needed = f"frame {mass.frame}{' with midway' if mass.midway else ''}"
                raise ValueError(f"mass {mass.name!r}: {needed} is too large; the rig has {last} rows")
            if mass.midway and self.path(mass.frame + 1)[:-1] != self.path(mass.frame):
                raise ValueError(
                    f"mass {mass.name!r}: row {mass.frame + 1} does not continue from frame {mass.frame}; "
                    f"give centre_mm instead of midway"
                )
        return self

    def __repr__(self) -> str:
        return f"Rig({self.name!r}, {counted(len(self.joints), 'joint')}, {counted(len(self.prisms), 'prism')})"

    __str__ = __repr__

    @property
    def text(self) -> str:
        """The TOML that the rig was read from; "" for one that was built in a program."""
        return self._text

    @classmethod
    def read(cls, path_or_shipped_name: str | Path) -> Rig:
        """Read a rig file or a shipped rig (`shipped_rigs`).

        Args:
            path_or_shipped_name: path of a TOML file, or a name such as `swdt82`.

        Raises:
            RigError: there is no such rig or file, or the file is malformed.
        """
        path = rig_path(str(path_or_shipped_name))
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
            raise RigError(str(path), "", f"cannot be read: {reason}") from error
        return parse_rig(text, path.name)

    def with_signals(self, *columns: str) -> Rig:
        """Return the rig with further signals, as if its file had a `[[signal]]` for each; its models keep them.

        Args:
            columns: names of columns of observations tables, `<name>_<unit>` or `<name>`, such as `tilt_x_deg`.

        Raises:
            RigError: a column cannot be a signal, or the rig has it already.
            ValueError: the rig was not read from a text.
        """
        lines = [self._text_to_add_to("the signals").rstrip("\n")]
        for column in columns:
            try:
                lines += ["", *signal_lines(signal_of(column, self.taken.names))]
            except ValueError as error:
                raise RigError(f"rig {self.name!r}", "signal", str(error)) from error
        return parse_rig("\n".join((*lines, "")), f"rig {self.name!r}")

    def with_decoding(self, decoding: Mapping[str, str]) -> Rig:
        """Return the rig with a different decoding of its channels, also in its text.

        Args:
            decoding: channel -> how its value is decoded.

        Raises:
            ValueError: the rig was not read from a text.
        """
        if decoding == self.decoding:
            return self
        return parse_rig(with_decoding(self._text_to_add_to("a decoding"), decoding), f"rig {self.name!r}")

    def _text_to_add_to(self, what: str) -> str:
        if not self.text:
            raise ValueError(f"the rig has no text to which {what} could be added; read the rig with Rig.read")
        return self.text

    def differences(self, other: Rig) -> tuple[str, ...]:
        """Return the names of the attributes in which another rig describes a different machine.

        Texts and signals are not compared. The decoding of a channel is compared only if both rigs have it.
        """
        named = (name for name in type(self).model_fields if name not in ("signals", "decoding"))
        differ = [name for name in named if getattr(self, name) != getattr(other, name)]
        return (*differ, "decoding") if decoded_otherwise(self.decoding, other.decoding) else tuple(differ)

    def misreading(self, recorded: Rig) -> str:
        """Return why readings recorded with another rig file do not fit this rig; "" if they do.

        The times of a channel may differ, and so may everything that does not affect readings: rows, limits, masses.

        Args:
            recorded: the rig file that converted counts to the readings.

        Returns:
            A clause such as "its channel L2 has zero_counts = 0, this one -2000".
        """
        for joint in self.joints:
            if joint.name not in recorded.joint_names:
                return f"it has no joint {joint.name}"
            if joint.unit != (unit := recorded.joint(joint.name).unit):
                return f"its joint {joint.name} is in {unit}, this one in {joint.unit}"
        channels = {channel.name: channel for channel in recorded.channels}
        for channel in self.channels:
            if channel.name in channels:
                here, there = channel.source(), channels[channel.name].source()
                for name in (*here, *there):
                    if here.get(name) != there.get(name):
                        return f"its channel {channel.name} has {name} = {there.get(name)}, this one {here.get(name)}"
        for name in decoded_otherwise(self.decoding, recorded.decoding):
            return f"its channel {name} is decoded as {recorded.decoding[name]}, this one as {self.decoding[name]}"
        return ""

    def couplings(self) -> Iterator[tuple[int, Driven, str, float]]:
        """Yield every coupling as (row number from 1, driven constant, joint name, coefficient)."""
        for number, row in enumerate(self.rows, 1):
            for driven, combination in row.drive.items():
                for name, coefficient in combination.items():
                    yield number, driven, name, coefficient

    def path(self, frame: int) -> tuple[int, ...]:
        """Return the numbers of the rows from the base to a frame, in this order; empty for frame 0."""
        numbers: list[int] = []
        while frame > 0:
            numbers.append(frame)
            frame = continues_from(self.rows, frame)
        return tuple(reversed(numbers))

    def joint(self, name: str) -> Joint:
        """Return the joint called `name`; raise KeyError, whose message lists the joints, if there is none."""
        if name not in self.joint_names:
            raise KeyError(f"rig {self.name!r} has no joint {name!r}; it has {', '.join(self.joint_names)}")
        return self.joints[self.joint_names.index(name)]

    def prism(self, name: str) -> Prism:
        """Return the prism called `name`; raise KeyError, whose message lists the prisms, if there is none."""
        if name not in self.prism_names:
            raise KeyError(f"rig {self.name!r} has no prism {name!r}; it has {', '.join(self.prism_names)}")
        return self.prisms[self.prism_names.index(name)]

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
        """Names and columns that a signal cannot have."""
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


def check_rig(rig: object) -> None:
    """Raise TypeError if an argument `rig` is not a Rig, such as the name of a shipped one."""
    check_type("rig", rig, Rig, "a Rig, as from rigcal.Rig.read('ur10')")


def parse_rig(text: str, source: str) -> Rig:
    """Read a rig description from its text.

    Args:
        text: TOML.
        source: file name for messages.

    Raises:
        RigError: malformed TOML, unknown keys, impossible values, or parts that do not fit together. Only the most
            informative of several faults is raised.
    """
    rig, faults = read_rig(text, source)
    if rig is None:
        raise faults[0]
    return rig


def read_rig(text: str, source: str) -> tuple[Rig | None, tuple[RigError, ...]]:
    """Read a rig description, or find all its faults.

    Args:
        text: TOML.
        source: file name for messages.

    Returns:
        The rig, or None if there are faults; and the faults, the most informative first.
    """
    try:
        raw = parse_toml(text)
    except ValueError as error:
        return None, (RigError(source, "", f"not valid TOML: {error}"),)
    try:
        rig = Rig.model_validate(raw)
    except ValidationError as error:
        # A misspelt key is both unknown and missing; the unknown key is more informative.
        found = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        # Faulty tables count as missing, so the list seems too short
        own = [e for e in found if e["type"] != "too_short"] or found
        return None, tuple(_fault(text, source, each) for each in own)
    rig._text = text
    return rig, ()


def _fault(text: str, source: str, error: ErrorDetails) -> RigError:
    """Return the fault that an error of pydantic reports."""
    where, why = place(error), _reason(error)
    return RigError(source, ".".join(map(str, where)), why, line_of(text, where or _named_in(why)))


def _named_in(why: str) -> tuple[str | int, ...]:
    """Return the place of the table with which a message about the whole rig begins: `row 3: ...` -> row, 3."""
    section, _, rest = why.partition(" ")
    number, _, _ = rest.partition(":")
    return (section, int(number)) if section in _SECTIONS and number.isdecimal() else ()


def _reason(error: ErrorDetails) -> str:
    """Return the message for an error of pydantic."""
    if error["type"] == "missing":
        return "missing; it is required"
    if error["type"] == "extra_forbidden":
        *inside, _ = (part for part in error["loc"] if isinstance(part, str))
        section = _SECTIONS.get(".".join(inside))
        fields = section.model_fields.items() if section else ()
        allowed = [field.alias or name for name, field in fields if name != "decoding"]  # users do not write it
        return "unknown key" + (f"; allowed here: {', '.join(allowed)}" if allowed else "")
    return reason(error, Rig)


def shipped_rig(name: str) -> Rig:
    """Return the shipped rig called `name`; raise RigError if there is none."""
    if name not in shipped_rigs():
        names = ", ".join(shipped_rigs())
        raise RigError(name, "", f"no such rig; give a shipped rig ({names}) or the path of a TOML file")
    path = rig_path(name)
    return parse_rig(path.read_text(encoding="utf-8"), path.name)
