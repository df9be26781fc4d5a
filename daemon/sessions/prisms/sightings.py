"""What a station has seen of a target, with the joints at that instant, and the arrays that the comparison takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.rig.description import Rig
from daemon.sessions.station_setups import Place

if TYPE_CHECKING:
    from calibration.identification.prism_identity import Targets


@dataclass(frozen=True)
class Sighting:
    """A target's place with the machine's joints at that instant.

    Attributes:
        prism: prism that the target is taken for.
        joints: readings in the rig's order, deg or mm.
        place_mm: place in the station's frame.
        slack_mm: largest error of the place that the motion of the boom may cause.
    """

    prism: str
    joints: tuple[float, ...]
    place_mm: Place
    slack_mm: float = 0.0


def sightings_of(rig: Rig, rows: Sequence[tuple[str, Mapping[str, float], Place]]) -> list[Sighting]:
    """Return sightings from stored observations; rows with an unknown prism or a missing joint are skipped.

    Args:
        rig: the machine.
        rows: prism, value by column, and place in mm of each observation.
    """
    columns = [joint.column for joint in rig.joints]
    return [
        Sighting(prism, tuple(values[column] for column in columns), place_mm)
        for prism, values, place_mm in rows
        if prism in rig.prism_names and all(column in values for column in columns)
    ]


def targets(rig: Rig, sightings: Sequence[Sighting]) -> Targets:
    """Return sightings as arrays."""
    from calibration.identification.prism_identity import Targets

    names = rig.prism_names
    return Targets(
        np.array([one.joints for one in sightings], dtype=np.float64).reshape(-1, len(rig.joints)),
        np.array([names.index(one.prism) for one in sightings], dtype=np.intp),
        np.array([one.place_mm for one in sightings], dtype=np.float64).reshape(-1, 3),
        np.array([one.slack_mm for one in sightings], dtype=np.float64),
    )
