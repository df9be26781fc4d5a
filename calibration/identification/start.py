"""Where the search begins: base placements and unknown prism offsets in closed form, on nominal kinematics.

The rigid transform is Kabsch's (Acta Cryst. A32, 1976), reweighted so that gross outliers do not tilt it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.samples import Samples
from calibration.kinematics import Chain, Placement
from calibration.observations import Floats

_ROUNDS = 200
_SETTLED = 1e-3  # of the misfit
_LINE = 1e-3  # second singular value over the first below which points lie on a line
_MIRRORED = 0.3


@dataclass(frozen=True)
class Start:
    """Result of `rough_start`.

    Attributes:
        placements: set-up -> where the base stands.
        x: (p,) parameters, with the offsets of unknown prisms.
        scale_mm: robust size of the 3-D misfit there.
        misfit_mm: (m,) 3-D misfit of each sample there.
    """

    placements: dict[str, Placement]
    x: Floats
    scale_mm: float
    misfit_mm: Floats


def rigid_fit(base_mm: Floats, station_mm: Floats, weight: Floats, *, mirrored: bool = False) -> Placement:
    """Least-squares rotation and translation from (n, 3) points to (n, 3) points with (n,) weights.

    `mirrored` allows the improper rotation instead, which no rigid body makes.
    """
    total = weight.sum()
    from_centre = weight @ base_mm / total
    to_centre = weight @ station_mm / total
    u, _, vt = np.linalg.svd(((station_mm - to_centre) * weight[:, None]).T @ (base_mm - from_centre))
    sign = np.sign(np.linalg.det(u @ vt)) * (-1.0 if mirrored else 1.0)
    rotation = u @ np.diag([1.0, 1.0, sign]) @ vt
    return Placement(rotation, to_centre - rotation @ from_centre)


def rough_start(
    chain: Chain,
    samples: Samples,
    x: Floats,
    *,
    offsets: bool = True,
    mirrored: Literal["refuse", "let pass"] = "refuse",
    rounds: int = _ROUNDS,
    in_base_mm: Floats | None = None,
) -> Start:
    """Place every base, alternating with the offsets of prisms whose mounting is unknown.

    Args:
        chain: kinematics whose placements are all the identity.
        samples: rows of every set-up of the chain.
        x: (p,) parameters to begin with; those of the bases are zero.
        offsets: False to leave the offsets of prisms as `x` has them.
        mirrored: what to do about coordinates that fit much better as their mirror image.
        rounds: of reweighting at most.
        in_base_mm: (m, 3) positions in the frames of the bases at `x`, where they are known already.

    Raises:
        UnsafeError: a set-up with fewer than three fixes, with all fixes on a line, or mirrored.
    """
    data = samples.data
    unknown = np.array([offsets and p.kind == "prism" and p.is_flat for p in chain.parameters])
    arm = chain.positions_mm(x, data) if in_base_mm is None else in_base_mm
    offset_jacobian = chain.jacobian(x, data)[:, :, unknown] if unknown.any() else np.zeros((len(data), 3, 0))
    offset = np.zeros(int(unknown.sum()))
    weight = np.ones(len(samples))
    rows_of = [np.flatnonzero(data.setup == s) for s in range(len(chain.setups))]
    for setup, rows in zip(chain.setups, rows_of, strict=True):
        _check_spread(setup, samples.position_mm[rows])
    base = np.zeros_like(arm)
    for _ in range(rounds):
        before = base.copy()
        point = arm + offset_jacobian @ offset
        placements = [rigid_fit(point[r], samples.position_mm[r], weight[r]) for r in rows_of]
        for placement, rows in zip(placements, rows_of, strict=True):
            base[rows] = (samples.position_mm[rows] - placement.translation_mm) @ placement.rotation
        misfit = base - point
        # Least absolute distances by reweighting: 20 % of gross outliers leave it where it is.
        distance = np.linalg.norm(misfit, axis=1)
        scale = float(np.median(distance))
        weight = 1.0 / np.maximum(distance, max(0.1 * scale, 1e-6))
        weight /= weight.max()
        step = np.zeros(0)
        if unknown.any():
            root = np.sqrt(weight)[:, None]
            step = np.linalg.lstsq(
                (offset_jacobian * root[:, :, None]).reshape(-1, len(offset)), (misfit * root).ravel(), rcond=1e-9
            )[0]
        offset = offset + step
        if max(np.abs(step).max(initial=0.0), np.abs(base - before).max()) < _SETTLED * scale:
            break
    for setup, placement, rows in zip(chain.setups, placements, rows_of, strict=True) if mirrored == "refuse" else ():
        _check_handedness(setup, point[rows], samples.position_mm[rows], weight[rows], placement)
    x = x.copy()
    x[unknown] += offset
    left = base - arm - offset_jacobian @ offset
    return Start(dict(zip(chain.setups, placements, strict=True)), x, scale, np.linalg.norm(left, axis=1))


def on_a_line(position_mm: Floats) -> bool:
    """Whether points (n, 3) leave a turn about them open: fewer than three, or all on a line."""
    if len(position_mm) < 3:
        return True
    spread = np.linalg.svd(position_mm - position_mm.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= _LINE * spread[0] or spread[0] == 0.0)


def _check_spread(setup: str, position_mm: Floats) -> None:
    name = f"set-up {setup!r}" if setup else "the data"
    if len(position_mm) < 3:
        fixes = "1 fix" if len(position_mm) == 1 else f"{len(position_mm)} fixes"
        raise UnsafeError(f"{name}: {fixes} cannot place the base; at least 3 in different places")
    if on_a_line(position_mm):
        raise UnsafeError(f"{name}: all fixes lie on a line, so the base may turn about it; measure other poses")


def _check_handedness(setup: str, point: Floats, position_mm: Floats, weight: Floats, proper: Placement) -> None:
    def misfit(placement: Placement) -> float:
        moved = point @ placement.rotation.T + placement.translation_mm
        return float(np.median(np.linalg.norm(position_mm - moved, axis=1)))

    improper = rigid_fit(point, position_mm, weight, mirrored=True)
    if misfit(improper) < _MIRRORED * misfit(proper):
        name = f"set-up {setup!r}" if setup else "the data"
        raise UnsafeError(
            f"{name}: the coordinates are mirrored ({misfit(improper):.0f} mm from the rig when mirrored back, "
            f"{misfit(proper):.0f} mm as given); x = east, y = north, z = up is right-handed: are two axes swapped?"
        )
