"""Profile `sokkia_set`: Sokkia's SET command family, which newer Topcon stations also use.

If the last measuring mode in `init` is a repeating one (Xb, Xd, Xe), one 11h starts a stream of replies. It is sent
again only if the stream has stopped for `reply_timeout_s`, and 12h ends the stream when the link closes.
"""

from __future__ import annotations

from drivers.stations.poller import CommandPlan
from drivers.stations.profile import ProfileOptions, StationProfile
from drivers.stations.sokkia.codec import CODEC

# 11H and 12H in the manuals: hexadecimal codes of single characters, like 06H (ACK) and 0DH (CR) there
REQUEST_DISTANCE = b"\x11"
STOP = b"\x12"
TRACKING = "Xe"
REPEATING = ("Xb", "Xd", TRACKING)  # fine repeat, rapid repeat, tracking
MEASURING_MODES = ("Xa", "Xc", *REPEATING)
PAUSE_S = 0.7  # SET600: pause after ACK or NAK before the next command


def _plan(options: ProfileOptions) -> CommandPlan:
    modes = [command for command in options.init if command in MEASURING_MODES]
    streams = bool(modes) and modes[-1] in REPEATING
    return CommandPlan(
        request=REQUEST_DISTANCE,
        setup=options.init_commands,
        opening=(STOP,),
        request_is_acknowledged=False,
        streams=streams,
        closing=(STOP,) if streams else (),
        pause_after_ack_s=PAUSE_S,
    )


PROFILE = StationProfile(name="sokkia_set", codec=CODEC, plan=_plan, untold_tracking=TRACKING)
