"""Calibrate, find what is missing, plan, and use a calibrated model: thin names over the functions of the pipeline."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from calibration.design.planning import PosePlan, plan_poses
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.evaluation.evaluation import Evaluation, evaluate
from calibration.export.formats import export_files
from calibration.export.model_export import Export
from calibration.gap.result import GapResult
from calibration.identification.refinement import Prior
from calibration.model.files import MANIFEST, model_to_files
from calibration.model.inverse import Inverse, inverse
from calibration.model.model import CalibratedModel, ParameterEstimate
from calibration.model.prediction import Prediction, Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Observations
from calibration.pipeline.calibrate import calibrate as calibrate_rig
from calibration.pipeline.find_gap import find_gap as find_gap_of_rig
from calibration.residual.selection import Kind
from calibration.rig.description import Rig
from calibration.run_settings import Progress, Run
from daemon.host.safe_output import write_file
from daemon.models.model_files import read_model, write_model


class Model:
    """A calibrated model: a rig with identified parameters, named effects and a learned residual.

    `calibrate` makes one, `load` reads one.

    Args:
        data: the parts of the model, as `calibration.model.model` documents them.
    """

    def __init__(self, data: CalibratedModel) -> None:
        self.data = data

    def __repr__(self) -> str:
        named = ", ".join(map(str, self.effects)) or "no effects"
        learned = " and a learned residual" if self.data.residual is not None else ""
        return f"<rigcal.Model of rig {self.rig.name}: {named}{learned}, noise {self.noise_mm:.3g} mm RMS>"

    @classmethod
    def load(cls, directory: str | Path) -> Model:
        """Read a model directory.

        The files are first loaded by a child process with limits, so that a damaged or hostile model cannot end this
        one; that takes a second or two for a model that this process has not met.

        Args:
            directory: as `save` or `rigcal calibrate --out` wrote it.

        Raises:
            ModelError: not a model, truncated, edited, or of another version.
        """
        return cls(read_model(Path(directory)))

    def save(self, directory: str | Path) -> str:
        """Write a model directory; a model that is there is replaced in one step.

        Args:
            directory: new, empty, or of a model.

        Returns:
            SHA-256 of the manifest, which names the model.

        Raises:
            ModelError: the directory holds something else.
        """
        return write_model(Path(directory), self.data)

    @property
    def rig(self) -> Rig:
        """The rig description."""
        return self.data.rig

    @property
    def parameters(self) -> tuple[ParameterEstimate, ...]:
        """Every identified constant with its standard error: deviations from nominal, mm or rad."""
        return self.data.parameters

    @property
    def effects(self) -> tuple[FittedEffect, ...]:
        """The named effects on top of the kinematics.

        `reported` of an effect has the numbers that reports list. Their standard errors count what the loads of the
        masses leave open; those of `coefficients` are of the fit alone.
        """
        return self.data.effects

    @property
    def noise_mm(self) -> float:
        """RMS 3-D error that is expected of a new fix."""
        return self.data.noise_mm

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about the training data and the fit."""
        return self.data.warnings

    def predict(self, observations: Observations) -> Prediction:
        """Predict where the station would measure the prisms.

        Args:
            observations: n rows; positions are not needed (`Observations.from_csv(..., positions_required=False)`).

        Returns:
            `position_mm` (n, 3) in the station's frame; `sigma_mm` (n, 3), the standard deviation of a fix about it;
            `half_mm` (n, 3) and `radius_mm` (n,): a fix is that near with 90 % probability, along each axis and in 3-D.

        Raises:
            UnsafeError: a set-up that the model does not know.
            CalibrationError: a position is not a finite number.
        """
        return Predictor.of(self.data).predict(observations)

    def warnings_for(self, observations: Observations) -> tuple[str, ...]:
        """Return sentences on what the model was not trained for in these rows; none where it may be used."""
        return model_warnings(self.data, observations)

    def inverse(self, targets: Observations) -> Inverse:
        """Compute the joint values that bring prisms to their targets, through effects and residual.

        Args:
            targets: n rows whose positions, mm in the station's frame, are the targets and whose joints are the nominal
                command. Rows of one session, set-up and pose are solved together.

        Returns:
            `observations` with the joint values to command (deg or mm), and `closure_mm` (n,), the distance left.

        Raises:
            DataError: a row without a position, or rows of one pose with different commands.
            UnsafeError: a set-up that the model does not know.
        """
        return inverse(self.data, targets)

    def evaluate(self, observations: Observations) -> Evaluation:
        """Compute the errors of every stage of the model on measured rows.

        Args:
            observations: n rows with positions.

        Raises:
            DataError: rows without positions.
            UnsafeError: a set-up that the model does not know.
        """
        return evaluate(self.data, observations)

    def export(self, directory: str | Path, format_name: str | None = None) -> tuple[Path, ...]:
        """Write the model for other programs.

        Args:
            directory: where to; it is made where it is missing.
            format_name: as `rigcal model export --format` has it (docs/how-to/export.md); `json` and `grid` by default.

        Returns:
            The files that were written.

        Raises:
            DataError: an unknown format, or one that needs a library that is not installed.
            OSError: the file system refuses.
        """
        out = Path(directory)
        out.mkdir(parents=True, exist_ok=True)
        manifest = model_to_files(self.data)[MANIFEST]
        export = Export(self.data, hashlib.sha256(manifest).hexdigest())
        files = export_files(export, () if format_name is None else (format_name,))
        for name, data in files.items():
            write_file(out / name, data)
        return tuple(out / name for name in files)


def calibrate(
    rig: Rig,
    observations: Observations,
    *,
    prior: Prior = "recalibration",
    method: str = "default",
    effects: str = "auto",
    residual: Kind = "default",
    seed: int = 0,
    progress: Progress | None = None,
) -> Model:
    """Calibrate a rig: identify kinematics and effects, learn what remains where it helps on held-out groups.

    Args:
        rig: as `Rig.read` gives it.
        observations: n training rows with positions, mm in the station's frame.
        prior: `recalibration` trusts the rig file's build tolerances, `as-built` estimates their scale.
        method: `default`, or a published one: `pde-paper`, `km`, `skcm`, `rbf-tcm`.
        effects: `auto` for those that the data ask for, `none`, or FAMILY@WHERE,... by name.
        residual: `default` for whichever learner is best or none; `none`, `rbfn`, `lightgbm`, `chain`, `gp`.
        seed: of everything random; the same seed gives the same model.
        progress: told the share done, 0 to 1, and what is going on.

    Raises:
        DataError: rows without positions, prisms that the rig lacks, data that the method or an effect cannot use.
        UnsafeError: too few fixes, mirrored coordinates, another rig's data.
        ValueError: an unknown prior, method, effect or residual, or a rig that was not read from a text.
    """
    _require_one_of("prior", prior, get_args(Prior))
    _require_one_of("residual", residual, get_args(Kind))
    run = _run(seed, progress)
    data, _ = calibrate_rig(
        rig, _text(rig), observations, prior=prior, method=method, effects=effects, residual=residual, run=run
    )
    return Model(data)


def find_gap(
    rig: Rig,
    observations: Observations,
    *,
    holdout: Observations | None = None,
    prior: Prior = "recalibration",
    families: Collection[str] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> GapResult:
    """Find where simulation and measurement disagree, and name the effect that is missing.

    Args:
        rig: as `Rig.read` gives it.
        observations: n training rows with positions, mm in the station's frame.
        holdout: further rows, at set-ups of the training rows, that no fit sees.
        prior: as `calibrate`.
        families: of effects that may be named; the whole library by default.
        seed: of everything random.
        progress: told the share done, 0 to 1, and what is going on.

    Returns:
        `verdict` (`named`, `none`, `indistinguishable`, `unidentified`), `effects`, the evidence, what to measure next;
        `Model(result.model)` is the model that has the named effects.

    Raises:
        DataError: rows without positions, prisms that the rig lacks.
        UnsafeError: too few fixes, mirrored coordinates, another rig's data, a held-out set-up that is not trained on.
        ValueError: an unknown prior or family, or a rig that was not read from a text.
    """
    _require_one_of("prior", prior, get_args(Prior))
    for family in families or ():
        _require_one_of("families", family, sorted(library()))
    run = _run(seed, progress)
    return find_gap_of_rig(rig, _text(rig), observations, holdout=holdout, prior=prior, families=families, run=run)


def plan(
    rig: Rig,
    poses: int,
    *,
    model: Model | None = None,
    station_mm: Sequence[float] | None = None,
    setup: str | None = None,
    floor_mm: float | None = None,
    separate: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> PosePlan:
    """Plan which poses to measure.

    Without a model the poses determine the parameters best; with one they lower its expected error most.

    Args:
        rig: the rig description.
        poses: how many.
        model: what is known already.
        station_mm: (3,) place of a new station set-up in the base frame.
        setup: which of the model's set-ups; by default the one whose base is known best.
        floor_mm: height of the floor over the base's origin.
        separate: effects to tell apart, each FAMILY@WHERE.
        seed: of the candidates.
        progress: told the share done, 0 to 1, and what is going on.

    Raises:
        DataError: fewer reachable poses than asked for; an effect that poses do not show.
        UnsafeError: a model of another rig, or without that set-up; no reachable pose in view.
        ValueError: no pose is asked for, an unknown effect, or a station's place that is not three finite numbers.
    """
    if poses < 1:
        raise ValueError(f"poses is {poses}; ask for one at least")
    for effect in separate:
        _require_one_of("separate", effect.partition("@")[0], sorted(library()))
    station = None if station_mm is None else np.array(station_mm, dtype=np.float64)
    if station is not None and (station.shape != (3,) or not np.isfinite(station).all()):
        raise ValueError(f"station_mm is {station_mm!r}; give three finite numbers, x, y and z in mm")
    return plan_poses(
        rig,
        poses,
        model=None if model is None else model.data,
        station_mm=station,
        setup=setup,
        floor_mm=floor_mm,
        separate=separate,
        run=_run(seed, progress),
    )


def _require_one_of(name: str, value: str, known: Collection[str]) -> None:
    if value not in known:
        raise ValueError(f"{name}: {value!r} is unknown; there are {', '.join(known)}")


def _run(seed: int, progress: Progress | None) -> Run:
    return Run(seed) if progress is None else Run(seed, progress=progress)


def _text(rig: Rig) -> str:
    if not rig.text:
        raise ValueError("the rig was not read from a text, which has to travel in the model; use Rig.read")
    return rig.text
