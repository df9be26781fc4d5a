"""Logs that are not of their session's time are refused with both times; how many observations are usable is told."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from daemon.cli.main import main
from daemon.sessions.export.session_file import SessionFile
from drivers.clock import NS_PER_S
from drivers.logs.can_log import read_can_log, write_can_log
from tests.golden.regenerate import CONFIG, SIMULATED

STANDING = SIMULATED / "standing"
FRAMES = list(read_can_log(STANDING / "boom.log", "boom"))
FIRST_NS, LAST_NS = FRAMES[0].stamp.utc_ns, FRAMES[-1].stamp.utc_ns

Zone = Callable[[str], None]


@pytest.fixture
def local(monkeypatch: pytest.MonkeyPatch) -> Iterator[Zone]:
    """Changes the computer's time zone."""

    def change(zone: str) -> None:
        monkeypatch.setenv("TZ", zone)
        time.tzset()

    yield change
    monkeypatch.undo()
    time.tzset()


def beside_the_station(log: Path) -> Path:
    """Put the log of the station where that of the bus will be."""
    shutil.copy(STANDING / "station.serial", log.with_name("station.serial"))
    return log


def replayed(
    directory: Path, log: Path, away_utc_ns: tuple[tuple[int, int], ...] | None = (), **changes: int
) -> Result:
    """What a replay of a log and the station's says, with the session of their time."""
    config, told = directory / "rigcal.toml", directory / "told.json"
    config.write_text(CONFIG.format(profile="passive", options=""), encoding="utf-8")
    since_ns, until_ns = changes.get("since_ns", FIRST_NS + NS_PER_S), changes.get("until_ns", LAST_NS)
    session = SessionFile(
        prism="r",
        kind="static_poses",
        since_utc_ns=since_ns,
        until_utc_ns=until_ns,
        control_points={},
        away_utc_ns=away_utc_ns,
    )
    told.write_text(session.model_dump_json(exclude_defaults=True), encoding="utf-8")
    arguments = ["replay", log, log.with_name("station.serial"), "--session", told, "--config", config]
    return CliRunner().invoke(main, [*map(str, arguments), "--store", str(directory / "new.sqlite")])


def test_an_asc_of_another_time_zone_is_refused_with_both_times_and_what_to_do(tmp_path: Path, local: Zone) -> None:
    local("Europe/Berlin")
    log = tmp_path / "s001-r-boom.asc"
    write_can_log(beside_the_station(log), FRAMES)
    assert replayed(tmp_path, log).exit_code == 0
    (tmp_path / "new.sqlite").unlink()
    local("UTC")
    result = replayed(tmp_path, log)
    assert result.exit_code == 2
    said = " ".join(result.output.split())
    assert re.search(
        r"boom.asc: contains captures of link 'boom' from 2023-11-14 23:13:20 UTC to 2023-11-14 23:13:\d\d UTC, but "
        r"the session lasted from 2023-11-14 22:13:21 UTC to 2023-11-14 22:13:\d\d UTC: an .asc contains local time "
        r"without a time zone: set the environment variable TZ .* or export the session with --format candump",
        said,
    )
    assert not (tmp_path / "new.sqlite").exists()


@pytest.mark.parametrize(
    ("zone", "utc", "fixed"),
    [
        ("Europe/Berlin", "2026-10-25T01:10:00Z", "UTC-1"),
        ("America/St_Johns", "2026-11-01T05:10:00Z", "UTC+3:30"),
        ("Australia/Lord_Howe", "2026-04-04T15:10:00Z", "UTC-10:30"),
    ],
)
def test_an_asc_of_the_second_hour_of_two_is_refused_with_a_zone_in_which_it_is_taken(
    tmp_path: Path, local: Zone, zone: str, utc: str, fixed: str
) -> None:
    local(zone)
    later_ns = round(datetime.fromisoformat(utc).timestamp()) * NS_PER_S - FIRST_NS
    path = tmp_path / "s001-r-boom.asc"
    write_can_log(path, [replace(frame, stamp=frame.stamp.shifted(later_ns)) for frame in FRAMES])
    text = (STANDING / "station.serial").read_text(encoding="utf-8")
    path.with_name("station.serial").write_text(
        re.sub(r"^(\d{10})(?=\.)", lambda found: str(int(found[1]) + later_ns // NS_PER_S), text, flags=re.MULTILINE),
        encoding="utf-8",
    )
    changes = {"since_ns": FIRST_NS + NS_PER_S + later_ns, "until_ns": LAST_NS + later_ns}
    result = replayed(tmp_path, path, **changes)
    assert result.exit_code == 2
    said = " ".join(result.output.split())
    assert f"set the environment variable TZ to {fixed}, with which" in said
    assert said.endswith("or export the session with --format candump")
    local(fixed)
    assert replayed(tmp_path, path, **changes).exit_code == 0


def test_logs_of_another_session_are_refused(tmp_path: Path) -> None:
    day_ns = 86_400 * NS_PER_S
    result = replayed(tmp_path, STANDING / "boom.log", since_ns=FIRST_NS + day_ns, until_ns=LAST_NS + day_ns)
    assert result.exit_code == 2
    said = " ".join(result.output.split())
    assert "but the session lasted from 2023-11-15 22:13:20 UTC" in said
    assert said.endswith("give the files that were exported with the session")


def test_a_replay_tells_how_many_observations_can_be_used_and_why_others_cannot(tmp_path: Path) -> None:
    result = replayed(tmp_path, SIMULATED / "moving" / "boom.log", until_ns=LAST_NS + 60 * NS_PER_S)
    assert result.exit_code == 0, result.output
    number = {what: int(n) for n, what in re.findall(r"^ *(\d+) (.+)$", result.output, re.MULTILINE)}
    unusable = sum(n for what, n in number.items() if what.startswith("cannot be used: "))
    assert 0 < number["of these observations can be used"] < number["observations"]
    assert number["of these observations can be used"] + unusable == number["observations"]


def test_a_replay_with_a_session_file_of_an_earlier_version_tells_once_that_it_may_use_another_prism_s_fixes(
    tmp_path: Path,
) -> None:
    log = STANDING / "boom.log"
    assert replayed(tmp_path, log).stderr == ""
    (tmp_path / "new.sqlite").unlink()
    result = replayed(tmp_path, log, away_utc_ns=None)
    assert result.exit_code == 0
    assert "away_utc_ns" not in (tmp_path / "told.json").read_text(encoding="utf-8")
    assert result.stderr.count("fixes of another prism from those times may be used; export the session again") == 1
