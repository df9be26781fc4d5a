"""Calibrate a rig, find missing effects, plan poses and use a model: thin wrappers around the pipeline."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from numbers import Integral
from pathlib import Path
from typing import get_args

import numpy as np

from calibration.design.planning import PosePlan, plan_poses
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.errors import check_type, wrong_type
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
from calibration.observations import Observations, check_observations
from calibration.pipeline.calibrate import calibrate as calibrate_rig
from calibration.pipeline.find_gap import find_gap as find_gap_of_rig
from calibration.residual.selection import Kind
from calibration.rig.description import Rig, check_rig
from calibration.run_settings import Progress, Run
from daemon.host.safe_output import write_file
from daemon.models.model_files import read_model, write_model


class Model:
    """A calibrated model: a rig with identified parameters, named effects and a learned residual.

    `calibrate` makes one, `load` reads one.

    Args:
        data: the parts of the model, as `calibration.model.model` documents them, such as `GapResult.model`.

    Raises:
        TypeError: `data` has a different type, such as the path of a model.
    """

    def __init__(self, data: CalibratedModel) -> None:
        wanted = "the model of a GapResult; rigcal.Model.load('model') reads a directory"
        check_type("data", data, CalibratedModel, wanted)
        self.data = data

    def __repr__(self) -> str:
        named = ", ".join(map(str, self.effects)) or "no effects"
        learned = " and a learned residual" if self.data.residual is not None else ""
        return f"<rigcal.Model of rig {self.rig.name}: {named}{learned}, noise {self.noise_mm:.3g} mm RMS>"

    @classmethod
    def load(cls, directory: str | Path) -> Model:
        """Read a model directory.

        A child process with resource limits loads the files first, so that a damaged or hostile model cannot crash this
        process. This takes a second or two for a model that this process has not loaded before.

        Args:
            directory: a directory that `save` or `rigcal calibrate --out` wrote.

        Raises:
            ModelError: the directory is not a model, or is truncated, edited or of an unsupported version.
        """
        return cls(read_model(Path(directory)))

    def save(self, directory: str | Path) -> str:
        """Write a model directory; an existing model in it is replaced atomically.

        Args:
            directory: a new or empty directory, or one that holds a model.

        Returns:
            SHA-256 of the manifest, which identifies the model.

        Raises:
            ModelError: the directory holds something other than a model.
        """
        return write_model(Path(directory), self.data)

    @property
    def rig(self) -> Rig:
        """The rig description."""
        return self.data.rig

    @property
    def parameters(self) -> tuple[ParameterEstimate, ...]:
        """All identified constants, as deviations from nominal with their standard errors, mm or rad."""
        return self.data.parameters

    @property
    def effects(self) -> tuple[FittedEffect, ...]:
        """The named effects that the model has in addition to its kinematics.

        `reported` of an effect holds the numbers that reports list. Their standard errors include the uncertainty of
        the loads of the masses; the standard errors of `coefficients` are those of the fit alone.
        """
        return self.data.effects

    @property
    def noise_mm(self) -> float:
        """Expected RMS 3-D error of a new fix, mm."""
        return self.data.noise_mm

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the training data and the fit, as sentences."""
        return self.data.warnings

    def predict(self, observations: Observations) -> Prediction:
        """Predict where the station would measure the prisms.

        Args:
            observations: n rows; positions are not needed (`Observations.from_csv(..., positions_required=False)`).

        Returns:
            `position_mm` (n, 3) in the station's frame; `sigma_mm` (n, 3), the standard deviation of a fix about it;
            `half_mm` (n, 3) and `radius_mm` (n,), the distances within which a fix lies with 90 % probability, along
            each axis and in 3-D.

        Raises:
            UnsafeError: the model does not know a set-up.
            CalibrationError: a position is not a finite number.
            TypeError: `observations` has a wrong type.
        """
        check_observations("observations", observations)
        return Predictor.of(self.data).predict(observations)

    def warnings_for(self, observations: Observations) -> tuple[str, ...]:
        """Return warnings about rows that the model was not trained for; empty if it may be used for all of them.

        Args:
            observations: n rows; positions are not needed.

        Raises:
            TypeError: `observations` has a wrong type.
        """
        check_observations("observations", observations)
        return model_warnings(self.data, observations)

    def inverse(self, targets: Observations) -> Inverse:
        """Compute the joint values that bring prisms to their targets, with effects and residual taken into account.

        Args:
            targets: n rows whose positions, mm in the station's frame, are the targets and whose joints are the nominal
                command. Rows of one session, set-up and pose are solved together.

        Returns:
            `observations` with the joint values to command (deg or mm), and `closure_mm` (n,), the remaining distance
            between prism and target.

        Raises:
            DataError: a row without a position, or rows of one pose with different commands.
            UnsafeError: the model does not know a set-up.
            TypeError: `targets` has a wrong type.
        """
        check_observations("targets", targets)
        return inverse(self.data, targets)

    def evaluate(self, observations: Observations) -> Evaluation:
        """Compute the errors of every stage of the model on measured rows.

        Args:
            observations: n rows with positions.

        Raises:
            DataError: rows without positions.
            UnsafeError: the model does not know a set-up.
            TypeError: `observations` has a wrong type.
        """
        check_observations("observations", observations)
        return evaluate(self.data, observations)

    def export(self, directory: str | Path, format_name: str | None = None) -> tuple[Path, ...]:
        """Write the model in formats for other programs.

        Args:
            directory: output directory; created if it does not exist.
            format_name: a format of `rigcal model export --format` (docs/how-to/export.md); `json` and `grid` by
                default.

        Returns:
            Paths of the files that were written.

        Raises:
            DataError: the format is unknown, or needs a library that is not installed.
            OSError: the files cannot be written.
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
    """Calibrate a rig: identify kinematics and effects, and learn the residual if that helps on held-out groups.

    Args:
        rig: rig description from `Rig.read`.
        observations: n training rows with positions, mm in the station's frame.
        prior: `recalibration` trusts the rig file's build tolerances, `as-built` estimates their scale.
        method: `default`, or a published one: `pde-paper`, `km`, `skcm`, `rbf-tcm`.
        effects: `auto` to select effects by the data, `none`, or names: FAMILY@WHERE,...
        residual: `default` for the best learner, or for none if none helps; `none`, `rbfn`, `lightgbm`, `chain`, `gp`.
        seed: seed of all random numbers; the same seed gives the same model.
        progress: called with the share done, 0 to 1, and a message about the current step.

    Returns:
        The calibrated model.

    Raises:
        DataError: rows without positions, prisms that the rig lacks, data that the method or an effect cannot use.
        UnsafeError: too few fixes, mirrored coordinates, or data of a different rig.
        TypeError: an argument has a wrong type.
        ValueError: an unknown prior, method, effect or residual, or a rig that was not read from a text.
    """
    check_rig(rig)
    check_observations("observations", observations)
    check_type(
        "effects", effects, str, "'auto', 'none', or one str of effects, as ','.join(['backlash@q1', 'backlash@q2'])"
    )
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
        rig: rig description from `Rig.read`.
        observations: n training rows with positions, mm in the station's frame.
        holdout: further rows, at set-ups of the training rows, that are not used in any fit.
        prior: as for `calibrate`.
        families: families of effects that may be named; the whole library by default.
        seed: seed of all random numbers.
        progress: called with the share done, 0 to 1, and a message about the current step.

    Returns:
        `verdict` (`named`, `none`, `indistinguishable`, `unidentified`), `effects`, the evidence, and what to measure
        next; `Model(result.model)` is the model with the named effects.

    Raises:
        DataError: rows without positions, prisms that the rig lacks.
        UnsafeError: too few fixes, mirrored coordinates, data of a different rig, or a held-out set-up that has no
            training rows.
        TypeError: an argument has a wrong type.
        ValueError: an unknown prior or family, or a rig that was not read from a text.
    """
    check_rig(rig)
    check_observations("observations", observations)
    if holdout is not None:
        check_observations("holdout", holdout)
    _require_several("families", families, "backlash")
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

    Without a model, the poses are those that determine the parameters best; with a model, those that lower its expected
    error most.

    Args:
        rig: the rig description.
        poses: number of poses.
        model: a model of an earlier calibration, from which planning starts.
        station_mm: (3,) position of a new station set-up in the base frame, mm.
        setup: a set-up of the model; by default the one whose base is known best.
        floor_mm: height of the floor above the base's origin, mm.
        separate: effects that the poses should distinguish, each FAMILY@WHERE.
        seed: seed of the candidate poses.
        progress: called with the share done, 0 to 1, and a message about the current step.

    Raises:
        DataError: fewer reachable poses than requested; an effect that poses cannot show.
        UnsafeError: a model of a different rig, or without that set-up; no reachable pose in view.
        TypeError: an argument has a wrong type.
        ValueError: `poses` is below 1, an effect is unknown, or `station_mm` is not three finite numbers.
    """
    check_rig(rig)
    check_type("poses", poses, Integral, "the number of poses, an int")
    if model is not None:
        check_type("model", model, Model, "a Model, as from rigcal.Model.load('model')")
    _require_several("separate", separate, "backlash@q1")
    if poses < 1:
        raise ValueError(f"poses is {poses}; give 1 or more")
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
        raise ValueError(f"{name}: {value!r} is unknown; give one of {', '.join(known)}")


def _require_several(name: str, names: Collection[str] | None, example: str) -> None:
    if isinstance(names, str):
        raise wrong_type(name, names, f"a list, as [{example!r}]")


def _run(seed: int, progress: Progress | None) -> Run:
    check_type("seed", seed, Integral, "an int, 0 or more")
    return Run(seed) if progress is None else Run(seed, progress=progress)


def _text(rig: Rig) -> str:
    if not rig.text:
        raise ValueError("the rig has no text, which a model must contain; read the rig with Rig.read")
    return rig.text
