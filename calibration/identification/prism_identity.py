"""Identification of targets: distances between the prism positions that the joints imply distinguish the prisms.

While the base stands still, one rigid transform places all prisms. Targets that are assigned to the wrong prisms fit no
such transform, as prisms are fixed to different links or to different places on one link.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.identification.start import rigid_fit
from calibration.kinematics.chain import Chain, ChainData, Integers, Placement
from calibration.observations import Floats
from calibration.rig.description import BEYOND_BUILDING, Rig

SLACK_MM = 100.0  # for errors that no build tolerance covers: droop, backlash, a swaying boom, a prism mounted askew


@dataclass(frozen=True)
class Targets:
    """n positions that a station measured from one set-up, each of a target that is assumed to be some prism.

    Attributes:
        readings: (n, joints), deg or mm, in the rig's order of joints.
        prism: (n,) index of the prism that each target is assumed to be.
        position_mm: (n, 3) in the station's frame.
        slack_mm: (n,) additional tolerance for motion of the boom since the measurement.
    """

    readings: Floats
    prism: Integers
    position_mm: Floats
    slack_mm: Floats

    def __len__(self) -> int:
        return len(self.prism)


@dataclass(frozen=True)
class Misfits:
    """Misfits of targets to each prism, in units of what build tolerances and motion explain: up to 1 is explained.

    Attributes:
        prism: (prisms,) misfit if the targets are that prism.
        standing: misfit if the targets are a reflector that stands next to the machine.
        distance_mm: (prisms,) approximate distance of the targets from where each prism would be.
    """

    prism: Floats
    standing: float
    distance_mm: Floats


class PrismIdentity:
    """Identification of the prisms that targets are.

    Args:
        rig: the machine; its nominal kinematics and build tolerances are used.
    """

    def __init__(self, rig: Rig) -> None:
        self._chain = Chain(rig, {"": Placement.identity()})
        self._x = np.zeros(len(self._chain))
        self._prior = np.array(
            [0.0 if p.kind == "base" or p.is_flat else p.prior_sigma for p in self._chain.parameters]
        )

    def own_misfits(self, targets: Targets) -> Floats:
        """Return the (n,) misfits of targets to the prisms that they are assumed to be, in units of `Misfits`."""
        base_mm, errors_mm = self._seen(targets, targets.prism)
        limit_mm = self._limits_mm(errors_mm, targets.slack_mm)
        return _off_mm(base_mm, targets.position_mm) / limit_mm

    def misfits(self, known: Targets, unknown: Targets) -> Misfits:
        """Return the misfits of targets to each prism.

        Args:
            known: m targets whose prisms are relied on; may be empty.
            unknown: n measurements of one and the same target; their `prism` is ignored.
        """
        m, n = len(known), len(unknown)
        station_mm = np.concatenate([known.position_mm, unknown.position_mm])
        slack_mm = np.concatenate([known.slack_mm, unknown.slack_mm])
        known_mm, known_errors_mm = self._seen(known, known.prism)
        found, distances_mm = [], []
        for prism in range(len(self._chain.rig.prisms)):
            own_mm, own_errors_mm = self._seen(unknown, np.full(n, prism, dtype=np.intp))
            limit_mm = self._limits_mm(np.concatenate([known_errors_mm, own_errors_mm]), slack_mm)
            off_mm = _off_mm(np.concatenate([known_mm, own_mm]), station_mm)
            off = off_mm / limit_mm
            found.append(max(float(np.median(group)) for group in (off[:m], off[m:]) if len(group)))
            # The transform lies between the groups, but all of its error is due to the prism of the second group.
            distances_mm.append(float(np.median(off_mm[m:])) * ((m + n) / m if m else 1.0))
        spread_mm = np.linalg.norm(unknown.position_mm - unknown.position_mm.mean(axis=0), axis=1)
        return Misfits(np.array(found), float(np.max(spread_mm) / SLACK_MM), np.array(distances_mm))

    def _seen(self, targets: Targets, prism: Integers) -> tuple[Floats, Floats]:
        """Return positions (n, 3) of prisms in the base frame and their displacements by one build tolerance, mm."""
        data = ChainData(targets.readings, prism, np.zeros(len(targets), dtype=np.intp))
        found = self._chain.linearise(self._x, data)
        return found.position_mm, found.jacobian * self._prior

    def _limits_mm(self, errors_mm: Floats, slack_mm: Floats) -> Floats:
        """Return the (n,) tolerated errors of targets, mm; the rigid transform absorbs displacements common to all."""
        own_mm: Floats = np.sqrt(((errors_mm - errors_mm.mean(axis=0)) ** 2).sum(axis=(1, 2)))
        return BEYOND_BUILDING * own_mm + SLACK_MM + slack_mm


def _off_mm(base_mm: Floats, station_mm: Floats) -> Floats:
    """Return distances (n,) that the best rigid transform leaves between (n, 3) points and (n, 3) points."""
    place = rigid_fit(base_mm, station_mm, np.ones(len(base_mm)))
    off_mm: Floats = np.linalg.norm(base_mm @ place.rotation.T + place.translation_mm - station_mm, axis=1)
    return off_mm
