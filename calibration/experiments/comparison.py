"""Comparison of all methods, and of all residuals on the default kinematics, fitted and evaluated on the same rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.evaluation.evaluation import Evaluation, evaluate, instrument_noise_mm, sizes_mm
from calibration.experiments.residual_comparison import RESIDUALS, MethodResult, compare_residuals, families
from calibration.identification.refinement import Prior
from calibration.observations import Floats, Observations, are_among, row_digests
from calibration.pipeline.calibrate import calibrate, identify, require_known_setups, train_residual
from calibration.rig.description import Rig
from calibration.run_settings import DEFAULT_RUN, Run

NOMINAL = "nominal"
REFIT_BASE = "its base transform would be a guess. Use --refit-base to fit it on the held-out fixes"
METHODS = ("km", "skcm", "rbf-tcm", "default", "pde-paper")  # in the order of the table, below the nominal model


@dataclass(frozen=True)
class Comparison:
    """Results of all methods on the same rows.

    Attributes:
        rig: name of the rig.
        training, held_out: numbers of rows.
        results: the nominal model first, then `METHODS`, with `RESIDUALS` before the default.
        warnings: warnings about data and fit that all applicable methods share.
    """

    rig: str
    training: int
    held_out: int
    results: tuple[MethodResult, ...]
    warnings: tuple[str, ...]

    @property
    def noise_mm(self) -> float | None:
        """RMS 3-D error that station and encoders explain on the held-out rows; None if no method returned it."""
        return next((r.noise_mm for r in reversed(self.results) if r.noise_mm is not None), None)

    def lowest(self, figure: str) -> frozenset[str]:
        """Return the methods with the lowest value of one of `FIGURES`."""
        values = {str(row["method"]): row[figure] for row in (result.as_dict() for result in self.results)}
        known = {method: value for method, value in values.items() if isinstance(value, float)}
        return frozenset(method for method, value in known.items() if value == min(known.values()))

    def as_dict(self) -> dict[str, object]:
        """Return a JSON object with rig, numbers of rows, noise, figures of each method, and warnings."""
        return {
            "rig": self.rig,
            "n": self.training,
            "n_holdout": self.held_out,
            "noise_mm": self.noise_mm,
            "methods": [result.as_dict() for result in self.results],
            "warnings": [*self.warnings, *(f"{r.method}: {note}" for r in self.results for note in r.notes)],
        }


def compare(
    rig: Rig,
    rig_text: str,
    training: Observations,
    held_out: Observations,
    *,
    clock: Callable[[], float],
    prior: Prior = "recalibration",
    refit_base: bool = False,
    time_limit_s: float | None = None,
    methods: Sequence[str] = METHODS,
    residuals: Sequence[str] = RESIDUALS,
    run: Run = DEFAULT_RUN,
) -> Comparison:
    """Calibrate by every method and evaluate the last stage of each model on the held-out rows.

    The default method identifies the kinematics and effects once; all `RESIDUALS` are then learned from the errors of
    this model.

    Args:
        rig: the rig description.
        rig_text: the TOML that it was read from.
        training: rows to fit.
        held_out: rows that are not used in any fit.
        clock: function that returns monotonic seconds.
        prior: trust the build tolerances, or estimate their scale.
        refit_base: first fit only the base transform of the held-out set-ups on the held-out rows.
        time_limit_s: time limit of each method, after which its global search stops.
        methods: methods to compare.
        residuals: residuals to compare, if `default` is one of the methods.
        run: seed, workers and progress.

    Raises:
        UnsafeError: the training rows lack a held-out set-up, and `refit_base` is False.
        CalibrationError: no method applies; the error is that of the default method, or else of the last method.
    """
    if not refit_base:
        require_known_setups(training, held_out, REFIT_BASE)
    task = _Task(rig, rig_text, training, held_out, clock, prior, refit_base, time_limit_s)
    results: list[MethodResult] = []
    nominal: MethodResult | None = None
    refused: dict[str, CalibrationError] = {}
    for number, method in enumerate(methods):
        part = run.part(number / len(methods), (number + 1) / len(methods), f"{method}: {{}}")
        try:
            own = task.default(residuals, part) if method == "default" else task.method(method, part)
        except CalibrationError as error:
            refused[method] = error
            results.append(MethodResult(method, reason=" ".join(str(error).split())))
            continue
        nominal = nominal or own[0]
        results.extend(own[1:])
    if nominal is None:
        raise refused.get("default") or list(refused.values())[-1]
    said = [set(result.notes) for result in results if result.method in methods and result.reason is None]
    common = tuple(n for n in dict.fromkeys(n for r in results for n in r.notes) if all(n in notes for notes in said))
    finished = [replace(r, notes=tuple(note for note in r.notes if note not in common)) for r in results]
    return Comparison(rig.name, len(training), len(held_out), (nominal, *finished), common)


@dataclass(frozen=True)
class _Task:
    """The arguments of `compare`; the methods return the result of the nominal model first, then their own."""

    rig: Rig
    rig_text: str
    training: Observations
    held_out: Observations
    clock: Callable[[], float]
    prior: Prior
    refit_base: bool
    time_limit_s: float | None

    def method(self, method: str, run: Run) -> list[MethodResult]:
        """Calibrate by a method and evaluate the model."""
        began = self.clock()
        limited = self._limited(run, began)
        model, trained = calibrate(self.rig, self.rig_text, self.training, prior=self.prior, method=method, run=limited)
        seconds = self.clock() - began
        return self._results(method, trained, evaluate(model, self.held_out, refit_base=self.refit_base), seconds)

    def default(self, residuals: Sequence[str], run: Run) -> list[MethodResult]:
        """Identify by the default method; return the results of the residuals one by one, and the default's last."""
        began = self.clock()
        limited = self._limited(run.part(0.0, 0.2), began)
        model = identify(self.rig, self.rig_text, self.training, prior=self.prior, run=limited)
        identified = self.clock()
        learned = train_residual(model, self.training, run=run.part(0.2, 0.5))
        seconds = self.clock() - began
        evaluation = evaluate(learned, self.held_out, refit_base=self.refit_base)
        nominal, default = self._results("default", evaluate(learned, self.training), evaluation, seconds)
        found = compare_residuals(
            learned,
            self.training,
            self.held_out,
            residuals,
            refit_base=self.refit_base,
            clock=self.clock,
            run=run.part(0.5, 1.0),
        )
        others = [
            replace(r, seconds=None if r.reason else round(identified - began + (r.seconds or 0.0), 3)) for r in found
        ]
        return [nominal, *others, default]

    def _results(self, method: str, trained: Evaluation, evaluation: Evaluation, seconds: float) -> list[MethodResult]:
        before, fitted_before = (sizes_mm(e.errors_mm[NOMINAL]) for e in (evaluation, trained))
        held, fitted = (sizes_mm(e.errors_mm["hybrid"]) for e in (evaluation, trained))
        model = evaluation.model
        adds = families(model) + (() if model.residual is None else (model.residual.learner.kind,))
        noise_mm = instrument_noise_mm(model, evaluation.observations)
        own = MethodResult(method, held, fitted, round(seconds, 3), adds, notes=evaluation.warnings, noise_mm=noise_mm)
        return [MethodResult(NOMINAL, before, fitted_before), own]

    def _limited(self, run: Run, began: float) -> Run:
        """Return the run with a stop at the time limit."""
        limit_s = self.time_limit_s
        return replace(run, should_stop=lambda: limit_s is not None and self.clock() - began > limit_s)


def shared_rows(training: Observations, held_out: Observations, names: tuple[str, str]) -> tuple[int, tuple[str, ...]]:
    """Find held-out rows that are not independent: rows that are training rows, or that share a standstill with them.

    Args:
        training: rows that are fitted.
        held_out: rows that the fit is evaluated on.
        names: names of the training and the held-out data for messages.

    Returns:
        Number of held-out rows that are also training rows, and a sentence about each kind of row that was found.
    """
    joints = tuple(training.joints)
    readings = [_keys(o.setup, *(o.joints[name] for name in joints)) for o in (training, held_out)]
    same = are_among(held_out, row_digests(training))
    pose = np.isin(readings[1], readings[0]) & ~same
    found = []
    first_same, first_pose = (held_out.row_name(int(np.argmax(rows))) for rows in (same, pose))
    if same.any():
        found.append(
            f"{same.sum()} of the {len(held_out)} rows of {names[1]} are rows of {names[0]} as well, the first in "
            f"{first_same}; they make the held-out errors too small"
        )
    if pose.any():
        found.append(
            f"{pose.sum()} of the {len(held_out)} rows of {names[1]} were measured in poses of {names[0]}, all joints "
            f"reading the same, the first in {first_pose}; they share the errors of those readings"
        )
    return int(same.sum()), tuple(found)


def _keys(*columns: NDArray[np.str_] | Floats) -> NDArray[np.str_]:
    """Return (n,) one text for each row; the texts are equal where all columns are equal."""
    return np.array(["\x1f".join(map(repr, row)) for row in zip(*(c.tolist() for c in columns), strict=True)])
