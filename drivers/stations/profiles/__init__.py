"""The registry of station profiles: the `PROFILE` of every file in this folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable
from functools import cache

from drivers.stations.profile import Codec, StationProfile


@cache
def station_profiles() -> dict[str, StationProfile]:
    """Return the profiles by name."""
    return find_profiles(__path__, __name__)


def find_profiles(folders: Iterable[str], package: str) -> dict[str, StationProfile]:
    """Return the profiles that the files of a package define, by name.

    Args:
        folders: the package's folders.
        package: its dotted name.
    """
    modules = (importlib.import_module(f"{package}.{info.name}") for info in pkgutil.iter_modules(folders))
    profiles: list[StationProfile] = [module.PROFILE for module in modules]
    return {profile.name: profile for profile in profiles}


def codecs_by_family() -> dict[str, Codec]:
    """Return the protocols that a passive listener can be told to expect, by the name of their family."""
    return {profile.codec.family: profile.codec for profile in station_profiles().values() if profile.codec}
