"""MATLAB MAT-file of version 5, one file with a structure for each table."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daemon.sessions.export.table_format import Row, TableFormat, Tables, batches, is_text

if TYPE_CHECKING:
    from numpy.typing import NDArray


def _write(tables: Tables, base: Path) -> list[Path]:
    from scipy.io import savemat

    found = {name: _arrays(rows) for name, rows in tables.items()}
    path = base.with_name(f"{base.name}.mat")
    savemat(
        path, {name: columns for name, columns in found.items() if columns}, long_field_names=True, oned_as="column"
    )
    return [path]


def _arrays(rows: Iterable[Row]) -> dict[str, NDArray[Any]]:
    """Return the columns of rows; missing numbers are NaN, missing texts are ""."""
    import numpy as np

    parts: dict[str, list[NDArray[Any]]] = {}
    for batch in batches(rows):
        for column in batch[0]:
            values = [row[column] for row in batch]
            if is_text(column):
                array: NDArray[Any] = np.array(["" if value is None else value for value in values])
            else:
                array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
            parts.setdefault(column, []).append(array)
    return {column: np.concatenate(arrays) for column, arrays in parts.items()}


FORMAT = TableFormat("mat", _write)
