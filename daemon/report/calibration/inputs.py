"""Input of the calibration report: plain tables, which `from_model.py` fills from a calibrated model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import BEYOND_BUILDING, Joint
from daemon.report.front import Facts

if TYPE_CHECKING:  # both import numba, which would delay `status` and `--help`
    from calibration.design.accuracy import ExpectedAccuracy
    from calibration.evaluation.latency import Latency
    from calibration.identification.sweeps.cross_check import AxisCheck

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]
Stage = Literal["nominal", "geometric", "effects", "hybrid"]
STAGES: tuple[Stage, ...] = get_args(Stage)
USUAL = 2.0  # build tolerances; building causes 95 % of the corrections within them


@dataclass(frozen=True)
class Spread:
    """Statistics of the norms of position errors in mm, over all rows including outliers."""

    n: int
    mean_mm: float
    rms_mm: float
    max_mm: float
    std_mm: float


def spread(errors_mm: Floats) -> Spread:
    """Return the spread of (n, 3) error vectors in mm; n must be at least 1."""
    norms = np.linalg.norm(errors_mm, axis=1)
    return Spread(
        n=len(norms),
        mean_mm=float(norms.mean()),
        rms_mm=float(np.sqrt(np.mean(norms**2))),
        max_mm=float(norms.max()),
        std_mm=float(norms.std()),
    )


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """One set of observations with the error that each stage of the model leaves.

    Attributes:
        prism: (n,) prism of each fix.
        joints: joint name -> (n,) readings, deg or mm.
        position_mm: (n, 3) measured positions in the rig's base frame.
        errors_mm: stage -> (n, 3) measured minus predicted position, in the rig's base frame.
    """

    prism: Strings
    joints: Mapping[str, Floats]
    position_mm: Floats
    errors_mm: Mapping[Stage, Floats]

    def __len__(self) -> int:
        return len(self.prism)

    @cached_property
    def prisms(self) -> tuple[str, ...]:
        """The prisms that occur, in alphabetical order."""
        return tuple(str(name) for name in np.unique(self.prism))

    def stage(self, stage: Stage, prism: str | None = None) -> Spread:
        """Return the spread of a stage's errors, over all rows or over one prism's."""
        errors = self.errors_mm[stage]
        return spread(errors if prism is None else errors[self.prism == prism])


@dataclass(frozen=True)
class ParameterLine:
    """A corrected constant of the kinematic model.

    Attributes:
        name: name in the model, e.g. `row4.theta`.
        unit: `mm` or `deg`.
        correction: what calibration added to the nominal value.
        sigma: its standard deviation after the fit.
        tolerance: build tolerance, 1 sigma, from the rig file or the estimated prior scale.
        determined: False if the data do not determine it and it stayed at the value of the drawings.
    """

    name: str
    unit: str
    correction: float
    sigma: float
    tolerance: float
    determined: bool

    @property
    def in_tolerances(self) -> float:
        """The correction in units of the build tolerance."""
        return self.correction / self.tolerance

    @property
    def is_unusual(self) -> bool:
        """True if it is larger than 95 % of the corrections that building causes."""
        return abs(self.in_tolerances) > USUAL

    @property
    def is_beyond_building(self) -> bool:
        """True if it is larger than building can explain."""
        return abs(self.in_tolerances) > BEYOND_BUILDING


@dataclass(frozen=True)
class EffectLine:
    """A named effect of the model.

    Attributes:
        family, where: family and place, as in the library.
        change, unit: largest change of the joint's value over the rows it was fitted to, `deg` or `mm`; for an effect
            that is not at a joint, the largest shift of the prism, `mm`.
        coefficients: name, value, standard deviation and unit of each coefficient.
    """

    family: str
    where: str
    change: float
    unit: str
    coefficients: Sequence[tuple[str, float, float, str]]


@dataclass(frozen=True)
class OutlierLine:
    """A fix that the fit set aside: its row as in warnings, its prism, and its error."""

    row: str
    prism: str
    error_mm: float
    sigmas: float


@dataclass(frozen=True)
class ControlPoint:
    """Misclosure of a control point, mm (x, y, z): measured minus known, at a session's start and at its end."""

    name: str
    start_mm: tuple[float, float, float] | None
    end_mm: tuple[float, float, float] | None


@dataclass(frozen=True)
class SetupLine:
    """A station set-up: its instrument, whether it moved, and its control points."""

    name: str
    instrument: str
    moved: bool
    control_points: Sequence[ControlPoint] = ()


@dataclass(frozen=True, eq=False)
class ReportInput:
    """The content of a calibration report.

    Attributes:
        rig: the rig's name.
        joints: its joints, for limits and units.
        training: the rows the model was fitted to.
        held_out: rows the fit never saw; None if there were none.
        noise_mm: scatter of a fix about the fitted model, 3-D RMS: all that the model does not explain.
        instrument_mm: instrument noise: 3-D RMS error that station and encoders explain on the judged rows.
        residual: name of the learned residual, or None.
        residual_reason: why the model has a learned residual or none, a sentence.
        effects: named effects of the model.
        effects_reason: why the model has these effects or none, a clause.
        parameters: kinematic constants with a build tolerance.
        n_parameters, rank: number of parameters, and how many of them the data determine.
        unidentifiable: names of parameters or combinations that the data cannot determine.
        outliers: fixes that the fit set aside.
        warnings: sentences for the operator.
        ignored_columns: columns of the data that rigcal does not know (docs/reference/formats.md).
        setups: station set-ups with their control points, where known.
        latencies: session -> latency of its fixes relative to the joints, or why it is unknown; empty for files.
        stations: session -> name of the station that measured it, for the latencies.
        provenance: label -> value: data hashes, versions, seed, time.
        expected: accuracy that the model expects of itself over the work volume, if known.
        axes: comparison of the model with single-joint sweeps of the judged rows.
        importance: (feature, its share of the gain of all splits of the learned trees), most important first; empty
            without trees.
        facts: the first lines of the report; by default the rig's name alone.
    """

    rig: str
    joints: Sequence[Joint]
    training: ErrorTable
    held_out: ErrorTable | None
    noise_mm: float
    instrument_mm: float
    residual: str | None
    residual_reason: str
    parameters: Sequence[ParameterLine]
    n_parameters: int
    rank: int
    unidentifiable: Sequence[str]
    outliers: Sequence[OutlierLine]
    warnings: Sequence[str]
    ignored_columns: Sequence[str]
    provenance: Mapping[str, str]
    setups: Sequence[SetupLine] = ()
    latencies: Mapping[str, Latency | str] = field(default_factory=dict)
    stations: Mapping[str, str] = field(default_factory=dict)
    effects: Sequence[EffectLine] = ()
    effects_reason: str = "switched off"
    expected: ExpectedAccuracy | None = None
    axes: Sequence[AxisCheck] = ()
    importance: Sequence[tuple[str, float]] = ()
    facts: Facts | None = None

    @property
    def judged(self) -> ErrorTable:
        """The rows that the report's figures refer to: the held-out rows, or the training rows if there are none."""
        return self.training if self.held_out is None else self.held_out
