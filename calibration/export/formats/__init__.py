"""Export formats, one per file: every module in this folder defines a `FORMAT` and is found automatically."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping, Sequence

from calibration.errors import DataError
from calibration.export.model_export import Export, Format


def formats() -> Mapping[str, Format]:
    """Return the formats by their names, in alphabetical order."""
    modules = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    found: dict[str, Format] = {}
    for made in sorted((module.FORMAT for module in modules), key=lambda made: str(made.name)):
        assert made.name not in found, f"two formats are called {made.name}"
        found[made.name] = made
    return found


def chosen_formats(names: Sequence[str] = ()) -> tuple[Format, ...]:
    """Return the formats of these names; without names, the default formats.

    Raises:
        DataError: an unknown format.
    """
    found = formats()
    unknown = next((name for name in names if name not in found), None)
    if unknown is not None:
        raise DataError("format", f"{unknown!r} is unknown; give one of {', '.join(found)}")
    return tuple(made for made in found.values() if (made.name in names if names else made.is_default))


def export_files(export: Export, names: Sequence[str] = ()) -> dict[str, bytes]:
    """Make the files of an export.

    Args:
        export: the model and the options of its export.
        names: names of formats; if empty, the default formats are written.

    Returns:
        File name -> content.

    Raises:
        DataError: an unknown format, a prism that the rig lacks, too few poses, a joint trained only beyond its limits,
            or a library that the format needs and that is not installed.
    """
    return {made.file: made.content(export) for made in chosen_formats(names)}
