"""Expected accuracy of a model over the work volume: its own error, apart from the noise of a fix.

Three things make a model's position err. Its parameters have a covariance. It lacks something: joints that yield,
encoders that are eccentric, slack. Whatever enters through the joints grows with the lever arm of each prism, which
noise of the fixes does not; so the training data themselves say how much of their scatter is the model's and how much
the instrument's (`model.joint_errors`). What scatters evenly at all prisms counts as noise of the fixes. And where the
model has effects that depend on more than the pose, such as slack on the side from which a joint came, a pose by itself
leaves them open.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from calibration.design.candidates import work_volume
from calibration.design.knowledge import Knowledge, setup_of
from calibration.design.visibility import site
from calibration.identification.noise import covariance_by_joints
from calibration.model.joint_errors import joint_error_sizes
from calibration.model.model import CalibratedModel
from calibration.numerics.matrices import traces
from calibration.observations import Floats
from calibration.rig.description import Rig

VOLUME_POSES = 1000
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
        return np.asarray(np.sqrt(traces(self._covariance_mm2)), dtype=np.float64)

    @property
    def rms_mm(self) -> float:
        """RMS 3-D error over all poses and prisms."""
        return _rms(self.rms_3d_mm)

    @property
    def parameters_mm(self) -> float:
        """Part by the parameters' covariance, RMS 3-D over all poses and prisms."""
        return _size_mm(self.parameters_mm2)

    @property
    def lacking_mm(self) -> float:
        """Part by errors that the model leaves, RMS 3-D over all poses and prisms."""
        return _size_mm(self.lacking_mm2)

    @property
    def open_mm(self) -> float:
        """Part that poses by themselves leave open, RMS 3-D over all poses and prisms."""
        return _size_mm(self.open_mm2)

    @cached_property
    def _norms_mm(self) -> Floats:
        """(draws, v, prisms) norms of errors drawn in every pose, always the same draws."""
        variance = np.maximum(np.linalg.eigvalsh(self._covariance_mm2), 0.0)
        drawn = np.random.default_rng(_SEED).standard_normal((_DRAWS, *variance.shape))
        return np.asarray(np.sqrt((variance * drawn**2).sum(axis=-1)), dtype=np.float64)

    @cached_property
    def spread(self) -> Spread:
        """Spread of the errors of all poses and prisms together."""
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
        """Return a JSON object: the spread over poses and prisms and of each prism, its parts, the worst pose."""
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
    """Predict the accuracy by what is known of a rig.

    Args:
        knowledge: where to linearise.
        root: (p + k, r) covariance of parameters and coefficients = root @ root'; after a plan it is smaller than the
            knowledge's own.
        readings: (v, joints) poses of the work volume, deg or mm.
        joint_error_scale: what the model lacks, as `joint_error_scale` gives it.
        parameters_share: share of the variance by parameters that a residual learner leaves.
        lacking_share: share that it leaves of the variance by what the model lacks.
    """
    rig = knowledge.chain.rig
    lin = knowledge.linearise(readings)
    lacking = lacking_share * (joint_error_sizes(rig) * joint_error_scale) ** 2
    rows = lin.jacobian @ root
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
    """Compute the accuracy that a calibrated model expects, in random poses of the work volume.

    Of several set-ups it is the one that `design.knowledge.setup_of` chooses. What a learned residual removed of the
    training data's scatter is removed here.

    Args:
        model: the model.
        rng: draws the poses.
        poses: number of them.

    Raises:
        UnsafeError: the rig can take no pose inside its joint limits.
    """
    number = setup_of(model)
    knowledge = Knowledge.of_model(model, number)
    at = site(model.chain, model.values, setup=number)
    return accuracy_of_model(model, knowledge, knowledge.root, work_volume(knowledge, at, rng, poses))


def accuracy_of_model(model: CalibratedModel, knowledge: Knowledge, root: Floats, readings: Floats) -> ExpectedAccuracy:
    """Predict the accuracy of a calibrated model whose residual learner is kept.

    The learner lowers the error that the kinematics leave as it does the whole excess: right where the excess is all
    the model's, and on the safe side where a part of it is noise of the fixes, from which no learner can take.

    Args:
        model: the model.
        knowledge: of it, or of the same machine at another set-up.
        root: as for `predicted_accuracy`.
        readings: (v, joints) poses of the work volume, deg or mm.
    """
    parameters_share = lacking_share = 1.0
    if model.residual is not None and model.excess_sigma_mm > 0.0:
        left = float(model.residual.excess_variance_mm2.sum()) / (3.0 * model.excess_sigma_mm**2)
        parameters_share, lacking_share = min(1.0, (model.noise_mm / model.effects_noise_mm) ** 2), min(1.0, left)
    return predicted_accuracy(
        knowledge,
        root,
        readings,
        joint_error_scale=model.joint_error_scale,
        parameters_share=parameters_share,
        lacking_share=lacking_share,
    )


def _size_mm(covariance: Floats) -> float:
    """RMS 3-D error of covariances (v, prisms, 3, 3)."""
    return math.sqrt(float(traces(covariance).mean()))


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _spread(rms_3d_mm: Floats, norms_mm: Floats) -> Spread:
    """Return the spread of errors whose RMS is known in each pose, the other figures from drawn norms."""
    median, p95, p99 = np.percentile(norms_mm, [50.0, 95.0, 99.0]).tolist()
    return Spread(_rms(rms_3d_mm), float(norms_mm.mean()), median, p95, p99)
