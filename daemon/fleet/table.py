"""A fleet as one table: a row for each rig and quantity, as Parquet, or as CSV if pyarrow is not installed."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from daemon.fleet.comparison import Fleet

COLUMNS = {
    "rig_name": "text",
    "source": "text",
    "rig": "text",
    "kind": "text",
    "quantity": "text",
    "unit": "text",
    "value": "number",
    "sigma": "number",
    "fleet_mean": "number",
    "fleet_mean_sigma": "number",
    "fleet_spread": "number",
    "estimate": "number",
    "estimate_sigma": "number",
    "deviation": "number",
    "is_outlier": "flag",
    "is_common": "flag",
}
_BATCH = 100_000


def rows(fleet: Fleet) -> Iterator[dict[str, Any]]:
    """Yield the rows: for each rig its figures, then its own estimate and the fleet's estimate of each quantity."""
    for group in fleet.groups:
        for number, answer in enumerate(group.answers):
            head = {"rig_name": answer["name"], "source": answer["source"], "rig": group.rig}
            figures = {f"{stage}_rms": value for stage, value in answer["stages"].items()}
            figures |= {"noise": answer["noise_mm"], "expected_rms": answer["expected_rms_mm"]}
            for name, value in figures.items():
                yield _row(**head, kind="figure", quantity=name, unit="mm", value=value)
            yield _row(**head, kind="figure", quantity="fixes", unit="", value=float(answer["fixes"]))
            if answer["drift"] is not None and answer["drift"]["ratio"] is not None:
                yield _row(**head, kind="figure", quantity="drift_ratio", unit="", value=answer["drift"]["ratio"])
            for quantity in group.quantities:
                fleet_part = quantity.fleet
                if np.isfinite(quantity.own[number]):
                    yield _row(
                        **head,
                        kind=quantity.kind,
                        quantity=quantity.name,
                        unit=quantity.unit,
                        value=float(quantity.own[number]),
                        sigma=float(quantity.own_sigma[number]),
                        fleet_mean=fleet_part.mean,
                        fleet_mean_sigma=fleet_part.mean_sigma,
                        fleet_spread=fleet_part.spread,
                        estimate=float(fleet_part.estimate[number]),
                        estimate_sigma=float(fleet_part.sigma[number]),
                        deviation=float(fleet_part.deviation[number]),
                        is_outlier=bool(quantity.outliers[number]),
                        is_common=quantity.is_common,
                    )


def _row(**given: Any) -> dict[str, Any]:
    return dict.fromkeys(COLUMNS) | given


def write_table(fleet: Fleet, out: Path) -> Path:
    """Write `fleet.parquet`, or `fleet.csv` if pyarrow is not installed; return the file's path."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        path = out / "fleet.csv"
        with path.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(COLUMNS), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows(fleet))
        return path
    types = {"text": pa.string(), "number": pa.float64(), "flag": pa.bool_()}
    schema = pa.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
    path = out / "fleet.parquet"
    with pq.ParquetWriter(path, schema) as writer:
        batch: list[dict[str, Any]] = []
        for row in rows(fleet):
            batch.append(row)
            if len(batch) == _BATCH:
                writer.write_table(pa.Table.from_pylist(batch, schema=schema))
                batch = []
        writer.write_table(pa.Table.from_pylist(batch, schema=schema))
    return path
