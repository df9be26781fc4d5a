"""What the fit sees: fixes of one standstill averaged, each with its measurement covariance.

Fixes of one session, set-up, pose and prism are repeats: averaging them lowers the noise of station and readings, as
far as it shows among them. What does not show is common to a standstill: no number of repeats averages it out, and in
the readings it is the same at other prisms of the pose as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.standing import standing_spread
from calibration.kinematics import Chain, ChainData
from calibration.limits import turns_deg
from calibration.observations import Floats, Observations, originals
from calibration.rig import Rig

Integers = NDArray[np.intp]

_LEAST_REPEATS = 10  # degrees of freedom below which the scatter of repeats says nothing
_REPEAT_LIMIT = 6.0  # a repeat farther than so many sigma from its standstill's median stands alone


@dataclass(frozen=True)
class Samples:
    """Rows of a fit.

    Attributes:
        data: (m) bound readings, the mean of each standstill.
        position_mm: (m, 3) mean position in the station's frame.
        station_covariance: (m, 3, 3) of that mean, mm^2, without readings, timing and excess.
        rates: (m, joints) deg/s or mm/s at the fix, 0 where not measured.
        of_row: (n,) which sample each observation went into, a copy into that of its original.
        repeat_variance: mm^2 per axis that repeats scatter beyond the station's covariance.
        fixes: (m,) how many observations each is the mean of.
        reading_scatter: (joints,) variance, deg^2 or mm^2, that readings show among repeats; 0 where these are too few.
        standstill: (m,) samples with the same number share those random errors of their readings that repeats do not
            show; None where each is a standstill of its own.
    """

    data: ChainData
    position_mm: Floats
    station_covariance: Floats
    rates: Floats
    of_row: Integers
    repeat_variance: float
    fixes: Floats
    reading_scatter: Floats
    standstill: Integers | None = None

    def __len__(self) -> int:
        return len(self.data)

    def select(self, rows: Integers | NDArray[np.bool_]) -> Samples:
        """The given samples, by mask or by index, each as a standstill and an observation of its own."""
        data = self.data.select(rows)
        return replace(
            self,
            data=data,
            position_mm=self.position_mm[rows],
            station_covariance=self.station_covariance[rows],
            rates=self.rates[rows],
            of_row=np.arange(len(data)),
            fixes=self.fixes[rows],
            standstill=None,
        )

    def average(self, values: Floats) -> Floats:
        """(m, ...) means over the observations of each sample of their `values` (n, ...)."""
        return _averages(self.of_row, values)

    def shared_variance(self, rig: Rig) -> Floats:
        """(joints,) variance of a standstill's readings that is common to all of its samples, deg^2 or mm^2."""
        shared: Floats = np.maximum(reading_variance(rig) - self.reading_scatter, 0.0)
        return shared

    def own_covariance(self, rig: Rig, joint_jacobian: Floats) -> Floats:
        """(m, 3, 3) of each sample's position without what it shares with others of its standstill, mm^2.

        Arguments as `covariance`.
        """
        readings = covariance_by_joints(joint_jacobian, self.own_variance(rig))
        return self.station_covariance + readings + _timing_covariance(rig, joint_jacobian, self.rates)

    def own_variance(self, rig: Rig) -> Floats:
        """(m, joints) variance of each sample's mean readings beside that, deg^2 or mm^2."""
        own: Floats = np.minimum(reading_variance(rig), self.reading_scatter) / self.fixes[:, None]
        return own

    def covariance(self, rig: Rig, joint_jacobian: Floats) -> Floats:
        """(m, 3, 3) of each sample's position by station, readings and the instant of the fix, mm^2.

        Args:
            rig: gives the random errors of readings and instant.
            joint_jacobian: (m, 3, joints) mm per deg or mm.
        """
        shared = covariance_by_joints(joint_jacobian, self.shared_variance(rig))
        return shared + self.own_covariance(rig, joint_jacobian)

    def variance(self, rig: Rig, joint_jacobian: Floats) -> float:
        """Mean of it over samples and axes, mm^2; arguments as `covariance`."""
        return float(np.trace(self.covariance(rig, joint_jacobian), axis1=1, axis2=2).mean()) / 3.0


def station_covariance(rig: Rig, position_mm: Floats, sigma_mm: Floats) -> Floats:
    """(n, 3, 3) covariance of fixes at positions (n, 3), mm^2.

    `sigma_mm` (n, 3) is used where given; elsewhere the instrument's circles, distance and target centring.
    """
    station = rig.station
    range_mm = np.maximum(np.linalg.norm(position_mm, axis=1), 1e-6)
    radial = (station.distance_sigma_mm + station.distance_sigma_ppm * 1e-6 * range_mm) ** 2
    across = (range_mm * np.radians(station.angle_sigma_arcsec / 3600.0)) ** 2
    line = position_mm / range_mm[:, None]
    identity = np.eye(3)
    covariance: Floats = (across + station.target_sigma_mm**2)[:, None, None] * identity + (radial - across)[
        :, None, None
    ] * line[:, :, None] * line[:, None, :]
    given = np.isfinite(sigma_mm).all(axis=1)
    covariance[given] = sigma_mm[given][:, :, None] ** 2 * identity
    return covariance


def reading_variance(rig: Rig) -> Floats:
    """(joints,) variance of a reading, deg^2 or mm^2: sigma^2 + resolution^2 / 12."""
    return np.array([joint.sigma**2 + joint.resolution**2 / 12.0 for joint in rig.joints])


def reading_covariance(rig: Rig, joint_jacobian: Floats, rates: Floats) -> Floats:
    """(n, 3, 3) what random errors of the readings and of the fix's instant add, mm^2.

    J_q Sigma_q J_q' + (J_q q_dot)(J_q q_dot)' sigma_t^2, of each fix by itself.
    """
    covariance = covariance_by_joints(joint_jacobian, reading_variance(rig))
    return covariance + _timing_covariance(rig, joint_jacobian, rates)


def _timing_covariance(rig: Rig, joint_jacobian: Floats, rates: Floats) -> Floats:
    velocity = joint_jacobian @ rates[:, :, None] * rig.station.timing_sigma_s
    covariance: Floats = velocity @ velocity.transpose(0, 2, 1)
    return covariance


def covariance_by_joints(joint_jacobian: Floats, variance: Floats) -> Floats:
    """(n, 3, 3) J_q V J_q': what independent errors of the joints' values do to the positions, mm^2.

    Args:
        joint_jacobian: (n, 3, joints) J_q, mm per deg or mm.
        variance: (joints,) or (n, joints), deg^2 or mm^2.
    """
    scaled = joint_jacobian * np.sqrt(variance)[..., None, :]
    covariance: Floats = scaled @ scaled.transpose(0, 2, 1)
    return covariance


def joint_rates(rig: Rig, observations: Observations) -> Floats:
    """(n, joints) `<name>_rate` columns, 0 where there is none."""
    missing = np.zeros(len(observations))
    columns = [observations.extra.get(f"{name}_rate", missing) for name in rig.joint_names]
    rates: Floats = np.nan_to_num(np.column_stack(columns))
    return rates


def averaged(chain: Chain, observations: Observations) -> Samples:
    """Average the repeats of every standstill; repeats that disagree with it stay apart, copies count once.

    Raises:
        DataError: a prism or set-up that the chain does not know.
    """
    rig, turns = chain.rig, turns_deg(chain.rig)
    distinct, original = np.unique(originals(observations), return_inverse=True)
    observations = observations.select(distinct)
    data = chain.bind(observations)
    position = observations.position_mm
    covariance = station_covariance(rig, position, observations.sigma_mm)
    of_row, squares, freedom = _standstills(rig, turns, observations, data.readings, covariance)
    count = np.bincount(of_row).astype(float)
    expected = np.trace(covariance, axis1=1, axis2=2).mean() / 3.0
    within = squares / (3.0 * freedom) if freedom >= _LEAST_REPEATS else expected
    repeat_variance = max(0.0, within - expected)
    common = max(0.0, 1.0 - within / expected)

    first = np.unique(of_row, return_index=True)[1]
    start = data.readings[first][of_row]
    readings = start + _differences(turns, data.readings - start)
    mean = _averages(of_row, readings)
    scatter = ((readings - mean[of_row]) ** 2).sum(axis=0) / max(freedom, 1)
    means = ChainData(mean, data.prism[first], data.setup[first])
    return Samples(
        means,
        _averages(of_row, position),
        _averages(of_row, covariance + repeat_variance * np.eye(3)) * (common + (1.0 - common) / count)[:, None, None],
        _averages(of_row, joint_rates(rig, observations)),
        of_row[original],
        float(repeat_variance),
        count,
        scatter if freedom >= _LEAST_REPEATS else np.zeros_like(scatter),
        _shared(rig, turns, observations.select(first), means, np.bincount(of_row)),
    )


def _averages(of_row: Integers, values: Floats) -> Floats:
    order = np.argsort(of_row, kind="stable")
    first = np.flatnonzero(np.diff(of_row[order], prepend=-1))
    if len(first) == len(order):
        return values[order]
    count = np.diff(first, append=len(order)).reshape(-1, *([1] * (values.ndim - 1)))
    averages: Floats = np.add.reduceat(values[order], first, axis=0) / count
    return averages


def _shared(rig: Rig, turns: Floats, observations: Observations, means: ChainData, count: Integers) -> Integers:
    """(m,) number of each sample's standstill, from one observation of each, mean readings and how many it averages.

    A standstill takes a prism in once: a second sample of it is one that disagreed.
    """
    spread = standing_spread(rig)
    found = np.arange(len(means), dtype=np.intp)
    begun: dict[tuple[str, str, str], list[tuple[int, Floats, set[int]]]] = {}
    # Most repeats first, so that the odd one out joins no others.
    for sample in np.argsort(-count, kind="stable").tolist():
        key = str(observations.session[sample]), str(observations.setup[sample]), str(observations.pose[sample])
        if not key[2]:
            continue
        prism, readings = int(means.prism[sample]), means.readings[sample]
        for number, first, prisms in begun.setdefault(key, []):
            if prism not in prisms and (np.abs(_differences(turns, readings - first)) <= spread).all():
                prisms.add(prism)
                found[sample] = number
                break
        else:
            begun[key].append((sample, readings, {prism}))
    return found


def _differences(turns: Floats, change: Floats) -> Floats:
    """(n, joints) changes of readings, deg or mm, without the whole turns (joints,) that leave the machine in place."""
    return np.where(turns > 0.0, (change + 180.0) % 360.0 - 180.0, change)


def _standstills(
    rig: Rig, turns: Floats, observations: Observations, readings: Floats, covariance: Floats
) -> tuple[Integers, float, int]:
    """Sample index of every row; sum of squared deviations within standstills and its degrees of freedom.

    A row whose position or joints do not agree with the others of its standstill is a sample of its own: their mean
    would be a place, or a joint value, that never was.
    """
    position_mm = observations.position_mm
    from_middle = standing_spread(rig) / 2.0
    keys = zip(
        observations.session.tolist(),
        observations.setup.tolist(),
        observations.pose.tolist(),
        observations.prism.tolist(),
        strict=True,
    )
    members: dict[tuple[str, ...] | int, list[int]] = {}
    for row, key in enumerate(keys):
        members.setdefault(key if key[2] else row, []).append(row)
    of_row = np.empty(len(observations), dtype=np.intp)
    following, squares, freedom = 0, 0.0, 0
    for rows in members.values():
        together = np.array(rows)
        if len(rows) > 1:
            distance = np.linalg.norm(position_mm[rows] - np.median(position_mm[rows], axis=0), axis=1)
            sigma = np.sqrt(np.trace(covariance[rows], axis1=1, axis2=2))
            # The half-way point of two repeats proves neither wrong, so their own spread does not widen the limit.
            spread = 3.0 * np.median(distance) if len(rows) > 2 else 0.0
            agrees = distance <= np.maximum(_REPEAT_LIMIT * sigma, spread)
            change = _differences(turns, readings[rows] - readings[rows[0]])
            agrees &= (np.abs(change - np.median(change, axis=0)) <= from_middle).all(axis=1)
            for row in together[~agrees]:
                of_row[row] = following
                following += 1
            together = together[agrees]
        if len(together) == 0:
            continue
        of_row[together] = following
        following += 1
        squares += float(((position_mm[together] - position_mm[together].mean(axis=0)) ** 2).sum())
        freedom += len(together) - 1
    return of_row, squares, freedom
