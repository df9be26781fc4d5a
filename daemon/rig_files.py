"""Rigs as the daemon and the commands name them: a shipped one by its name, any by the path of its file."""

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

HOW_TO_READ_AGAIN = "to read its captures with this one, `rigcal session export` it, and `rigcal replay` the files"


@dataclass(frozen=True)
class RigSource:
    """A rig and its origin.

    Attributes:
        rig: the description.
        text: the TOML it was read from; travels with the model.
        directory: where the DBC and EDS files that it names are.
    """

    rig: Rig
    text: str
    directory: Path


def load_rig(name_or_path: str, signals: Sequence[str] = (), *, named_in: Path | None = None) -> RigSource:
    """Load a shipped rig by its name, or any rig by the path of its file.

    Args:
        name_or_path: of the rig.
        signals: columns of further signals, as `Rig.with_signals` takes them.
        named_in: the configuration whose key `rig` names it, for messages.

    Raises:
        RigError: no such rig or file, or the file is malformed.
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
    """Read a rig's text, unchecked; returns it with the file's name and directory.

    Raises:
        RigError: no such rig or file, or it cannot be read.
    """
    path = rig_path(name_or_path)
    try:
        return read_text(path, LONGEST), path.name, path.parent
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise RigError(str(path), "", f"cannot be read: {reason}") from error


def misreading(rig: Rig, recorded_text: str | None, prism: str) -> str:
    """Return why readings that were made with another rig file are not those of `rig`, a clause; "" where they are.

    Args:
        rig: what they are to be used with.
        recorded_text: the rig file that turned counts into the readings; None where the store lacks it.
        prism: on which they were measured.
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
    """Return True if a recorded rig file says how each channel of `rig` that a DBC or EDS file describes was read.

    Args:
        rig: what its readings are to be used with.
        recorded_text: a rig file of which `misreading` says nothing.
    """
    recorded = _recorded(recorded_text)
    return isinstance(recorded, Rig) and rig.decoding.keys() <= recorded.decoding.keys()


@lru_cache(maxsize=16)
def _recorded(text: str) -> Rig | str:
    """Return the rig of a file, or why it is none: it takes some 10 ms, and hundreds of sessions may have the same."""
    try:
        return parse_rig(text, "the rig file")
    except RigError as error:
        return str(error)
