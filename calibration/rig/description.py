"""The rig description: joints, rows, prisms, masses, channels and station, read from a TOML file.

A rig file is data; nothing here computes kinematics. Rows are numbered from 1 as in the papers; frame i is the frame
after row i. Files keep degrees and mm, and so does this description.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from pydantic import BaseModel, Field, PrivateAttr, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic_core import ErrorDetails

from calibration.errors import RigError
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
    "parse_rig",
    "read_rig",
    "shipped_rig",
    "shipped_rigs",
]

BEYOND_BUILDING = 4.0  # build tolerances: no correction by building alone is larger
ANOTHER_VALUE = 10.0  # build tolerances: so far off, the file's value is another machine's and tells nothing
_MOST = 300  # joints, rows, prisms, masses, channels or signals


class Rig(Part):
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
        decoding: channel -> how the DBC or EDS file that it names decodes its value. The daemon adds it to the rig that
            it stores with sessions and models; a rig file needs none.
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
        self._require_places_of_their_own([channel for channel in self.channels if channel.name in known])
        return self

    @staticmethod
    def _require_places_of_their_own(channels: Iterable[Channel]) -> None:
        taken: dict[tuple[tuple[str, object], ...], str] = {}
        for channel in channels:
            other = taken.setdefault(tuple(channel.place().items()), channel.name)
            if other != channel.name:
                raise ValueError(f"joints {other!r} and {channel.name!r} are read from the same place on the bus")

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
        path = rig_path(str(path_or_shipped_name))
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
        lines = [self._text_to_add_to("the signals").rstrip("\n")]
        for column in columns:
            try:
                lines += ["", *signal_lines(signal_of(column, self.taken.names))]
            except ValueError as error:
                raise RigError(f"rig {self.name!r}", "signal", str(error)) from error
        return parse_rig("\n".join((*lines, "")), f"rig {self.name!r}")

    def with_decoding(self, decoding: Mapping[str, str]) -> Rig:
        """Return the rig with another decoding of its channels, in its text as well.

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
            raise ValueError(f"the rig was not read from a text, to which {what} could be added; use Rig.read")
        return self.text

    def differences(self, other: Rig) -> tuple[str, ...]:
        """Return the attributes in which another rig is another machine.

        Neither its text nor its signals are such, and the decoding of a channel only where both rigs tell it.
        """
        named = (name for name in type(self).model_fields if name not in ("signals", "decoding"))
        differ = [name for name in named if getattr(self, name) != getattr(other, name)]
        return (*differ, "decoding") if decoded_otherwise(self.decoding, other.decoding) else tuple(differ)

    def misreading(self, recorded: Rig) -> str:
        """Return why readings that were recorded with another rig file are not this one's; "" where they are.

        Times of a channel may differ, and so may all that is no reading: rows, limits, masses.

        Args:
            recorded: the rig file that turned counts into the readings.

        Returns:
            a clause: "its channel L2 has zero_counts = 0, this one -2000".
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
            frame = continues_from(self.rows, frame)
        return tuple(reversed(numbers))

    def joint(self, name: str) -> Joint:
        """Return the joint called `name`; KeyError, which names those that there are, if there is none."""
        if name not in self.joint_names:
            raise KeyError(f"rig {self.name!r} has no joint {name!r}; it has {', '.join(self.joint_names)}")
        return self.joints[self.joint_names.index(name)]

    def prism(self, name: str) -> Prism:
        """Return the prism called `name`; KeyError, which names those that there are, if there is none."""
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


def parse_rig(text: str, source: str) -> Rig:
    """Read a rig description from its text.

    Args:
        text: TOML.
        source: file name for messages.

    Raises:
        RigError: malformed TOML, unknown keys, impossible values, parts that do not fit each other; of several faults
            the one that tells most.
    """
    rig, faults = read_rig(text, source)
    if rig is None:
        raise faults[0]
    return rig


def read_rig(text: str, source: str) -> tuple[Rig | None, tuple[RigError, ...]]:
    """Read a rig description, or find all that is wrong with it.

    Args:
        text: TOML.
        source: file name for messages.

    Returns:
        The rig, None where there are faults; the faults, that which tells most first.
    """
    try:
        raw = parse_toml(text)
    except ValueError as error:
        return None, (RigError(source, "", f"not valid TOML: {error}"),)
    try:
        rig = Rig.model_validate(raw)
    except ValidationError as error:
        # A misspelt key is unknown and missing; the spelling tells more.
        found = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        # Tables that are wrong do not count as there
        own = [e for e in found if e["type"] != "too_short"] or found
        return None, tuple(_fault(text, source, each) for each in own)
    rig._text = text
    return rig, ()


def _fault(text: str, source: str, error: ErrorDetails) -> RigError:
    """Return the fault that one of pydantic's errors is about."""
    where, why = place(error), _reason(error)
    return RigError(source, ".".join(map(str, where)), why, line_of(text, where or _named_in(why)))


def _named_in(why: str) -> tuple[str | int, ...]:
    """Return the key of the table that a sentence of the rig as a whole begins with: `row 3: ...` -> row, 3."""
    section, _, rest = why.partition(" ")
    number, _, _ = rest.partition(":")
    return (section, int(number)) if section in _SECTIONS and number.isdecimal() else ()


def _reason(error: ErrorDetails) -> str:
    """Return the fault that one of pydantic's errors is about."""
    if error["type"] == "missing":
        return "missing; it is required"
    if error["type"] == "extra_forbidden":
        *inside, _ = (part for part in error["loc"] if isinstance(part, str))
        section = _SECTIONS.get(".".join(inside))
        fields = section.model_fields.items() if section else ()
        allowed = [field.alias or name for name, field in fields if name != "decoding"]  # nobody writes it by hand
        return "unknown key" + (f"; there are {', '.join(allowed)}" if allowed else "")
    return reason(error, Rig)


def shipped_rig(name: str) -> Rig:
    """Return a rig that comes with the program; RigError if there is none of that name."""
    if name not in shipped_rigs():
        raise RigError(name, "", f"no such rig; shipped: {', '.join(shipped_rigs())}, or give a path to a TOML file")
    path = rig_path(name)
    return parse_rig(path.read_text(encoding="utf-8"), path.name)
