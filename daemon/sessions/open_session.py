"""An open session, and which fixes are its own: those measured in it while the station was on its prism."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from daemon.sessions.control_shot import Shot
from daemon.sessions.prisms.evidence import PrismEvidence
from daemon.sessions.prisms.guard import PrismGuard, Word
from daemon.sessions.station_setups import Place
from drivers.clock import Order, Stamp, lies_within

CONSTANT_TOLERANCE_MM = 0.05  # of a prism's constant: stations have it in steps of 0.1 mm
CONTROL_POINT_RADIUS_MM = 300.0  # a fix this close to a control point is of the control point, not of the boom


@dataclass
class OpenSession:
    """A session that takes fixes. Each fix's instant tells whose it is: it is joined, and comes, some time later.

    Attributes:
        order: of instants.
        since, until: fixes measured in between are of its prism, whichever run of the daemon decodes them; until is
            None while it is open.
        shots: when the station was on control points instead.
        jumped: joints whose encoder jumped in it, since when.
        constants_mm: station -> prism constant that it applied to its first fix that may be used.
        control_points: where those of its set-up are, mm.
        words: who said when that its stations are on its prism.
        guards: station -> what watches that it stays there; for the writer's thread.
        evidence: what the joints say of its prism; likewise.
    """

    id: str
    setup_id: str
    prism: str
    kind: str
    order: Order
    since: Stamp
    until: Stamp | None = None
    shots: list[Shot] = field(default_factory=list)
    jumped: dict[str, Stamp] = field(default_factory=dict)
    constants_mm: dict[str, float] = field(default_factory=dict)
    control_points: list[Place] = field(default_factory=list)
    words: list[Word] = field(default_factory=list)
    guards: dict[str, PrismGuard] = field(default_factory=dict)
    evidence: PrismEvidence | None = None

    def lasted(self, stamp: Stamp) -> bool:
        """Return True if that instant lies in it."""
        return lies_within(self.order, stamp, self.since, self.until)

    def has(self, stamp: Stamp) -> bool:
        """Return True if a fix of that instant is of its prism, and not of a shot."""
        return self.lasted(stamp) and not any(
            lies_within(self.order, stamp, shot.since, shot.until) for shot in self.shots
        )

    def confirmations_by(self, stamp: Stamp) -> int:
        """Return the number of times that an operator had confirmed its prism by then."""
        return sum(not word.is_turning and self.order(word.at) <= self.order(stamp) for word in self.words)

    def know(self, control_points: list[Place], constants_mm: dict[str, float]) -> None:
        """Take where the control points of its set-up are, and the prism constants of other fixes."""
        self.control_points, self.constants_mm = control_points, constants_mm

    def end_shots(self, at: Stamp) -> None:
        """Take the station to be on its prism from then on."""
        for shot in self.shots:
            shot.until = shot.until or at

    def is_control_point(self, place_mm: Place) -> bool:
        """Return True if a control point of its set-up is there."""
        return any(math.dist(place_mm, point) < CONTROL_POINT_RADIUS_MM for point in self.control_points)
