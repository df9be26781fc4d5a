"""Profile `passive`: listens to an instrument that another program controls, and never sends anything."""

from __future__ import annotations

from drivers.stations.profile import StationProfile

PROFILE = StationProfile(name="passive", codec=None, plan=None)
