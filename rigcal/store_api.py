"""A daemon's store, read-only: sessions and observations as data frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from calibration.errors import DataError
from calibration.observations import Observations
from calibration.rig.description import Rig, parse_rig
from daemon.sessions.session_data import require_used, sessions_csv
from daemon.store.queries.observations import OBSERVATION_COLUMNS, all_observations
from daemon.store.queries.sessions import SESSION_COLUMNS, all_sessions, session
from daemon.store.reader import Reader

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

FrameLibrary = Literal["pandas", "polars"]


def open_store(path: str | Path, frames: FrameLibrary = "pandas") -> Store:
    """Open a store for reading, also while the daemon writes to it.

    Args:
        path: the daemon's `rigcal.sqlite`.
        frames: library of the data frames that the store returns; it must be installed.

    Raises:
        StoreError: there is no store, or it cannot be read.
        ValueError: `frames` is neither `pandas` nor `polars`.
    """
    if frames not in ("pandas", "polars"):
        raise ValueError(f"frames: {frames!r} is unknown; give one of pandas, polars")
    return Store(Reader(Path(path)), frames)


class Store:
    """A read-only store and context manager; only the thread that opened it may use it.

    Args:
        reader: the connection.
        frames: library of the data frames that the store returns.
    """

    def __init__(self, reader: Reader, frames: FrameLibrary) -> None:
        self._reader, self._frames = reader, frames

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._reader.close()

    def sessions(self) -> pd.DataFrame | pl.DataFrame:
        """Return every calibration session, oldest first.

        Returns:
            One row per session: `id`, `rig`, `setup_id`, `prism`, `kind` (`check` for one that is never used for
            training), `state` (`open`, `closed` or `aborted`), `operator`, `note`, `started_utc_ns`, `ended_utc_ns`
            (None while it is open), and `not_used` (the reason why calibration does not use the session; None, in
            pandas perhaps NaN, if it does).
        """
        return self._frame(all_sessions(self._reader), SESSION_COLUMNS)

    def observations(self, sessions: Sequence[str] = ()) -> pd.DataFrame | pl.DataFrame:
        """Return the observations of sessions, oldest first, including those that calibration must not use.

        Args:
            sessions: ids; all by default.

        Returns:
            One row per fix: `session_id`, `setup_id`, `prism`, `pose`, `utc_ns`, `x_mm`, `y_mm`, `z_mm` in the
            station's frame, `sigma_x_mm` and so on, `dwell_s`, `excluded` (the reason why calibration must not use the
            fix, else None), and the joints and signals under their column names (`theta1_deg`, `L2_mm`, ...).

        Raises:
            DataError: there is no such session.
        """
        self._require(sessions)
        return self._frame(all_observations(self._reader, sessions), OBSERVATION_COLUMNS)

    def training_data(self, sessions: Sequence[str]) -> tuple[Rig, Observations]:
        """Return the rig of sessions and the observations that calibration may use, as the daemon's jobs do.

        Args:
            sessions: ids of sessions of one rig whose `not_used` is None, or only that the rig file has changed since.
                The returned rig is that of the newest session.

        Raises:
            DataError: there is no such session; a session is open, was aborted, or is not used for a reason and was not
                accepted by an operator (`rigcal session accept`); no observation may be used; or the rig files of the
                sessions differ in the meaning of readings.
        """
        found = self._require(sessions)
        if not found:
            raise DataError(str(self._reader.path), "no session given; give at least one")
        require_used(self._reader, sessions)
        ages = [row["id"] for row in all_sessions(self._reader)]
        newest = max(found, key=lambda row: ages.index(row["id"]))
        rig = parse_rig(str(newest["rig_text"]), f"the rig of session {newest['id']}")
        return rig, Observations.from_csv(sessions_csv(self._reader, rig, sessions).decode(), rig)

    def _require(self, sessions: Sequence[str]) -> list[dict[str, Any]]:
        """Return the rows of sessions; raise DataError for an unknown id."""
        if isinstance(sessions, str):
            raise DataError(str(self._reader.path), f"sessions is a string; give a list: [{sessions!r}]")
        rows = []
        for name in sessions:
            row = session(self._reader, name)
            if row is None:
                raise DataError(str(self._reader.path), f"there is no session {name!r}")
            rows.append(row)
        return rows

    def _frame(self, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> pd.DataFrame | pl.DataFrame:
        """Return a frame of rows; one without rows has the given columns."""
        table = [dict(row) for row in rows]
        names = None if table else list(columns)
        if self._frames == "polars":
            import polars as pl

            return pl.DataFrame(table, schema=names, infer_schema_length=None)
        import pandas as pd

        return pd.DataFrame(table, columns=names)
