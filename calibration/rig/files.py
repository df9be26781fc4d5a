"""Paths of rig files: shipped rigs by name, other files by path."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from calibration.errors import RigError

_ENDING = ".toml"


def shipped_rigs() -> tuple[str, ...]:
    """Return the names of the shipped rigs."""
    return tuple(sorted(f.name.removesuffix(_ENDING) for f in _directory().iterdir() if f.name.endswith(_ENDING)))


def rig_path(name_or_path: str) -> Path:
    """Return the path of a rig's file.

    Args:
        name_or_path: name of a shipped rig, or path of a file.

    Raises:
        RigError: there is no such rig or file.
    """
    shipped = shipped_rigs()
    if name_or_path in shipped:
        return _directory() / f"{name_or_path}{_ENDING}"
    path = Path(name_or_path)
    if path.is_file():
        return path
    names = ", ".join(shipped)
    if "/" in name_or_path or name_or_path.endswith(_ENDING):
        raise RigError(name_or_path, "", f"there is no such file; give another path, or a shipped rig ({names})")
    raise RigError(
        name_or_path, "", f"neither a shipped rig ({names}) nor a rig file; give one of these names or a path"
    )


def _directory() -> Path:
    return Path(str(resources.files("calibration").joinpath("rigs")))
