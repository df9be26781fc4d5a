"""docs/reference/schema.md and metadata.yaml: every view, table and column of the example rig's store."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from calibration.rig.description import shipped_rig
from daemon.store import Store
from daemon.store.describe.description import StoreDescription, TableDescription, describe_store
from daemon.store.describe.metadata import datasette_metadata
from docs.references.markdown import table

_HEAD = """# The store's tables

Every view, table and column of `rigcal.sqlite`. Start with the views: they have ISO times, joints as columns, and units
in their names. The views shown here are those of the rig `swdt82`; the columns of another rig are its own joints and
signals. [The store](../how-to/store.md#reading-it-with-other-tools) explains how to open a store with other tools.

This page is generated from the code: `python -m docs.references`.
"""


def example() -> StoreDescription:
    """Describe the store of the example rig that the documentation uses."""
    rig = shipped_rig("swdt82")
    joints = {joint.name: joint.unit for joint in rig.joints}
    signals = {channel.name: channel.unit for channel in rig.channels if channel.name not in joints}
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "rigcal.sqlite"
        with contextlib.closing(Store(path)) as store:
            store.declare_channels(joints, signals)
        return describe_store(path)


def page() -> str:
    """Return the text of docs/reference/schema.md."""
    store = example()
    lines = [_HEAD]
    for heading, are_views in (("Views", True), ("Tables", False)):
        lines.append(f"## {heading}\n")
        for told in store.tables:
            if told.is_view == are_views:
                lines += _table_lines(told)
    lines.append("## Queries\n")
    lines.append("The queries that `metadata.yaml` defines for Datasette. `:session` is the name of a session.\n")
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


def metadata() -> str:
    """Return the text of docs/reference/metadata.yaml."""
    return datasette_metadata(example())
