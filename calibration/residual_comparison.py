"""Every residual on the same kinematics and effects: nothing, the field's and the paper's incumbents, our learners.

The incumbents are fitted as they are used, one for each prism and whether they help or not. Our learners are trained as
`calibrate --residual` trains them, and left out where they do not help.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.pipeline import rows_to_learn_from, train_residual
from calibration.rebase import with_refitted_base
from calibration.residual.correction_table import CorrectionTable
from calibration.residual.features import Features
from calibration.residual.folds import group_labels
from calibration.residual.hybrid import Kind
from calibration.residual.paper_rbfn import THETA, PaperRbfn, best_theta
from calibration.single_thread import one_blas_thread

EFFECTS, TABLE, PAPER_NETWORK = "effects", "table", "rbfn-paper"
LEARNERS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if kind not in ("default", "none"))
RESIDUALS = (EFFECTS, TABLE, PAPER_NETWORK, *LEARNERS)

Labels = NDArray[np.str_]


@dataclass(frozen=True)
class ResidualResult:
    """What one residual makes of the data.

    Attributes:
        kind: one of `RESIDUALS`.
        held_out_mm, training_mm: (n,) sizes of the errors; None where it cannot be trained, and `reason` says why.
        seconds: for training.
        adds: the learner that is on top of kinematics and effects, if any.
        reason: why there are no errors.
        notes: what is to be said of it.
    """

    kind: str
    held_out_mm: Floats | None = None
    training_mm: Floats | None = None
    seconds: float = 0.0
    adds: str | None = None
    reason: str | None = None
    notes: tuple[str, ...] = ()


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
    seed: int,
    executor: Executor | None,
    progress: Callable[[float, str], None],
) -> list[ResidualResult]:
    """Train each on what the model leaves of the training rows, and look at the held-out ones.

    Args:
        model: identified on the training rows; its own residual is left aside.
        training, held_out: rows.
        kinds: which of `RESIDUALS`.
        refit_base: fit the base transform of the held-out set-ups, and nothing else, on the held-out rows first, for
            each learner by itself.
        clock: monotonic seconds.
        seed: of the learners.
        executor: runs what is independent; threads by default.
        progress: told (share done, what is going on).
    """
    bare = replace(model, residual=None)
    incumbents = _Incumbents(bare, training, held_out, refit_base=refit_base)
    results = []
    for number, kind in enumerate(kinds):
        progress(number / len(kinds), f"learning the residual: {kind}")
        began = clock()
        try:
            if kind in (TABLE, PAPER_NETWORK):
                found = incumbents.table() if kind == TABLE else incumbents.paper_network(seed)
            else:
                learner: Kind = next((name for name in LEARNERS if name == kind), "none")
                found = _learner(bare, training, held_out, kind, learner, seed, executor, refit_base=refit_base)
        except CalibrationError as error:
            found = ResidualResult(kind, reason=" ".join(str(error).split()))
        results.append(replace(found, seconds=clock() - began))
    return results


def _learner(
    model: CalibratedModel,
    training: Observations,
    held_out: Observations,
    kind: str,
    learner: Kind,
    seed: int,
    executor: Executor | None,
    *,
    refit_base: bool,
) -> ResidualResult:
    trained = train_residual(model, training, kind=learner, seed=seed, executor=executor)
    notes: tuple[str, ...] = ()
    if trained.residual is None and learner != "none":
        notes = (f"left out, its errors are those of the effects: {trained.residual_reason}",)
    elsewhere = with_refitted_base(trained, held_out) if refit_base else trained
    return ResidualResult(
        kind,
        _size(held_out.position_mm - elsewhere.predict(held_out).position_mm),
        _size(training.position_mm - trained.predict(training).position_mm),
        adds=None if trained.residual is None else kind,
        notes=notes,
    )


class _Incumbents:
    """What the incumbents are fitted to: for each prism, features and errors of the rows to learn from."""

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

    def table(self) -> ResidualResult:
        """The correction table."""
        held_out, training = self._errors(lambda seen, left_mm, _: CorrectionTable.fit(seen, left_mm))
        return ResidualResult(TABLE, held_out, training, adds=TABLE)

    def paper_network(self, seed: int) -> ResidualResult:
        """The paper's network; what the best width would make of it is in the notes."""
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
            f"for each prism by cross-validation ({chosen}) it is {wider.mean():.3g} mm"
        )
        return ResidualResult(PAPER_NETWORK, held_out, training, adds=PAPER_NETWORK, notes=(note,))

    def _errors(self, fit: _Fit) -> tuple[Floats, Floats]:
        """Sizes of the errors on held-out and on training rows, with an incumbent for each prism."""
        fitted = {
            prism: fit(self._good.seen.select(rows), self._good.left_mm[rows], self._groups[rows])
            for prism, rows in self._good.prisms()
        }
        return self._held_out_errors(fitted), _size(self._training.left_mm - self._training.estimates(fitted))

    def _held_out_errors(self, fitted: Mapping[str, _Incumbent]) -> Floats:
        estimates, rows = self._held_out.estimates(fitted), self._rows
        if not self._refit_base:
            return _size(self._held_out.left_mm - estimates)
        # As for our learners, a base is fitted to what the incumbents leave.
        rows = replace(rows, position_mm=rows.position_mm - self._judged.to_station(rows, estimates))
        return _size(rows.position_mm - with_refitted_base(self._model, rows).effects_mm(rows))


@dataclass(frozen=True)
class _Left:
    """What kinematics and effects leave of n rows, in the base frame."""

    prism: Labels
    seen: Features
    left_mm: Floats

    @classmethod
    def of(cls, model: CalibratedModel, rows: Observations) -> _Left:
        left_mm = model.to_base(rows, rows.position_mm - model.effects_mm(rows))
        return cls(rows.prism, model.residual_features(rows, ()), left_mm)

    def prisms(self) -> Iterator[tuple[str, NDArray[np.bool_]]]:
        """Each prism with its rows."""
        return ((prism, self.prism == prism) for prism in np.unique(self.prism).tolist())

    def estimates(self, fitted: Mapping[str, _Incumbent]) -> Floats:
        """(n, 3) by each prism's incumbent; zero for a prism without one."""
        estimates = np.zeros_like(self.left_mm)
        for prism, rows in self.prisms():
            if prism in fitted:
                estimates[rows] = fitted[prism].predict(self.seen.select(rows))
        return estimates


def _size(error_mm: Floats) -> Floats:
    return np.asarray(np.linalg.norm(error_mm, axis=1))
