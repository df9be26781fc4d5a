"""Profile `topcon_gts8`: the Topcon GTS-8 tracking family, polled with C11. The host acknowledges nothing."""

from __future__ import annotations

from drivers.stations.poller import CommandPlan
from drivers.stations.profile import ProfileOptions, StationProfile
from drivers.stations.topcon.codec import CODEC

TRACK = b"T34"
REQUEST_TRACKED = b"C11"


def _plan(options: ProfileOptions) -> CommandPlan:
    return CommandPlan(request=REQUEST_TRACKED, setup=(*options.init_commands, TRACK), track=TRACK)


PROFILE = StationProfile(name="topcon_gts8", codec=CODEC, plan=_plan)
