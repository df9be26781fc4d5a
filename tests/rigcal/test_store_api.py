"""A store that a daemon has written, read as data frames and as training data."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pandas as pd
import polars as pl
import pytest

import rigcal
from daemon.cli.lines.state import show_session
from daemon.commands import HOW_TO_READ_AGAIN, OTHER_RIG_FILE
from daemon.store.queries.sessions import SessionTable, sessions_of_use
from daemon.store.reader import Reader
from tests.daemon.support.sessions import SOURCE, Rig, controlled


@pytest.fixture
def written(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    rig = Rig(tmp_path / "rigcal.sqlite")
    rig.say("setup_new", id="S1", instrument="GTS-905A")
    yield tmp_path / "rigcal.sqlite", controlled(rig)
    rig.store.close()


@pytest.mark.parametrize(("library", "frame"), [("pandas", pd.DataFrame), ("polars", pl.DataFrame)])
def test_sessions_and_observations_are_frames(
    written: tuple[Path, str], library: Literal["pandas", "polars"], frame: type
) -> None:
    path, session = written
    with rigcal.open_store(path, library) as store:
        sessions, rows = store.sessions(), store.observations([session])
        everything = store.observations()
    assert isinstance(sessions, frame)
    assert isinstance(rows, frame)
    assert list(sessions["id"]) == [session]
    assert list(sessions["state"]) == ["closed"]
    assert len(rows) > 0
    assert {"prism", "x_mm", "theta1_deg", "excluded"} <= set(rows.columns)
    assert len(everything) == len(rows)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frames_of_a_store_without_sessions_have_their_columns(
    written: tuple[Path, str], tmp_path: Path, library: Literal["pandas", "polars"]
) -> None:
    path, _ = written
    new = Rig(tmp_path / "new.sqlite")
    new.store.close()
    with rigcal.open_store(tmp_path / "new.sqlite", library) as store:
        sessions, rows = store.sessions(), store.observations()
    assert (len(sessions), len(rows)) == (0, 0)
    assert list(sessions["id"]) == list(rows["excluded"]) == []
    with rigcal.open_store(path, library) as store:
        assert list(sessions.columns) == list(store.sessions().columns)
        assert set(rows.columns) <= set(store.observations().columns)


def test_a_session_is_training_data(written: tuple[Path, str]) -> None:
    path, session = written
    with rigcal.open_store(path) as store:
        rig, observations = store.training_data([session])
        used = store.observations([session])
        with pytest.raises(rigcal.DataError, match="no session 's9'"):
            store.training_data(["s9"])
    assert rig.name == "swdt82"
    assert len(observations) == int(used["excluded"].isna().sum())


OTHER_FILE = f"{OTHER_RIG_FILE}it has no joint L2"
AND_MOVED = f"{OTHER_FILE}; no control point was shot"


@pytest.fixture(scope="module")
def every_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A store with a session in every state, s006-r and s007-r of a different rig file, s008-r open."""
    rig = Rig(tmp_path_factory.mktemp("store") / "rigcal.sqlite")
    rig.say("setup_new", id="S1", instrument="GTS-905A")
    controlled(rig)
    controlled(rig, kind="check")
    for end in ("stop", "abort", "stop", "stop", "stop", None):
        rig.say("start", prism="r", kind="static_poses")
        rig.live(1.0)
        if end is not None:
            rig.say(end)
    rig.say("accept", id="s005-r", operator="Ada")
    SessionTable(rig.store, SOURCE.rig.name).change("s006-r", excluded=OTHER_FILE)
    SessionTable(rig.store, SOURCE.rig.name).change("s007-r", excluded=AND_MOVED)
    yield rig
    rig.store.close()


@pytest.mark.parametrize(
    ("session", "why"),
    [
        ("s003-r", "session s003-r: calibration does not use this session: no control point was shot"),
        ("s003-r", "to use it anyway: `rigcal session accept s003-r`"),
        ("s004-r", "session s004-r: it was aborted, and calibration does not use aborted sessions; leave it out"),
        ("s007-r", f"session s007-r: {AND_MOVED}; {HOW_TO_READ_AGAIN}"),
        ("s008-r", "session s008-r: it is still open; stop it first: `rigcal session stop`"),
    ],
)
def test_a_session_that_the_jobs_do_not_use_is_refused_as_training_data(
    every_state: Rig, session: str, why: str
) -> None:
    with rigcal.open_store(every_state.store.path) as store:
        for sessions in ([session], ["s001-r", session]):
            with pytest.raises(rigcal.DataError, match=re.escape(why)):
                store.training_data(sessions)
        assert len(store.observations([session])) > 0


def test_the_reason_why_a_session_is_refused_is_the_sentence_of_session_show(
    every_state: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    show_session(every_state.say("show", id="s003-r"))
    with rigcal.open_store(every_state.store.path) as store, pytest.raises(rigcal.DataError) as refused:
        store.training_data(["s003-r"])
    assert refused.value.reason in capsys.readouterr().out


@pytest.mark.parametrize("session", ["s001-r", "s002-r", "s005-r"], ids=["used", "check", "accepted"])
def test_a_session_that_the_jobs_use_is_training_data(every_state: Rig, session: str) -> None:
    with rigcal.open_store(every_state.store.path) as store:
        _, observations = store.training_data([session])
    assert set(observations.session) == {session}


def test_a_session_from_before_a_change_of_the_rig_file_is_training_data_of_its_own_rig(every_state: Rig) -> None:
    with rigcal.open_store(every_state.store.path) as store:
        rig, observations = store.training_data(["s006-r"])
    assert rig.text == SOURCE.text
    assert set(observations.session) == {"s006-r"}


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_sessions_show_which_of_them_calibration_does_not_use(
    every_state: Rig, library: Literal["pandas", "polars"]
) -> None:
    with rigcal.open_store(every_state.store.path, library) as store, Reader(every_state.store.path) as reader:
        sessions = store.sessions()
        training, checks = sessions_of_use(reader)
    rows = zip(sessions["id"], sessions["not_used"], strict=True)
    reasons = {name: None if pd.isna(why) else why for name, why in rows}
    assert [name for name, why in reasons.items() if why is None] == sorted([*training, *checks])
    assert (training, checks) == (["s001-r", "s005-r"], ["s002-r"])
    assert reasons["s003-r"].startswith("no control point was shot")
    assert (reasons["s004-r"], reasons["s006-r"]) == ("it was aborted", OTHER_FILE)
    assert reasons["s008-r"] == "it is still open"


def test_a_session_that_is_not_there_is_no_empty_frame(written: tuple[Path, str]) -> None:
    path, name = written
    with rigcal.open_store(path) as store:
        for sessions, why in ((["s9"], "no session 's9'"), (name, "sessions is a string; give a list")):
            with pytest.raises(rigcal.DataError, match=why):
                store.observations(sessions)


def test_what_is_no_store_or_no_library_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="give one of pandas, polars"):
        rigcal.open_store(tmp_path / "rigcal.sqlite", "dask")  # type: ignore[arg-type]
    with pytest.raises(Exception, match="there is no store"):
        rigcal.open_store(tmp_path / "rigcal.sqlite")
