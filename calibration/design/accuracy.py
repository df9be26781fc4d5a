"""Expected accuracy of a model over the work volume: its own error, apart from the noise of a fix.

A model's position error has three sources:

1. Its parameters have a covariance.
2. It lacks some effects, such as compliant joints, eccentric encoders or backlash. Errors that enter through the joints
   grow with the lever arm of each prism, noise of the fixes does not. The training data therefore show how much of
   their scatter is due to the model and how much to the instrument (`model.joint_errors`). Scatter that is equal at
   all prisms counts as noise of the fixes.
3. Some of its effects may depend on more than the pose, as backlash depends on the direction of approach. A pose alone
   does not determine them.
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
_PARTS = 3  # equal parts of a joint's range that are compared to find where the model is worst
_NOTABLE = 1.15  # a part is reported if its RMS exceeds the total RMS by this factor
_MOST = 0.5  # share of the total RMS above which the undetermined part is reported
_DRAWS, _SEED = 64, 0  # random errors drawn in every pose


@dataclass(frozen=True)
class Spread:
    """Statistics of the norms of 3-D errors, pooled over poses and prisms, mm.

    Attributes:
        rms_mm, mean_mm, median_mm: RMS, mean and median of the norm.
        p95_mm, p99_mm: 95th and 99th percentile of the norm.
    """

    rms_mm: float
    mean_mm: float
    median_mm: float
    p95_mm: float
    p99_mm: float


@dataclass(frozen=True)
class ExpectedAccuracy:
    """Expected position errors of a model over the work volume, without measurement noise; normal with mean zero.

    Attributes:
        rig: the rig description.
        setup: the set-up whose station frame the positions refer to.
        readings: (v, joints) poses, deg or mm.
        parameters_mm2: (v, prisms, 3, 3) error covariance due to the covariance of the parameters.
        lacking_mm2: (v, prisms, 3, 3) error covariance due to effects that the model lacks.
        open_mm2: (v, prisms, 3, 3) error covariance due to effects that need more than a pose: a direction of approach,
            a temperature, a load.
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
        """Part due to the covariance of the parameters, RMS 3-D over all poses and prisms."""
        return _size_mm(self.parameters_mm2)

    @property
    def lacking_mm(self) -> float:
        """Part due to effects that the model lacks, RMS 3-D over all poses and prisms."""
        return _size_mm(self.lacking_mm2)

    @property
    def open_mm(self) -> float:
        """Part due to effects that poses alone do not determine, RMS 3-D over all poses and prisms."""
        return _size_mm(self.open_mm2)

    @cached_property
    def _norms_mm(self) -> Floats:
        """(draws, v, prisms) norms of random errors in every pose, drawn with a fixed seed."""
        variance = np.maximum(np.linalg.eigvalsh(self._covariance_mm2), 0.0)
        drawn = np.random.default_rng(_SEED).standard_normal((_DRAWS, *variance.shape))
        return np.asarray(np.sqrt((variance * drawn**2).sum(axis=-1)), dtype=np.float64)

    @cached_property
    def spread(self) -> Spread:
        """Spread of the errors over all poses and prisms."""
        return _spread(self.rms_3d_mm, self._norms_mm)

    @cached_property
    def per_prism(self) -> dict[str, Spread]:
        """Prism -> spread of its errors over all poses."""
        names = self.rig.prism_names
        return {name: _spread(self.rms_3d_mm[:, i], self._norms_mm[:, :, i]) for i, name in enumerate(names)}

    @property
    def worst(self) -> tuple[int, int]:
        """Indices of the pose and prism with the largest RMS 3-D error."""
        pose, prism = np.unravel_index(int(np.argmax(self.rms_3d_mm)), self.rms_3d_mm.shape)
        return int(pose), int(prism)

    @property
    def where(self) -> str:
        """Sentence naming the worst prism and, where notable, the worst joint range and the undetermined part."""
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
        """Return a JSON object with the spread in total and for each prism, its parts, and the worst pose."""
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
    """Predict the accuracy from the knowledge of a rig.

    Args:
        knowledge: linearisation point, and the effects of the model.
        root: (p + k, r) root of the covariance of parameters and coefficients, root @ root'. After a plan it is smaller
            than that of `knowledge`.
        readings: (v, joints) poses of the work volume, deg or mm.
        joint_error_scale: size of the joint errors that the model lacks, as returned by `joint_error_scale`.
        parameters_share: share of the variance due to parameters that remains after a residual learner.
        lacking_share: share of the variance due to lacking effects that remains after a residual learner.
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
    """Compute the expected accuracy of a calibrated model in random poses of the work volume.

    Of several set-ups, `design.knowledge.setup_of` chooses one. The share of the training data's scatter that a learned
    residual removed is removed here too.

    Args:
        model: the model.
        rng: random generator for the poses.
        poses: number of poses.

    Raises:
        UnsafeError: the rig can take no pose inside its joint limits.
    """
    number = setup_of(model)
    knowledge = Knowledge.of_model(model, number)
    at = site(model.chain, model.values, setup=number)
    return accuracy_of_model(model, knowledge, knowledge.root, work_volume(knowledge, at, rng, poses))


def accuracy_of_model(model: CalibratedModel, knowledge: Knowledge, root: Floats, readings: Floats) -> ExpectedAccuracy:
    """Predict the accuracy of a calibrated model, including its residual learner.

    The learner is assumed to reduce the error left by the kinematics in the same proportion as the whole excess
    variance. This is exact where all excess is due to the model, and conservative where part of it is noise of the
    fixes, which no learner can reduce.

    Args:
        model: the model.
        knowledge: knowledge of the model, or of the same machine at a different set-up.
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
    """Return the spread of errors: the RMS from the RMS of each pose, the other statistics from drawn norms."""
    median, p95, p99 = np.percentile(norms_mm, [50.0, 95.0, 99.0]).tolist()
    return Spread(_rms(rms_3d_mm), float(norms_mm.mean()), median, p95, p99)
