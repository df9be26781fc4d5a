"""Apache Parquet, one file for each table; needs the library pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from daemon.commands import CommandError
from daemon.sessions.export.table_format import WHOLE, TableFormat, Tables, batches, is_text, table_file


def _write(tables: Tables, base: Path) -> list[Path]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise CommandError("Parquet needs pyarrow: `pip install 'rigcal[parquet]'`, or use --format csv") from error
    files = []
    for name, rows in tables.items():
        path = table_file(base, name, "parquet")
        writer = None
        try:
            for batch in batches(rows):
                columns = {column: [row[column] for row in batch] for column in batch[0]}
                if writer is None:
                    types = [(column, _arrow_type(pa, column)) for column in columns]
                    writer = pq.ParquetWriter(path, pa.schema(types))
                writer.write_table(pa.table(columns, schema=writer.schema))
        finally:
            if writer is not None:
                writer.close()
        if writer is not None:
            files.append(path)
    return files


def _arrow_type(pa: Any, column: str) -> Any:
    """Return a column's type by its name, because a batch may contain no value of it."""
    if is_text(column):
        return pa.string()
    return pa.int64() if column in WHOLE else pa.float64()


FORMAT = TableFormat("parquet", _write)
