"""Profile `topcon_classic`: single measurements with C; the host acknowledges each record."""

from __future__ import annotations

from drivers.stations.poller import CommandPlan
from drivers.stations.profile import ProfileOptions, StationProfile
from drivers.stations.replies import ACK
from drivers.stations.topcon.codec import CODEC

REQUEST = b"C"
SLOPE_DISTANCE = b"Z34"
COORDINATES = b"Z64"


def _plan(options: ProfileOptions) -> CommandPlan:
    mode = COORDINATES if options.measure == "coordinates" else SLOPE_DISTANCE
    return CommandPlan(request=REQUEST, setup=(*options.init_commands, mode), host_acknowledges=ACK, recover=(mode,))


PROFILE = StationProfile(name="topcon_classic", codec=CODEC, plan=_plan)
