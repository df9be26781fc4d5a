"""Section of the calibration report on the latency of the station's fixes relative to the bus."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from daemon.report import markup
from daemon.report.words import PLUS_MINUS

if TYPE_CHECKING:  # imports numba, which would delay `status` and `--help`
    from calibration.evaluation.latency import Latency

_CLEAR = 3.0  # standard errors
_LEAST_MS = 1.0  # smallest uncertainty of a latency: the resolution of timestamps
_MEANING = (
    "Delay of the total station's timestamps relative to those of the joint readings on the bus, beyond the delay that "
    "the configuration states (link_delay_s), estimated from fixes of the moving boom. Motion shows only the "
    "difference of the two delays: it is positive if the station is late, and negative if the bus is late. The model "
    "is fitted to fixes of the standing boom, which do not depend on this delay."
)


def timing(latencies: Mapping[str, Latency | str]) -> str:
    """Return the section on latencies; empty without sessions.

    Args:
        latencies: session -> latency of its fixes, or a clause that states why it is unknown.
    """
    if not latencies:
        return ""
    known = {name: latency for name, latency in latencies.items() if not isinstance(latency, str)}
    rows = [[name, _size(latency), str(latency.fixes), str(latency.motions)] for name, latency in known.items()]
    columns = ["session", f"latency {PLUS_MINUS} standard error, ms", "fixes", "motions"]
    unknown = [f"{name}: not known, {why}." for name, why in latencies.items() if isinstance(why, str)]
    return markup.section(
        "Timing of station and bus",
        markup.paragraph(_MEANING),
        markup.table(columns, rows) if rows else "",
        *(markup.paragraph(_advice(name, latency)) for name, latency in known.items() if _is_clear(latency)),
        *(markup.paragraph(text, "note") for text in unknown),
    )


def _milliseconds(latency: Latency) -> tuple[float, float]:
    return latency.seconds * 1e3, max(latency.standard_error_s * 1e3, _LEAST_MS)


def _size(latency: Latency) -> str:
    size_ms, error_ms = _milliseconds(latency)
    return f"{size_ms:.0f} {PLUS_MINUS} {error_ms:.0f}"


def _is_clear(latency: Latency) -> bool:
    size_ms, error_ms = _milliseconds(latency)
    return abs(size_ms) > _CLEAR * error_ms


def _advice(name: str, latency: Latency) -> str:
    size_ms, _ = _milliseconds(latency)
    if size_ms > 0.0:
        return f"In {name} the station is late by {size_ms:.0f} ms: add it to link_delay_s of its [[station]]."
    return f"In {name} the bus is late by {-size_ms:.0f} ms: subtract it from link_delay_s of the [[station]]."
