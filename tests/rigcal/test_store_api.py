"""A store that a daemon has written, read as data frames and as training data."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pandas as pd
import polars as pl
import pytest

import rigcal
from tests.daemon.support.sessions import Rig, controlled


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


def test_a_session_is_training_data(written: tuple[Path, str]) -> None:
    path, session = written
    with rigcal.open_store(path) as store:
        rig, observations = store.training_data([session])
        used = store.observations([session])
        with pytest.raises(rigcal.DataError, match="no session 's9'"):
            store.training_data(["s9"])
    assert rig.name == "swdt82"
    assert len(observations) == int(used["excluded"].isna().sum())


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
