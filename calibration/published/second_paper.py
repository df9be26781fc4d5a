"""The second paper's identifications (ICIC 2020): plain least squares without priors or robust weights.

In addition to the paper, a step that would increase the sum of squares is halved until it does not.

KM iterates d_phi = (J'J)^-1 J' dP over the kinematic parameters (Eqs. 5-8). SKCM adds one linear compliance for each
joint with a torque, d_theta = tau C and so dP = J_e tau C (Eqs. 16, 17), and solves for both together. If J'J is
singular, the paper removes redundant parameters by hand. Here the directions that the data do not determine are found
once, on the nominal model, and held: every step is the shortest of all equally good ones. RBF-TCM is KM with the
network of `calibration.residual.rbf.torque_network` in addition.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.columns import EffectColumns, joined
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.errors import CalibrationError, DataError, UnsafeError
from calibration.gap.adoption import Adopted
from calibration.identification.checks import different_fixes, refuse_turning, rms_left_mm, rms_tolerated_mm
from calibration.identification.identifiability import identifiability
from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples
from calibration.identification.solve import Solution, place
from calibration.identification.start import refuse_mirrored
from calibration.kinematics.chain import Chain, Linearisation
from calibration.kinematics.torques import gravity_torques, loaded_joints
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig
from calibration.run_settings import Run

_SEEN = 1e-6  # singular value relative to the largest, for columns of equal length; redundant parameters are at 1e-16
_ROUNDS = 100
_HALVINGS = 12
_CONVERGED = 1e-4  # converged if a step changes the positions by less than this share of the error


@dataclass(frozen=True)
class _State:
    """Parameters and coefficients `z` (p + k,), and the linearised model of the samples at `z`."""

    z: Floats
    additions: EffectColumns
    lin: Linearisation
    error: Floats  # (m, 3) measured minus modelled

    @property
    def squares(self) -> float:
        return float((self.error**2).sum())

    def columns(self) -> Floats:
        """Return (3 m, p + k) derivatives of the positions."""
        added = self.additions.moved_mm(self.lin.joint_jacobian)
        both: Floats = np.concatenate([self.lin.jacobian, added], axis=2).reshape(3 * len(self.error), -1)
        return both


def km(rig: Rig, observations: Observations, run: Run) -> Solution:
    """Identify kinematic parameters by iterated least squares (Eqs. 5-8).

    Args:
        rig: the rig description.
        observations: rows with positions.
        run: receives the progress.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: too few fixes, a base that cannot be determined, mirrored coordinates, or data of a different rig.
        CalibrationError: the iteration diverged beyond the range of numbers.
    """
    run.progress(0.0, "placing the base")
    chain, samples, start = place(rig, observations)
    refuse_mirrored(chain, samples)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    refuse_turning(chain, samples, nominal.x)
    run.progress(0.2, "iterating least squares")
    fit, rounds = _iterated(
        chain, samples, nominal.x, _Compliances(samples, EffectContext(chain, nominal.x, observations))
    )
    tolerated_mm = rms_tolerated_mm(chain, samples, nominal)
    left_mm = rms_left_mm(chain, samples, fit.x)
    if left_mm > tolerated_mm:
        raise UnsafeError(
            f"after plain least squares the error is still {left_mm:.0f} mm RMS, but this rig's build tolerances "
            f"explain only {tolerated_mm:.0f} mm even before any fit: the method is not suitable for these data; use "
            f"--method default, which can fit them or reports what is wrong with them"
        )
    run.progress(0.9, "checking what the data determine")
    seen = identifiability(chain, samples, fit.x, fit.excess_variance)
    words = f"plain least squares from the nominal model, {rounds} rounds"
    return Solution(chain, samples, nominal, fit, seen, words, tolerated_mm, has_priors=False)


def skcm(rig: Rig, observations: Observations, run: Run) -> Adopted:
    """Identify kinematic parameters together with one compliance for each joint with a torque (Eqs. 16, 17).

    Args:
        rig: the rig description.
        observations: rows with positions.
        run: receives the progress.

    Returns:
        The joint fit with its effects; its `geometric` is the fit of `km`.

    Raises:
        DataError: as for `require_torques`, or a prism that the rig lacks.
        UnsafeError, CalibrationError: as for `km`.
    """
    require_torques(rig, observations, "skcm")
    solution = km(rig, observations, run.part(0.0, 0.7))
    chain, samples, nominal = solution.chain, solution.samples, solution.nominal
    run.progress(0.7, "iterating least squares with compliances")
    context = EffectContext(chain, nominal.x, observations)
    joints = loaded_joints(rig, gravity_torques(chain, nominal.x, observations))
    choices = tuple(Choice("joint_compliance", rig.joint_names[joint], {}) for joint in joints)
    compliances = _Compliances(samples, context, choices)
    fit, rounds = _iterated(chain, samples, nominal.x, compliances)
    p = len(chain)
    errors = np.sqrt(np.diag(fit.covariance))
    effects = tuple(choice.fitted(context, fit.x[[p + i]], errors[[p + i]]) for i, choice in enumerate(choices))
    joint = replace(
        solution,
        fit=fit,
        search=f"plain least squares with compliances from the nominal model, {rounds} rounds",
        additions=compliances.at(fit.x[:p]),
    )
    return Adopted(joint, solution.fit, effects, "a part of the method")


def require_torques(rig: Rig, observations: Observations, method: str) -> None:
    """Raise DataError if the torque of no joint is known.

    Args:
        rig: the rig description.
        observations: n rows.
        method: method that needs the torques, for the message: `skcm` or `rbf-tcm`.

    Raises:
        DataError: there are neither masses in the rig file nor torques measured in every row.
    """
    chain = Chain(rig, {})
    if not loaded_joints(rig, gravity_torques(chain, np.zeros(len(chain)), observations)):
        raise DataError(
            "observations",
            f"method {method} needs the torques of joints; add masses to rig {rig.name!r}, or to the data a column "
            f"<joint>_Nm with a value in every row",
        )


@dataclass(frozen=True)
class _Compliances:
    """The compliances to identify, none for kinematics alone; their torques depend on the kinematics."""

    samples: Samples
    context: EffectContext
    choices: tuple[Choice, ...] = ()

    def at(self, x: Floats) -> EffectColumns:
        """Return the columns of the samples at kinematic parameters x (p,)."""
        context = replace(self.context, x=x)
        found = joined([choice.columns(context) for choice in self.choices], len(context))
        return found.over(self.samples.average)


def _iterated(chain: Chain, samples: Samples, start: Floats, compliances: _Compliances) -> tuple[Fit, int]:
    """Iterate least squares from kinematic parameters `start` (p,) and no compliance; return fit and rounds."""
    p = len(chain)
    additions = compliances.at(start)
    state = _state(chain, samples, np.concatenate([start, np.zeros(len(additions))]), additions)
    seen, unseen = _directions(state)
    different = different_fixes(chain, samples)
    if 3 * different <= seen.shape[1]:
        raise UnsafeError(
            f"{different} different poses cannot determine {seen.shape[1]} parameters by least squares; "
            f"measure at least {seen.shape[1] // 3 + 1}"
        )
    rounds, converged = 0, False
    while not converged and rounds < _ROUNDS:
        rounds += 1
        if len(additions):
            state = _state(chain, samples, state.z, compliances.at(state.z[:p]))
        state, change = _step(chain, samples, state, seen)
        converged = change <= _CONVERGED
    return _fit(chain, samples, state, seen, unseen, converged), rounds


def _state(chain: Chain, samples: Samples, z: Floats, additions: EffectColumns) -> _State:
    p = len(z) - len(additions)
    data, _ = additions.apply(samples.data, z[p:])
    lin = chain.linearise(z[:p], data)
    return _State(z, additions, lin, samples.position_mm - lin.position_mm)


def _directions(state: _State) -> tuple[Floats, Floats]:
    """Return (p + k, rank) directions that the data determine, and (p + k, rest) those that they do not."""
    columns = state.columns()
    length = np.linalg.norm(columns, axis=0)
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    _, size, vt = np.linalg.svd(np.linalg.qr(columns * scale, mode="r"), full_matrices=True)
    rank = int((size > _SEEN * size[0]).sum())
    axes = scale[:, None] * vt.T
    return axes[:, :rank], axes[:, rank:]


def _step(chain: Chain, samples: Samples, state: _State, seen: Floats) -> tuple[_State, float]:
    """Make one step of least squares, halved while it increases the squares.

    Returns:
        The new state, and the size of the full step divided by the size of the error.
    """
    columns = state.columns() @ seen
    step = np.linalg.lstsq(columns, state.error.ravel(), rcond=None)[0]
    change = float(np.linalg.norm(columns @ step)) / max(math.sqrt(state.squares), 1e-9)
    for halving in range(_HALVINGS):
        moved = _state(chain, samples, state.z + seen @ step * 0.5**halving, state.additions)
        if moved.squares <= state.squares * (1.0 + 1e-12):
            return moved, change
    return state, change


def _fit(chain: Chain, samples: Samples, state: _State, seen: Floats, unseen: Floats, converged: bool) -> Fit:
    """Return the fit: covariance of least squares in determined directions, of the prior in the others."""
    m = len(samples)
    variance = state.squares / (3 * m - seen.shape[1])
    if not math.isfinite(variance):
        raise CalibrationError("identification: the fit left the range of numbers; check units of the observations")
    excess = max(variance - samples.variance(chain.rig, state.lin.joint_jacobian), 1e-12)
    triangle = np.linalg.qr(state.columns() @ seen, mode="r")
    half = seen @ np.linalg.inv(triangle)
    precision = np.concatenate([prior_precision(chain, 1.0), state.additions.prior_sigma**-2.0])
    prior = unseen @ np.linalg.inv(unseen.T @ (precision[:, None] * unseen)) @ unseen.T
    return Fit(
        x=state.z,
        covariance=variance * half @ half.T + prior,
        excess_variance=excess,
        prior_scale=1.0,
        weight=np.ones(m),
        cost=1.5 * m * math.log(max(state.squares / (3 * m), 1e-300)),
        converged=converged,
    )
