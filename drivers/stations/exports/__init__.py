"""The registry of export formats of instruments and their programs: the `FORMAT` of every file in this directory."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from drivers.stations.export_format import ExportFormat, refuse


@cache
def export_formats() -> dict[str, ExportFormat]:
    """Return the formats by name, in the order in which they are tried."""
    modules = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    found: dict[str, ExportFormat] = {}
    for known in sorted((module.FORMAT for module in modules), key=lambda known: int(known.rank)):
        assert known.name not in found, f"two formats are called {known.name}"
        found[known.name] = known
    return found


def format_of(text: str, source: str) -> ExportFormat:
    """Return the format of a text.

    Raises:
        DescriptionError: no format recognises the text.
    """
    for known in export_formats().values():
        if known.recognises(text):
            return known
    refuse(source, f"unknown format; known: {', '.join(known.title for known in export_formats().values())}")
