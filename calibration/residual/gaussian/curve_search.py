"""Search for the curves that explain a residual, by marginal likelihood (evidence).

Terms are added one after another. Each is the one that raises the marginal likelihood most (Tipping and Faul 2003, Fast
marginal likelihood maximisation for sparse Bayesian models; here with a whole curve in place of one basis function).
The search ends when no term raises it by more than the number of candidates makes likely by chance. Amplitude and
length of every curve, the size of the parameters' corrections and the noise jointly maximise the marginal likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, lapack, solve_triangular
from scipy.optimize import minimize

from calibration.observations import Floats
from calibration.residual.gaussian.curves import Curve, Variable, log_amplitudes, products, slope_by_log_length, waves

_WAVES, _PAIR_WAVES = 8, 4
# For a joint's error over its own value: errors of encoders and gears have many periods per turn.
_FINE_WAVES, _FINE_TURN_WAVES = 40, 120
_FINE_DISTINCT = 30
_MOST_TERMS = 40
_PER_ROUND = 6  # terms between two optimisations
_CONSIDERED = 8  # best by a quick estimate, whose gain is computed exactly
_WORTH_A_LOOK = 2.0  # nats of gain, by the quick estimate
_SURE = 5.0  # nats of gain in addition to the logarithm of the number of candidates
_AMPLITUDES = (0.1, 0.3, 1.0)  # of a curve, relative to the spread that is not explained yet
_LENGTHS, _FINE_LENGTHS = (0.1, 0.5), (0.02, 0.15)  # relative to a radian of the scaled variable
_AMPLITUDE_STEPS, _LENGTH_STEPS = (0.1, 0.3, 1.0, 3.0), (0.3, 1.0, 3.0)  # about the quick estimate's best
_USUAL_LOG_LENGTH, _LOG_LENGTH_SPREAD = math.log(0.3), 1.5
_LENGTH_LIMITS = (math.log(0.005), math.log(5.0))
_FREEDOM, _WIDEST = 7.0, 3.0  # range of log amplitudes and log noise below and above the log spread of the residual
_ITERATIONS, _LAST_ITERATIONS = 10, 40
_ENOUGH = 0.01  # nats; a step that raises the evidence by less is the last
_LEAST = 1e-12
_ROUNDING = 1e-12


class Rows:
    """Rows with the design matrices of a linear model.

    Attributes:
        axes: variables.
        scaled: (n, axes) scaled values of the variables.
        levers: (n, 3, l) derivatives by the joints, then by the base frame's axes, mm per deg or mm.
        parameters: (n, 3, p) derivatives by the parameters of the kinematics, each scaled to an RMS of 1, or 0.
        target_mm: (n, 3) residuals.
    """

    def __init__(
        self, axes: Sequence[Variable], scaled: Floats, levers: Floats, parameters: Floats, target_mm: Floats
    ) -> None:
        self.axes, self.scaled, self.levers, self.parameters = axes, scaled, levers, parameters
        self.target_mm = target_mm
        self._waves: dict[tuple[tuple[int, ...], tuple[int, ...]], tuple[Floats, Floats]] = {}

    def waves(self, axes: tuple[int, ...], counts: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Return the (n, m) eigenfunctions over one or two variables and their (m,) squared frequencies."""
        found = self._waves.get((axes, counts))
        if found is None:
            values, frequency = waves(self.axes[axes[0]], self.scaled[:, axes[0]], counts[0])
            square = frequency**2
            if len(axes) == 2:
                others, frequency = waves(self.axes[axes[1]], self.scaled[:, axes[1]], counts[1])
                values, square = products(values, others), np.add.outer(square, frequency**2).ravel()
            found = self._waves[axes, counts] = values, square
        return found

    def columns(self, curve: Curve) -> Floats:
        """Return the (3 n, m) displacements by unit weights of a curve."""
        values, _ = self.waves(curve.axes, curve.counts)
        return np.asarray((self.levers[:, :, curve.lever, None] * values[:, None, :]).reshape(3 * len(values), -1))

    def matrix(self, curves: Sequence[Curve]) -> Floats:
        """Return the (3 n, p + m) design matrix: parameters, then curves."""
        parameters = self.parameters.reshape(3 * len(self.scaled), -1)
        return np.hstack([parameters, *(self.columns(curve) for curve in curves)])


@dataclass(frozen=True)
class _Candidates:
    """Curves over the same variables, one for each of several levers."""

    axes: tuple[int, ...]
    counts: tuple[int, ...]
    levers: tuple[int, ...]
    log_lengths: tuple[float, ...]


@dataclass(frozen=True)
class _Guess:
    """A candidate with its best amplitude and length, and its gain in log evidence."""

    gain: float
    curve: Curve
    log_amplitude: float
    log_length: float


@dataclass(frozen=True)
class Terms:
    """Curves with the logarithms of their amplitudes and lengths, of the noise and of the size of the corrections."""

    curves: tuple[Curve, ...]
    log_amplitude: tuple[float, ...]
    log_length: tuple[float, ...]
    log_correction: float
    log_sigma: float


class CurveSearch:
    """Search for curves that explain the residual of some rows.

    Args:
        rows: the rows.
        own: axis of its own value, by joint.
        start: terms found for similar rows. The amplitudes of those without evidence in these rows become negligible.

    Attributes:
        curves: curves found so far.
    """

    def __init__(self, rows: Rows, own: Mapping[int, int], start: Terms | None = None) -> None:
        self.curves: list[Curve] = []
        self._rows = rows
        self._y = rows.target_mm.ravel()
        self._lever_square = (rows.levers**2).sum(axis=1)
        self._lever_size = np.sqrt(self._lever_square.mean(axis=0))
        self._distinct = [len(np.unique(column[np.isfinite(column)])) for column in rows.scaled.T]
        self._candidates = self._first_candidates(own)
        self._matrix = rows.matrix(())
        self._p = self._matrix.shape[1]
        self._gram, self._moment = self._matrix.T @ self._matrix, self._matrix.T @ self._y
        self._square_frequency: list[Floats] = []
        # Logarithms of the target's spread, the size of the parameters' corrections, noise, amplitudes and lengths.
        self._log_spread = math.log(max(float(self._y.std()), _LEAST))
        self._log_correction, self._log_sigma = self._log_spread - 1.0, self._log_spread
        self._log_amplitude: list[float] = []
        self._log_length: list[float] = []
        self._information: dict[_Candidates, Floats] = {}
        if start is not None:
            for curve, amplitude, length in zip(start.curves, start.log_amplitude, start.log_length, strict=True):
                self._take(_Guess(0.0, curve, amplitude, length))
            self._log_correction, self._log_sigma = start.log_correction, start.log_sigma

    def run(self) -> None:
        """Add terms until no candidate has significant evidence."""
        if self.curves:
            self._optimise(_LAST_ITERATIONS)
        begun = len(self.curves)
        while self._take_some():
            self._optimise(_ITERATIONS)
        if len(self.curves) > begun:
            self._optimise(_LAST_ITERATIONS)

    @property
    def terms(self) -> Terms:
        """Return the curves that were found."""
        amplitude, length = tuple(self._log_amplitude), tuple(self._log_length)
        return Terms(tuple(self.curves), amplitude, length, self._log_correction, self._log_sigma)

    def weights(self, gram: Floats, moment: Floats) -> Floats:
        """Return (p + m,) corrections of the parameters, then weights of the curves, for other rows.

        Args:
            gram: (p + m, p + m) M'M with M of `Rows.matrix`.
            moment: (p + m,) M'y.
        """
        sd, variance = self._prior(self._theta), math.exp(2.0 * self._log_sigma)
        factor = _factor(gram, sd, variance)
        return sd * _solve(factor, sd * moment / variance)

    # ---- candidates --------------------------------------------------------------------------------------------------

    def _first_candidates(self, own: Mapping[int, int]) -> list[_Candidates]:
        moved = tuple(np.flatnonzero(self._lever_size > _LEAST).tolist())
        found = []
        for axis in range(len(self._rows.axes)):
            count = self._count(axis, _WAVES)
            if count:
                found.append(_Candidates((axis,), (count,), moved, tuple(map(math.log, _LENGTHS))))
        for joint, axis in own.items():
            if joint in moved and self._distinct[axis] > _FINE_DISTINCT:
                most = _FINE_TURN_WAVES if self._rows.axes[axis].is_periodic else _FINE_WAVES
                count = self._count(axis, min(most, len(self._rows.scaled)))
                found.append(_Candidates((axis,), (count,), (joint,), tuple(map(math.log, _FINE_LENGTHS))))
        return found

    def _count(self, axis: int, most: int) -> int:
        """Return the number of waves of a variable: no more than its distinct values, and even if it is periodic."""
        count = min(most, self._distinct[axis]) if self._distinct[axis] > 1 else 0
        return count - count % 2 if self._rows.axes[axis].is_periodic else count

    def _add_pairs(self, curve: Curve) -> None:
        """Add products of a curve's variable with every other variable to the candidates."""
        if len(curve.axes) == 2:
            return
        known = {(c.axes, lever) for c in self._candidates for lever in c.levers}
        for other in range(len(self._rows.axes)):
            axes = (min(curve.axes[0], other), max(curve.axes[0], other))
            counts = (self._count(axes[0], _PAIR_WAVES), self._count(axes[1], _PAIR_WAVES))
            if axes[0] != axes[1] and all(counts) and (axes, curve.lever) not in known:
                self._candidates.append(_Candidates(axes, counts, (curve.lever,), tuple(map(math.log, _LENGTHS))))

    # ---- one round ---------------------------------------------------------------------------------------------------

    def _take_some(self) -> int:
        """Add up to `_PER_ROUND` terms, with the hyperparameters of the others fixed; return the number added."""
        taken = 0
        while taken < _PER_ROUND and len(self.curves) < _MOST_TERMS:
            sd, variance = self._prior(self._theta), math.exp(2.0 * self._log_sigma)
            factor = _factor(self._gram, sd, variance)
            left = self._y - self._matrix @ (sd * _solve(factor, sd * self._moment / variance))
            quick = sorted(self._quick_guesses(left, variance), key=lambda guess: -guess.gain)[:_CONSIDERED]
            exact = [self._weigh(guess, left, sd, factor, variance) for guess in quick if guess.gain > _WORTH_A_LOOK]
            best = max(exact, key=lambda guess: guess.gain, default=None)
            number = sum(len(candidates.levers) for candidates in self._candidates)
            if best is None or best.gain < _SURE + math.log(number):
                break
            self._take(best)
            taken += 1
        return taken

    def _quick_guesses(self, left: Floats, variance: float) -> list[_Guess]:
        """Estimate each candidate's gain, assuming its waves are independent of each other and of the terms so far."""
        by_lever = np.einsum("nk,nkl->nl", left.reshape(-1, 3), self._rows.levers)
        spread = float(left.std())
        found = []
        taken = {(c.axes, c.counts, c.lever) for c in self.curves}
        for candidates in self._candidates:
            levers = [v for v in candidates.levers if (candidates.axes, candidates.counts, v) not in taken]
            if not levers:
                continue
            values, square = self._rows.waves(candidates.axes, candidates.counts)
            score = values.T @ by_lever[:, levers] / variance
            information = self._squares(candidates)[:, levers] / variance
            best = np.full(len(levers), -np.inf)
            amplitude, length = np.zeros(len(levers)), np.zeros(len(levers))
            for log_length in candidates.log_lengths:
                shape = np.exp(2.0 * log_amplitudes(square, log_length))[:, None]
                for share in _AMPLITUDES:
                    size = share * spread / self._lever_size[levers]
                    prior = shape * size**2
                    with_prior = 1.0 + prior * information
                    gain = 0.5 * (score**2 * prior / with_prior - np.log(with_prior)).sum(axis=0)
                    better = gain > best
                    best = np.where(better, gain, best)
                    amplitude, length = np.where(better, np.log(size), amplitude), np.where(better, log_length, length)
            found += [
                _Guess(float(g), Curve(lever, candidates.axes, candidates.counts), float(a), float(k))
                for g, lever, a, k in zip(best, levers, amplitude, length, strict=True)
            ]
        return found

    def _squares(self, candidates: _Candidates) -> Floats:
        """Return (m, l) sums of squares of each wave at each lever; these do not depend on the terms so far."""
        if candidates not in self._information:
            values, _ = self._rows.waves(candidates.axes, candidates.counts)
            self._information[candidates] = (values**2).T @ self._lever_square
        return self._information[candidates]

    def _weigh(self, guess: _Guess, left: Floats, sd: Floats, factor: Floats, variance: float) -> _Guess:
        """Compute the gain in log evidence, given the terms so far, at the best amplitude and length near the guess."""
        columns = self._rows.columns(guess.curve)
        _, square = self._rows.waves(guess.curve.axes, guess.curve.counts)
        shared = solve_triangular(factor, sd[:, None] * (self._matrix.T @ columns), lower=True) / variance
        information = columns.T @ columns / variance - shared.T @ shared
        score = columns.T @ left / variance
        best = guess
        best_gain = -math.inf
        for length_step in _LENGTH_STEPS:
            log_length = guess.log_length + math.log(length_step)
            shape = log_amplitudes(square, log_length)
            for amplitude_step in _AMPLITUDE_STEPS:
                log_amplitude = guess.log_amplitude + math.log(amplitude_step)
                prior = np.exp(log_amplitude + shape)
                inner, failed = lapack.dpotrf(np.eye(len(prior)) + information * np.outer(prior, prior), lower=1)
                if failed:
                    continue
                whitened = solve_triangular(inner, prior * score, lower=True)
                gain = 0.5 * float(whitened @ whitened) - float(np.log(np.diag(inner)).sum())
                if gain > best_gain:
                    best_gain, best = gain, _Guess(gain, guess.curve, log_amplitude, log_length)
        return best

    def _take(self, guess: _Guess) -> None:
        columns = self._rows.columns(guess.curve)
        _, square = self._rows.waves(guess.curve.axes, guess.curve.counts)
        across = self._matrix.T @ columns
        self._gram = np.block([[self._gram, across], [across.T, columns.T @ columns]])
        self._moment = np.concatenate([self._moment, columns.T @ self._y])
        self._matrix = np.hstack([self._matrix, columns])
        self.curves.append(guess.curve)
        self._square_frequency.append(square)
        self._log_amplitude.append(guess.log_amplitude)
        self._log_length.append(guess.log_length)
        self._add_pairs(guess.curve)

    # ---- marginal likelihood -----------------------------------------------------------------------------------------

    @property
    def _theta(self) -> Floats:
        return np.array([self._log_correction, *self._log_amplitude, *self._log_length])

    def _prior(self, theta: Floats) -> Floats:
        """Return (p + m,) prior standard deviations of the parameters' corrections and of the weights."""
        terms = len(self.curves)
        amplitude, length = theta[1 : 1 + terms], theta[1 + terms : 1 + 2 * terms]
        parts = [
            np.exp(a + log_amplitudes(square, k))
            for a, k, square in zip(amplitude, length, self._square_frequency, strict=True)
        ]
        return np.concatenate([np.full(self._p, math.exp(theta[0])), *parts])

    def _optimise(self, iterations: int) -> None:
        """Maximise the marginal likelihood over amplitudes, lengths, noise and the size of the corrections."""
        terms = len(self.curves)
        start = np.append(self._theta, self._log_sigma)
        total, rows = float(self._y @ self._y), len(self._y)
        term = np.repeat(np.arange(terms), [len(square) for square in self._square_frequency])

        def cost(theta: Floats) -> tuple[float, Floats]:
            sd, variance = self._prior(theta), math.exp(2.0 * theta[-1])
            factor = _factor(self._gram, sd, variance)
            mean = _solve(factor, sd * self._moment / variance)
            spread = np.diag(lapack.dpotri(factor, lower=1)[0])
            explained = float(mean @ (sd * self._moment)) / variance
            length = theta[1 + terms : 1 + 2 * terms]
            off = (length - _USUAL_LOG_LENGTH) / _LOG_LENGTH_SPREAD
            value = 0.5 * (total / variance - explained) + float(np.log(np.diag(factor)).sum())
            value += rows * theta[-1] + 0.5 * float(off @ off)
            by_log_sd = 1.0 - spread - mean**2
            slope = np.concatenate(
                [slope_by_log_length(s, k) for s, k in zip(self._square_frequency, length, strict=True)]
            )
            by_weight = by_log_sd[self._p :]
            by_length = np.bincount(term, by_weight * slope, terms) + off / _LOG_LENGTH_SPREAD
            fitted = sd * mean
            squares = total - 2.0 * float(fitted @ self._moment) + float(fitted @ self._gram @ fitted)
            by_sigma = rows - (len(sd) - float(spread.sum())) - squares / variance
            correction = float(by_log_sd[: self._p].sum())
            return value, np.concatenate([[correction], np.bincount(term, by_weight, terms), by_length, [by_sigma]])

        widest = [self._log_spread - math.log(self._lever_size[curve.lever]) for curve in self.curves]
        bounds = [
            (self._log_spread - _FREEDOM, self._log_spread + _WIDEST),
            *((at - _FREEDOM, at + _WIDEST) for at in widest),
            *(terms * [_LENGTH_LIMITS]),
            (self._log_spread - _FREEDOM, self._log_spread + _WIDEST),
        ]
        start = np.clip(start, *np.transpose(bounds))
        # SciPy's tolerance is relative to the cost, which is many thousands.
        enough = _ENOUGH / max(abs(cost(start)[0]), 1.0)
        found = minimize(
            cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations, "ftol": enough}
        ).x
        self._log_correction, self._log_sigma = float(found[0]), float(found[-1])
        self._log_amplitude = found[1 : 1 + terms].tolist()
        self._log_length = found[1 + terms : 1 + 2 * terms].tolist()


def _factor(gram: Floats, sd: Floats, variance: float) -> Floats:
    """Return the lower Cholesky factor of 1 + S M'M S / variance, where S is the diagonal matrix of `sd`."""
    inside = np.multiply(gram, sd[:, None], order="F")
    inside *= sd / variance
    inside[np.diag_indices_from(inside)] += 1.0 + _ROUNDING * float(np.diag(inside).max(initial=0.0))
    factor, failed = lapack.dpotrf(inside, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the normal matrix of the curves is not positive definite")
    return np.asarray(factor, dtype=np.float64)


def _solve(factor: Floats, right: Floats) -> Floats:
    """Solve a linear system with the lower Cholesky factor of its matrix."""
    return np.asarray(cho_solve((factor, True), right, check_finite=False))
