"""Station profile: everything that rigcal must know about a kind of instrument, in one object.

To add an instrument, add a file with a `PROFILE` to `drivers/stations/profiles`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from pydantic import Field, field_validator

from drivers.settings import Settings
from drivers.stations.poller import CommandPlan
from drivers.stations.replies import Framer, Parser


class ProfileOptions(Settings):
    """Options of a station that its profile reads.

    Attributes:
        init: further set-up commands, without checksums: `ZB4+`, `ZB52`, `ZB61` (circle clockwise, compensator on,
            zenith 0) for topcon_gts8, `Xe` (tracking) for sokkia_set. The station must acknowledge each of them.
        crlf: commands end with CR LF after ETX (Topcon), or with CR LF instead of CR (Sokkia).
        measure: quantity that topcon_classic requests.
        ppm_scale: ppm per count of the atmospheric correction, see `drivers.stations.topcon.records.CorrectionScales`.
        prism_scale_mm: mm per count of the prism constant, see `CorrectionScales`.
    """

    init: tuple[str, ...] = ()
    crlf: bool = True
    measure: Literal["slope_distance", "coordinates"] = "slope_distance"
    ppm_scale: float = Field(default=0.1, gt=0)
    prism_scale_mm: float = Field(default=0.1, gt=0)

    @field_validator("init")
    @classmethod
    def _printable(cls, commands: tuple[str, ...]) -> tuple[str, ...]:
        for command in commands:
            if not (command and command.isascii() and command.isprintable()):
                raise ValueError(f"{command!r} is not a command: give printable ASCII without checksum and line end")
        return commands

    @property
    def init_commands(self) -> tuple[bytes, ...]:
        """The commands of `init` as bytes, without framing."""
        return tuple(command.encode("ascii") for command in self.init)


@dataclass(frozen=True, kw_only=True)
class Codec:
    """The protocol of a family of instruments.

    Attributes:
        family: name of the family, for `listen_to`.
        encode: function that frames a command; if its second argument is True, the command ends with CR LF.
        framer: function that creates a framer.
        parser: function that creates a parser for the station of a given name.
        shortest_record: length in bytes; garbage of at least this length counts as a damaged answer.
    """

    family: str
    encode: Callable[[bytes, bool], bytes]
    framer: Callable[[], Framer]
    parser: Callable[[str, ProfileOptions], Parser]
    shortest_record: int


@dataclass(frozen=True, kw_only=True)
class StationProfile:
    """A kind of station.

    Attributes:
        name: name in the configuration.
        codec: its protocol; None to use the protocol of the family given by `listen_to`.
        plan: function that creates the commands and pauses from the station's options; None to never send anything.
        untold_tracking: set-up command after which the station tracks its prism, if its records do not contain its lock
            state; None if there is no such command.
    """

    name: str
    codec: Codec | None
    plan: Callable[[ProfileOptions], CommandPlan] | None
    untold_tracking: str | None = None
