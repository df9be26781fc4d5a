"""An open session, and which fixes belong to it: those measured during it while the station was on its prism."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from daemon.sessions.control_shot import Shot
from daemon.sessions.prisms.evidence import PrismEvidence
from daemon.sessions.prisms.guard import OperatorConfirmation, PrismGuard
from daemon.sessions.station_setups import CONTROL_POINT_RADIUS_MM, Place
from drivers.clock import Order, Stamp, lies_within

OTHER_CONSTANT = "the station applies a prism constant of"  # the reasons for these exclusions begin with it
CONSTANT_TOLERANCE_MM = 0.05  # tolerance of a prism constant, which stations hold in steps of 0.1 mm


@dataclass
class OpenSession:
    """A session that takes fixes.

    A fix arrives some time after it was measured; its instant decides to which session it belongs.

    Attributes:
        order: order of instants.
        since, until: fixes measured in between are of its prism, whichever run of the daemon decodes them; until is
            None while it is open.
        shots: times during which the station was on control points instead.
        cut_off: start of a shot that the end of an earlier run cut off; the station may still be on its point.
        jumped: joint whose encoder jumped during the session -> instant of the jump.
        constants_mm: station -> prism constant of its first usable fix.
        control_points: places of the control points of its set-up, mm.
        is_outdated: a control point was located since its fixes were judged, so they must be judged again.
        confirmations: confirmations that its stations are on its prism.
        guards: station -> guard of its prism; for the writer thread only.
        evidence: evidence from the joints on its prism; for the writer thread only.
    """

    id: str
    setup_id: str
    prism: str
    kind: str
    order: Order
    since: Stamp
    until: Stamp | None = None
    shots: list[Shot] = field(default_factory=list)
    cut_off: Stamp | None = None
    jumped: dict[str, Stamp] = field(default_factory=dict)
    constants_mm: dict[str, float] = field(default_factory=dict)
    control_points: list[Place] = field(default_factory=list)
    is_outdated: bool = False
    confirmations: list[OperatorConfirmation] = field(default_factory=list)
    guards: dict[str, PrismGuard] = field(default_factory=dict)
    evidence: PrismEvidence | None = None

    def lasted(self, stamp: Stamp) -> bool:
        """Return True if that instant lies in the session."""
        return lies_within(self.order, stamp, self.since, self.until)

    def has(self, stamp: Stamp) -> bool:
        """Return True if a fix of that instant is of the session's prism, not of a shot."""
        away = [(shot.since, shot.until) for shot in self.shots]
        if self.cut_off is not None:
            away.append((self.cut_off, self.back()))
        return self.lasted(stamp) and not any(lies_within(self.order, stamp, *time) for time in away)

    @property
    def is_away(self) -> bool:
        """True while a guide knows that the station is on no prism."""
        return any(not shot.wanted and shot.until is None for shot in self.shots)

    def back(self) -> Stamp | None:
        """Return when the station was back after a shot that was cut off: on a confirmation, or after another shot."""
        ends = [one.at for one in self.confirmations]
        ends += [shot.until for shot in self.shots if shot.aimed is not None and shot.until is not None]
        return min((at for at in ends if lies_within(self.order, at, self.cut_off, None)), key=self.order, default=None)

    def confirmations_by(self, stamp: Stamp) -> int:
        """Return the number of times that an operator had confirmed its prism by then."""
        return sum(not one.is_turning and self.order(one.at) <= self.order(stamp) for one in self.confirmations)

    def know(self, control_points: list[Place], constants_mm: dict[str, float]) -> None:
        """Set the places of the set-up's control points, and the prism constants of earlier fixes."""
        is_outdated = control_points != self.control_points
        self.control_points, self.constants_mm = control_points, constants_mm
        self.is_outdated |= is_outdated  # only now, as another thread judges the fixes by these places

    def end_shots(self, at: Stamp) -> None:
        """End all open shots at an instant, from which the station is on the session's prism."""
        for shot in self.shots:
            shot.until = shot.until or at

    def is_control_point(self, place_mm: Place) -> bool:
        """Return True if a control point of the set-up is at that place."""
        return any(math.dist(place_mm, point) < CONTROL_POINT_RADIUS_MM for point in self.control_points)
