"""Comparison of residuals on the same kinematics and effects: none, incumbents of industry and the paper, our learners.

The incumbents are fitted as in practice: one for each prism, whether it helps or not. Our learners are trained as by
`calibrate --residual`, and left out if they do not help.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.evaluation.evaluation import sizes_mm, statistics
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.numerics.single_thread import one_blas_thread
from calibration.observations import Floats, Observations
from calibration.pipeline.calibrate import rows_to_learn_from, train_residual
from calibration.residual.baselines import THETA, CorrectionTable, PaperRbfn, best_theta
from calibration.residual.features import Features
from calibration.residual.folds import group_labels
from calibration.residual.selection import Kind
from calibration.run_settings import Run

EFFECTS, TABLE, PAPER_NETWORK = "effects", "table", "rbfn-paper"
LEARNERS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if kind not in ("default", "none"))
FIGURES = ("mean_mm", "max_mm", "std_mm", "rms_mm", "training_mean_mm")
RESIDUALS = (EFFECTS, TABLE, PAPER_NETWORK, *LEARNERS)

Labels = NDArray[np.str_]


@dataclass(frozen=True)
class MethodResult:
    """Errors of one method; a method that does not apply to the data has a reason and no errors.

    Attributes:
        method: `nominal`, a method of `calibrate`, or one of `RESIDUALS` on the default kinematics.
        error_mm: (n,) size of the last stage's error on every held-out row.
        training_error_mm: the same on the training rows.
        seconds: duration of the whole calibration including identification; None for the nominal model.
        adds: families of effects and then the residual's learner that the method adds to the kinematics.
        reason: why the method does not apply.
        notes: warnings about data and fit by this method only.
        noise_mm: RMS 3-D error that station and encoders explain on the held-out rows, according to this model.
    """

    method: str
    error_mm: Floats | None = None
    training_error_mm: Floats | None = None
    seconds: float | None = None
    adds: tuple[str, ...] = ()
    reason: str | None = None
    notes: tuple[str, ...] = ()
    noise_mm: float | None = None

    def as_dict(self) -> dict[str, object]:
        """Return a JSON object with the figures in mm, None if the method does not apply."""
        held, trained = self.error_mm, self.training_error_mm
        figures: dict[str, float | None] = dict.fromkeys(FIGURES)
        if held is not None and trained is not None:
            figures |= statistics(held) | {"training_mean_mm": float(trained.mean())}
        return {
            "method": self.method,
            **figures,
            "seconds": self.seconds,
            "adds": list(self.adds),
            "reason": self.reason,
        }


class _Incumbent(Protocol):
    def predict(self, features: Features) -> Floats: ...


_Fit = Callable[[Features, Floats, Labels], _Incumbent]


@one_blas_thread()
def compare_residuals(
    model: CalibratedModel,
    training: Observations,
    held_out: Observations,
    kinds: Sequence[str],
    *,
    refit_base: bool,
    clock: Callable[[], float],
    run: Run,
) -> list[MethodResult]:
    """Train each residual on the model's errors on the training rows, and evaluate it on the held-out rows.

    Args:
        model: model identified on the training rows; its own residual is ignored.
        training: rows to fit.
        held_out: rows to evaluate on.
        kinds: residuals to compare, of `RESIDUALS`.
        refit_base: first fit only the base transform of the held-out set-ups on the held-out rows, for each learner
            separately.
        clock: function that returns monotonic seconds.
        run: seed of the learners, workers and progress.

    Returns:
        A result for each kind; its `seconds` are those of the training alone.
    """
    bare = replace(model, residual=None)
    incumbents = _Incumbents(bare, training, held_out, refit_base=refit_base)
    results, effects = [], families(model)
    for number, kind in enumerate(kinds):
        run.progress(number / len(kinds), f"learning the residual: {kind}")
        began = clock()
        try:
            if kind in (TABLE, PAPER_NETWORK):
                found = incumbents.table() if kind == TABLE else incumbents.paper_network(run.seed)
            else:
                learner: Kind = next((name for name in LEARNERS if name == kind), "none")
                found = _learner(bare, training, held_out, kind, learner, run, refit_base=refit_base)
        except CalibrationError as error:
            found = MethodResult(kind, reason=" ".join(str(error).split()))
        results.append(replace(found, seconds=clock() - began, adds=(*effects, *found.adds)))
    return results


def _learner(
    model: CalibratedModel,
    training: Observations,
    held_out: Observations,
    kind: str,
    learner: Kind,
    run: Run,
    *,
    refit_base: bool,
) -> MethodResult:
    trained = train_residual(model, training, kind=learner, run=run.quiet())
    notes: tuple[str, ...] = ()
    if trained.residual is None and learner != "none":
        notes = (f"left out, so its errors are those of the effects: {trained.residual_reason}",)
    elsewhere = with_refitted_base(trained, held_out) if refit_base else trained
    return MethodResult(
        kind,
        sizes_mm(held_out.position_mm - Predictor.of(elsewhere).predict(held_out).position_mm),
        sizes_mm(training.position_mm - Predictor.of(trained).predict(training).position_mm),
        adds=() if trained.residual is None else (kind,),
        notes=notes,
    )


class _Incumbents:
    """Data that the incumbents are fitted to: features and errors of the rows to learn from, for each prism."""

    def __init__(
        self,
        model: CalibratedModel,
        training: Observations,
        held_out: Observations,
        *,
        refit_base: bool,
    ) -> None:
        good = training.select(rows_to_learn_from(model, training))
        self._good, self._training = _Left.of(model, good), _Left.of(model, training)
        self._groups = group_labels(good)
        self._model, self._rows, self._refit_base = model, held_out, refit_base
        self._judged = with_refitted_base(model, held_out) if refit_base else model
        self._held_out = _Left.of(self._judged, held_out)

    def table(self) -> MethodResult:
        """Return the errors with the correction table."""
        held_out, training = self._errors(lambda seen, left_mm, _: CorrectionTable.fit(seen, left_mm))
        return MethodResult(TABLE, held_out, training, adds=(TABLE,))

    def paper_network(self, seed: int) -> MethodResult:
        """Return the errors with the paper's network; the notes contain the error at the best width."""
        held_out, training = self._errors(lambda seen, left_mm, _: PaperRbfn.fit(seen, left_mm, seed=seed))
        thetas: dict[float, None] = {}

        def best(seen: Features, left_mm: Floats, groups: Labels) -> PaperRbfn:
            theta = best_theta(seen, left_mm, groups, seed=seed) if len(np.unique(groups)) > 1 else THETA
            thetas[theta] = None
            return PaperRbfn.fit(seen, left_mm, theta=theta, seed=seed)

        wider, _ = self._errors(best)
        chosen = ", ".join(f"{theta:g}" for theta in sorted(thetas))
        note = (
            f"at the paper's width theta = {THETA:g} the mean held-out error is {held_out.mean():.3g} mm; at the best "
            f"width of each prism by cross-validation ({chosen}) it is {wider.mean():.3g} mm"
        )
        return MethodResult(PAPER_NETWORK, held_out, training, adds=(PAPER_NETWORK,), notes=(note,))

    def _errors(self, fit: _Fit) -> tuple[Floats, Floats]:
        """Return sizes of the errors on held-out and on training rows, with an incumbent for each prism."""
        fitted = {
            prism: fit(self._good.seen.select(rows), self._good.left_mm[rows], self._groups[rows])
            for prism, rows in self._good.prisms()
        }
        return self._held_out_errors(fitted), sizes_mm(self._training.left_mm - self._training.estimates(fitted))

    def _held_out_errors(self, fitted: Mapping[str, _Incumbent]) -> Floats:
        estimates, rows = self._held_out.estimates(fitted), self._rows
        if not self._refit_base:
            return sizes_mm(self._held_out.left_mm - estimates)
        # As for our learners, the base is fitted to the errors that remain after the incumbents.
        rows = replace(rows, position_mm=rows.position_mm - Predictor.of(self._judged).to_station(rows, estimates))
        return sizes_mm(rows.position_mm - Predictor.of(with_refitted_base(self._model, rows)).effects_mm(rows))


@dataclass(frozen=True)
class _Left:
    """Errors of kinematics and effects in n rows, in the base frame."""

    prism: Labels
    seen: Features
    left_mm: Floats

    @classmethod
    def of(cls, model: CalibratedModel, rows: Observations) -> _Left:
        predictor = Predictor.of(model)
        left_mm = predictor.to_base(rows, rows.position_mm - predictor.effects_mm(rows))
        return cls(rows.prism, predictor.features(rows, ()), left_mm)

    def prisms(self) -> Iterator[tuple[str, NDArray[np.bool_]]]:
        """Return each prism with the (n,) mask of its rows."""
        return ((prism, self.prism == prism) for prism in np.unique(self.prism).tolist())

    def estimates(self, fitted: Mapping[str, _Incumbent]) -> Floats:
        """Return (n, 3) estimates by each prism's incumbent; zero for a prism without an incumbent."""
        estimates = np.zeros_like(self.left_mm)
        for prism, rows in self.prisms():
            if prism in fitted:
                estimates[rows] = fitted[prism].predict(self.seen.select(rows))
        return estimates


def families(model: CalibratedModel) -> tuple[str, ...]:
    """Return the families of a model's effects."""
    return tuple(dict.fromkeys(effect.family for effect in model.effects))
