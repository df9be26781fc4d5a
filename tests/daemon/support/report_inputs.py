"""Report inputs made of known numbers."""

from __future__ import annotations

import numpy as np

from calibration.rig.description import Joint, Rig, shipped_rig
from daemon.report.calibration.inputs import (
    ControlPoint,
    ErrorTable,
    OutlierLine,
    ParameterLine,
    ReportInput,
    SetupLine,
)


def error_table(rig: Rig, joints: tuple[Joint, ...], n: int, seed: int, *, learned: bool = True) -> ErrorTable:
    rng = np.random.default_rng(seed)
    after = rng.normal(0.0, 2.0, (n, 3))
    middle = after + (3.0 if learned else 0.0)
    return ErrorTable(
        prism=np.array([rig.prism_names[i % len(rig.prism_names)] for i in range(n)]),
        joints={j.name: rng.uniform(*j.limits, n) for j in joints},
        position_mm=rng.uniform(-5000.0, 5000.0, (n, 3)),
        errors_mm={"nominal": after + 40.0, "geometric": middle, "effects": middle, "hybrid": after},
    )


def report_input(
    rig_name: str = "swdt82",
    *,
    joints: int | None = 2,
    n: int = 60,
    held_out: bool = True,
    learned: bool = True,
    **changes: object,
) -> ReportInput:
    """Of the first joints of a rig, or of all: their plots take two seconds to draw."""
    rig = shipped_rig(rig_name)
    of = rig.joints[:joints]
    values: dict[str, object] = {
        "rig": rig.name,
        "joints": of,
        "training": error_table(rig, of, n, 1, learned=learned),
        "held_out": error_table(rig, of, 24, 2, learned=learned) if held_out else None,
        "noise_mm": 3.2,
        "instrument_mm": 3.0,
        "residual": "rbfn" if learned else None,
        "residual_reason": "rbfn halves the error of held-out groups" if learned else "none helps on held-out groups",
        "parameters": [
            ParameterLine("row1.alpha", "deg", 0.9, 0.02, 0.2, True),
            ParameterLine("row2.a", "mm", -3.0, 1.0, 5.0, True),
            ParameterLine("row9.theta", "deg", 0.0, 0.2, 0.2, False),
        ],
        "n_parameters": 56,
        "rank": 54,
        "unidentifiable": ["row9.theta with prism.s.x"],
        "outliers": [OutlierLine("line 7", rig.prism_names[0], 55.5, 12.0)],
        "warnings": ["Joint L2 moved over less than a tenth of its range."],
        "ignored_columns": ["operator_note"],
        "provenance": {"made": "2026-11-21 14:03 UTC", "seed": "17"},
        "setups": [SetupLine("north face", "GTS-8", True, [ControlPoint("P1", (0.3, -0.4, 0.0), None)])],
        **changes,
    }
    return ReportInput(**values)  # type: ignore[arg-type]  # the tests' own dictionary
