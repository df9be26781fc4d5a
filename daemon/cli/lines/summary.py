"""The daemon's state on one screen: what it does, what is wrong, and what to do next."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from daemon.cli.lines.jobs import job_line
from daemon.cli.lines.state import alarm_line, decoding_lines, gap_state_lines, model_lines, notice_lines, store_lines
from daemon.commands import CHECK
from daemon.host.safe_output import duration, shown
from daemon.report.words import number

LINES = 23  # one of a terminal's 24 is the prompt's
NARROWEST = 60
ENOUGH_POSES = {CHECK: 5}  # of one session, by its kind
_ENOUGH_POSES = 25
_LABEL = 10  # characters
_NAMES_SHOWN = 6
_REASONS_SHOWN = 2
_CELL = 22  # characters of a joint with its value
_HELD_UP_S = 30.0


class Line(NamedTuple):
    """A line of the screen with its style, as `click.style` names it."""

    text: str
    style: Mapping[str, Any] = {}


# ---- one sentence each -----------------------------------------------------------------------------------------------


def state_sentence(status: Mapping[str, Any]) -> str:
    """Say in one sentence what the rig is doing."""
    session, jobs, models = status["session"], status["jobs"], status["models"] or {}
    if status["alarms"]["looked_age_s"] > _HELD_UP_S:
        return f"held up: the daemon last looked at its alarms {duration(status['alarms']['looked_age_s'])} ago"
    if session is not None:
        counted = f"{session['poses']} poses, {session['observations']} observations"
        return f"recording session {session['id']} ({session['kind']}, prism {session['prism']}): {counted}"
    if any(job["state"] == "running" for job in jobs):
        return "calibrating: a job runs, no session is open"
    links = status["acquisition"]["links"]
    if links and not any(link["up"] for link in links):
        return "not connected: no link is open"
    live = models.get("live")
    return f"ready, {'no model' if live is None else 'model ' + str(live['id'])} is live, no session is open"


def next_step(status: Mapping[str, Any]) -> str:
    """Say in one sentence what to do next."""
    alarms = status["alarms"]["active"]
    critical = next((alarm for alarm in alarms if alarm["severity"] == "critical"), None)
    if critical is not None:
        return f"{critical['subject']}: {critical['remedy']}"
    if status.get("guide") is not None:
        return f"a guide is open, `rigcal session guide` leads: {status['guide']}"
    if status["session"] is not None:
        return _in_session(status["session"])
    if status["jobs"]:
        return "wait for the jobs; `rigcal watch` follows them, `rigcal jobs list` has their results"
    return next(_between_sessions(status, alarms))


def _in_session(session: Mapping[str, Any]) -> str:
    points = {
        phase: {s["point"] for s in session["control_shots"] if s["phase"] == phase} for phase in ("start", "end")
    }
    enough = ENOUGH_POSES.get(session["kind"], _ENOUGH_POSES)
    if suspicions := session.get("prism_suspicions"):
        return str(suspicions[0]["remedy"])
    if session["setup_moved"]:
        return "the station has moved: `rigcal session stop`, then describe where it stands with `rigcal setup new`"
    if not points["start"] and not points["end"]:
        return "aim the station at a control point and shoot it: `rigcal session shoot NAME`"
    if session["poses"] < enough:
        more = enough - session["poses"]
        return f"stand still at {more} more pose{'s' if more > 1 else ''}, spread over the ranges of all joints"
    if missing := sorted(points["start"] - points["end"]):
        return f"enough poses: shoot the control points again, `rigcal session shoot {missing[0]}`"
    return "enough poses: `rigcal session stop`; identification, effects, residual and report follow by themselves"


def _between_sessions(status: Mapping[str, Any], alarms: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what there is to do, the most important first."""
    setup, models, gap = status.get("setup"), status["models"] or {}, status["gap"] or {}
    live, candidate = models.get("live"), models.get("candidate")
    if candidate is not None and candidate["is_acceptable"]:
        yield f"`rigcal model accept {candidate['id']}` makes the better model live"
    if setup is None or setup["state"] != "ok":
        yield "describe where the station stands: `rigcal setup new NAME --instrument TYPE`"
    if gap.get("failed") is not None:
        yield f"job {gap['failed']['job']} failed: do what it says, or hold another session, `rigcal session start`"
    if candidate is not None and candidate["comparison"] is None:
        yield "hold a check session, to compare the new model with: `rigcal session start --kind check --prism NAME`"
    verdict = gap.get("verdict")
    if verdict is not None and verdict["verdict"] == "indistinguishable" and verdict["experiments"]:
        yield f"measure what tells the causes apart: {verdict['experiments'][0]}"
    if alarms:
        yield f"{alarms[0]['subject']}: {alarms[0]['remedy']}"
    if candidate is not None:
        yield "the new model is no better yet: hold sessions of other prisms or poses, then another check session"
    if live is None:
        yield "hold a calibration session: `rigcal session start --prism NAME`; `rigcal plan` proposes poses"
    yield "nothing needs doing; a check session now and then shows whether the live model still holds"


# ---- the screen ------------------------------------------------------------------------------------------------------


def summary(status: Mapping[str, Any], width: int, lines: int = LINES, *, with_joints: bool = False) -> list[Line]:
    """Return the state on at most so many lines: what does not fit is counted, with the command that shows it.

    Args:
        status: the daemon's state.
        width: columns of the terminal.
        lines: how many there may be; a state that is long may take more than very few.
        with_joints: the joints' values, too.
    """
    width = max(width, NARROWEST)
    version = f", rigcal {status['version']}" if "version" in status else ""
    head = _labelled("rig", [f"{status['rig']} ({status['mode']}){version}, store {status['store']}"], width)
    head += _labelled("state", [state_sentence(status)], width, bold=True)
    if with_joints:
        head += _joints(status["acquisition"]["channels"], width)
    body = [line for label, texts in _body(status) for line in _labelled(label, texts, width)]
    end = _labelled("next", [next_step(status)], width, bold=True)
    room = max(lines - len(head) - len(end) - len(body), 3)
    alarms = _alarms(status["alarms"]["active"], width, room)
    left = max(lines - len(head) - len(end) - len(alarms), 1)
    if len(body) > left:
        body = [*body[: left - 1], Line(" " * _LABEL + "... `rigcal status --all` has the rest")]
    return [*head, *alarms, *body, *end]


def reading(channel: Mapping[str, Any]) -> str:
    """Return the present value of a channel with its unit, or why there is none."""
    if channel["value"] is None:
        return str(channel["status"]).replace("_", " ")
    return f"{channel['value']:.3f} {channel['unit']}"


def _joints(channels: Sequence[Mapping[str, Any]], width: int) -> list[Line]:
    """Return the joints' values in columns that keep their places."""
    cells = [f"{c['name']} {reading(c)}" for c in channels if c["kind"] == "joint"]
    many = max((width - _LABEL) // _CELL, 1)
    rows = ["".join(f"{shown(cell):{_CELL}}" for cell in cells[i : i + many]) for i in range(0, len(cells), many)]
    return [Line(f"{'joints' if not place else '':{_LABEL}}{row}".rstrip()) for place, row in enumerate(rows)]


def _alarms(active: Sequence[Mapping[str, Any]], width: int, room: int) -> list[Line]:
    """Return alarms with their remedies on as many lines as there is room, those that count most first."""
    if not active:
        return _labelled("alarms", ["none"], width)
    told: list[Line] = []
    for place, alarm in enumerate(active):
        is_critical = alarm["severity"] == "critical"
        lines = _labelled(
            "" if told else "alarms",
            [alarm_line(alarm)],
            width,
            fg="red" if is_critical else "yellow",
            bold=is_critical,
        ) + _labelled("", [f"  {alarm['remedy']}"], width)
        rest = len(active) - place
        if told and len(told) + len(lines) > room - (rest > 1):
            return [*told, *_labelled("", [f"and {rest} more: `rigcal alarms` has all"], width)]
        told += lines
    return told


def _body(status: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    acquisition, models, gap = status["acquisition"], status["models"], status["gap"]
    yield "links", [_links(acquisition["links"])]
    yield "channels", [_channels(acquisition["channels"])]
    yield "station", [f"{s['name']}: {s['sentence']}; {s['fixes']} fixes" for s in acquisition["stations"]]
    yield "", [*store_lines(status), *notice_lines(status["notices"]), *decoding_lines(acquisition["decoding"])]
    yield "gaps", [line.removeprefix("gap: ") for line in gap_state_lines(acquisition)]
    if status["session"]:
        yield "session", list(_session(status["session"]))
    yield "jobs", [job_line(job) for job in status["jobs"]]
    yield "models", model_lines(models) if models else []
    if gap and gap["verdict"] is not None:
        yield "verdict", [f"{gap['verdict']['sentence']} (session {gap['verdict']['session']})"]
    if gap and gap["drift"] is not None and gap["drift"]["alarm"] == "worse":
        yield "drift", [f"the machine has left model {gap['drift']['model']}"]


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
            bad.setdefault(channel["status"].replace("_", " "), []).append(channel["name"])
    faults = [f"{status}: {_some(names)}" for status, names in bad.items()]
    return "; ".join([", ".join(told), *faults])


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
        yield f"fixes do not count: {suspicion['text']}"


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
