"""Text for people about the computer's clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_UNITS = ((1.0, "s", 1.0), (1e-3, "ms", 1e3), (0.0, "us", 1e6))


def clock_sentence(state: Mapping[str, Any]) -> str:
    """Return the state of the computer's clock as a clause."""
    if state["is_synchronized"] is None:
        return f"unknown whether it is synchronised ({state['error']})"
    if not state["is_synchronized"]:
        return "not synchronised with other clocks"
    text = f"synchronised ({state['source']})"
    if state["offset_s"] is not None:
        text += f", {_size(state['offset_s'])} {'ahead' if state['offset_s'] >= 0 else 'behind'}"
    if state["max_error_s"] is not None:
        text += f", off by at most {_size(state['max_error_s'])}"
    return text


def session_clock_lines(session: Mapping[str, Any]) -> Iterator[str]:
    """Yield the state of the computer's clock at a session's start and end, in one line if both are the same."""
    told = {phase: clock_sentence(state) for phase, state in session["clock"].items() if state is not None}
    if len(told) > 1 and len({*told.values()}) == 1:
        yield f"the computer's clock at its start and end: {told['start']}"
    else:
        for phase, sentence in told.items():
            yield f"the computer's clock at its {phase}: {sentence}"


def latency_sentence(latency: Mapping[str, Any]) -> str:
    """Return the latency of a session's fixes relative to its joint readings, as a clause."""
    if "reason" in latency:
        return f"unknown: {latency['reason']}"
    milliseconds, sigma = latency["seconds"] * 1e3, latency["standard_error_s"] * 1e3
    basis = f"{latency['fixes']} fixes of {latency['motions']} motions"
    return f"{milliseconds:.0f} ms +- {max(sigma, 1.0):.0f} ms in addition to link_delay_s (from {basis})"


def _size(seconds: float) -> str:
    size = abs(seconds)
    _, unit, factor = next(row for row in _UNITS if size >= row[0])
    return f"{size * factor:.3g} {unit}"
