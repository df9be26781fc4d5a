"""The daemon's state on one screen: what it does, what is wrong, and what to do next.

Alarms have priority, then open gaps. Long lists are shortened; a line counts the omitted entries and names the command
that shows them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from calibration.rig.words import counted
from daemon.cli.lines.jobs import job_lines
from daemon.cli.lines.state import (
    alarm_line,
    channel_status,
    decoding_lines,
    gap_state_lines,
    model_lines,
    notice_lines,
    store_lines,
)
from daemon.host.safe_output import duration, shown
from daemon.next_step import next_line
from daemon.report.words import number

LINES = 23  # of a terminal's 24 lines, one is for the prompt
NARROWEST = 60
_LABEL = 10  # characters
_NAMES_SHOWN = 6
_REASONS_SHOWN = 2
_DEVICES_SHOWN = 2  # with decoding failures
_JOBS_SHOWN = 3
_GAPS_KEPT = 3  # shown even if there are many alarms
_CELL = 22  # characters of a joint with its value
_HELD_UP_S = 30.0


class Line(NamedTuple):
    """A line of the screen with its style options of `click.style`."""

    text: str
    style: Mapping[str, Any] = {}


def state_sentence(status: Mapping[str, Any]) -> str:
    """Return in one sentence what the rig is doing."""
    session, jobs, models = status["session"], status["jobs"], status["models"] or {}
    if status["alarms"]["looked_age_s"] > _HELD_UP_S:
        return f"blocked: the daemon last evaluated its alarms {duration(status['alarms']['looked_age_s'])} ago"
    if session is not None:
        holds = f"{counted(session['poses'], 'pose')}, {counted(session['observations'], 'observation')}"
        return f"recording session {session['id']} ({session['kind']}, prism {session['prism']}): {holds}"
    if (guide := status.get("guide")) is not None:
        return f"guide {guide['id']} is open, no session is open"
    if any(job["state"] == "running" for job in jobs):
        return "calibrating: a job runs, no session is open"
    links = status["acquisition"]["links"]
    if links and not any(link["up"] for link in links):
        return "not connected: no link is open"
    live = models.get("live")
    return f"ready, {'no model' if live is None else 'model ' + str(live['id'])} is live, no session is open"


def summary(status: Mapping[str, Any], width: int, lines: int = LINES, *, with_joints: bool = False) -> list[Line]:
    """Return the state in a limited number of lines.

    Args:
        status: the daemon's state.
        width: columns of the terminal.
        lines: largest number of lines; may be exceeded if it is very small.
        with_joints: whether to include the joints' values.
    """
    width = max(width, NARROWEST)
    version = f", rigcal {status['version']}" if "version" in status else ""
    head = _labelled("rig", [f"{status['rig']} ({status['mode']}){version}, store {status['store']}"], width)
    head += _labelled("state", [state_sentence(status)], width, bold=True)
    joints = _joints(status["acquisition"]["channels"], width) if with_joints else []
    end = _labelled("next", [next_line(status)], width, bold=True)
    gaps = _entries("gaps", _gaps(status["acquisition"]), width)
    body = [entry for label, texts in _body(status) for entry in _entries(label, texts, width)]
    room = lines - len(head) - len(joints) - len(end)
    kept = sum(map(len, gaps[:_GAPS_KEPT])) + 1  # and a line that counts the omitted lines
    alarms = _alarms(status["alarms"]["active"], width, room - kept)
    told = _fitted([*gaps, *body], room - len(alarms), "... {} more lines: `rigcal status --all` shows them", width)
    return [*head, *alarms, *joints, *told, *end]


def reading(channel: Mapping[str, Any]) -> str:
    """Return the current value of a channel with its unit, or the reason why there is none."""
    if channel["value"] is None:
        return channel_status(channel).partition(",")[0]  # only the first words fit beside other channels
    return f"{channel['value']:.3f} {channel['unit']}"


def _joints(channels: Sequence[Mapping[str, Any]], width: int) -> list[Line]:
    """Return the joints' values in columns with fixed positions."""
    cells = [f"{c['name']} {reading(c)}" for c in channels if c["kind"] == "joint"]
    many = max((width - _LABEL) // _CELL, 1)
    rows = ["".join(f"{shown(cell):{_CELL}}" for cell in cells[i : i + many]) for i in range(0, len(cells), many)]
    return [Line(f"{'joints' if not place else '':{_LABEL}}{row}".rstrip()) for place, row in enumerate(rows)]


def _alarms(active: Sequence[Mapping[str, Any]], width: int, room: int) -> list[Line]:
    """Return as many alarms with their remedies as fit, the most important first, but at least one."""
    if not active:
        return _labelled("alarms", ["none"], width)
    entries: list[list[Line]] = []
    for alarm in active:
        is_critical = alarm["severity"] == "critical"
        style = {"fg": "red" if is_critical else "yellow", "bold": is_critical}
        label = "" if entries else "alarms"
        remedy = _labelled("", [f"  {alarm['remedy']}"], width)
        entries.append(_labelled(label, [alarm_line(alarm)], width, **style) + remedy)
    return _fitted(entries, max(room, len(entries[0]) + 1), "and {} more: `rigcal alarms` shows all", width)


def _gaps(acquisition: Mapping[str, Any]) -> list[str]:
    return [line.removeprefix("gap: ") for line in gap_state_lines(acquisition)]


def _body(status: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    acquisition, models, gap = status["acquisition"], status["models"], status["gap"]
    failing = sorted(acquisition["decoding"], key=lambda device: -device["lately"])
    yield "links", [_links(acquisition["links"])]
    yield "channels", [_channels(acquisition["channels"])]
    yield "station", [f"{s['name']}: {s['sentence']}; {s['fixes']} fixes" for s in acquisition["stations"]]
    yield "", [*store_lines(status), *notice_lines(status["notices"])]
    yield "decoding", _first([*decoding_lines(failing)], _DEVICES_SHOWN, "`rigcal status --all` shows all")
    if status["session"]:
        yield "session", list(_session(status["session"]))
    yield "jobs", _first(job_lines(status), _JOBS_SHOWN, "`rigcal jobs list` shows all")
    yield "models", model_lines(models) if models else []
    if gap and gap["verdict"] is not None:
        yield "verdict", [f"{gap['verdict']['sentence']} (session {gap['verdict']['session']})"]
    if gap and gap["drift"] is not None and gap["drift"]["alarm"] == "worse":
        yield "drift", [f"the machine has drifted from model {gap['drift']['model']}"]


def _links(links: Sequence[Mapping[str, Any]]) -> str:
    told = []
    for link in links:
        state = {None: "starting", True: f"{link['captures_per_s']:.0f} captures/s", False: "DOWN"}[link["up"]]
        reason = f" ({link['reason']})" if link["up"] is False and link["reason"] else ""
        lost = f", {link['dropped']} dropped" if link["dropped"] else ""
        told.append(f"{link['name']} {state}{reason}{lost}")
    return "; ".join(told) or "none is configured"


def _channels(channels: Sequence[Mapping[str, Any]]) -> str:
    told = []
    for kind in ("joint", "signal"):
        own = [channel for channel in channels if channel["kind"] == kind]
        if own:
            told.append(f"{sum(c['status'] == 'ok' for c in own)} of {len(own)} {kind}s ok")
    bad: dict[str, list[str]] = {}
    for channel in channels:
        if channel["status"] != "ok":
            bad.setdefault(channel_status(channel), []).append(channel["name"])
    faults = [f"{status}: {_some(names)}" for status, names in bad.items()]
    return "; ".join([", ".join(told), *faults])


def _first(lines: Sequence[str], most: int, where: str) -> list[str]:
    """Return the first `most` lines and, if there are more, a line with their number."""
    more = [f"and {len(lines) - most} more: {where}"] if len(lines) > most else []
    return [*lines[:most], *more]


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return ", ".join(names[:_NAMES_SHOWN]) + more


def _session(session: Mapping[str, Any]) -> Iterator[str]:
    shots = [
        f"{shot['point']} at the {shot['phase']}"
        + ("" if shot["misclosure_mm"] is None else f" {number(shot['misclosure_mm'], 2)} mm")
        for shot in session["control_shots"]
    ]
    if shots:
        yield f"control points: {', '.join(shots)}"
    if session["excluded"]:
        reasons = [f"{n} {reason}" for reason, n in session["excluded"].items()]  # the most frequent first
        rest = len(reasons) - _REASONS_SHOWN
        more = f"; {rest} more reasons: `rigcal session show {session['id']}`" if rest > 0 else ""
        yield f"excluded: {', '.join(reasons[:_REASONS_SHOWN])}{more}"
    for suspicion in session.get("prism_suspicions", ()):
        yield f"fixes are not used: {suspicion['text']}"


def _fitted(entries: Sequence[list[Line]], room: int, more: str, width: int) -> list[Line]:
    """Return as many whole entries as fit into `room` lines; the last line counts omitted entries."""
    told: list[Line] = []
    for place, entry in enumerate(entries):
        left = len(entries) - place
        if len(told) + len(entry) + (left > 1) > room:
            return [*told, *_labelled("", [more.format(left)], width)]
        told += entry
    return told


def _entries(label: str, texts: Iterable[str], width: int) -> list[list[Line]]:
    """Return the lines of each text, with a label before the first."""
    return [_labelled("" if place else label, [text], width) for place, text in enumerate(texts)]


def _labelled(label: str, texts: Sequence[str], width: int, **style: Any) -> list[Line]:
    """Return texts with a label before the first, wrapped with a hanging indent."""
    found: list[Line] = []
    for text in texts:
        clean = shown(text)
        indent = " " * (_LABEL + len(clean) - len(clean.lstrip()))
        first = f"{label if not found else '':{_LABEL}}"
        wrapped = textwrap.wrap(clean, width, initial_indent=first, subsequent_indent=indent, break_on_hyphens=False)
        found += [Line(line, style) for line in wrapped]
    return found
