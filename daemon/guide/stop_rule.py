"""The stop rule of a guide: when more poses of a prism are no longer worthwhile."""

from __future__ import annotations

import math
from dataclasses import dataclass

from daemon.commands import CHECK
from daemon.guide.job import Job

LEAST_POSES = 6  # of a prism
WORTHWHILE = 0.05  # five more poses must lower the expected error by this share
_MORE_THAN_NEEDED = 1.25  # margin on the number of poses without which a calibration is refused


@dataclass(frozen=True)
class Forecast:
    """Expected RMS 3-D error over the work volume, mm.

    Attributes:
        now_mm: present error of all prisms measured so far.
        prism_mm: present error of the prism that is being measured.
        prism_after_5_mm: error of this prism after five more poses.
    """

    now_mm: float
    prism_mm: float
    prism_after_5_mm: float


def least_poses(job: Job, needed: int) -> int:
    """Return the minimum number of poses of the prism.

    Args:
        job: job of the guide; its operator may have asked for more poses.
        needed: poses without which a calibration is refused; the sessions of a guide share them, with a margin.
    """
    sessions = sum(run.kind != CHECK for run in job.runs)
    return max(LEAST_POSES, job.run.least, math.ceil(_MORE_THAN_NEEDED * needed / sessions))


def stop_reason(forecast: Forecast, target_mm: float | None, done: int, least: int = LEAST_POSES) -> str:
    """Return why there are enough poses, a clause; "" if more poses are worthwhile.

    Args:
        forecast: expected errors.
        target_mm: error at which there are enough poses; None if none was given.
        done: measured poses of the prism.
        least: minimum number of poses.
    """
    if done < least:
        return ""
    if target_mm is not None and max(forecast.now_mm, forecast.prism_mm) <= target_mm:
        return f"the expected error, {forecast.prism_mm:.2g} mm, has reached the target of {target_mm:g} mm"
    gain = 1.0 - forecast.prism_after_5_mm / forecast.prism_mm
    if gain < WORTHWHILE:
        return f"five more poses would lower the expected error of {forecast.prism_mm:.2g} mm by only {gain:.0%}"
    return ""
