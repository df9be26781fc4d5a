"""The registry of station profiles: the `PROFILE` of every file in this directory."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from drivers.stations.profile import Codec, StationProfile


@cache
def station_profiles() -> dict[str, StationProfile]:
    """Return the profiles by name."""
    found: dict[str, StationProfile] = {}
    for info in pkgutil.iter_modules(__path__):
        profile: StationProfile = importlib.import_module(f"{__name__}.{info.name}").PROFILE
        assert profile.name not in found, f"two station profiles are called {profile.name}"
        found[profile.name] = profile
    return found


def codecs_by_family() -> dict[str, Codec]:
    """Return the protocols that a passive listener can use, by the name of their family."""
    return {profile.codec.family: profile.codec for profile in station_profiles().values() if profile.codec}
