"""Rows that lack an input of an effect, such as the direction of the last motion of a joint with play.

The effect exists in these rows, too, but its size there is unknown. Taken as zero, it would remain in their errors and
get another name: a pose whose direction is unknown looks like a zero that has moved for a time. Such rows therefore
have unknown displacements in the fit: first of any size, so that only the other rows show which effects there are and
how large they are, then of the size of these effects.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import JointFamily
from calibration.effects.columns import NO_JOINT, EffectColumns, Integers, joined
from calibration.effects.context import EffectContext
from calibration.effects.fitted import AppliedEffects, FittedEffect
from calibration.effects.library import library
from calibration.gap.adoption import Adopted
from calibration.gap.joint_fit import JointFit
from calibration.identification.refinement import Prior, refine
from calibration.identification.samples import Samples
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations, Strings
from calibration.rig.description import Rig

_LEAST_STANDSTILLS = 3  # of a run
_MOST_RUNS = 20  # of samples that lack inputs of effects at one joint; more make the fit slow
_CHANCE = 3.0  # standard errors
_SAME_SIZE = 1.2  # ratio
_ANY_SIZE = {"revolute": 5.0, "prismatic": 200.0}  # deg, mm: larger than any effect
_ANY_SIZE_MM = 500.0  # the same for an effect that moves prisms


def filled_in(observations: Observations, samples: Samples) -> Observations:
    """Return the rows with missing inputs taken from other fixes of the same standstill, which share them.

    An empty rate stays empty, as it means that the joint stands still.

    Args:
        observations: n rows.
        samples: made from these rows.
    """
    standstill = np.unique(samples.standstill, return_inverse=True)[1][samples.of_row]
    extra = {
        name: values if name.endswith("_rate") else _filled_in(values, standstill)
        for name, values in observations.extra.items()
    }
    return replace(observations, extra=extra)


def _filled_in(values: Floats, standstill: Integers) -> Floats:
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    number = np.bincount(standstill, known)
    mean = np.bincount(standstill, np.where(known, values, 0.0)) / np.where(number > 0, number, np.nan)
    return np.where(known, values, mean[standstill])


@dataclass(frozen=True)
class Unknowns:
    """Unknown displacements of the m samples that lack inputs of effects.

    Attributes:
        runs: coefficients that consecutive samples have in common, as a joint may not have moved meanwhile.
        variance: (m, joints) variance of each standstill's own part, as the joint may have moved, deg^2 or mm^2.
        along_axes_mm2: (m,) the same of the prisms' positions, mm^2 per axis.
        largest: (k,) largest size of the effects in the rows that have their inputs, for each of the k runs.
    """

    runs: EffectColumns
    variance: Floats
    along_axes_mm2: Floats
    largest: Floats

    def is_like(self, other: Unknowns) -> bool:
        """Return True if the same samples have unknowns, of about the same size."""
        pairs = ((self.variance, other.variance), (self.along_axes_mm2, other.along_axes_mm2))
        return self.runs.names == other.runs.names and all(_are_like(*pair) for pair in pairs)


def _are_like(one: Floats, other: Floats) -> bool:
    return bool((one <= _SAME_SIZE**2 * other).all() and (other <= _SAME_SIZE**2 * one).all())


def unknowns_of_any_size(
    effects: Iterable[tuple[str, str]], context: EffectContext, samples: Samples
) -> Unknowns | None:
    """Return unknown displacements of any size of samples that lack inputs; None if there are no such samples.

    Args:
        effects: families and places of the effects whose inputs may be lacking.
        context: of the rows.
        samples: made from these rows.
    """
    chain = context.chain
    at_joints, at_prisms = np.zeros((len(context), len(chain.joint_index))), np.zeros(len(context))
    for name, where in effects:
        family = library()[name]
        lacks = ~family.known(context, where)
        if isinstance(family, JointFamily):
            at_joints[lacks, chain.joint_index[where]] = 1.0
        else:
            at_prisms[lacks] = 1.0
    if not (at_joints.any() or at_prisms.any()):
        return None
    return _of_any_size(samples.average(at_joints), samples.average(at_prisms), chain.rig)


def widened(unknowns: Unknowns, rig: Rig) -> Unknowns:
    """Return unknown displacements of any size of the same samples.

    Args:
        unknowns: result of `unknown_inputs`.
        rig: rig of the samples.
    """
    at_joints, at_prisms = (own > 0.0 for own in (unknowns.variance, unknowns.along_axes_mm2))
    return _of_any_size(at_joints.astype(np.float64), at_prisms.astype(np.float64), rig)


def _of_any_size(at_joints: Floats, at_prisms: Floats, rig: Rig) -> Unknowns:
    """Return unknowns of any size; (m, joints) and (m,) shares of each sample that lack inputs at joints and prisms."""
    sizes = np.array([_ANY_SIZE[joint.kind] for joint in rig.joints])
    return Unknowns(joined([], len(at_prisms)), at_joints * sizes**2, at_prisms * _ANY_SIZE_MM**2, np.empty(0))


def unknown_inputs(
    effects: Sequence[FittedEffect], context: EffectContext, samples: Samples, implausible: Collection[str] = ()
) -> Unknowns | None:
    """Return the unknown displacements of samples that lack inputs of effects; None if there are no such samples.

    The variance of the part in common, and of each standstill's own part, is that of a prediction in such rows.

    Args:
        effects: the effects.
        context: of the rows.
        samples: made from these rows.
        implausible: names of runs to leave out.
    """
    applied = AppliedEffects(effects, context.chain)
    session = context.observations.session[np.unique(samples.of_row, return_index=True)[1]]
    of_sample = session, samples.standstill
    by_joint = samples.average(applied.unknown_variance(context))
    along_axes_mm2 = samples.average(applied.unknown_mm2(context))
    if not (by_joint.any() or along_axes_mm2.any()):
        return None
    parts = [
        _at_joint(name, number, by_joint[:, number], *of_sample) for name, number in context.chain.joint_index.items()
    ]
    runs = joined([part for part in (*parts, _at_prisms(along_axes_mm2, *of_sample)) if len(part)], len(samples))
    kept = np.array([name not in implausible for name in runs.names], dtype=bool)
    columns = applied.columns(context)
    at_joints = np.abs(columns.change(applied.values, len(parts))).max(axis=0)
    at_prisms_mm = np.abs(columns.shifted_mm(applied.values)).max()
    largest = np.where(runs.joint == NO_JOINT, at_prisms_mm, at_joints[runs.joint])
    return Unknowns(_only(runs, kept), by_joint, along_axes_mm2, largest[kept])


def implausible_runs(joint: JointFit, unknowns: Unknowns) -> EffectColumns:
    """Return the unknowns of runs that are larger than the effects, so there must be another cause.

    Args:
        joint: a fit with these unknowns.
        unknowns: as in `with_unknowns`.
    """
    first = len(joint.context.chain)
    own = slice(first, first + len(unknowns.runs))
    value, error = np.abs(joint.fit.x[own]), np.sqrt(np.diag(joint.fit.covariance)[own])
    return _only(unknowns.runs, value > unknowns.largest + _CHANCE * error)


def _at_joint(name: str, number: int, variance: Floats, session: Strings, standstill: Integers) -> EffectColumns:
    """Return the unknowns of one joint; `variance` (m,) is positive in the samples that have them."""
    runs = _runs(variance > 0.0, session, standstill)
    return EffectColumns(
        tuple(f"unknown@{name}:{run[0]}-{run[-1]}" for run in runs),
        np.full(len(runs), number),
        _indicators(runs, len(variance)),
        np.array([math.sqrt(variance[run].mean()) for run in runs]),
    )


def _at_prisms(variance: Floats, session: Strings, standstill: Integers) -> EffectColumns:
    """Return the unknowns of the prisms' positions, along each axis; `variance` as for a joint."""
    runs = _runs(variance > 0.0, session, standstill)
    is_here = _indicators(runs, len(variance))
    return EffectColumns(
        tuple(f"unknown@prism:{axis}{run[0]}-{run[-1]}" for axis in "xyz" for run in runs),
        np.full(3 * len(runs), NO_JOINT),
        np.zeros((len(variance), 3 * len(runs))),
        np.array([math.sqrt(variance[run].mean()) for _ in "xyz" for run in runs]),
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


def _runs(lacks: NDArray[np.bool_], session: Strings, standstill: Integers) -> list[Integers]:
    """Return the longest runs of consecutive samples of a session that lack an input, in their order."""
    found = np.flatnonzero(lacks)
    starts = np.flatnonzero((np.diff(found) > 1) | (session[found[1:]] != session[found[:-1]])) + 1
    runs = [run for run in np.split(found, starts) if len(np.unique(standstill[run])) >= _LEAST_STANDSTILLS]
    longest = sorted(runs, key=len, reverse=True)[:_MOST_RUNS]
    return sorted(longest, key=lambda run: int(run[0]))


def _indicators(runs: Sequence[Integers], samples: int) -> Floats:
    """Return (m, k): 1 in the samples of each run, else 0."""
    out = np.zeros((samples, len(runs)))
    for number, run in enumerate(runs):
        out[run, number] = 1.0
    return out


def with_warning(
    found: Adopted, effects: Sequence[FittedEffect], implausible: EffectColumns, samples: Samples
) -> Adopted:
    """Return a result with a warning of errors that lacking inputs do not explain, which count as structure.

    Args:
        found: the result.
        effects: effects whose inputs are lacking.
        implausible: result of `implausible_runs`.
        samples: of the fit.
    """
    moved = implausible.column.any(axis=1)
    if implausible.shift_mm is not None:
        moved |= implausible.shift_mm.any(axis=(1, 2))
    named = ", ".join(map(str, effects))
    told = (
        f"{samples.fixes[moved].sum():.0f} fixes that lack inputs of {named} have larger errors than that can cause: "
        "something else differs in just these fixes, such as the zero of a joint"
    )
    return replace(found, warnings=(*found.warnings, told), structured=True)


def with_doubt(found: Adopted, effects: Sequence[FittedEffect]) -> Adopted:
    """Return a result with a warning of effects that are not named, and of the structure that they would explain.

    Args:
        found: the result with unknowns.
        effects: effects that are found only if rows that lack their inputs count as rows without the effect.
    """
    named = ", ".join(map(str, effects))
    told = f"not named: {named}; the rows that have all inputs do not show it, and the other rows have errors like it"
    return replace(found, warnings=(*found.warnings, told), structured=True)


def with_unknowns(solution: Solution, unknowns: Unknowns, prior: Prior) -> Solution:
    """Refit a solution of the kinematics alone with unknown displacements of some samples.

    Args:
        solution: the kinematics alone.
        unknowns: result of `unknown_inputs`.
        prior: prior of the solution.
    """
    samples = replace(
        solution.samples,
        station_covariance=solution.samples.station_covariance + unknowns.along_axes_mm2[:, None, None] * np.eye(3),
        unknown_variance=unknowns.variance,
    )
    additions = unknowns.runs if len(unknowns.runs) else None
    fit = refine(solution.chain, samples, solution.fit.x, prior=prior, additions=additions)
    return replace(solution, samples=samples, fit=fit, additions=additions)


def without_unknowns(found: Adopted, samples: Samples, unknowns: Unknowns) -> Adopted:
    """Return kinematics and effects without the unknowns of the training rows, which a model does not have.

    Args:
        found: kinematics and effects that were fitted with these unknowns.
        samples: the samples without them.
        unknowns: as in `with_unknowns`.
    """
    first = len(found.solution.chain)
    kept = np.delete(np.arange(len(found.solution.fit.x)), slice(first, first + len(unknowns.runs)))
    alone, fit = found.geometric, found.solution.fit
    together = replace(fit, x=fit.x[kept], covariance=fit.covariance[np.ix_(kept, kept)])
    additions = found.solution.additions if found.effects else None
    return replace(
        found,
        solution=replace(found.solution, samples=samples, fit=together, additions=additions),
        geometric=replace(alone, x=alone.x[:first], covariance=alone.covariance[:first, :first]),
    )
