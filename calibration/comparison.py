"""Every method, and every residual on the default's kinematics, fitted and judged on the same rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError, UnsafeError
from calibration.evaluation import Evaluation, evaluate
from calibration.identification.refinement import Prior
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.pipeline import calibrate, identify, train_residual
from calibration.residual_comparison import RESIDUALS, compare_residuals
from calibration.rig import Rig

Progress = Callable[[float, str], None]

NOMINAL = "nominal"
METHODS = ("km", "skcm", "rbf-tcm", "default", "pde-paper")  # in the order of the table, below the nominal model
FIGURES = ("mean_mm", "max_mm", "std_mm", "rms_mm", "training_mean_mm")


@dataclass(frozen=True)
class MethodResult:
    """What one method makes of the data; a method that refuses them has a reason and no errors.

    Attributes:
        method: `nominal`, a name of `pipeline.calibrate`'s methods, or of `RESIDUALS` on the default's kinematics.
        error_mm: (n,) size of the last stage's error on every held-out row.
        training_error_mm: the same on the training rows.
        seconds: for the whole calibration with identification; None for the nominal model, which comes with any method.
        adds: what it puts on top of the kinematics: families of effects, then the residual's learner.
        reason: why the method does not apply.
        notes: what this method alone has to say of data and fit.
    """

    method: str
    error_mm: Floats | None = None
    training_error_mm: Floats | None = None
    seconds: float | None = None
    adds: tuple[str, ...] = ()
    reason: str | None = None
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """For JSON: the figures in mm, None where the method does not apply."""
        held, trained = self.error_mm, self.training_error_mm
        if held is None or trained is None:
            figures: dict[str, float | None] = dict.fromkeys(FIGURES)
        else:
            figures = {
                "mean_mm": float(held.mean()),
                "max_mm": float(held.max()),
                "std_mm": float(held.std()),
                "rms_mm": float(np.sqrt((held**2).mean())),
                "training_mean_mm": float(trained.mean()),
            }
        return {
            "method": self.method,
            **figures,
            "seconds": self.seconds,
            "adds": list(self.adds),
            "reason": self.reason,
        }


@dataclass(frozen=True)
class Comparison:
    """All methods side by side.

    Attributes:
        rig: name.
        training, held_out: how many rows.
        results: the nominal model first, then `METHODS`, with `RESIDUALS` above the default.
        warnings: what all methods that apply have to say of data and fit.
    """

    rig: str
    training: int
    held_out: int
    results: tuple[MethodResult, ...]
    warnings: tuple[str, ...]

    def lowest(self, figure: str) -> frozenset[str]:
        """Methods with the lowest value of one of `FIGURES`."""
        values = {str(row["method"]): row[figure] for row in (result.as_dict() for result in self.results)}
        known = {method: value for method, value in values.items() if isinstance(value, float)}
        return frozenset(method for method, value in known.items() if value == min(known.values()))

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "rig": self.rig,
            "n": self.training,
            "n_holdout": self.held_out,
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
    seed: int = 0,
    prior: Prior = "recalibration",
    refit_base: bool = False,
    time_limit_s: float | None = None,
    methods: Sequence[str] = METHODS,
    residuals: Sequence[str] = RESIDUALS,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Calibrate by every method and evaluate each one's last stage on the held-out rows.

    The default method identifies once; every one of `RESIDUALS` is then learned from what this one model leaves.

    Args:
        rig, rig_text: the rig description and the TOML it was read from.
        training: rows to fit.
        held_out: rows that no method sees.
        clock: monotonic seconds.
        seed: of everything random.
        prior: trust the build tolerances, or estimate their scale.
        refit_base: fit the base transform of the held-out set-ups, and nothing else, on the held-out rows first.
        time_limit_s: ends a method's global search.
        methods: which.
        residuals: which take part where `default` does.
        executor: runs the searches; threads by default.
        progress: told (share done, what is going on).

    Raises:
        UnsafeError: a held-out set-up that the training rows lack, without `refit_base`.
        CalibrationError: what the default method says (or else the last one), where no method applies.
    """
    require_known_setups(training, held_out, refit_base=refit_base)
    task = _Task(rig, rig_text, training, held_out, clock, seed, prior, refit_base, time_limit_s, executor)
    results: list[MethodResult] = []
    nominal: MethodResult | None = None
    refused: dict[str, CalibrationError] = {}
    for number, method in enumerate(methods):

        def report(share: float, what: str, number: int = number, method: str = method) -> None:
            if progress is not None:
                progress((number + share) / len(methods), f"{method}: {what}")

        try:
            own = task.default(residuals, report) if method == "default" else task.method(method, report)
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
    """What `compare` was given; its methods return the nominal model's result first, then their own."""

    rig: Rig
    rig_text: str
    training: Observations
    held_out: Observations
    clock: Callable[[], float]
    seed: int
    prior: Prior
    refit_base: bool
    time_limit_s: float | None
    executor: Executor | None

    def method(self, method: str, report: Progress) -> list[MethodResult]:
        """Calibrate by a method, and evaluate."""
        began = self.clock()
        model, trained = calibrate(
            self.rig,
            self.rig_text,
            self.training,
            seed=self.seed,
            prior=self.prior,
            method=method,
            executor=self.executor,
            progress=report,
            should_stop=lambda: self._is_late(began),
        )
        seconds = self.clock() - began
        return self._results(method, trained, evaluate(model, self.held_out, refit_base=self.refit_base), seconds)

    def default(self, residuals: Sequence[str], report: Progress) -> list[MethodResult]:
        """Identify by the default method, then train the residuals one by one, and the default's last."""
        began = self.clock()
        model = identify(
            self.rig,
            self.rig_text,
            self.training,
            seed=self.seed,
            prior=self.prior,
            executor=self.executor,
            progress=lambda share, what: report(0.2 * share, what),
            should_stop=lambda: self._is_late(began),
        )
        identified = self.clock()
        learned = train_residual(
            model,
            self.training,
            seed=self.seed,
            executor=self.executor,
            progress=lambda share, what: report(0.2 + 0.3 * share, what),
        )
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
            seed=self.seed,
            executor=self.executor,
            progress=lambda share, what: report(0.5 + 0.5 * share, what),
        )
        families = _families(model)
        others = [
            MethodResult(
                r.kind,
                r.held_out_mm,
                r.training_mm,
                None if r.reason else round(identified - began + r.seconds, 3),
                families if r.adds is None else (*families, r.adds),
                r.reason,
                r.notes,
            )
            for r in found
        ]
        return [nominal, *others, default]

    def _results(self, method: str, trained: Evaluation, evaluation: Evaluation, seconds: float) -> list[MethodResult]:
        nominal = MethodResult(NOMINAL, _norms(evaluation, NOMINAL), _norms(trained, NOMINAL))
        held, fitted = (_norms(e, "hybrid") for e in (evaluation, trained))
        adds = _adds(evaluation.model)
        return [nominal, MethodResult(method, held, fitted, round(seconds, 3), adds, notes=evaluation.warnings)]

    def _is_late(self, began: float) -> bool:
        return self.time_limit_s is not None and self.clock() - began > self.time_limit_s


def require_known_setups(training: Observations, held_out: Observations, *, refit_base: bool) -> None:
    """Refuse held-out rows from a set-up whose base no training row tells.

    Raises:
        UnsafeError: there is such a set-up, and `refit_base` is not set.
    """
    unknown = sorted(set(held_out.setup.tolist()) - set(training.setup.tolist()))
    if unknown and not refit_base:
        known = ", ".join(map(repr, sorted(set(training.setup.tolist()))))
        raise UnsafeError(
            f"set-up {unknown[0]!r} of the held-out rows is not among those of the training rows ({known}); its base "
            f"transform would be a guess. Use --refit-base to fit it on the held-out fixes"
        )


def shared_rows(training: Observations, held_out: Observations, names: tuple[str, str]) -> tuple[str, ...]:
    """Sentences about held-out rows that are no test, because the training rows have them or their standstill.

    Args:
        training, held_out: the rows.
        names: what to call either of them.
    """
    joints = tuple(training.joints)
    readings = [_keys(o.setup, *(o.joints[name] for name in joints)) for o in (training, held_out)]
    rows = [_keys(key, o.prism, *o.position_mm.T) for key, o in zip(readings, (training, held_out), strict=True)]
    same = np.isin(rows[1], rows[0])
    pose = np.isin(readings[1], readings[0]) & ~same
    found = []
    if same.any():
        found.append(
            f"{same.sum()} of the {len(held_out)} rows of {names[1]} are rows of {names[0]} as well (the first is row "
            f"{int(np.argmax(same)) + 1}): the held-out figures are too good by these"
        )
    if pose.any():
        found.append(
            f"{pose.sum()} of the {len(held_out)} rows of {names[1]} were measured in poses of {names[0]}, all joints "
            f"reading the same (the first is row {int(np.argmax(pose)) + 1}): they share the errors of those readings"
        )
    return tuple(found)


def _keys(*columns: NDArray[np.str_] | Floats) -> NDArray[np.str_]:
    """(n,) one text for each row; equal where all columns are."""
    return np.array(["\x1f".join(map(repr, row)) for row in zip(*(c.tolist() for c in columns), strict=True)])


def _families(model: CalibratedModel) -> tuple[str, ...]:
    return tuple(dict.fromkeys(effect.family for effect in model.effects))


def _adds(model: CalibratedModel) -> tuple[str, ...]:
    return _families(model) + (() if model.residual is None else (model.residual.learner.kind,))


def _norms(evaluation: Evaluation, stage: str) -> Floats:
    return np.asarray(np.linalg.norm(evaluation.errors_mm[stage], axis=1))
