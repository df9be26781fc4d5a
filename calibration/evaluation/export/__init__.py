"""Export formats, one a file: every module of this folder with a `FORMAT` is found by its being here."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping

from calibration.errors import DataError
from calibration.evaluation.exports import Export, Format


def formats() -> Mapping[str, Format]:
    """Return the formats by the names of their modules, in alphabetical order."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    return {name: importlib.import_module(f"{__name__}.{name}").FORMAT for name in names}


def export_files(export: Export, name: str | None = None) -> dict[str, bytes]:
    """Make the files of an export.

    Args:
        export: the model and what is asked.
        name: one format; all of them by default.

    Returns:
        File name -> content.

    Raises:
        DataError: an unknown format; a prism that the rig lacks, too few poses, or a joint trained beyond its limits.
    """
    found = formats()
    if name is not None and name not in found:
        raise DataError("format", f"{name!r} is unknown; there are {', '.join(found)}")
    chosen = found.values() if name is None else [found[name]]
    return {made.file: made.content(export) for made in chosen}
