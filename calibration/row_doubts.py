"""What rows say wrongly of how they were measured (set-up, clock, origin, payload, rates), one sentence each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibration.observations import Observations
from calibration.rig import Rig

_FAR_MM = 5e5  # from the instrument: nobody measures a boom from there
_LIGHT, _HEAVY = 1e-3, 10.0  # of the machine, between which its payload is
_TOO_FAST = 3.0  # times the fastest motion of a joint
_UNORDERED = 0.25  # of the rows; a clock is not set as often


def row_doubts(rig: Rig, observations: Observations) -> Iterator[str]:
    """Every doubt that needs no model."""
    yield from _of_setups(observations)
    yield from _of_clock(observations)
    yield from _of_origin(observations)
    yield from _of_payload(rig, observations)
    yield from _of_rates(rig, observations)


def _of_setups(observations: Observations) -> Iterator[str]:
    blank = observations.setup == ""
    if blank.any() and not blank.all():
        named = ", ".join(repr(setup) for setup in np.unique(observations.setup[~blank]).tolist())
        yield (
            f"{blank.sum()} of {len(blank)} rows have no setup, the first in row {blank.argmax() + 1}, beside those of "
            f"{named}: they are taken for another set-up with a base of its own; fill in the column"
        )


def _of_clock(observations: Observations) -> Iterator[str]:
    """A clock that was set back, or that began anew; a table that is sorted by something else is no sign of one."""
    time_s = observations.extra.get("time_s", np.full(len(observations), np.nan))
    known = np.flatnonzero(np.isfinite(time_s))
    # By prism and set-up tables are often sorted.
    order = known[np.lexsort((observations.prism[known], observations.setup[known]))]
    same = (observations.prism[order][1:] == observations.prism[order][:-1]) & (
        observations.setup[order][1:] == observations.setup[order][:-1]
    )
    back = order[1:][same & (np.diff(time_s[order]) < 0.0)]
    if 0 < len(back) <= _UNORDERED * len(known):
        yield (
            f"time_s runs backward, first in row {back.min() + 1}: what depends on time takes the rows in the order of "
            f"time_s; was the clock set, or does every session count from zero? correct the column"
        )


def _of_origin(observations: Observations) -> Iterator[str]:
    distance_mm = float(np.median(np.linalg.norm(observations.position_mm, axis=1)))
    if distance_mm > _FAR_MM:
        yield (
            f"the fixes are {distance_mm / 1e6:.3g} km from the origin of x, y, z, where the instrument should be: of "
            f"map coordinates, subtract the instrument's; the noise of a fix goes with its distance from there"
        )


def _of_payload(rig: Rig, observations: Observations) -> Iterator[str]:
    machine_kg = sum(mass.kg for mass in rig.masses)
    most_kg = float(np.nanmax(observations.extra.get("payload_kg", np.zeros(0)), initial=0.0))
    if min(machine_kg, most_kg) > 0.0 and not _LIGHT < most_kg / machine_kg < _HEAVY:
        yield (
            f"payload_kg is {most_kg:.3g} at most, on a machine of {machine_kg:.0f} kg by the rig file: is it in "
            f"{'t' if most_kg < machine_kg else 'g'}? convert it to kg"
        )


def _of_rates(rig: Rig, observations: Observations) -> Iterator[str]:
    for joint in rig.joints:
        rate = observations.extra.get(f"{joint.name}_rate", np.zeros(0))
        beyond = int((np.abs(rate) > _TOO_FAST * joint.max_rate).sum())
        if beyond:
            yield (
                f"{joint.name}_rate: {beyond} of {len(rate)} are more than {_TOO_FAST:g} times its max_rate, "
                f"{joint.max_rate:g} {joint.unit}/s; check column and unit, for the noise of a fix goes with its rates"
            )
