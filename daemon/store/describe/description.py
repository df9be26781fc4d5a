"""Description of a store's actual tables and views: the meaning of each column and the table that it refers to."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlite_utils import Database

from daemon.store.describe.table_words import TABLES
from daemon.store.describe.view_words import VIEWS, channel_meaning
from daemon.store.describe.words import Words
from daemon.store.errors import StoreError
from daemon.store.queries.canned_queries import Query, canned_queries
from daemon.store.views import Channel, channels_of


@dataclass(frozen=True)
class ColumnDescription:
    """A column.

    Attributes:
        name: name of the column.
        type: INTEGER, REAL, TEXT or BLOB; "" in a view.
        meaning: meaning of its values.
        refers_to: table whose rows it refers to; None if it refers to none.
    """

    name: str
    type: str
    meaning: str
    refers_to: str | None = None


@dataclass(frozen=True)
class TableDescription:
    """A table or a view.

    Attributes:
        name: name of the table.
        words: title and description.
        columns: its columns, in order.
        is_view: True for a view.
    """

    name: str
    words: Words
    columns: tuple[ColumnDescription, ...]
    is_view: bool


@dataclass(frozen=True)
class StoreDescription:
    """Description of a store.

    Attributes:
        tables: views first, then tables, both sorted by name.
        queries: the canned queries.
    """

    tables: tuple[TableDescription, ...]
    queries: tuple[Query, ...]


def describe_store(path: Path) -> StoreDescription:
    """Describe a store; the daemon may be writing to it.

    Raises:
        StoreError: there is no store, or it has a table or column without a description, because a newer or older
            program made it.
    """
    if not path.is_file():
        raise StoreError(f"{path}: there is no store")
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
        db = Database(connection)
        channels = channels_of(db)
        views = [_described(db, name, channels, is_view=True) for name in sorted(db.view_names())]
        tables = [_described(db, name, channels, is_view=False) for name in sorted(db.table_names())]
    return StoreDescription((*views, *tables), canned_queries(channels))


def _described(db: Database, name: str, channels: Sequence[Channel], *, is_view: bool) -> TableDescription:
    words = (VIEWS if is_view else TABLES).get(name)
    if words is None:
        raise StoreError(f"{'view' if is_view else 'table'} {name!r} is not of this version of rigcal")
    meanings = words.meanings()
    if words.has_channels:
        for channel in channels:
            for column in (channel.column, f"{channel.name}_dir", f"{channel.name}_rate"):
                meaning = channel_meaning(column, channel.name, channel.unit, is_joint=channel.is_joint)
                meanings.setdefault(column, meaning)
    refers = {} if is_view else {key.column: key.other_table for key in db.table(name).foreign_keys if key.column}
    columns = []
    for found in db[name].columns:
        if found.name not in meanings:
            raise StoreError(f"column {found.name!r} of {name!r} is not of this version of rigcal")
        kind = "" if is_view else found.type
        columns.append(ColumnDescription(found.name, kind, meanings[found.name], refers.get(found.name)))
    return TableDescription(name, words, tuple(columns), is_view)
