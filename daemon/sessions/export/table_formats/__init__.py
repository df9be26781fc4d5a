"""Table formats of exported sessions, one per file: every module in this folder defines a `FORMAT` and is found."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping

from daemon.sessions.export.table_format import TableFormat


def table_formats() -> Mapping[str, TableFormat]:
    """Return the formats by their names, in alphabetical order."""
    modules = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    return {form.name: form for form in sorted((module.FORMAT for module in modules), key=lambda form: str(form.name))}
