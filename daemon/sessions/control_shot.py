"""A control point being measured: the mean of the next good fixes of a standing target."""

from __future__ import annotations

import logging
import math
import threading
from concurrent.futures import Future
from dataclasses import dataclass, field

from daemon.commands import FAILED, CommandError, caller_has_left
from daemon.sessions.station_setups import Place
from drivers.clock import Clock, Order, Stamp, lies_within
from drivers.readings import Fix, Status
from drivers.stations.survey import position_mm

log = logging.getLogger(__name__)

SPREAD_MM = 20.0  # fixes of one shot that lie further apart are not of one standing target
_LOOK_S = 0.5  # how often a shot looks whether anyone still waits for it


@dataclass
class Shot:
    """One shot of a control point.

    Attributes:
        wanted: how many.
        since, until: fixes measured in between are not of the prism.
        aimed: fixes measured from then on may be of the point; None until the station was told to turn to it.
        fixes, places_mm: so far.
        done: when there are enough.
    """

    wanted: int
    since: Stamp
    until: Stamp | None = None
    aimed: Stamp | None = None
    fixes: list[Fix] = field(default_factory=list)
    places_mm: list[Place] = field(default_factory=list)
    done: Future[None] = field(default_factory=Future)

    def take(self, fix: Fix, order: Order) -> None:
        """Take a fix, in the order of time, if it is of the point; the last one that is wanted completes the shot."""
        place_mm = position_mm(fix)
        if self.done.done() or place_mm is None or fix.status is not Status.OK:
            return
        if not lies_within(order, fix.stamp, self.aimed, None):
            return
        if self.places_mm and math.dist(place_mm, self.places_mm[0]) > SPREAD_MM:
            self.fixes.clear()  # the station was still turning to it
            self.places_mm.clear()
        self.fixes.append(fix)
        self.places_mm.append(place_mm)
        if len(self.fixes) == self.wanted:
            self.done.set_result(None)

    def wait(self, clock: Clock, timeout_s: float) -> None:
        """Wait until the shot is complete; the time-out runs on the clock of the rig.

        An operator who gives up turns the station back to the prism: a shot that nobody waits for ends at once.

        Raises:
            CommandError: nobody waits any more, or too few good fixes came.
        """
        arrived = threading.Event()
        self.done.add_done_callback(lambda _: arrived.set())
        left_s, is_complete = timeout_s, False
        while left_s > 0 and not is_complete:
            is_complete = clock.wait(arrived, min(left_s, _LOOK_S))
            left_s -= _LOOK_S
            if caller_has_left():
                log.info("a shot of a control point was given up: nobody waits for it any more")
                raise CommandError("the shot was given up, and nothing was stored", FAILED)
        if not is_complete:
            raise CommandError(
                f"{len(self.fixes)} of {self.wanted} good fixes within {timeout_s:g} s; is the station aimed at the "
                "control point, and locked? `rigcal status` shows",
                FAILED,
            )
