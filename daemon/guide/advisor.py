"""Estimates of the remaining gain: queries the gain meter's process and keeps the newest answer."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from daemon.commands import CHECK
from daemon.guide.job import Job, Pose
from daemon.guide.meter_link import Answer, MeterLink, Place
from daemon.guide.stop_rule import Forecast, least_poses, stop_reason
from drivers.clock import Clock

log = logging.getLogger(__name__)

AHEAD = 5  # poses that the meter looks ahead
HUNG = "the gain meter, which chooses the poses, did not answer in time and was restarted"

Take = Callable[[str, list[Pose], str], None]
"""Receives a session, the poses chosen for it, and why there are none ("" if there are some)."""


class Advisor:
    """Queries the gain meter; answers arrive in a separate thread.

    Args:
        place: returns the locations of the meter's input.
        training: returns the sessions that the next model will be trained on, oldest first, without the open one.
        clock: clock for the time of an answer.
        enough: called with a session and the reason why it has enough poses.

    Attributes:
        accuracy, coverage: accuracy and coverage of the newest answer; None before the first.
        trouble: why there is no answer, a sentence; "" if there is one.
    """

    def __init__(
        self,
        place: Callable[[], Place],
        training: Callable[[], list[str]],
        clock: Clock,
        enough: Callable[[str, str], None],
    ) -> None:
        self.accuracy: dict[str, Any] | None = None
        self.coverage: dict[str, Any] | None = None
        self.trouble = ""
        self._place, self._training, self._clock, self._enough = place, training, clock, enough
        self._meter: MeterLink | None = None

    @property
    def is_alive(self) -> bool:
        """Return True while the process runs and answers in time."""
        return self._meter is not None and self._meter.is_alive

    def start(self) -> None:
        """Start or restart the process."""
        if self._meter is not None and self._meter.is_late:
            log.warning("the gain meter (process %d) did not answer in time; it is restarted", self._meter.pid)
            self.trouble = HUNG
        self.close()
        try:
            self._meter = MeterLink(self._place())
        except OSError as error:
            self.trouble = f"the gain meter cannot be started: {error}"

    def close(self) -> None:
        """End the process."""
        meter, self._meter = self._meter, None
        if meter is not None:
            meter.close()

    def forget(self) -> None:
        """Discard the answers for a previous guide."""
        self.accuracy, self.coverage, self.trouble = None, None, ""

    def assess(self, job: Job, setup: str) -> None:
        """Request the expected accuracy, which a check does not change.

        Args:
            job: job of the guide.
            setup: station set-up.
        """
        is_known_check = job.run.kind == CHECK and self.accuracy is not None
        if self._meter is None or job.state != "open" or not job.run.session or is_known_check:
            return
        prisms = list(dict.fromkeys(run.prism for run in job.runs[: job.at + 1] if run.session))
        question = self._question(job, setup) | {"do": "assess", "prisms": prisms, "next": job.run.upcoming(AHEAD)}
        self._meter.ask(question, partial(self._take_assessment, job, prisms))

    def choose(self, job: Job, setup: str, count: int, seed: int, take: Take) -> bool:
        """Request poses of the current run; return False if no gain meter was started.

        Args:
            job: job of the guide.
            setup: station set-up.
            count: number of poses.
            seed: seed of the choice.
            take: receives the poses.
        """
        if self._meter is None:
            return False
        is_check = job.run.kind == CHECK
        question = self._question(job, setup) | {"do": "choose", "count": count, "seed": seed, "evenly": is_check}
        self._meter.ask(question, partial(self._take_poses, job.run.session, take))
        return True

    def _question(self, job: Job, setup: str) -> dict[str, Any]:
        run, used = job.run, self._training()
        is_training = run.kind != CHECK and bool(run.session) and run.session not in used
        sessions = [*used, run.session] if is_training else used
        return {"sessions": sessions, "setup": setup, "session": run.session, "prism": run.prism}

    def _take_assessment(self, job: Job, prisms: Sequence[str], answer: Answer) -> None:
        if "error" in answer:
            self.trouble = str(answer["error"])
            return
        found = dict(answer["result"])
        self.trouble, self.coverage, needed = "", found.pop("coverage"), int(found.pop("least_poses"))
        self.accuracy = found | {
            "target_mm": job.request.target_mm,
            "prisms": list(prisms),
            "for_poses": job.run.done,
            "session": job.run.session,
            "computed_at_utc_ns": self._clock.now().utc_ns,
        }
        if found["prism_mm"] is not None and job.run.kind != CHECK:
            forecast = Forecast(found["now_mm"], found["prism_mm"], found["prism_after_5_mm"])
            reason = stop_reason(forecast, job.request.target_mm, job.run.done, least_poses(job, needed))
            if reason:
                self._enough(job.run.session, reason)

    def _take_poses(self, session: str, take: Take, answer: Answer) -> None:
        poses: list[Pose] = [] if "error" in answer else answer["result"]["poses"]
        take(session, poses, "" if poses else f"no poses could be chosen: {answer.get('error', 'none is in view')}")


def accuracy_view(job: Job, found: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the newest answer as clients see it, updated for events since then."""
    if found is None:
        return None
    run, target_mm = job.run, job.request.target_mm
    is_own = found["session"] == run.session
    why = found["why"]
    if not why and found["prism_mm"] is not None:
        gain = 1.0 - found["prism_after_5_mm"] / found["prism_mm"]
        why = run.enough or f"five more poses would lower the expected error of this prism by {gain:.0%}"
        why = f"{why[:1].upper()}{why[1:]}."
    return {key: value for key, value in found.items() if key not in ("session", "why")} | {
        "why": why,
        "is_target_reached": target_mm is not None and found["now_mm"] is not None and found["now_mm"] <= target_mm,
        "is_enough": bool(run.enough) and is_own,
        "for_poses": found["for_poses"] if is_own else 0,
    }
