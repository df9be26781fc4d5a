"""Sends the live tip over CAN, if configured."""

from __future__ import annotations

import threading

from daemon.config.sections import TipCanSection, TipSection
from daemon.models.live_tip import LiveTip
from drivers.can.tip_frames import encode_tip
from drivers.can_link import CanLink

STOP_TIMEOUT_S = 5.0


class TipSender(threading.Thread):
    """A thread that sends the tip at a fixed rate; without a position it sends only the status.

    Args:
        tip: the present position.
        section: prism and rate.
        can: CAN identifiers.
        link: CAN link to send on.
    """

    def __init__(self, tip: LiveTip, section: TipSection, can: TipCanSection, link: CanLink) -> None:
        super().__init__(name="tip", daemon=True)
        self._tip, self._section, self._can, self._link = tip, section, can, link
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Stop sending."""
        self._stopping.set()
        if self.is_alive():
            self.join(timeout=STOP_TIMEOUT_S)

    def run(self) -> None:
        """Send at the fixed rate until stopped; if sending is forbidden, the thread ends, which raises an alarm."""
        counter = 0
        while not self._stopping.wait(1.0 / self._section.rate_hz):
            message = self._tip.tip(self._section.prism).message()
            self._link.publish(encode_tip(message, self._can.arbitration_id, counter))
            counter += 1
