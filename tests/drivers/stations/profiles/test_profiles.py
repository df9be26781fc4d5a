"""The registry of station profiles: a new instrument is one file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.readings import Fix, Status
from drivers.stations import profiles
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.link import start_poller
from tests.drivers.serial_support import received

NEW_INSTRUMENT = '''
"""An instrument that sends its slope distance in mm, one line a record."""

from drivers.readings import Fix, LockState, Status
from drivers.stations.poller import CommandPlan
from drivers.stations.profile import Codec, StationProfile
from drivers.stations.replies import Frame, Framer, Reply, ReplyKind


class LineFramer(Framer):
    def feed(self, data):
        found = []
        for byte in data:
            self._buffer.append(byte)
            if byte == 10:
                found.append(Frame(bytes(self._buffer[:-1]), self._start, self._start + len(self._buffer) - 1))
                self._drop(len(self._buffer))
        return found


class MillimetreParser:
    def __init__(self, station, options):
        self._station = station

    def parse(self, data, first_byte, last_byte):
        distance_m = int(data) / 1000
        fix = Fix(self._station, first_byte, last_byte, Status.OK, LockState.UNKNOWN, 0.0, 1.5, distance_m)
        return Reply(ReplyKind.RECORD, (fix,))


CODEC = Codec(
    family="theodolite_works",
    encode=lambda command, crlf: command + b"!",
    framer=LineFramer,
    parser=MillimetreParser,
    shortest_record=3,
)
PROFILE = StationProfile(
    name="theodolite_one", codec=CODEC, plan=lambda options: CommandPlan(request=b"MEASURE", setup=(b"WAKE",))
)
'''


@pytest.fixture
def new_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with one further profile."""
    (tmp_path / "theodolite_one.py").write_text(NEW_INSTRUMENT, encoding="utf-8")
    monkeypatch.setattr(profiles, "__path__", [*profiles.__path__, str(tmp_path)])
    profiles.station_profiles.cache_clear()
    yield tmp_path
    profiles.station_profiles.cache_clear()


def config(**settings: object) -> StationConfig:
    return StationConfig.model_validate({"serial": {"path": "/dev/null"}, **settings})


def test_the_profiles_are_those_of_the_configuration() -> None:
    assert {"passive", "sokkia_set", "topcon_classic", "topcon_gts8"} <= profiles.station_profiles().keys()
    assert {"sokkia", "topcon"} <= profiles.codecs_by_family().keys()


def test_two_profiles_of_one_name_are_refused(new_file: Path) -> None:
    (new_file / "theodolite_two.py").write_text(NEW_INSTRUMENT, encoding="utf-8")
    with pytest.raises(AssertionError, match="two station profiles are called theodolite_one"):
        profiles.station_profiles()


@pytest.mark.usefixtures("new_file")
def test_a_new_file_is_all_that_a_new_instrument_takes() -> None:
    station = config(profile="theodolite_one")
    poller = start_poller(station)
    assert poller is not None
    assert poller.step(0) == b"WAKE!"
    poller.feed(received(b"\x06\n"))  # framed as one line, which is an acknowledgement
    assert poller.step(2_000_000_000) == b"MEASURE!"
    for settings in ({"profile": "theodolite_one"}, {"profile": "passive", "listen_to": "theodolite_works"}):
        (fix,) = StationDecoder(config(**settings)).feed(received(b"12345\n"))
        assert isinstance(fix, Fix)
        assert (fix.status, fix.slope_distance_m) == (Status.OK, 12.345)


def test_a_profile_or_family_that_no_file_defines_is_refused() -> None:
    known, families = (", ".join(sorted(names)) for names in (profiles.station_profiles(), profiles.codecs_by_family()))
    with pytest.raises(ValueError, match=f"'theodolite_one' is not known; known: {known}"):
        config(profile="theodolite_one")
    with pytest.raises(ValueError, match=f"'theodolite_works' is not known; known: {families}"):
        config(profile="passive", listen_to="theodolite_works")
