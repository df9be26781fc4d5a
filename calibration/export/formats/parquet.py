"""corrections.parquet: the correction grid of corrections.csv as a Parquet table, with a description as metadata."""

from __future__ import annotations

import io

import numpy as np

from calibration.errors import DataError
from calibration.export.model_export import Export, Format


def _content(export: Export) -> bytes:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise DataError(
            "format", "parquet needs pyarrow, which is not installed: pip install 'rigcal[parquet]'"
        ) from None
    grid, rig = export.grid, export.model.rig
    prisms, n = list(grid.nominal_mm), len(grid.readings)
    columns: dict[str, object] = {"prism": np.repeat(prisms, n)}
    columns |= {joint.column: np.tile(grid.readings[:, i], len(prisms)) for i, joint in enumerate(rig.joints)}
    nominal, corrected = (np.concatenate([of[p] for p in prisms]) for of in (grid.nominal_mm, grid.corrected_mm))
    for kind, values in (("nominal", nominal), ("corrected", corrected), ("correction", corrected - nominal)):
        columns |= {f"{axis}_{kind}_mm": values[:, i] for i, axis in enumerate("xyz")}
    columns["reachable"] = np.tile(grid.reachable, len(prisms))
    about = "\n".join(export.heading(export.left_out_of_grid))
    table = pyarrow.table(columns).replace_schema_metadata({"rigcal": about})
    out = io.BytesIO()
    parquet.write_table(table, out)
    return out.getvalue()


FORMAT = Format(
    "parquet",
    "corrections.parquet",
    "the grid's table as Parquet",
    _content,
    lambda export: export.left_out_of_grid,
    has_grid=True,
)
