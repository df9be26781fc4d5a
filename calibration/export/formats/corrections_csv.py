"""corrections.csv: the nominal and the corrected position of each prism at every node of the grid, in the base frame.

A controller that has only its own nominal kinematics can interpolate the difference linearly in every joint value.
"""

from __future__ import annotations

import csv
import io

import numpy as np

from calibration.export.model_export import GRID_FILE, Export, Format

_DECIMALS = 4  # of mm


def _content(export: Export) -> bytes:
    """Return the CSV: prism, joint values, nominal and corrected position, their difference, 1 for a reachable pose."""
    grid, out = export.grid, io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    places = [f"{axis}_{kind}_mm" for kind in ("nominal", "corrected", "correction") for axis in "xyz"]
    writer.writerow(["prism", *(joint.column for joint in export.model.rig.joints), *places, "reachable"])
    joints = np.round(grid.readings, 6).tolist()
    reachable = grid.reachable.astype(int).tolist()
    for prism, nominal in grid.nominal_mm.items():
        corrected = grid.corrected_mm[prism]
        numbers = np.round(np.hstack([nominal, corrected, corrected - nominal]), _DECIMALS).tolist()
        writer.writerows(
            [prism, *reading, *place, flag] for reading, place, flag in zip(joints, numbers, reachable, strict=True)
        )
    return out.getvalue().encode()


FORMAT = Format(
    "grid",
    GRID_FILE,
    "CSV: the nominal and the corrected position of each prism at the nodes of a grid of joint values",
    _content,
    lambda export: export.left_out_of_grid,
    is_default=True,
    has_grid=True,
)
