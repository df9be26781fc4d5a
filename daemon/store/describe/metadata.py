"""The store's description as metadata for Datasette."""

from __future__ import annotations

import json
from collections.abc import Iterator

from daemon.store.describe.description import StoreDescription

_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
_TITLE = "rigcal: acquisition and calibration of a drilling boom"
_ABOUT = (
    "Readings, fixes, sessions, observations, jobs and models of a rig. Start with the views (v_...) and the queries."
)


def datasette_metadata(store: StoreDescription, database: str = "rigcal") -> str:
    """Return the `metadata.yaml` of a store.

    Args:
        store: description of the store.
        database: name of the database file without its suffix.
    """
    tables = {
        table.name: {
            "title": table.words.title,
            "description": table.words.description,
            **({"label_column": table.words.label} if table.words.label else {}),
            "columns": {column.name: column.meaning for column in table.columns},
        }
        for table in store.tables
    }
    queries = {
        query.name: {
            "title": query.title,
            "description": query.description,
            **({"params": list(query.parameters)} if query.parameters else {}),
            "sql": query.sql,
        }
        for query in store.queries
    }
    document = {
        "title": _TITLE,
        "description": _ABOUT,
        "databases": {database: {"tables": tables, "queries": queries}},
    }
    return "\n".join(_yaml(document)) + "\n"


def _yaml(value: object, indent: str = "") -> Iterator[str]:
    """Yield the lines of a mapping as YAML: text quoted as in JSON, text of several lines as blocks."""
    assert isinstance(value, dict)
    for name, item in value.items():
        key = json.dumps(name) if name.lower() in _YAML_WORDS else name
        if isinstance(item, dict):
            yield f"{indent}{key}:"
            yield from _yaml(item, indent + "  ")
        elif isinstance(item, str) and "\n" in item:
            yield f"{indent}{key}: |-"
            yield from (f"{indent}  {line}" for line in item.split("\n"))
        else:
            yield f"{indent}{key}: {json.dumps(item, ensure_ascii=False)}"
