"""Loads the mathematical code that compares targets with the joints; numerical packages take a second to import."""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING

from calibration.rig.description import Rig
from daemon.sessions.prisms.sightings import Sighting, targets
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.identification.prism_identity import PrismIdentity
    from daemon.sessions.prisms.motion import TargetMotion

log = logging.getLogger(__name__)

RETRY_S = 30.0  # after it could not be loaded


class IdentityLoader:
    """Loads the mathematical code in a thread when a session first needs it, and retries on failure.

    Args:
        rig: the machine.

    Attributes:
        trouble: why the last attempt to load failed, a clause; None if it did not.
    """

    def __init__(self, rig: Rig) -> None:
        self.trouble: str | None = None
        self._rig = rig
        self._thread: threading.Thread | None = None
        self._loaded: PrismIdentity | None = None

    def now(self) -> PrismIdentity | None:
        """Return the comparison of prisms; None until it is loaded."""
        return self._loaded

    def motion(self) -> TargetMotion | None:
        """Return a new comparison of successive fixes; None until the code is loaded."""
        if self._loaded is None:
            return None
        from daemon.sessions.prisms.motion import TargetMotion

        return TargetMotion(self._rig)

    def start(self, wait_s: float = 0.0) -> None:
        """Start loading, and wait for its end for at most `wait_s` seconds."""
        if self._thread is None:
            thread = threading.Thread(target=self._run, name="prism-identity", daemon=True)
            try:
                thread.start()
            except RuntimeError as error:  # the system cannot start a thread; the next session tries again
                self._fail(error)
                return
            self._thread = thread
        if wait_s:
            self._thread.join(wait_s)

    def _run(self) -> None:
        while self._loaded is None:
            try:
                self._loaded = self._load()
                self.trouble = None
            except Exception as error:  # noqa: BLE001 - what the computer lacks may be available the next time
                self._fail(error)
                time.sleep(RETRY_S)

    def _load(self) -> PrismIdentity:
        prepare()
        import daemon.sessions.prisms.motion  # noqa: F401  # so that no later call waits for it
        from calibration.identification.prism_identity import PrismIdentity

        made = PrismIdentity(self._rig)
        middle = tuple(sum(joint.limits) / 2 for joint in self._rig.joints)
        made.own_misfits(targets(self._rig, [Sighting(self._rig.prism_names[0], middle, (0.0, 0.0, 0.0))]))
        return made

    def _fail(self, error: Exception) -> None:
        trouble = f"{type(error).__name__}: {error}"
        if trouble != self.trouble:
            log.error(
                "prisms cannot be checked against the joints at present; new locks are judged by distance alone",
                exc_info=error,
            )
        self.trouble = trouble
