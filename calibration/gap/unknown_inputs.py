"""Rows that lack an input of an effect, such as the direction of the last motion of a joint with play.

The effect exists in these rows, too, but its size there is unknown. Taken as zero, it would remain in their errors and
get another name: a pose whose direction is unknown looks like a zero that has moved for a time. Such rows therefore
have unknown displacements of the effect's usual size in the fit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from calibration.effects.columns import NO_JOINT, EffectColumns, Integers, joined
from calibration.effects.context import EffectContext
from calibration.effects.fitted import AppliedEffects, FittedEffect
from calibration.gap.adoption import Adopted
from calibration.gap.joint_fit import JointFit
from calibration.identification.refinement import Prior, refine
from calibration.identification.samples import Samples
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations, Strings

_MOST_PIECES = 200  # of the samples that lack inputs of effects at one joint; more make the fit slow
_LARGEST = 1.5  # prior sigmas; the usual effect, such as half the width of a play, is one
_CHANCE = 2.0  # standard errors
_PART = "part "  # in the name of an unknown of a part of a run


def filled_in(observations: Observations, samples: Samples) -> Observations:
    """Return the rows with missing inputs taken from other fixes of the same standstill, which share them.

    An empty rate stays empty, as it means that the joint stands still.

    Args:
        observations: n rows.
        samples: made from these rows.
    """
    extra = {
        name: values if name.endswith("_rate") else _filled_in(values, samples.of_row)
        for name, values in observations.extra.items()
    }
    return replace(observations, extra=extra)


def _filled_in(values: Floats, of_row: Integers) -> Floats:
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    number = np.bincount(of_row, known)
    mean = np.bincount(of_row, np.where(known, values, 0.0)) / np.where(number > 0, number, np.nan)
    return np.where(known, values, mean[of_row])


def unknown_inputs(
    effects: Sequence[FittedEffect], context: EffectContext, samples: Samples, implausible: Collection[str] = ()
) -> EffectColumns | None:
    """Return unknown displacements of the samples that lack inputs of effects; None if there are no such samples.

    Consecutive samples that lack them have one unknown in common, as the joint may not have moved meanwhile, and each
    has one of its own, as it may have. Their prior variance is that of a prediction in such rows.

    Args:
        effects: the effects.
        context: of the rows.
        samples: made from these rows.
        implausible: names of unknowns to leave out.
    """
    applied = AppliedEffects(effects, context.chain)
    session = context.observations.session[np.unique(samples.of_row, return_index=True)[1]]
    by_joint = samples.average(applied.unknown_variance(context))
    parts = [
        _at_joint(name, number, by_joint[:, number], session) for name, number in context.chain.joint_index.items()
    ]
    parts.append(_at_prisms(samples.average(applied.unknown_mm2(context)), session))
    found = joined([part for part in parts if len(part)], len(samples))
    found = _only(found, np.array([name not in implausible for name in found.names], dtype=bool))
    return found if len(found) else None


def implausible_unknowns(joint: JointFit, unknowns: EffectColumns) -> EffectColumns:
    """Return the unknowns of whole runs that are larger than the effects can be, so there must be another cause.

    Args:
        joint: a fit with these unknowns.
        unknowns: as in `with_unknowns`.
    """
    first = len(joint.context.chain)
    own = slice(first, first + len(unknowns))
    value, error = np.abs(joint.fit.x[own]), np.sqrt(np.diag(joint.fit.covariance)[own])
    beyond = value > _LARGEST * unknowns.prior_sigma + _CHANCE * error
    beyond &= [_PART not in name for name in unknowns.names]  # a single sample that is off is an outlier
    return _only(unknowns, beyond)


def _at_joint(name: str, number: int, variance: Floats, session: Strings) -> EffectColumns:
    """Return the unknowns of one joint; `variance` (m,) is positive in the samples that have them."""
    pieces = _pieces(variance > 0.0, session)
    return EffectColumns(
        tuple(f"unknown@{name}:{piece}" for piece in pieces),
        np.full(len(pieces), number),
        _indicators(pieces, len(variance)),
        np.array([math.sqrt(variance[own].mean()) for own in pieces.values()]),
    )


def _at_prisms(variance: Floats, session: Strings) -> EffectColumns:
    """Return the unknowns of the prisms' positions, along each axis; `variance` as for a joint."""
    pieces = _pieces(variance > 0.0, session)
    is_here = _indicators(pieces, len(variance))
    return EffectColumns(
        tuple(f"unknown@prism:{axis} {piece}" for axis in "xyz" for piece in pieces),
        np.full(3 * len(pieces), NO_JOINT),
        np.zeros((len(variance), 3 * len(pieces))),
        np.array([math.sqrt(variance[own].mean()) for _ in "xyz" for own in pieces.values()]),
        np.stack([np.kron(axis, is_here) for axis in np.eye(3)], axis=1),
    )


def _only(every: EffectColumns, kept: NDArray[np.bool_]) -> EffectColumns:
    return EffectColumns(
        tuple(compress(every.names, kept)),
        every.joint[kept],
        every.column[:, kept],
        every.prior_sigma[kept],
        None if every.shift_mm is None else every.shift_mm[:, :, kept],
    )


def _pieces(lacks: NDArray[np.bool_], session: Strings) -> dict[str, Integers]:
    """Return runs of consecutive samples of a session that lack an input, and the parts of each run, by name."""
    found = np.flatnonzero(lacks)
    if not len(found):
        return {}
    starts = np.flatnonzero((np.diff(found) > 1) | (session[found[1:]] != session[found[:-1]])) + 1
    length = math.ceil(len(found) / _MOST_PIECES)
    pieces = {}
    for run in np.split(found, starts):
        pieces[f"{run[0]}-{run[-1]}"] = run
        if len(run) > length:
            pieces |= {f"{_PART}{own[0]}-{own[-1]}": own for own in np.split(run, range(length, len(run), length))}
    return pieces


def _indicators(pieces: Mapping[str, Integers], samples: int) -> Floats:
    """Return (m, k): 1 in the samples of each piece, else 0."""
    out = np.zeros((samples, len(pieces)))
    for number, own in enumerate(pieces.values()):
        out[own, number] = 1.0
    return out


def with_warning(
    found: Adopted, effects: Sequence[FittedEffect], implausible: EffectColumns, samples: Samples
) -> Adopted:
    """Return a result with a warning of errors that lacking inputs do not explain, which count as structure.

    Args:
        found: the result.
        effects: effects whose inputs are lacking.
        implausible: result of `implausible_unknowns`.
        samples: of the fit.
    """
    moved = implausible.column.any(axis=1)
    if implausible.shift_mm is not None:
        moved |= implausible.shift_mm.any(axis=(1, 2))
    named = ", ".join(f"{effect.family}@{effect.where}" for effect in effects)
    told = (
        f"{samples.fixes[moved].sum():.0f} fixes that lack inputs of {named} have larger errors than that can cause: "
        "something else differs in just these fixes, such as the zero of a joint"
    )
    return replace(found, warnings=(*found.warnings, told), structured=True)


def with_unknowns(solution: Solution, unknowns: EffectColumns, prior: Prior) -> Solution:
    """Refit a solution of the kinematics alone with unknown displacements of some samples.

    Args:
        solution: the kinematics alone.
        unknowns: result of `unknown_inputs`.
        prior: prior of the solution.
    """
    fit = refine(solution.chain, solution.samples, solution.fit.x, prior=prior, additions=unknowns)
    return replace(solution, fit=fit, additions=unknowns)


def without_unknowns(found: Adopted, unknowns: EffectColumns) -> Adopted:
    """Return kinematics and effects without the unknowns of the training rows, which a model does not have.

    Args:
        found: kinematics and effects that were fitted with these unknowns.
        unknowns: as in `with_unknowns`.
    """
    first = len(found.solution.chain)
    kept = np.delete(np.arange(len(found.solution.fit.x)), slice(first, first + len(unknowns)))
    alone, fit = found.geometric, found.solution.fit
    together = replace(fit, x=fit.x[kept], covariance=fit.covariance[np.ix_(kept, kept)])
    return replace(
        found,
        solution=replace(found.solution, fit=together, additions=found.solution.additions if found.effects else None),
        geometric=replace(alone, x=alone.x[:first], covariance=alone.covariance[:first, :first]),
    )
