"""Sources of a fleet's rigs: stores of daemons, and directories of observations."""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from calibration.errors import DataError
from calibration.rig.description import parse_rig
from calibration.rig.toml import LONGEST
from daemon.fleet.assess import FleetSettings, RigTask
from daemon.rig_files import load_rig
from daemon.sessions.export.session_file import read_session_file
from daemon.sessions.session_data import sessions_csv
from daemon.store.queries.sessions import session, sessions_of_use
from daemon.store.reader import Reader
from drivers.files import read_text, read_whole

STORE = "rigcal.sqlite"
RIG_FILE = "rig.toml"
_NOTHING = f"contains neither a {STORE} nor CSV files of observations"
_CSV_MAX_BYTES = 128 << 20


@dataclass(frozen=True)
class RigSource:
    """A rig of the fleet; its data are read only when it is assessed.

    Attributes:
        name: unique in the fleet.
        path: a store, or a directory of CSV files.
        rig: rig to use for a directory without a rig file.
    """

    name: str
    path: Path
    rig: str | None

    def task(self, settings: FleetSettings) -> RigTask:
        """Read the rig's data.

        Raises:
            CalibrationError, StoreError: the data cannot be used.
            OSError: the data cannot be read.
        """
        if self.path.is_file():
            return _of_store(self, settings)
        return _of_directory(self, settings)


def find_rigs(directories: Sequence[Path], pattern: str | None, rig: str | None) -> list[RigSource]:
    """Find the rigs of a fleet, in the order of their names.

    Args:
        directories: one for each rig, with a store or with CSV files of observations.
        pattern: glob pattern of the paths of further stores; None for none.
        rig: rig to use for directories without a `rig.toml`.

    Raises:
        DataError: no directory contains data, the pattern matches nothing, or there is no rig at all.
    """
    found: list[tuple[Path, Path]] = []  # the path that names the rig, and the path of its data
    for directory in directories:
        store = directory / STORE
        if store.is_file():
            found.append((directory, store))
        else:
            found.append((directory, directory))
    if directories and pattern is None and not any(_has_data(data) for _, data in found):
        raise DataError(", ".join(map(str, directories)), _NOTHING)
    if pattern is not None:
        stores = sorted(Path(path) for path in glob.glob(pattern, recursive=True) if Path(path).is_file())
        if not stores:
            raise DataError(pattern, "matches no store; quote the pattern, so that the shell does not expand it")
        found += [(store.parent if store.name == STORE else store, store) for store in stores]
    if not found:
        raise DataError("fleet", "no rigs given; name directories of rigs, or stores with --stores")
    return [RigSource(name, path, rig) for name, path in sorted(_named(found))]


def _has_data(path: Path) -> bool:
    return path.is_file() or any(path.glob("*.csv"))


def _named(found: Sequence[tuple[Path, Path]]) -> Iterator[tuple[str, Path]]:
    """Name rigs by their directories, with as many parent directories as make the names unique."""
    parts = [path.resolve().parts for path, _ in found]
    depth = next(
        (n for n in range(1, max(map(len, parts)) + 1) if len({part[-n:] for part in parts}) == len(parts)), None
    )
    if depth is None:
        raise DataError("fleet", "the same rig is given twice; name each rig once")
    for (_, data), part in zip(found, parts, strict=True):
        yield "-".join(part[-depth:]).replace("/", "-"), data


def _of_store(source: RigSource, settings: FleetSettings) -> RigTask:
    with Reader(source.path) as reader:
        training, checks = sessions_of_use(reader)
        if not training:
            raise DataError(str(source.path), "contains no closed session that calibration may use")
        newest = session(reader, training[-1])
        assert newest is not None  # it was just listed
        text = str(newest["rig_text"])
        rig = parse_rig(text, f"the rig of session {training[-1]}")
        data = sessions_csv(reader, rig, training)
        checked = sessions_csv(reader, rig, checks) if checks else None
    return RigTask(source.name, str(source.path), text, data, checked, settings)


def _of_directory(source: RigSource, settings: FleetSettings) -> RigTask:
    if not _has_data(source.path):
        raise DataError(str(source.path), _NOTHING)
    own = source.path / RIG_FILE
    if own.is_file():
        text = read_text(own, LONGEST)
    elif source.rig is not None:
        text = load_rig(source.rig).text
    else:
        raise DataError(str(source.path), f"contains no {RIG_FILE}; name the rig with --rig")
    training: list[Path] = []
    checks: list[Path] = []
    for path in sorted(source.path.glob("*.csv")):
        if b"prism" in _header(path):  # an export also has files of joints and of fixes
            (checks if _is_check(path) else training).append(path)
    if not training:
        raise DataError(
            str(source.path), "contains no CSV file of training observations; such a file has a column prism"
        )
    data, files = _joined(training)
    return RigTask(source.name, str(source.path), text, data, _joined(checks)[0] or None, settings, files)


def _header(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.readline(1 << 20).strip()


def _is_check(path: Path) -> bool:
    """Return True if the session file of an exported session describes a check session."""
    told = path.with_suffix(".json")
    return told.is_file() and read_session_file(told).kind == "check"


def _joined(paths: Sequence[Path]) -> tuple[bytes, tuple[tuple[str, int], ...]]:
    """Join CSV files; return the joined data, and each file's name with the line of its first row in the data."""
    if not paths:
        return b"", ()
    header = _header(paths[0])
    parts, files, line = [header + b"\n"], [], 2
    for path in paths:
        if _header(path) != header:
            reason = f"its columns differ from those of {paths[0].name}; all files of a rig must have the same columns"
            raise DataError(path.name, reason, 1)
        parts.append(_ended(read_whole(path, _CSV_MAX_BYTES).partition(b"\n")[2]))
        files.append((path.name, line))
        line += parts[-1].count(b"\n")
    return b"".join(parts), tuple(files)


def _ended(data: bytes) -> bytes:
    return data if not data or data.endswith(b"\n") else data + b"\n"
