"""The problem that searches are compared on: a boom far from its drawing, base and prisms known, 38 unknowns.

The truth is computed by matrix products over all poses, apart from the calibration's kinematics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.kinematics.fitness import Fitness
from calibration.rig.description import Rig, shipped_rig

Floats = NDArray[np.float64]
NOISE_MM = 3.0


def _rotations(axis: int, angle: Floats) -> Floats:
    """(n, 4, 4) about x, y or z."""
    out = np.zeros((len(angle), 4, 4))
    u, v = (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis] = out[:, 3, 3] = 1.0
    out[:, u, u] = out[:, v, v] = np.cos(angle)
    out[:, v, u] = np.sin(angle)
    out[:, u, v] = -out[:, v, u]
    return out


def _translations(axis: int, length: Floats) -> Floats:
    """(n, 4, 4) along x, y or z."""
    out = np.zeros((len(length), 4, 4))
    out[:, range(4), range(4)] = 1.0
    out[:, axis, 3] = length
    return out


def positions_mm(rig: Rig, readings: Floats, deviation: dict[str, float]) -> Floats:
    """(poses, prisms, 3) by the rows' matrices, the base's frame being the station's."""

    def size(row: int, name: str) -> Floats:
        description = rig.rows[row]
        angle = name in {"alpha", "theta", "beta"}
        value = np.full(len(readings), getattr(description, f"{name}_deg" if angle else f"{name}_mm"))
        for driven, coefficients in description.drive.items():
            for joint, coefficient in coefficients.items() if driven == name else ():
                value = value + coefficient * readings[:, rig.joint_names.index(joint)]
        return (np.radians(value) if angle else value) + deviation.get(f"row{row + 1}.{name}", 0.0)

    frames = [np.tile(np.eye(4), (len(readings), 1, 1))]
    for row in range(len(rig.rows)):
        step = _translations(0, size(row, "a")) @ _rotations(0, size(row, "alpha"))
        step = step @ _translations(2, size(row, "d")) @ _rotations(2, size(row, "theta"))
        frames.append(frames[-1] @ step @ _rotations(1, size(row, "beta")))
    return np.stack([(frames[p.frame] @ [*p.offset_mm, 1.0])[:, :3] for p in rig.prisms], axis=1)


@dataclass(frozen=True)
class Boom:
    """One drawn machine and its fixes.

    Attributes:
        chain: kinematics of the drawing, the base at the station.
        samples: every prism in every pose, 3 mm of noise per axis.
        truth: (p,) its parameters.
        free: (p,) the 38 of the rows.
        width: (38,) how far the truth may be from the drawing.
    """

    chain: Chain
    samples: Samples
    truth: Floats
    free: NDArray[np.bool_]
    width: Floats

    @cached_property
    def fitness(self) -> Fitness:
        """Sum of squared errors, mm^2, of (candidates, 38)."""
        samples = self.samples
        return Fitness.build(
            self.chain,
            samples.data,
            samples.position_mm,
            np.ones(len(samples)),
            free=self.free,
            at=np.zeros(len(self.chain)),
        )

    def rms_mm(self, cost: float) -> float:
        """RMS 3-D error that a sum of squares is."""
        return math.sqrt(cost / len(self.samples))

    def refined(self, x: Floats) -> Fit:
        """Gauss-Newton from the 38 parameters `x`."""
        start = np.zeros(len(self.chain))
        start[self.free] = x
        return refine(self.chain, self.samples, start, free=self.free, prior="as-built")

    @cached_property
    def optimum(self) -> float:
        """Sum of squares that plain Gauss-Newton from the truth ends at."""
        x = self.truth.copy()
        for _ in range(20):
            error = self.samples.position_mm - self.chain.positions_mm(x, self.samples.data)
            jacobian = (
                self.chain.linearise(x, self.samples.data).jacobian[:, :, self.free].reshape(-1, int(self.free.sum()))
            )
            scale = 1.0 / np.linalg.norm(jacobian, axis=0)
            x[self.free] += scale * np.linalg.lstsq(jacobian * scale, error.ravel(), rcond=1e-9)[0]
        return float(self.fitness(x[self.free][None])[0])


def boom(seed: int, poses: int = 200, reach_mm: float = 400.0, reach_deg: float = 6.0) -> Boom:
    """A boom whose rows are uniformly wrong within +-reach, measured in random poses within the joints' limits."""
    rig = shipped_rig("swdt82")
    rng = np.random.default_rng(seed)
    chain = Chain(rig, {"": Placement.identity()})
    free = np.array([p.kind == "row" for p in chain.parameters])
    reach = np.array([reach_mm if p.unit == "mm" else math.radians(reach_deg) for p in chain.parameters])
    truth = np.where(free, reach * rng.uniform(-1.0, 1.0, len(chain)), 0.0)
    readings = np.column_stack([rng.uniform(*joint.limits, poses) for joint in rig.joints])
    deviation = {p.name: float(v) for p, v in zip(chain.parameters, truth, strict=True)}
    position = positions_mm(rig, readings, deviation).reshape(-1, 3)
    position += rng.normal(0.0, NOISE_MM, position.shape)
    prisms, n = len(rig.prisms), len(position)
    data = ChainData(readings.repeat(prisms, axis=0), np.tile(np.arange(prisms), poses), np.zeros(n, dtype=np.intp))
    samples = Samples(
        data,
        position,
        np.tile(NOISE_MM**2 * np.eye(3), (n, 1, 1)),
        np.zeros_like(data.readings),
        np.arange(n),
        0.0,
        np.ones(n),
        np.zeros(len(rig.joints)),
        np.arange(n),
    )
    return Boom(chain, samples, truth, free, reach[free])
