"""Which logs `rigcal replay` takes: nothing is stored under a wrong link's name, and nothing twice."""

from __future__ import annotations

import shutil
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from daemon.cli.main import main
from daemon.composition import live
from daemon.config.config import read_config
from daemon.rig_files import load_rig
from daemon.store.reader import Reader
from drivers.errors import DescriptionError
from drivers.logs.can_log import FORMATS, read_can_log, write_can_log
from drivers.readings import CanCapture, LinkItem
from tests.golden.regenerate import CONFIG, SIMULATED

STANDING = SIMULATED / "standing"
FRAMES = list(read_can_log(STANDING / "boom.log", "can0"))[:60]
SECOND_BUS = '\n[[can]]\nname = "feed"\nchannel = "can1"\n'


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "rigcal.toml"
    path.write_text(CONFIG.format(profile="passive", options=""), encoding="utf-8")
    return path


def log(path: Path, *channels: str, frames: list[CanCapture] = FRAMES) -> Path:
    """A log whose frames are of these channels in turn."""
    write_can_log(path, (replace(c, link=channels[n % len(channels)]) for n, c in enumerate(frames)))
    return path


def replay(config: Path, *logs: Path) -> Result:
    arguments = ["replay", *logs, "--config", config, "--store", config.with_name("new.sqlite")]
    return CliRunner().invoke(main, [*map(str, arguments)])


def refusal(config: Path, *logs: Path) -> str:
    """What is said of logs that are refused before anything is stored."""
    result = replay(config, *logs)
    assert result.exit_code == 2, result.output
    assert not config.with_name("new.sqlite").exists()
    return " ".join(result.output.split())


def stored_links(config: Path) -> list[str]:
    with Reader(config.with_name("new.sqlite")) as reader:
        return [capture.link for capture in reader.captures()]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("channels", [("can0", "can1"), ("can1", "can0")])
def test_a_log_of_two_buses_is_refused_where_one_is_configured(
    tmp_path: Path, config: Path, suffix: str, channels: tuple[str, str]
) -> None:
    path = log(tmp_path / f"mixed{suffix}", *channels)
    known = "can0, boom" if suffix == ".log" else "can0"
    assert (
        f"{path}: contains frames of several channels, can0, can1, and more than one would become link 'boom': "
        f"configure each as a [[can]] (known: {known}), or give a log of only the link's channel"
    ) in refusal(config, path)


def test_a_log_of_two_buses_of_which_the_configuration_knows_none_is_refused(tmp_path: Path, config: Path) -> None:
    assert "channels, vcan3, vcan4," in refusal(config, log(tmp_path / "mixed.log", "vcan3", "vcan4"))


def test_a_name_and_a_channel_of_one_link_in_a_log_are_two_buses(tmp_path: Path, config: Path) -> None:
    assert "channels, boom, can0," in refusal(config, log(tmp_path / "mixed.log", "boom", "can0"))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_log_of_two_buses_gives_each_link_its_own(tmp_path: Path, config: Path, suffix: str) -> None:
    config.write_text(config.read_text(encoding="utf-8") + SECOND_BUS, encoding="utf-8")
    result = replay(config, log(tmp_path / f"mixed{suffix}", "can0", "can1"))
    assert result.exit_code == 0, result.output
    assert sorted(stored_links(config)) == ["boom"] * 30 + ["feed"] * 30


@pytest.mark.parametrize("channel", ["boom", "can0", "vcan7"])
def test_a_log_of_one_bus_is_the_one_link_s_whatever_its_channel_is_called(
    tmp_path: Path, config: Path, channel: str
) -> None:
    result = replay(config, log(tmp_path / "alone.log", channel))
    assert result.exit_code == 0, result.output
    assert stored_links(config) == ["boom"] * 60


def test_a_log_that_is_given_twice_is_refused(tmp_path: Path, config: Path) -> None:
    path = log(tmp_path / "boom.log", "boom")
    assert f"{path}: is given twice, so its captures would be stored twice" in refusal(config, path, path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_copy_of_a_log_is_refused_beside_it_in_whatever_format(tmp_path: Path, config: Path, suffix: str) -> None:
    first, copy = log(tmp_path / "first.log", "boom"), log(tmp_path / f"copy{suffix}", "can0")
    text = refusal(config, first, copy)
    assert f"{copy}: contains captures of link 'boom' from 2023-11-14 22:13:20 UTC to" in text
    assert f"and so does {first}: they would be stored twice; give one of the two" in text


def test_logs_of_a_link_that_overlap_are_refused_in_either_order(tmp_path: Path, config: Path) -> None:
    before = log(tmp_path / "before.log", "boom", frames=FRAMES[:40])
    after = log(tmp_path / "after.log", "boom", frames=FRAMES[30:])
    for files in ((before, after), (after, before)):
        assert "they would be stored twice" in refusal(config, *files)
    serial = tmp_path / "copy.serial"
    shutil.copy(STANDING / "station.serial", serial)
    assert "captures of link 'station' from" in refusal(config, STANDING / "station.serial", serial)


def test_a_single_frame_is_not_stored_twice_either(tmp_path: Path, config: Path) -> None:
    files = [log(tmp_path / f"{name}.log", "boom", frames=FRAMES[:1]) for name in "ab"]
    assert "they would be stored twice" in refusal(config, *files)


def test_logs_of_a_link_that_follow_one_another_are_one(tmp_path: Path, config: Path) -> None:
    before = log(tmp_path / "before.log", "boom", frames=FRAMES[:30])
    meeting = [replace(FRAMES[30], stamp=FRAMES[29].stamp), *FRAMES[31:]]  # parts may meet at one instant
    result = replay(config, log(tmp_path / "after.log", "boom", frames=meeting), before)
    assert result.exit_code == 0, result.output
    assert len(stored_links(config)) == 60


def test_a_log_that_is_played_back_is_one_bus_s(tmp_path: Path, config: Path) -> None:
    path = log(tmp_path / "boom.log", "vcan7")
    text = config.read_text(encoding="utf-8").replace('channel = "can0"', f'channel = "{path}"\ninterface = "playback"')
    config.write_text(text + SECOND_BUS, encoding="utf-8")
    settings = read_config(config)
    played = next(link for link in live(settings, load_rig(settings.rig)).links if link.name == "boom")
    items: list[LinkItem] = []
    stop = threading.Event()

    def take(item: LinkItem) -> None:
        items.append(item)
        if len(items) == len(FRAMES):
            stop.set()

    played.run(take, stop)
    assert {item.link for item in items} == {"boom"}
    log(path, "boom", "feed")
    with pytest.raises(DescriptionError, match="several channels, boom, feed, and more than one would become"):
        live(settings, load_rig(settings.rig))
