"""The rig that a simulation is of, by name or path."""

from __future__ import annotations

from pathlib import Path

from calibration.errors import RigError
from calibration.rig import Rig, parse_rig, shipped_rig, shipped_rigs


def load_rig(name_or_path: str) -> Rig:
    """A shipped rig by its name, or any rig by the path of its file; RigError if there is none."""
    if name_or_path in shipped_rigs():
        return shipped_rig(name_or_path)
    try:
        return parse_rig(Path(name_or_path).read_text(encoding="utf-8"), name_or_path)
    except (OSError, UnicodeDecodeError) as error:
        shipped = ", ".join(shipped_rigs())
        raise RigError(name_or_path, "", f"no shipped rig ({shipped}) and not to be read as a file: {error}") from error
