"""CAN logs of channel numbers: each link has its own, in an export and back in a replay, and none is guessed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.config.config import Config, ConfigError, read_config
from daemon.sessions.export.captured_logs import export_session
from daemon.sessions.export.session_file import SessionFile, read_session_file
from daemon.sessions.replay import captures_of, first_captures
from daemon.sessions.vector_channels import SUFFIXES, channel_numbers
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.logs.can_log import FORMATS, read_can_log, write_can_log
from drivers.readings import CanCapture
from tests.daemon.session_support import Rig

BEGIN = Stamp(1_795_800_000_000_000_000, 5_000_000_000, "b")
TOLD = SessionFile(prism="r", kind="check", since_utc_ns=0, until_utc_ns=1, control_points={})


def configured(directory: Path, **channels: str) -> Config:
    """A configuration of these CAN links, name=channel."""
    links = "".join(f'\n[[can]]\nname = "{name}"\nchannel = "{channel}"\n' for name, channel in channels.items())
    (directory / "rigcal.toml").write_text(f'rig = "swdt82"\nstate_directory = "."\n{links}', encoding="utf-8")
    return read_config(directory / "rigcal.toml")


def frames(link: str) -> list[CanCapture]:
    return [CanCapture(link, BEGIN.shifted(n * 100_000_000), 0x1A0, bytes(range(4))) for n in range(1, 6)]


def links_of(path: Path, config: Config, told: SessionFile | None = None) -> set[str]:
    return {capture.link for capture in captures_of(path, config, told)}


def exported(directory: Path, config: Config, can_format: str, links: Sequence[str]) -> dict[str, Path]:
    """Link -> its log of a session in which all links had frames."""
    rig = Rig(config.store_path)
    rig.clock.set(BEGIN)
    rig.store.begin_run(rig.clock.now())
    rig.say("setup_new", id="S1")
    rig.say("start", prism="r", id="s001-r")
    for link in links:
        rig.store.append_captures(frames(link))
    rig.clock.advance(2.0)
    rig.say("stop")
    rig.store.close()
    export_session(config, "s001-r", directory / "out", can_format)  # type: ignore[arg-type]
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
    tmp_path: Path, can_format: str, channels: dict[str, str]
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
@pytest.mark.parametrize(("stem", "why"), [("recorded", "no link"), ("s1-left-arm", "several links")])
def test_a_log_of_channel_1_that_may_be_any_link_s_is_refused(tmp_path: Path, suffix: str, stem: str, why: str) -> None:
    path = tmp_path / f"{stem}{suffix}"
    write_can_log(path, frames("boom"))
    config = configured(tmp_path, **{"arm": "can0", "left-arm": "can1"})
    with pytest.raises(DescriptionError, match=rf"channel 1 alone.*in that of {why}: name the file \.\.\.-LINK"):
        links_of(path, config, TOLD)


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
