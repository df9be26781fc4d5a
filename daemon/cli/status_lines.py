"""Alarms, gaps, stations and failed decodes as lines for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from daemon.cli.talk import utc
from daemon.present_state import duration

_SHOWN = 6  # names in one line


def alarm_line(alarm: Mapping[str, Any]) -> str:
    """What is wrong, and since when."""
    since = f"{duration(alarm['age_s'])}, since {utc(alarm['since_utc_ns'])}"
    return f"{alarm['severity'].upper()} {alarm['kind']} {alarm['subject']}: {alarm['text']} ({since})"


def cleared_line(alarm: Mapping[str, Any]) -> str:
    """What was wrong, from when to when."""
    lasted = f"{utc(alarm['since_utc_ns'])} to {utc(alarm['cleared_utc_ns'])}"
    return f"{lasted} {alarm['severity']} {alarm['kind']} {alarm['subject']}: {alarm['text']}"


def gap_state_lines(acquisition: Mapping[str, Any]) -> Iterator[str]:
    """The gaps that are open, one line for all channels of a link that lack data for one reason."""
    links = {channel["name"]: channel["link"] for channel in acquisition["channels"]}
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for gap in acquisition["gaps"]:
        groups.setdefault((gap["reason"], links.get(gap["channel"], gap["channel"])), []).append(gap)
    for (reason, _), gaps in groups.items():
        names = [gap["channel"] for gap in gaps]
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        age = duration(gaps[0]["age_s"])  # the longest comes first
        yield f"gap: {reason.replace('_', ' ')} for {age}: {', '.join(names[:_SHOWN])}{more}"


def station_line(station: Mapping[str, Any]) -> str:
    """What a station is now."""
    return f"station {station['name']}: {station['sentence']}; {station['fixes']} fixes"


def decoding_lines(decoding: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """How much of each device could not be decoded, and mostly why."""
    for device in decoding:
        count, mostly = device["count"], device["reason_count"]
        why = device["reason"] if mostly == count else f"{mostly} of them: {device['reason']}"
        lately = f" ({device['lately']} in the last minute)" if device["lately"] else ""
        yield f"{count} captures of {device['device']} could not be decoded{lately}: {why}"
