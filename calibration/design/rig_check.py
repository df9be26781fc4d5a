"""Check of a rig file: places at the zero pose, reach, links, and the parameters that data can show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calibration.design.visibility import Bodies, Site, is_reachable, limits, placement, site, spread_poses
from calibration.identification.identifiability import Identifiability, identifiability
from calibration.identification.samples import averaged
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

_LEAST_MM = 10.0  # every machine has a length above this
_TURN_RAD = 6.4  # a whole turn in rad; smaller limits may be in rad
_THICK = 0.25  # largest plausible radius of a link, as a share of the reach
_ROUNDED = 1e-3  # tolerance in right angles, for pi / 2 written with four digits
POSES = 100  # number of poses at which identifiability is evaluated
_POSES_EACH = 2.0  # poses per parameter where 100 are too few


@dataclass(frozen=True)
class LinkRadius:
    """The link of a row.

    Attributes:
        row: number of the row.
        length_mm: mean length of the link over the work volume.
        radius_mm: radius that `plan` keeps clear around the link.
        is_assumed: True if the row gives no radius.
    """

    row: int
    length_mm: float
    radius_mm: float
    is_assumed: bool


@dataclass(frozen=True)
class RigCheck:
    """Properties that follow from a rig file.

    Attributes:
        rig: the rig.
        zero: the machine with all joints at zero, one pose.
        middle: the machine with all joints in the middle of their limits, one pose.
        at: floor, station and reach.
        links: the links that have a length.
        free_share: share of the poses inside the limits in which links touch neither each other nor the floor.
        poses: number of poses that `seen` is based on.
        seen: identifiability of the parameters from fixes of all prisms in these poses, spread evenly.
    """

    rig: Rig
    zero: Bodies
    middle: Bodies
    at: Site
    links: tuple[LinkRadius, ...]
    free_share: float
    poses: int
    seen: Identifiability

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on values that may be missing or wrong in the file."""
        return tuple(self._warnings())

    def _warnings(self) -> Iterator[str]:
        yield from _unit_warnings(self.rig)
        assumed = [link for link in self.links if link.is_assumed]
        if assumed:
            yield (
                f"`rigcal plan` assumes a radius of {assumed[0].radius_mm:.0f} mm (1.2 % of the reach) for the links "
                f"of {len(assumed)} of {len(self.links)} rows; give them radius_mm"
            )
        for link in self.links:
            if not link.is_assumed and link.radius_mm > _THICK * self.at.reach_mm:
                yield (
                    f"radius_mm of row {link.row} is {link.radius_mm:g} mm, over a quarter of the reach: it is half "
                    "the width of a link, and links that always touch are not kept clear of each other; check it"
                )
        outside = [j for j in self.rig.joints if not j.limits[0] <= 0.0 <= j.limits[1]]
        if outside:
            yield (
                f"the zero pose is beyond the limits of {', '.join(j.name for j in outside)}: the drawing shows a pose "
                "that the machine does not take"
            )
        if self.free_share < 0.5:
            yield (
                f"in {1.0 - self.free_share:.0%} of the poses inside the limits, links as thick as that touch each "
                "other, the base or the floor"
            )
        if not self.rig.masses:
            yield "there are no masses: effects of gravity need measured torques (`<joint>_Nm`)"

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object of `rigcal rig check`."""
        frames, prisms = self.zero.frames_mm[0], self.zero.prisms_mm[0]
        return {
            "rig": self.rig.name,
            "joints": [j.name for j in self.rig.joints],
            "rows": len(self.rig.rows),
            "zero_pose": {
                "frames_mm": [[round(x, 6) + 0.0 for x in place] for place in frames.tolist()],
                "prisms_mm": {
                    name: [round(x, 6) + 0.0 for x in place]
                    for name, place in zip(self.rig.prism_names, prisms.tolist(), strict=True)
                },
            },
            "reach_mm": self.at.reach_mm,
            "floor_mm": self.at.floor_mm,
            "links": [
                {"row": k.row, "length_mm": k.length_mm, "radius_mm": k.radius_mm, "assumed": k.is_assumed}
                for k in self.links
            ],
            "free_share": self.free_share,
            "poses": self.poses,
            "identifiability": self.seen.as_dict(),
            "warnings": list(self.warnings),
        }


def _unit_warnings(rig: Rig) -> Iterator[str]:
    """Yield sentences on numbers that suggest a wrong unit."""
    lengths = [abs(x) for row in rig.rows for x in (row.a_mm, row.d_mm, row.b_mm)]
    lengths += [abs(x) for row in rig.rows if row.before for x in (row.before.x_mm, row.before.y_mm, row.before.z_mm)]
    lengths += [abs(x) for joint in rig.joints if joint.kind == "prismatic" for x in joint.limits]
    if 0.0 < max(lengths) < _LEAST_MM:
        yield f"no length of a row is over {max(lengths):g} mm: if lengths are in m here, convert them to mm"
    turning = [joint for joint in rig.joints if joint.kind == "revolute"]
    widest = max((abs(x) for joint in turning for x in joint.limits), default=0.0)
    if len(turning) > 1 and widest < _TURN_RAD:
        yield f"no joint turns further than {widest:g} deg: if limits are in rad here, convert them to deg"
    for number, row in enumerate(rig.rows, 1):
        for key in ("alpha_deg", "theta_deg"):
            quarters = abs(getattr(row, key)) / (np.pi / 2.0)
            if quarters > 0.5 and abs(quarters - round(quarters)) < _ROUNDED:
                yield (
                    f"{key} of row {number} is {getattr(row, key):g}, a multiple of a right angle in rad: if angles "
                    "are in rad here, convert them to deg"
                )
                return


def check_rig(rig: Rig) -> RigCheck:
    """Compute the properties of a rig that its file implies.

    Args:
        rig: the rig.

    Raises:
        CalibrationError: the file has implausible numbers.
    """
    chain = Chain(rig, {"": Placement.identity()})
    x = np.zeros(len(chain))
    at = site(chain, x)
    n = max(POSES, int(_POSES_EACH * len(chain) / len(rig.prisms)))
    bodies = Bodies.of(chain, x, spread_poses(rig, n))
    low, high = limits(rig)
    links = tuple(
        LinkRadius(k, bodies.length_mm(k), at.radius_mm(k), rig.rows[k - 1].radius_mm is None) for k in bodies.links
    )
    return RigCheck(
        rig,
        Bodies.of(chain, x, np.zeros((1, len(rig.joints)))),
        Bodies.of(chain, x, (low + high)[None] / 2.0),
        at,
        links,
        float(is_reachable(bodies, at).mean()),
        n,
        _seen(rig, spread_poses(rig, n), at),
    )


def _seen(rig: Rig, readings: Floats, at: Site) -> Identifiability:
    """Return the identifiability of the parameters from fixes of all prisms, measured from the station of `at`."""
    chain = Chain(rig, {"": placement(at)})
    n, prisms = len(readings), len(rig.prisms)
    rows = n * prisms
    label = np.full(rows, "")
    observations = Observations(
        prism=np.tile(rig.prism_names, n),
        joints=dict(zip(rig.joint_names, np.repeat(readings, prisms, axis=0).T, strict=True)),
        position_mm=np.zeros((rows, 3)),
        sigma_mm=np.full((rows, 3), np.nan),
        setup=label,
        session=label,
        pose=np.repeat(np.arange(n), prisms).astype(np.str_),
    )
    x = np.zeros(len(chain))
    observations.position_mm[:] = chain.positions_mm(x, chain.bind(observations))
    return identifiability(chain, averaged(chain, observations), x, 0.0)
