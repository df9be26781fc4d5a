"""Loads rigs for the daemon and the commands: shipped rigs by name, any rig by the path of its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from calibration.errors import RigError
from calibration.rig.description import Rig, parse_rig
from calibration.rig.files import rig_path
from calibration.rig.toml import LONGEST
from drivers.files import read_text


@dataclass(frozen=True)
class RigSource:
    """A rig and its origin.

    Attributes:
        rig: the description.
        text: the TOML text it was read from, which is stored with each model.
        directory: directory of the DBC and EDS files that the rig file names.
    """

    rig: Rig
    text: str
    directory: Path


def load_rig(name_or_path: str, signals: Sequence[str] = (), *, named_in: Path | None = None) -> RigSource:
    """Load a shipped rig by name, or any rig by the path of its file.

    Args:
        name_or_path: name of a shipped rig, or path of a rig file.
        signals: columns of additional signals, as for `Rig.with_signals`.
        named_in: configuration file whose key `rig` names the rig, for error messages.

    Raises:
        RigError: the rig or its file does not exist, or the file is malformed.
    """
    try:
        text, name, directory = read_rig_text(name_or_path)
    except RigError as error:
        if named_in is None:
            raise
        raise RigError(str(named_in), "rig", str(error)) from error
    rig = parse_rig(text, name)
    if signals:
        rig = rig.with_signals(*signals)
    return RigSource(rig, rig.text, directory)


def read_rig_text(name_or_path: str) -> tuple[str, str, Path]:
    """Read the text of a rig file without checking it; return the text, the file's name and its directory.

    Raises:
        RigError: the rig or its file does not exist or cannot be read.
    """
    path = rig_path(name_or_path)
    try:
        return read_text(path, LONGEST), path.name, path.parent
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise RigError(str(path), "", f"cannot be read: {reason}") from error


def misreading(rig: Rig, recorded_text: str | None, prism: str) -> str:
    """Return why readings decoded with a different rig file cannot be used with `rig`, as a clause; "" if they can.

    Args:
        rig: the rig that the readings are to be used with.
        recorded_text: rig file with which the readings were decoded; None if the store lacks it.
        prism: name of the prism that was measured.
    """
    if recorded_text == rig.text:
        return ""
    if recorded_text is None:
        return "it is not in the store"
    recorded = _recorded(recorded_text)
    if isinstance(recorded, str):
        return f"this rigcal cannot read it ({recorded})"
    if prism not in rig.prism_names:
        return f"it has a prism {prism}, this one has none"
    return rig.misreading(recorded)


def tells_decoding(rig: Rig, recorded_text: str) -> bool:
    """Return True if a recorded rig file includes the decoding of each channel that `rig` takes from DBC or EDS files.

    Args:
        rig: the rig that the readings are to be used with.
        recorded_text: a rig file for which `misreading` returned "".
    """
    recorded = _recorded(recorded_text)
    return isinstance(recorded, Rig) and rig.decoding.keys() <= recorded.decoding.keys()


@lru_cache(maxsize=16)
def _recorded(text: str) -> Rig | str:
    """Return the rig in a text, or the parse error. Cached: parsing takes 10 ms, and many sessions share one text."""
    try:
        return parse_rig(text, "the rig file")
    except RigError as error:
        return str(error)
