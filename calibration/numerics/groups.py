"""Groups of poses that are held out together: stretches of a path, as opposed to independent poses.

Neighbours along a path have nearly the same pose and nearly the same error, even in different cells of the workspace.
If they are held out row by row, or in cells of a few rows, they show how well a model interpolates but not its accuracy
at new poses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibration.observations import Floats

Integers = NDArray[np.intp]

_LEAST_POSES = 40
_SMOOTH = 0.3  # least median cosine between consecutive steps; random poses have -0.5 or less
_NEIGHBOURS = 0.9  # least autocorrelation of consecutive poses; a coarse grid measured line by line has less
_RELATED = 0.5  # autocorrelation of the poses at which a stretch ends
_LEAST_STRETCHES = 20
_STILL = 0.02  # of the greatest spread among joints, below which a joint counts as not moving


def same_readings(readings: Floats, track: Integers) -> Integers:
    """Return (n,) numbers of the standstills: rows of one track with the same readings of all joints.

    Args:
        readings: (n, joints) deg or mm.
        track: (n,) rows of one set-up and session have the same number.
    """
    if len(readings) == 0:
        return np.zeros(0, dtype=np.intp)
    keyed = np.column_stack([track, readings])
    return np.asarray(np.unique(keyed, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.intp)


def path_stretches(readings: Floats, track: Integers) -> Integers | None:
    """Return (n,) numbers of the stretches of a path, or None if the poses do not follow one.

    Rows follow a path if steps mostly continue in the direction of the step before, and neighbours have nearly the same
    pose. The length of a stretch is the correlation length of the poses, limited so that there are at least about
    twenty stretches. Where the path returns to a place, its rows belong to the first stretch there.

    Args:
        readings: (n, joints) deg or mm, in the order in which they were measured.
        track: (n,) rows of one set-up and session have the same number; paths do not cross between tracks.
    """
    if len(readings) < _LEAST_POSES:
        return None
    spread = readings.std(axis=0)
    moving = spread > _STILL * spread.max(initial=0.0)
    if not moving.any():
        return None
    scaled = readings[:, moving] / spread[moving]
    # Prisms measured one after the other in one standstill are one pose of the path.
    new = np.ones(len(scaled), dtype=bool)
    new[1:] = (track[1:] != track[:-1]) | (scaled[1:] != scaled[:-1]).any(axis=1)
    poses, of_track = scaled[new], track[new]
    if len(poses) < _LEAST_POSES or _median_cosine(poses, of_track) < _SMOOTH:
        return None
    if _autocorrelation(poses, of_track, 1) < _NEIGHBOURS:
        return None
    length = _correlation_length(poses, of_track)
    return _nearest_leader(scaled, _leaders(poses, length))


def _median_cosine(poses: Floats, track: Integers) -> float:
    """Return the median cosine between each step and the one before it, within a track."""
    step = np.diff(poses, axis=0)
    whole = (track[2:] == track[1:-1]) & (track[1:-1] == track[:-2])
    size = np.linalg.norm(step, axis=1)
    product = size[1:] * size[:-1]
    whole &= product > 0.0
    if not whole.any():
        return -1.0
    return float(np.median((step[1:] * step[:-1]).sum(axis=1)[whole] / product[whole]))


def _autocorrelation(poses: Floats, track: Integers, lag: int) -> float:
    """Return the mean autocorrelation over the joints, each with a variance of 1, of poses within a track."""
    together = track[lag:] == track[:-lag]
    if not together.any():
        return 0.0
    return float(1.0 - ((poses[lag:] - poses[:-lag])[together] ** 2).mean() / 2.0)


def _correlation_length(poses: Floats, track: Integers) -> int:
    """Return the number of poses until their autocorrelation has fallen to `_RELATED`, at most a twentieth of all."""
    most = len(poses) // _LEAST_STRETCHES
    return next((lag for lag in range(1, most) if _autocorrelation(poses, track, lag) < _RELATED), most)


def _leaders(poses: Floats, length: int) -> Floats:
    """Return the poses in the middle of each stretch, without those inside an earlier stretch."""
    middles = poses[length // 2 :: length]
    # Half the usual distance between consecutive middles.
    reach = 0.5 * float(np.median(np.linalg.norm(np.diff(middles, axis=0), axis=1)))
    kept: list[Floats] = []
    for middle in middles:
        if all(np.linalg.norm(middle - other) > reach for other in kept):
            kept.append(middle)
    return np.array(kept)


def _nearest_leader(scaled: Floats, leaders: Floats) -> Integers:
    return np.asarray(cKDTree(leaders).query(scaled)[1], dtype=np.intp)
