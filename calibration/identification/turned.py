"""Joints whose zero is far from the drawing's: a start with some of them turned by quarters, where that fits better.

An encoder mounted the other way round, or a row's angle counted from another axis, is a basin of its own that neither
Gauss-Newton nor a search within build tolerances reaches.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.samples import Samples
from calibration.identification.start import rough_start
from calibration.kinematics import Chain, Placement
from calibration.observations import Floats

_QUARTERS = (0.5 * math.pi, math.pi, -0.5 * math.pi)
_MOST_JOINTS = 3
_CARRIED = 6
_CLEARLY = 0.7  # of the mean misfit; a turn that gains less is no turn


@dataclass(frozen=True)
class _Trial:
    x: Floats
    misfit_mm: float
    joints: frozenset[str]


def turned_start(blank: Chain, chain: Chain, samples: Samples) -> tuple[Floats, tuple[str, ...]]:
    """A start with up to three revolute joints turned.

    One joint after the other is turned, the few best combinations are carried on (two wrong joints may show no gain
    before both are right), and a further joint counts only where it lowers the mean misfit clearly.

    Args:
        blank: the chain with the identity as placements.
        chain: the chain that the start is for.
        samples: rows of every set-up.

    Returns:
        (p,) parameters for `chain`; names of the joints that were turned, none where nothing gains.
    """
    offsets = {j.name: _offsets(blank, j.name) for j in blank.rig.joints if j.kind == "revolute"}
    nothing = _placed(blank, chain, samples, np.zeros(len(blank)), frozenset())
    best, carried = nothing, [nothing]
    for _ in range(_MOST_JOINTS):
        trials: dict[tuple[float, ...], _Trial] = {}
        for trial in carried:
            body = np.where(np.arange(len(blank)) < blank.base_start, trial.x, 0.0)
            for joint in sorted(offsets.keys() - trial.joints):
                for angle in _QUARTERS:
                    turned = body + angle * offsets[joint]
                    key = tuple(np.round(turned[: blank.base_start], 3))
                    if key in trials or not offsets[joint].any():
                        continue
                    try:
                        trials[key] = _placed(blank, chain, samples, turned, trial.joints | {joint})
                    except UnsafeError:  # mirrored: not with this turn
                        continue
        carried = sorted(trials.values(), key=lambda t: t.misfit_mm)[:_CARRIED]
        if carried and carried[0].misfit_mm < _CLEARLY * best.misfit_mm:
            best = carried[0]
    return best.x, tuple(sorted(best.joints))


def _placed(blank: Chain, chain: Chain, samples: Samples, x: Floats, joints: frozenset[str]) -> _Trial:
    """Parameters for `chain` with the bases placed anew."""
    start = rough_start(blank, samples, x)
    out = start.x.copy()
    for setup, name in enumerate(chain.setups):
        out[chain.base_index(setup)] = _deviation(start.placements[name], chain.placements[name])
    error = samples.position_mm - chain.positions_mm(out, samples.data)
    return _Trial(out, float(np.linalg.norm(error, axis=1).mean()), joints)


def _deviation(wanted: Placement, given: Placement) -> Floats:
    """Base parameters x, y, z, rz, ry, rx that bring one placement to another (`Chain.base`)."""
    r = wanted.rotation @ given.rotation.T
    angles = math.atan2(r[1, 0], r[0, 0]), -math.asin(float(np.clip(r[2, 0], -1.0, 1.0))), math.atan2(r[2, 1], r[2, 2])
    return np.concatenate([wanted.translation_mm - given.translation_mm, angles])


def _offsets(chain: Chain, joint: str) -> Floats:
    """(p,) how the rows' angles move when the joint turns by 1 rad."""
    out = np.zeros(len(chain))
    index = chain.rig.joint_names.index(joint)
    for op in itertools.chain.from_iterable(chain.row_ops):
        for driven, coefficient in op.drive:
            if driven == index and op.rotates and op.parameter >= 0:
                out[op.parameter] += coefficient / math.radians(1.0)
    return out
