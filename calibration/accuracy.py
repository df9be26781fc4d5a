"""How true a model is expected to be over the work volume: its own error, apart from the noise of a fix.

Three things make a model's position err. Its parameters have a covariance. It lacks something: joints that yield,
encoders that are eccentric, slack. Whatever enters through the joints grows with the lever arm of each prism, which
noise of the fixes does not; so the training data themselves say how much of their scatter is the model's and how much
the instrument's (`joint_error_scale`). What scatters evenly at all prisms counts as noise of the fixes. And where the
model has effects that depend on more than the pose, such as slack on the side from which a joint came, a pose by itself
leaves them open.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from calibration.design.knowledge import Knowledge, setup_of
from calibration.design.poses import work_volume
from calibration.design.visibility import site
from calibration.identification.samples import Samples, averaged, covariance_by_joints
from calibration.kinematics import Integers
from calibration.model import OUTLIER_SIGMA, CalibratedModel
from calibration.observations import Floats, Observations
from calibration.rig import Rig

VOLUME_POSES = 1000
_SURE = 5.0  # in log likelihood; less is chance
_LINEARITY_DEG = 0.1  # of an encoder whose rig file gives none
_LINEARITY = 1e-3  # of a transducer's stroke
_FLOOR = 0.1  # of the known variance: what a fitted row keeps at least
_PARTS = 3  # of a joint's range, to say where the model is worst
_NOTABLE = 1.15  # RMS there over the RMS of all
_MOST = 0.5  # of the RMS over all
_DRAWS, _SEED = 64, 0  # of errors in every pose


@dataclass(frozen=True)
class Spread:
    """Norms of the 3-D errors of several poses and prisms taken together, mm.

    Attributes:
        rms_mm, mean_mm, median_mm: of the norm.
        p95_mm, p99_mm: 95 % and 99 % of the errors are smaller.
    """

    rms_mm: float
    mean_mm: float
    median_mm: float
    p95_mm: float
    p99_mm: float


@dataclass(frozen=True)
class ExpectedAccuracy:
    """A model's own position errors over the work volume: in each pose normally distributed about zero.

    Attributes:
        rig: the rig description.
        setup: the set-up in whose station's frame the positions are.
        readings: (v, joints) poses, deg or mm.
        parameters_mm2: (v, prisms, 3, 3) covariance of the error that the parameters' covariance makes.
        lacking_mm2: (v, prisms, 3, 3) covariance of it that what the model lacks makes.
        open_mm2: (v, prisms, 3, 3) covariance of it by effects that need more than a pose: a direction of approach, a
            temperature, a load.
    """

    rig: Rig
    setup: str
    readings: Floats
    parameters_mm2: Floats
    lacking_mm2: Floats
    open_mm2: Floats

    @cached_property
    def _covariance_mm2(self) -> Floats:
        return self.parameters_mm2 + self.lacking_mm2 + self.open_mm2

    @cached_property
    def rms_3d_mm(self) -> Floats:
        """(v, prisms) RMS 3-D error expected in each pose."""
        return np.asarray(np.sqrt(_traces(self._covariance_mm2)), dtype=np.float64)

    @property
    def rms_mm(self) -> float:
        """RMS 3-D error over all poses and prisms."""
        return _rms(self.rms_3d_mm)

    @property
    def parameters_mm(self) -> float:
        """What the parameters' covariance has in it, RMS 3-D over all poses and prisms."""
        return _size_mm(self.parameters_mm2)

    @property
    def lacking_mm(self) -> float:
        """What the model lacks has in it, RMS 3-D over all poses and prisms."""
        return _size_mm(self.lacking_mm2)

    @property
    def open_mm(self) -> float:
        """What poses by themselves leave open has in it, RMS 3-D over all poses and prisms."""
        return _size_mm(self.open_mm2)

    @cached_property
    def _norms_mm(self) -> Floats:
        """(draws, v, prisms) norms of errors drawn in every pose, always the same draws."""
        variance = np.maximum(np.linalg.eigvalsh(self._covariance_mm2), 0.0)
        drawn = np.random.default_rng(_SEED).standard_normal((_DRAWS, *variance.shape))
        return np.asarray(np.sqrt((variance * drawn**2).sum(axis=-1)), dtype=np.float64)

    @cached_property
    def spread(self) -> Spread:
        """Of the errors of all poses and prisms together."""
        return _spread(self.rms_3d_mm, self._norms_mm)

    @cached_property
    def per_prism(self) -> dict[str, Spread]:
        """Prism -> spread of its errors in all poses."""
        names = self.rig.prism_names
        return {name: _spread(self.rms_3d_mm[:, i], self._norms_mm[:, :, i]) for i, name in enumerate(names)}

    @property
    def worst(self) -> tuple[int, int]:
        """Pose and prism with the largest RMS 3-D error."""
        pose, prism = np.unravel_index(int(np.argmax(self.rms_3d_mm)), self.rms_3d_mm.shape)
        return int(pose), int(prism)

    @property
    def where(self) -> str:
        """In words: the worst prism; the worst part of a joint's range and what poses leave open, where it is much."""
        worst, text = _NOTABLE * self.rms_mm, ""
        for index, joint in enumerate(self.rig.joints):
            edges = np.linspace(*joint.limits, _PARTS + 1)
            for low, high in pairwise(edges.tolist()):
                inside = (self.readings[:, index] >= low) & (self.readings[:, index] <= high)
                if inside.any() and _rms(self.rms_3d_mm[inside]) > worst:
                    worst = _rms(self.rms_3d_mm[inside])
                    text = f" and where {joint.name} is {low:.0f} .. {high:.0f} {joint.unit} ({worst:.2g} mm)"
        prism, spread = max(self.per_prism.items(), key=lambda item: item[1].rms_mm)
        if self.open_mm > _MOST * self.rms_mm:
            closed_mm = math.hypot(self.parameters_mm, self.lacking_mm)
            text += f"; {closed_mm:.2g} mm where the data have all columns that its effects need"
        return f"largest at prism {prism} ({spread.rms_mm:.2g} mm RMS){text}"

    def as_dict(self) -> dict[str, object]:
        """For JSON: the set-up, the spread over poses and prisms and of each prism, its parts, and the worst pose."""
        pose, prism = self.worst
        return {
            **asdict(self.spread),
            "parameters_mm": self.parameters_mm,
            "lacking_mm": self.lacking_mm,
            "open_mm": self.open_mm,
            "per_prism": {name: asdict(spread) for name, spread in self.per_prism.items()},
            "worst": {
                "prism": self.rig.prism_names[prism],
                "joints": {j.column: float(self.readings[pose, i]) for i, j in enumerate(self.rig.joints)},
                "rms_3d_mm": float(self.rms_3d_mm[pose, prism]),
            },
            "where": self.where,
            "setup": self.setup,
            "poses": len(self.readings),
        }


def predicted_accuracy(
    knowledge: Knowledge,
    root: Floats,
    readings: Floats,
    *,
    joint_error_scale: float = 0.0,
    parameters_share: float = 1.0,
    lacking_share: float = 1.0,
) -> ExpectedAccuracy:
    """Accuracy of what is known of a rig.

    Args:
        knowledge: where to linearise.
        root: (p + k, r) covariance of parameters and coefficients = root @ root'; after a plan it is smaller than the
            knowledge's own.
        readings: (v, joints) poses of the work volume, deg or mm.
        joint_error_scale: what the model lacks, as `joint_error_scale` gives it.
        parameters_share, lacking_share: of either variance that a residual learner leaves.
    """
    rig = knowledge.chain.rig
    lin, jacobian = knowledge.linearise(readings)
    lacking = lacking_share * (joint_error_sizes(rig) * joint_error_scale) ** 2
    rows = jacobian @ root
    shape = len(readings), len(rig.prisms), 3, 3
    even = knowledge.unknown_mm2(readings)[:, None, None] * np.eye(3)
    return ExpectedAccuracy(
        rig,
        knowledge.chain.setups[knowledge.setup],
        readings,
        parameters_share * (rows @ rows.transpose(0, 2, 1)).reshape(shape),
        covariance_by_joints(lin.joint_jacobian, lacking).reshape(shape),
        (covariance_by_joints(lin.joint_jacobian, knowledge.unknown_variance(readings)) + even).reshape(shape),
    )


def expected_accuracy(
    model: CalibratedModel, rng: np.random.Generator, *, poses: int = VOLUME_POSES
) -> ExpectedAccuracy:
    """What a calibrated model expects of itself, in random poses of the work volume (`design.work_volume`).

    Of several set-ups it is the one that `design.knowledge.setup_of` chooses. What a learned residual removed of the
    training data's scatter is removed here.

    Args:
        model: the model.
        rng: draws the poses.
        poses: how many.

    Raises:
        UnsafeError: the rig can take no pose inside its joint limits.
    """
    number = setup_of(model)
    knowledge = Knowledge.of_model(model, number)
    at = site(model.chain, model.values, setup=number)
    readings = work_volume(knowledge, at, rng, poses)
    parameters, lacking = shares_left(model)
    return predicted_accuracy(
        knowledge,
        knowledge.root,
        readings,
        joint_error_scale=model.joint_error_scale,
        parameters_share=parameters,
        lacking_share=lacking,
    )


def shares_left(model: CalibratedModel) -> tuple[float, float]:
    """Shares of the parameters' variance and of what the kinematics lack that a model's residual learner leaves.

    What the kinematics lack is lowered as the whole excess is: right where the excess is all the model's, and on the
    safe side where a part of it is noise of the fixes, from which no learner can take.
    """
    if model.residual is None or model.excess_sigma_mm == 0.0:
        return 1.0, 1.0
    left = float(model.residual.excess_variance_mm2.sum()) / (3.0 * model.excess_sigma_mm**2)
    return min(1.0, (model.noise_mm / model.effects_noise_mm) ** 2), min(1.0, left)


def joint_error_sizes(rig: Rig) -> Floats:
    """(joints,) systematic error of each joint that its rig file names (`linearity`), or a usual one, deg or mm."""
    return np.array(
        [
            (joint.linearity or _LINEARITY_DEG)
            if joint.kind == "revolute"
            else (joint.linearity or _LINEARITY) * (joint.limits[1] - joint.limits[0])
            for joint in rig.joints
        ]
    )


def joint_error_scale(model: CalibratedModel, observations: Observations, *, structured: bool = False) -> float:
    """What the kinematics (and effects) lack: the size of an error of every joint, in `joint_error_sizes`.

    The errors of the training fixes have the covariance Sigma_known + s^2 I + k^2 J_q D J_q' - J C J': station and
    readings, even noise, an error of the joints with the lever arms J_q, less what the fit took. Repeats are averaged.
    Maximum likelihood in s and k, with k = 0 unless the data prefer another by 5 in log likelihood. For that the prisms
    of a standstill count together, as a joint's error is the same at each; but the size of k is that of the fixes each
    by itself, which holds also where what the model lacks moves the prisms of a standstill otherwise than joints do.
    Where the lever arms are much the same everywhere, the data cannot prefer; what is known to have structure counts as
    an error of the joints all the same.

    Args:
        model: fitted to these rows; outliers are left out.
        observations: the training rows.
        structured: whether the errors are known to depend on something, and so are no noise.

    Returns:
        k >= 0; 0 where even noise explains the scatter.
    """
    rows = observations.select(model.deviations(observations) <= OUTLIER_SIGMA)
    if len(rows) == 0:
        return 0.0
    samples = averaged(model.chain, rows)
    each = _groups(model, rows, samples, np.arange(len(samples)))
    scale, gain = _likeliest(each, model.excess_sigma_mm)
    if samples.standstill is not None and gain > _SURE:
        _, gain = _likeliest(_groups(model, rows, samples, samples.standstill), model.excess_sigma_mm)
    if gain > _SURE:
        return scale
    by_joint = _mean_variance(each, "by_joint")
    return model.excess_sigma_mm / math.sqrt(by_joint) if structured and by_joint > 0.0 else 0.0


@dataclass(frozen=True)
class _Groups:
    """Groups of equally many samples that err together, g of them with c = 3 coordinates a sample.

    Attributes:
        error: (g, c) measured minus modelled.
        known: (g, c, c) covariance by station and readings.
        by_joint: (g, c, c) covariance by an error of every joint in `joint_error_sizes`.
        taken: (g, c, c) what the fit took.
    """

    error: Floats
    known: Floats
    by_joint: Floats
    taken: Floats

    @cached_property
    def least(self) -> Floats:
        """(g, 1) variance that any combination of a group's coordinates keeps."""
        least: Floats = _FLOOR * _traces(self.known)[:, None] / self.error.shape[1]
        return least

    def cost(self, even: float, lever: float) -> float:
        """Negative log likelihood for s^2 and k^2."""
        covariance = self.known + even * np.eye(self.error.shape[1]) + lever * self.by_joint - self.taken
        value, vector = np.linalg.eigh(covariance)
        value = np.maximum(value, self.least)
        along = np.einsum("gji,gj->gi", vector, self.error)
        return 0.5 * float(np.log(value).sum() + (along**2 / value).sum())


def _groups(model: CalibratedModel, rows: Observations, samples: Samples, label: Integers) -> list[_Groups]:
    """The samples in groups of one label (m,)."""
    rig = model.rig
    lin, by_parameter = model.linearise(rows)
    error = samples.average(rows.position_mm - lin.position_mm)
    by_reading, by_parameter = samples.average(lin.joint_jacobian), samples.average(by_parameter)
    taken = (by_parameter.reshape(-1, len(model.covariance)) @ model.covariance).reshape(by_parameter.shape)
    unsure = samples.shared_variance(rig) + samples.average(model.unknown_variance(rows))
    alone = samples.own_covariance(rig, by_reading)
    order = np.argsort(label, kind="stable")
    start, count = np.unique(label[order], return_index=True, return_counts=True)[1:]
    found = []
    for size in np.unique(count).tolist():
        at = order[start[count == size][:, None] + np.arange(size)]  # (g, size) samples
        shape = len(at), 3 * size
        known = np.zeros((len(at), size, 3, size, 3))
        for i in range(size):
            known[:, i, :, i] = alone[at[:, i]]
        arms, fitted = by_reading[at].reshape(*shape, -1), by_parameter[at].reshape(*shape, -1)
        found.append(
            _Groups(
                error[at].reshape(shape),
                known.reshape(*shape, 3 * size) + covariance_by_joints(arms, unsure[at].mean(axis=1)),
                covariance_by_joints(arms, joint_error_sizes(rig) ** 2),
                taken[at].reshape(*shape, -1) @ fitted.transpose(0, 2, 1),
            )
        )
    return found


def _likeliest(groups: list[_Groups], excess_sigma_mm: float) -> tuple[float, float]:
    """The likeliest size of an error of every joint, and what it gains in log likelihood over none."""
    known, by_joint = _mean_variance(groups, "known"), _mean_variance(groups, "by_joint")
    if by_joint == 0.0:
        return 0.0, 0.0

    def cost(logarithms: Floats) -> float:
        """Negative log likelihood for log s^2 and, where given, log k^2."""
        even, lever = [*np.exp(logarithms), 0.0][:2]
        return sum(g.cost(even, lever) for g in groups)

    def best(*start: float) -> tuple[Floats, float]:
        found = minimize(cost, np.array(start), method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01})
        return found.x, float(found.fun)

    even = math.log(max(excess_sigma_mm**2, 0.01 * _FLOOR * known))
    _, without = best(even)
    at, with_joints = best(even, even - math.log(by_joint))
    return math.exp(0.5 * float(at[1])), without - with_joints


def _mean_variance(groups: list[_Groups], part: Literal["known", "by_joint"]) -> float:
    """Of a coordinate, mm^2."""
    return sum(float(_traces(getattr(g, part)).sum()) for g in groups) / sum(g.error.size for g in groups)


def _traces(covariance: Floats) -> Floats:
    return np.asarray(np.trace(covariance, axis1=-2, axis2=-1), dtype=np.float64)


def _size_mm(covariance: Floats) -> float:
    """RMS 3-D error of covariances (v, prisms, 3, 3)."""
    return math.sqrt(float(_traces(covariance).mean()))


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _spread(rms_3d_mm: Floats, norms_mm: Floats) -> Spread:
    """Of poses with these RMS errors, which need no draws, and norms drawn."""
    median, p95, p99 = np.percentile(norms_mm, [50.0, 95.0, 99.0]).tolist()
    return Spread(_rms(rms_3d_mm), float(norms_mm.mean()), median, p95, p99)
