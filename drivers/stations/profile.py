"""Station profile: all that rigcal must know of a kind of instrument, in one object.

A new instrument is one new file in `drivers/stations/profiles`, with its `PROFILE`.
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
        init: further commands of the set-up, without check sums: `ZB4+`, `ZB52`, `ZB61` (circle clockwise, compensator
            on, zenith 0) for topcon_gts8, `Xe` (tracking) for sokkia_set. Each must be one that the station
            acknowledges.
        crlf: commands end with CR LF after ETX (Topcon), or CR LF rather than CR (Sokkia).
        measure: what topcon_classic asks for.
        ppm_scale: ppm per count of the atmospheric correction, see `drivers.stations.topcon.records.CorrectionScales`.
        prism_scale_mm: mm per count of the prism constant, see there.
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
                raise ValueError(f"{command!r} is no command: give printable ASCII without check sum and line end")
        return commands

    @property
    def init_commands(self) -> tuple[bytes, ...]:
        """The commands of `init` as they are sent, but for framing."""
        return tuple(command.encode("ascii") for command in self.init)


@dataclass(frozen=True, kw_only=True)
class Codec:
    """The protocol of a family of instruments.

    Attributes:
        family: its name, as `listen_to` gives it.
        encode: frames a command; the second argument says whether it ends with CR LF.
        framer: makes a framer.
        parser: makes a parser of the station of a name.
        shortest_record: bytes; garbage of at least so many was meant as an answer.
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
        name: as the configuration gives it.
        codec: its protocol; None: that of the family which `listen_to` names.
        plan: makes the commands and pauses from the station's options; None: nothing is sent, ever.
        untold_tracking: the set-up command after which the station follows its prism, where its records say nothing
            of its lock; None: no such command.
    """

    name: str
    codec: Codec | None
    plan: Callable[[ProfileOptions], CommandPlan] | None
    untold_tracking: str | None = None
