"""Comma-separated values, one file for each table."""

from __future__ import annotations

import csv
from pathlib import Path

from daemon.sessions.export.table_format import TableFormat, Tables, batches, table_file


def _write(tables: Tables, base: Path) -> list[Path]:
    files = []
    for name, rows in tables.items():
        path = table_file(base, name, "csv")
        for i, batch in enumerate(batches(rows)):
            with path.open("a" if i else "w", encoding="utf-8", newline="") as stream:
                writer = csv.DictWriter(stream, list(batch[0]), lineterminator="\n")
                if not i:
                    writer.writeheader()
                    files.append(path)
                writer.writerows(batch)
    return files


FORMAT = TableFormat("csv", _write)
