"""CAN logs of channel numbers: each link has its own, in an export and back in a replay, and none is guessed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.config.config import Config, ConfigError, read_config
from daemon.guide.times_away import times_away
from daemon.sessions.export.captured_logs import CanFormat, export_session
from daemon.sessions.export.session_file import DoubtfulCaptures, SessionFile, read_session_file
from daemon.sessions.replay import captures_of, first_captures
from daemon.sessions.vector_channels import SUFFIXES, channel_numbers
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.logs.can_log import FORMATS, read_can_log, write_can_log
from drivers.readings import CanCapture
from tests.daemon.support.sessions import Rig

BEGIN = Stamp(1_795_800_000_000_000_000, 5_000_000_000, "b")
TOLD = SessionFile(prism="r", kind="check", since_utc_ns=0, until_utc_ns=1, control_points={})


def configured(directory: Path, **channels: str) -> Config:
    """A configuration of these CAN links, name=channel."""
    links = "".join(
        f'\n[[can]]\nname = "{name}"\ninterface = "{"slcan" if "/" in channel else "socketcan"}"\n'
        f'channel = "{channel}"\n'
        for name, channel in channels.items()
    )
    (directory / "rigcal.toml").write_text(f'rig = "swdt82"\nstate_directory = "."\n{links}', encoding="utf-8")
    return read_config(directory / "rigcal.toml")


def frames(link: str) -> list[CanCapture]:
    return [CanCapture(link, BEGIN.shifted(n * 100_000_000), 0x1A0, bytes(range(4))) for n in range(1, 6)]


def links_of(path: Path, config: Config, told: SessionFile | None = None) -> set[str]:
    return {capture.link for capture in captures_of(path, config, told)}


def exported(directory: Path, config: Config, can_format: CanFormat, links: Sequence[str]) -> dict[str, Path]:
    """Link -> its log of a session in which all links had frames."""
    rig = Rig(config.store_path)
    rig.clock.set(BEGIN)
    rig.store.begin_run(rig.clock.now())
    rig.say("setup_new", id="S1")
    rig.say("start", prism="r", id="s001-r")
    for link in links:
        rig.store.mark_decoded(rig.store.append_captures(frames(link)))
    rig.clock.advance(2.0)
    rig.say("stop")
    rig.store.end_run(rig.clock.now())
    rig.store.close()
    export_session(config, "s001-r", directory / "out", can_format, times_away)
    return {link: directory / "out" / f"s001-r-{link}.{can_format}" for link in links}


@pytest.mark.parametrize("can_format", ["log", "asc", "blf"])
@pytest.mark.parametrize(
    "channels",
    [
        {"boom": "can0", "arm": "can1"},
        {"boom": "can1", "arm": "can0"},
        {"boom": "/dev/ttyACM0", "arm": "/dev/ttyACM1"},
        {"boom": "can5", "arm": "vcan0"},
    ],
)
def test_each_link_of_an_exported_session_comes_back_as_itself_alone_and_with_the_others(
    tmp_path: Path, can_format: CanFormat, channels: dict[str, str]
) -> None:
    config = configured(tmp_path, **channels)
    logs = exported(tmp_path, config, can_format, list(channels))
    told = read_session_file(tmp_path / "out" / "s001-r.json")
    for link, path in logs.items():
        assert links_of(path, config, told) == {link}
        assert links_of(path, config) == {link}
        assert links_of(path, configured(tmp_path, **dict(reversed(channels.items()))), told) == {link}
        renamed = path.rename(path.with_stem(f"copy of {path.stem} for Ann"))
        assert links_of(renamed, config, told) == {link}
        renamed.rename(path)
    assert (
        len(first_captures(list(logs.values()), config, told)) == len(first_captures(list(logs.values()), config)) == 2
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_export_of_an_earlier_version_is_the_link_s_whose_name_it_has(tmp_path: Path, suffix: str) -> None:
    config = configured(tmp_path, boom="can0", arm="can1")
    for link in ("boom", "arm"):
        path = tmp_path / f"s001-r-{link}{suffix}"
        write_can_log(path, frames(link))  # all were written as channel 1
        assert {capture.link for capture in read_can_log(path)} == {"can0"}
        assert links_of(path, config) == links_of(path, config, TOLD) == {link}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_log_of_channel_1_that_may_be_any_link_s_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"recorded{suffix}"
    write_can_log(path, frames("boom"))
    config = configured(tmp_path, **{"arm": "can0", "left-arm": "can1"})
    with pytest.raises(DescriptionError, match=r"channel 1 only.*does not end with a link: name the file \.\.\.-LINK"):
        links_of(path, config, TOLD)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_of_links_whose_names_end_alike_the_longest_is_a_log_s(tmp_path: Path, suffix: str) -> None:
    config = configured(tmp_path, **{"arm": "can0", "left-arm": "can1"})
    for link in ("arm", "left-arm"):
        path = tmp_path / f"s001-r-{link}{suffix}"
        write_can_log(path, frames(link))
        assert links_of(path, config) == {link}
    new = tmp_path / f"left-arm{suffix}"
    write_can_log(new, frames("left-arm"), channel_numbers(config))
    assert links_of(new, config) == {"left-arm"}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("now", [["crane", "boom", "arm"], ["arm", "boom"]])
def test_frames_do_not_come_under_a_link_that_has_the_number_of_another_by_now(
    tmp_path: Path, suffix: str, now: list[str]
) -> None:
    ports = {"boom": "/dev/a", "arm": "/dev/b", "crane": "/dev/c"}
    then = channel_numbers(configured(tmp_path, boom="/dev/a", arm="/dev/b"))
    logs = {link: tmp_path / f"s001-r-{link}{suffix}" for link in then}
    for link, path in logs.items():
        write_can_log(path, frames(link), then)
    config = configured(tmp_path, **{link: ports[link] for link in now})
    assert links_of(logs["boom"], config) == {"boom"}, "which has channel 1, and goes by its name"
    said = "has frames of link 'boom' according to the channel number.*of 'arm' according to the file's name: "
    said += ".* with --session"
    with pytest.raises(DescriptionError, match=said):
        links_of(logs["arm"], config)
    told = TOLD.model_copy(update={"can_channels": then})
    assert links_of(logs["arm"], config, told) == {"arm"}


@pytest.mark.parametrize("can_format", ["log", "asc", "blf"])
def test_the_exported_log_of_a_link_without_captures_is_taken_with_its_session_file(
    tmp_path: Path, can_format: CanFormat
) -> None:
    config = configured(tmp_path, boom="can0", arm="can1")
    rest = exported(tmp_path, config, can_format, ["boom"])
    silent = tmp_path / "out" / f"s001-r-arm.{can_format}"
    write_can_log(silent, [], {"boom": 1, "arm": 2})
    told = read_session_file(tmp_path / "out" / "s001-r.json")
    assert list(first_captures([silent, rest["boom"]], config, told)) == [rest["boom"]]
    other = tmp_path / f"other.{can_format}"
    other.write_bytes(silent.read_bytes())
    for files, known, said in (
        ([silent], told, "no file contains captures"),
        ([silent, rest["boom"]], None, "contains no captures: leave it out"),
        ([other, rest["boom"]], told, "contains no captures: leave it out"),
    ):
        with pytest.raises(DescriptionError, match=said):
            first_captures(files, config, known)


def test_a_log_that_has_lost_its_captures_is_no_silent_link_s(tmp_path: Path) -> None:
    config = configured(tmp_path, boom="can0", arm="can1")
    doubtful = {"arm": DoubtfulCaptures(captures=3, runs=((0, 1),))}
    told = TOLD.model_copy(update={"can_channels": {"boom": 1, "arm": 2}, "doubtful": doubtful})
    path = tmp_path / "s001-r-arm.log"
    write_can_log(path, [])
    with pytest.raises(DescriptionError, match="contains no captures"):
        first_captures([path], config, told)


def test_the_log_of_one_link_does_not_become_another_s_that_alone_is_configured(tmp_path: Path) -> None:
    path = tmp_path / "s001-r-boom.asc"
    write_can_log(path, frames("boom"), {"boom": 1})
    told = TOLD.model_copy(update={"can_channels": {"boom": 1, "arm": 2}})
    with pytest.raises(ConfigError, match="link 'can0' is not configured"):
        links_of(path, configured(tmp_path, arm="can1"), told)
    assert links_of(path, configured(tmp_path, main="can1"), told) == {"main"}, "a link may have another name by now"


def test_links_that_are_configured_no_more_have_numbers_of_their_own(tmp_path: Path) -> None:
    config = configured(tmp_path, boom="can1", serial="/dev/ttyACM0")
    assert channel_numbers(config, ["old", "boom", "can7"]) == {"boom": 2, "serial": 1, "old": 3, "can7": 8}


@pytest.mark.parametrize("suffix", FORMATS)
def test_frames_of_a_log_have_the_channel_number_that_their_link_is_given(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_can_log(path, [replace(frames("arm")[0], link="arm")], {"boom": 1, "arm": 3})
    assert [capture.link for capture in read_can_log(path)] == ["arm" if suffix == ".log" else "can2"]
