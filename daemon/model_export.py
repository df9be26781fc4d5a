"""A model directory as the files that other programs read: calibration.json and corrections.csv."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.export import CorrectionGrid, correction_grid, document
from calibration.rig import Rig
from daemon.modelfiles import model_sha256, read_model

DOCUMENT, GRID = "calibration.json", "corrections.csv"
_DECIMALS = 4  # of mm


def exported(directory: Path, prisms: Sequence[str], most_poses: int) -> tuple[dict[str, bytes], dict[str, Any]]:
    """The files of an export, and what is to be said of the grid.

    Args:
        directory: of the model.
        prisms: in the grid; all of the rig when empty.
        most_poses: the grid has no more.

    Returns:
        file name -> content; `rows`, `poses`, `nodes` (joint -> how many), `rms_mm`, `p95_mm`, `max_mm` of the
        interpolation, `correction_rms_mm` of what is interpolated, and `warnings`, sentences.

    Raises:
        ModelError: not a model, or a damaged one.
        DataError: a prism that the rig lacks, or too few poses.
    """
    model = read_model(directory)
    chosen = tuple(prisms) or model.rig.prism_names
    grid = correction_grid(model, chosen, most_poses, np.random.default_rng(0))
    summary = {
        "rows": len(grid.readings) * len(chosen),
        "poses": len(grid.readings),
        "nodes": {name: len(values) for name, values in grid.nodes.items()},
        "rms_mm": grid.rms_mm,
        "p95_mm": grid.p95_mm,
        "max_mm": grid.max_mm,
        "correction_rms_mm": grid.correction_rms_mm,
        "warnings": list(_warnings(grid)),
    }
    about = document(model) | {"manifest_sha256": model_sha256(directory), "grid": {"file": GRID, **summary}}
    text = json.dumps(about, indent=1, allow_nan=False) + "\n"
    return {DOCUMENT: text.encode(), GRID: grid_csv(grid, model.rig).encode()}, summary


def _warnings(grid: CorrectionGrid) -> Iterator[str]:
    yield from (f"{GRID}: {sentence}; `rigcal predict` has it where the data do" for sentence in grid.left_out)
    if grid.is_coarse:
        yield (
            f"between the nodes of {GRID}, interpolated corrections are wrong by {grid.rms_mm:.2g} mm RMS, more than "
            f"half of the {grid.correction_rms_mm:.2g} mm that they are: the table mends little; allow more rows "
            "(--rows), or use `rigcal predict`"
        )


def grid_csv(grid: CorrectionGrid, rig: Rig) -> str:
    """The grid as CSV: prism, joint values, nominal and corrected place, difference, and whether it is reachable."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    axes = "xyz"
    places = [f"{axis}_{what}_mm" for what in ("nominal", "corrected", "correction") for axis in axes]
    writer.writerow(["prism", *(joint.column for joint in rig.joints), *places, "reachable"])
    joints = np.round(grid.readings, 6).tolist()
    reachable = grid.reachable.astype(int).tolist()
    for prism, nominal in grid.nominal_mm.items():
        corrected = grid.corrected_mm[prism]
        numbers = np.round(np.hstack([nominal, corrected, corrected - nominal]), _DECIMALS).tolist()
        writer.writerows(
            [prism, *reading, *place, flag] for reading, place, flag in zip(joints, numbers, reachable, strict=True)
        )
    return out.getvalue()
