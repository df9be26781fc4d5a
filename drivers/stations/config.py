"""Configuration of a total station."""

from __future__ import annotations

from pydantic import Field, field_validator, model_validator

from drivers.stations.poller import PollTiming
from drivers.stations.profile import Codec, ProfileOptions, StationProfile
from drivers.stations.profiles import codecs_by_family, station_profiles
from drivers.stations.replies import ReplyReader
from drivers.stations.serial_port import SerialConfig
from drivers.stations.survey import RANGE_MAX_M


class StationConfig(ProfileOptions, PollTiming):
    """A total station and how it is read.

    The base classes define the options of its profile and its timeouts.

    Attributes:
        name: name of the station in its captures, fixes and events.
        profile: name of a profile in `drivers.stations.profiles`.
        serial: its serial port.
        listen_to: family of the station whose records a passive listener expects.
        link_delay_s: constant delay from the measurement to the first byte on the host. It is not included in fixes,
            but subtracted when they are combined with the joints.
        max_speed_m_s: see `relock_within_m`.
        jump_slack_m: see `relock_within_m`.
        relock_within_m: the target may be a different prism if it moves from one fix to the next by more than
            `max_speed_m_s` and `jump_slack_m` allow, or if after a loss the station locks farther than this from
            where it lost the prism. In a session such fixes do not count until the station is back on the prism or an
            operator confirms it.
        max_range_m: a fix farther away is refused. The default is the longest distance that the distance meters of
            these families measure to a single prism under good conditions.
        silence_timeout_s: no record for longer than this is a gap; 0 for a station that only measures on request.
    """

    name: str = Field(default="station", pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    profile: str = "topcon_gts8"
    serial: SerialConfig
    listen_to: str = "topcon"
    link_delay_s: float = Field(default=0.0, ge=0, le=60)
    max_speed_m_s: float = Field(default=5.0, gt=0)
    jump_slack_m: float = Field(default=0.1, gt=0)
    relock_within_m: float = Field(default=2.0, gt=0)
    max_range_m: float = Field(default=RANGE_MAX_M, ge=1)
    silence_timeout_s: float = Field(default=4.0, ge=0)

    @model_validator(mode="before")
    @classmethod
    def _no_prism_is_accepted_by_time(cls, given: object) -> object:
        if isinstance(given, dict) and "new_target_after_s" in given:
            raise ValueError(
                "new_target_after_s no longer exists, remove it: a prism is never accepted because time has passed; "
                "confirm it with `rigcal session confirm-prism`"
            )
        return given

    @field_validator("profile")
    @classmethod
    def _profile_exists(cls, name: str) -> str:
        return _one_of(station_profiles(), name)

    @field_validator("listen_to")
    @classmethod
    def _family_exists(cls, name: str) -> str:
        return _one_of(codecs_by_family(), name)

    @model_validator(mode="after")
    def _silent_profile_has_no_commands(self) -> StationConfig:
        if self.init and self.station_profile.plan is None:
            raise ValueError("a passive listener sends nothing: remove init, or choose another profile")
        return self

    @property
    def station_profile(self) -> StationProfile:
        """The profile object."""
        return station_profiles()[self.profile]

    @property
    def codec(self) -> Codec:
        """The protocol of the station's records."""
        return self.station_profile.codec or codecs_by_family()[self.listen_to]

    @property
    def tracks_silently(self) -> bool:
        """True if the station tracks its prism although its records do not contain its lock state."""
        return self.station_profile.untold_tracking in self.init

    def reply_reader(self) -> ReplyReader:
        """Create a new reader of the station's replies."""
        codec = self.codec
        parser = codec.parser(self.name, self)
        return ReplyReader(self.name, codec.framer(), parser, codec.shortest_record, self.serial.character_s)


def _one_of(known: dict[str, StationProfile] | dict[str, Codec], name: str) -> str:
    if name not in known:
        raise ValueError(f"{name!r} is not known; known: {', '.join(sorted(known))}")
    return name
