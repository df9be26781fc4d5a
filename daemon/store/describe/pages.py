"""The store's description as a page of the documentation, and as metadata for Datasette."""

from __future__ import annotations

import json
from collections.abc import Iterator

from calibration.rig.reference import table
from daemon.store.describe.description import StoreDescription, TableDescription

_HEAD = """# The store's tables

Every view, table and column of `rigcal.sqlite`. Read views first: they have ISO times, joints as columns, and units in
their names. The views here are those of the rig `swdt82`; with another rig its own joints and signals are columns.
[The store](../how-to/store.md#reading-it-with-other-tools) says how to open a store with other tools.

This page is made from the code: `python -m daemon.store.describe schema > docs/reference/schema.md`.
"""
_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
_TITLE = "rigcal: acquisition and calibration of a drilling boom"
_ABOUT = (
    "Readings, fixes, sessions, observations, jobs and models of a rig. Begin with the views (v_...) and the queries."
)


def schema_page(store: StoreDescription) -> str:
    """Return the page of a store's views, tables and queries."""
    lines = [_HEAD]
    for heading, are_views in (("Views", True), ("Tables", False)):
        lines.append(f"## {heading}\n")
        for told in store.tables:
            if told.is_view == are_views:
                lines += _table_lines(told)
    lines.append("## Queries\n")
    lines.append("The queries that `metadata.yaml` gives to Datasette. `:session` stands for a session's name.\n")
    for query in store.queries:
        lines += [f"### {query.name}\n", f"{query.title}. {query.description}\n", f"```sql\n{query.sql}\n```\n"]
    return "\n".join(lines).rstrip() + "\n"


def _table_lines(told: TableDescription) -> Iterator[str]:
    yield f"### {told.name}\n"
    yield f"{told.words.title}. {told.words.description}\n"
    if told.is_view:
        yield from table(("column", "meaning"), ((f"`{column.name}`", column.meaning) for column in told.columns))
    else:
        rows = ((f"`{column.name}`", column.type, column.meaning, _link(column.refers_to)) for column in told.columns)
        yield from table(("column", "type", "meaning", "refers to"), rows)
    yield ""


def _link(name: str | None) -> str:
    """Return a link to a table of the page; empty for none."""
    return f"[{name}](#{name})" if name else ""


def datasette_metadata(store: StoreDescription, database: str = "rigcal") -> str:
    """Return the `metadata.yaml` of a store.

    Args:
        store: in words.
        database: name of the file without its ending.
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
    """Yield the lines of a mapping as YAML: quoted text as JSON has it, text of several lines as blocks."""
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
