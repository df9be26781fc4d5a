"""Sends the live tip over CAN, where the configuration says so."""

from __future__ import annotations

import threading

from daemon.config.sections import TipCanSection, TipSection
from daemon.models.live_tip import LiveTip
from drivers.can.tip_frames import encode_tip
from drivers.can_link import CanLink

STOP_TIMEOUT_S = 5.0


class TipSender(threading.Thread):
    """One thread that sends the tip at a fixed rate, its status too where there is no position.

    Args:
        tip: where the prism is.
        section: which prism, and how often.
        can: under which identifiers.
        link: where to.
    """

    def __init__(self, tip: LiveTip, section: TipSection, can: TipCanSection, link: CanLink) -> None:
        super().__init__(name="tip", daemon=True)
        self._tip, self._section, self._can, self._link = tip, section, can, link
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Send no more."""
        self._stopping.set()
        if self.is_alive():
            self.join(timeout=STOP_TIMEOUT_S)

    def run(self) -> None:
        """Send at the fixed rate until stopped; where it may not be sent, the thread ends, which is an alarm."""
        counter = 0
        while not self._stopping.wait(1.0 / self._section.rate_hz):
            message = self._tip.tip(self._section.prism).message()
            self._link.publish(encode_tip(message, self._can.arbitration_id, counter))
            counter += 1
