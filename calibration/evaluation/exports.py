"""A model to be exported: the correction grid and the summary that export formats share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from calibration.evaluation.correction_grid import CorrectionGrid, correction_grid
from calibration.model.model import CalibratedModel

GRID_FILE = "corrections.csv"


@dataclass(frozen=True)
class Export:
    """A model and what is asked of its export.

    Attributes:
        model: the model.
        manifest_sha256: SHA-256 of the model's manifest, which names it.
        prisms: prisms of the grid; all of the rig when empty.
        most_poses: greatest number of nodes of the grid.
    """

    model: CalibratedModel
    manifest_sha256: str
    prisms: tuple[str, ...] = ()
    most_poses: int = 20_000

    @cached_property
    def grid(self) -> CorrectionGrid:
        """The correction grid, computed once.

        Raises:
            DataError: as `correction_grid`.
        """
        prisms = self.prisms or self.model.rig.prism_names
        return correction_grid(self.model, prisms, self.most_poses, np.random.default_rng(0))

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """Size of the grid, its interpolation errors in mm, and `warnings`, sentences."""
        grid = self.grid
        return {
            "rows": len(grid.readings) * len(grid.nominal_mm),
            "poses": len(grid.readings),
            "nodes": {name: len(values) for name, values in grid.nodes.items()},
            "rms_mm": grid.rms_mm,
            "p95_mm": grid.p95_mm,
            "max_mm": grid.max_mm,
            "correction_rms_mm": grid.correction_rms_mm,
            "warnings": list(_warnings(grid)),
        }


@dataclass(frozen=True)
class Format:
    """One format.

    Attributes:
        file: name of the file that it writes.
        content: makes its content.
    """

    file: str
    content: Callable[[Export], bytes]


def _warnings(grid: CorrectionGrid) -> Iterator[str]:
    yield from (f"{GRID_FILE}: {sentence}; `rigcal predict` has it where the data do" for sentence in grid.left_out)
    if grid.is_coarse:
        yield (
            f"between the nodes of {GRID_FILE}, interpolated corrections are wrong by {grid.rms_mm:.2g} mm RMS, more "
            f"than half of the {grid.correction_rms_mm:.2g} mm that they are: the table mends little; allow more rows "
            "(--rows), or use `rigcal predict`"
        )
