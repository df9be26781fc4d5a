"""Section of the calibration report on the latency of the station's fixes relative to the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from scipy.special import chdtrc

from daemon.report import markup
from daemon.report.words import PLUS_MINUS

if TYPE_CHECKING:  # imports numba, which would delay `status` and `--help`
    from calibration.evaluation.latency import Latency

_CLEAR = 3.0  # standard errors
_LEAST_MS = 1.0  # smallest uncertainty of a latency: the resolution of timestamps
_DISAGREE = 0.05  # sessions whose differences are less probable than this by chance do not share one latency
_MEANING = (
    "Delay of the total station's timestamps relative to those of the joint readings on the bus, beyond the delay that "
    "the configuration states (link_delay_s), estimated from fixes of the moving boom. Motion shows only the "
    "difference of the two delays: it is positive if the station is late, and negative if the bus is late. The model "
    "is fitted to fixes of the standing boom, which do not depend on this delay."
)


class _Combined(NamedTuple):
    """Latency of one station over several sessions.

    Attributes:
        size_ms, error_ms: mean weighted by the inverse variances, and its standard error.
        least_ms, most_ms: smallest and largest latency of a session.
        p: probability that the sessions differ as much by chance.
        sessions: number of sessions.
    """

    size_ms: float
    error_ms: float
    least_ms: float
    most_ms: float
    p: float
    sessions: int


def timing(latencies: Mapping[str, Latency | str], stations: Mapping[str, str] | None = None) -> str:
    """Return the section on latencies; empty without sessions.

    Args:
        latencies: session -> latency of its fixes, or a clause that states why it is unknown.
        stations: session -> name of the station that measured it; sessions that are missing share one station.
    """
    if not latencies:
        return ""
    known = {name: latency for name, latency in latencies.items() if not isinstance(latency, str)}
    rows = [
        [name, _size(*_milliseconds(latency)), str(latency.fixes), str(latency.motions)]
        for name, latency in known.items()
    ]
    columns = ["session", f"latency {PLUS_MINUS} standard error, ms", "fixes", "motions"]
    unknown = [f"{name}: not known, {why}." for name, why in latencies.items() if isinstance(why, str)]
    by_station: dict[str, list[Latency]] = {}
    for name, latency in known.items():
        by_station.setdefault((stations or {}).get(name, ""), []).append(latency)
    return markup.section(
        "Timing of station and bus",
        markup.paragraph(_MEANING),
        markup.table(columns, rows) if rows else "",
        *(markup.paragraph(_advice(station, _combined(found))) for station, found in by_station.items()),
        *(markup.paragraph(text, "note") for text in unknown),
    )


def _milliseconds(latency: Latency) -> tuple[float, float]:
    return latency.seconds * 1e3, max(latency.standard_error_s * 1e3, _LEAST_MS)


def _size(size_ms: float, error_ms: float) -> str:
    return f"{size_ms:.0f} {PLUS_MINUS} {error_ms:.0f}"


def _combined(latencies: Sequence[Latency]) -> _Combined:
    values = [_milliseconds(latency) for latency in latencies]
    weight = sum(error**-2 for _, error in values)
    mean = sum(size / error**2 for size, error in values) / weight
    chi2 = sum(((size - mean) / error) ** 2 for size, error in values)
    p = float(chdtrc(len(values) - 1, chi2)) if len(values) > 1 else 1.0
    sizes = [size for size, _ in values]
    return _Combined(mean, 1.0 / math.sqrt(weight), min(sizes), max(sizes), p, len(values))


def _advice(station: str, found: _Combined) -> str:
    """Return what the sessions of one station show together, and what to change."""
    whose = f"Station {station}" if station else "Station"
    if found.p < _DISAGREE:
        return (
            f"{whose}: the sessions disagree ({found.least_ms:.0f} to {found.most_ms:.0f} ms): change nothing; a busy "
            "computer delays unevenly."
        )
    over = f" over {found.sessions} sessions" if found.sessions > 1 else ""
    text = f"{whose}: {_size(found.size_ms, found.error_ms)} ms{over}"
    if abs(found.size_ms) <= _CLEAR * found.error_ms:
        return f"{text}, which is not clearly different from zero: change nothing."
    if found.size_ms > 0.0:
        return f"{text}; the station is late: add {found.size_ms:.0f} ms to link_delay_s of its [[station]]."
    return f"{text}; the bus is late: subtract {-found.size_ms:.0f} ms from link_delay_s of the [[station]]."
