"""Measurement of a control point: the mean of the next good fixes of a stationary target."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

from daemon.commands import FAILED, LOOK_S, CommandError, is_cancelled
from daemon.sessions.station_setups import Place
from drivers.clock import Clock, Order, Stamp, lies_within
from drivers.readings import Fix, Status
from drivers.stations.survey import position_mm

log = logging.getLogger(__name__)

SPREAD_MM = 20.0  # fixes of one shot that lie further apart are not of one stationary target


@dataclass
class Shot:
    """One shot of a control point.

    Attributes:
        wanted: number of fixes needed; 0 for a time during which a guide knows that the station is on no prism.
        since, until: fixes measured in between are not of the prism.
        aimed: fixes measured from this instant on may be of the point; None until the station was told to turn to it.
        fixes, places_mm: fixes so far, and their places in the station's frame.
        done: completed once there are enough fixes.
    """

    wanted: int
    since: Stamp
    until: Stamp | None = None
    aimed: Stamp | None = None
    fixes: list[Fix] = field(default_factory=list)
    places_mm: list[Place] = field(default_factory=list)
    done: Future[None] = field(default_factory=Future)

    def take(self, fix: Fix, measured: Stamp, order: Order) -> None:
        """Add a fix, in order of time, if it is of the point; the last fix needed completes the shot.

        Args:
            fix: the fix.
            measured: when it was measured, which is before it arrived.
            order: order of instants.
        """
        place_mm = position_mm(fix)
        if self.done.done() or place_mm is None or fix.status is not Status.OK:
            return
        if not lies_within(order, measured, self.aimed, None):
            return
        if self.places_mm and math.dist(place_mm, self.places_mm[0]) > SPREAD_MM:
            self.fixes.clear()  # the station was still turning to the point
            self.places_mm.clear()
        self.fixes.append(fix)
        self.places_mm.append(place_mm)
        if len(self.fixes) == self.wanted:
            self.done.set_result(None)

    def wait(self, clock: Clock, timeout_s: float, why_no_fix: Callable[[], str | None]) -> None:
        """Wait until the shot is complete.

        If the caller disconnects, the shot is cancelled, because an operator who cancels turns the station back to the
        prism.

        Args:
            clock: clock of the rig, on which the timeout runs.
            timeout_s: longest wait.
            why_no_fix: returns why no fix can arrive at present, a clause; None if fixes can arrive.

        Raises:
            CommandError: the caller has disconnected, or too few good fixes were measured.
        """
        arrived = threading.Event()
        self.done.add_done_callback(lambda _: arrived.set())
        left_s, is_complete = timeout_s, False
        while left_s > 0 and not is_complete:
            is_complete = clock.wait(arrived, min(left_s, LOOK_S))
            left_s -= LOOK_S
            if is_cancelled():
                log.info("a shot of a control point was cancelled: its caller has disconnected")
                raise CommandError("the shot was cancelled, and nothing was stored", FAILED)
        if not is_complete:
            advice = "check with `rigcal status` that the station is aimed at the control point and locked"
            raise CommandError(
                f"only {len(self.fixes)} of {self.wanted} good fixes within {timeout_s:g} s; {why_no_fix() or advice}",
                FAILED,
            )
