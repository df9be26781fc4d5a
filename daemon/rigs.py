"""Rigs by name or path, with what lies beside their files."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from calibration.errors import RigError
from calibration.rig import Rig, parse_rig, shipped_rigs
from calibration.toml import LONGEST
from drivers.files import read_text


@dataclass(frozen=True)
class RigSource:
    """A rig with where it comes from.

    Attributes:
        rig: the description.
        text: the TOML it was read from; travels with the model.
        directory: where the DBC and EDS files that it names are.
    """

    rig: Rig
    text: str
    directory: Path


def load_rig(name_or_path: str) -> RigSource:
    """A shipped rig by its name, or any rig by the path of its file.

    Raises:
        RigError: no such rig or file, or the file is malformed.
    """
    if name_or_path in shipped_rigs():
        directory = Path(str(resources.files("calibration").joinpath("rigs")))
        path = directory / f"{name_or_path}.toml"
    else:
        path = Path(name_or_path)
        directory = path.parent
        if not path.is_file():
            shipped = ", ".join(shipped_rigs())
            raise RigError(name_or_path, "", f"neither a shipped rig ({shipped}) nor a rig file")
    try:
        text = read_text(path, LONGEST)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise RigError(str(path), "", f"cannot be read: {reason}") from error
    return RigSource(parse_rig(text, path.name), text, directory)
