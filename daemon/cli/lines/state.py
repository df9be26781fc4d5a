"""Text for people about the daemon's state: alarms, gaps, stations, sessions, jobs and models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from calibration.rig.words import counted
from daemon.cli.client import utc, who
from daemon.cli.lines.clock import session_clock_lines
from daemon.cli.terminal import echo
from daemon.host.safe_output import duration
from daemon.report.words import not_used, number

LATE = "late, not yet decoded"
_NAMES_SHOWN = 6  # in one line
_EXPERIMENTS_SHOWN = 3
_ALARMS_OLD_S = 30.0  # they are evaluated every second


# ---- alarms and acquisition ------------------------------------------------------------------------------------------


def show_alarms(alarms: Mapping[str, Any]) -> None:
    """Print the active alarms, each with its remedy."""
    if alarms["looked_age_s"] > _ALARMS_OLD_S:
        echo(f"alarms were last evaluated {duration(alarms['looked_age_s'])} ago: the daemon is blocked")
    for alarm in alarms["active"]:
        is_critical = alarm["severity"] == "critical"
        echo(alarm_line(alarm), fg="red" if is_critical else "yellow", bold=is_critical)
        echo(f"  {alarm['remedy']}")
    if not alarms["active"]:
        echo("no alarms")


def alarm_line(alarm: Mapping[str, Any]) -> str:
    """Return an active alarm with its age."""
    since = f"{duration(alarm['age_s'])}, since {utc(alarm['since_utc_ns'])}"
    return f"{alarm['severity'].upper()} {alarm['kind']} {alarm['subject']}: {alarm['text']} ({since})"


def cleared_line(alarm: Mapping[str, Any]) -> str:
    """Return a cleared alarm with the times when it was raised and cleared."""
    lasted = f"{utc(alarm['since_utc_ns'])} to {utc(alarm['cleared_utc_ns'])}"
    return f"{lasted} {alarm['severity']} {alarm['kind']} {alarm['subject']}: {alarm['text']}"


def notice_lines(notices: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each target to which notices cannot be delivered, with the number of pending notices."""
    for one in notices:
        if one["error"] is not None:
            yield f"notices by {one['target']}: {one['waiting']} pending, the last delivery failed: {one['error']}"


def store_lines(status: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines on the store's current work and its unreadable parts; its faults are alarms."""
    if status["store_health"]["state"] == "checking":
        yield status["store_health"]["text"]
    if status["acquisition"]["is_behind"]:
        yield "captures are waiting to be decoded: readings and fixes are late, and jobs wait"
    for part, reason in status["unreadable"].items():
        yield f"{part}: cannot be read from the store ({reason})"


def gap_state_lines(acquisition: Mapping[str, Any]) -> Iterator[str]:
    """Yield the open gaps, with one line for all channels of a link that have the same reason."""
    links = {channel["name"]: channel["link"] for channel in acquisition["channels"]}
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for gap in acquisition["gaps"]:
        groups.setdefault((gap["reason"], links.get(gap["channel"], gap["channel"])), []).append(gap)
    for (reason, _), gaps in groups.items():
        names = [gap["channel"] for gap in gaps]
        more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
        age = duration(gaps[0]["age_s"])  # the longest comes first
        yield f"gap: {reason.replace('_', ' ')} for {age}: {', '.join(names[:_NAMES_SHOWN])}{more}"


def channel_status(channel: Mapping[str, Any]) -> str:
    """Return the status of a joint, signal or station in words. One whose records wait to be decoded is late."""
    if channel["status"] == "silent" and not channel["is_silent"]:
        return LATE
    return str(channel["status"]).replace("_", " ")


def station_line(station: Mapping[str, Any]) -> str:
    """Return a station's current state."""
    return f"station {station['name']}: {station['sentence']}; {station['fixes']} fixes"


def decoding_lines(decoding: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the number of captures of each device that could not be decoded, with the most frequent reason."""
    for device in decoding:
        count, mostly = device["count"], device["reason_count"]
        why = device["reason"] if mostly == count else f"{mostly} of them: {device['reason']}"
        lately = f" ({device['lately']} in the last minute)" if device["lately"] else ""
        yield f"{count} captures of {device['device']} could not be decoded{lately}: {why}"


# ---- sessions and jobs -----------------------------------------------------------------------------------------------


def show_session(session: Mapping[str, Any]) -> None:
    """Print a session: counts, exclusions, control points, and why calibration does not use it."""
    echo(
        f"session {session['id']} ({session['kind']}, prism {session['prism']}, set-up {session['setup']}) is "
        f"{session['state']}: {counted(session['poses'], 'pose')}, {counted(session['observations'], 'observation')}"
    )
    for reason, n in session["excluded"].items():
        echo(f"  {n} excluded: {reason}")
    for suspicion in session.get("prism_suspicions", ()):
        what = f"{suspicion['text']}; these fixes are not used: {suspicion['remedy']}"
        echo(f"  since {utc(suspicion['since_utc_ns'])} {what}", fg="red")
    for shot in session["control_shots"]:
        size = "defined" if shot["misclosure_mm"] is None else f"misclosure {shot['misclosure_mm']:.1f} mm"
        echo(f"  control point {shot['point']} at the {shot['phase']}: {size}")
    if session["state"] == "open" and not session["control_shots"]:
        echo("  no control point has been shot yet: `rigcal session shoot NAME`, now and once more before the end")
    for line in session_clock_lines(session):
        echo(f"  {line}")
    for step in session["clock_steps"]:
        back = "back" if step["step_s"] < 0 else "forward"
        echo(f"  {utc(step['at_utc_ns'])}: the computer's clock was set {back} by {abs(step['step_s']):.1f} s")
    if session["setup_moved"]:
        echo("  the station has moved since this set-up was recorded", fg="red")
    if session["not_used"] is not None:
        echo(f"  {not_used(session['id'], session['not_used'])}", fg="red")
    if session["rejected"] is not None:
        echo(f"  {rejection(session['rejected'])}")
    if session["accepted"] is not None:
        accepted = session["accepted"]
        by = who(accepted["by"], accepted["user"]) or "an operator"
        echo(f"  accepted by {by}, although {accepted['despite']}")


def rejection(rejected: Mapping[str, Any]) -> str:
    """Return by whom, when and why a session was rejected, as the end of a sentence."""
    by = who(rejected["by"], rejected["user"]) or "an operator"
    return f"rejected by {by}, {utc(rejected['utc_ns'])}" + (f": {rejected['reason']}" if rejected["reason"] else "")


# ---- models ----------------------------------------------------------------------------------------------------------


def model_lines(models: Mapping[str, Any]) -> list[str]:
    """Return lines on the live model and the newest candidate."""
    live, candidate = models["live"], models["candidate"]
    lines = [f"model {live['id']} ({live['stage']}) is live" if live else "no model is live"]
    if candidate is not None:
        start = f"model {candidate['id']} ({candidate['stage']}) is a candidate"
        if candidate["is_acceptable"]:
            lines.append(f"{start}: {candidate['comparison']['sentence']}")
            lines.append(f"  `rigcal model accept {candidate['id']}` makes it the live one")
        else:
            lines.append(f"{start} but would be refused now: {candidate['refused_because']}")
    return lines


def gap_lines(gap: Mapping[str, Any]) -> Iterator[str]:
    """Yield the newest verdict on the model's gap with the next measurements, and the live model's drift."""
    found, failed, drift = gap["verdict"], gap["failed"], gap["drift"]
    if failed is not None:
        yield f"gap: the job of session {failed['session']} failed (job {failed['job']}): {failed['error']}"
    if found is not None:
        yield f"gap ({found['verdict']}, after session {found['session']}): {found['sentence']}"
        for text in found["experiments"][:_EXPERIMENTS_SHOWN]:
            yield f"  next: {text}"
        yield f"  report: {found['report']}"
    if drift is not None:
        yield _drift_line(drift)


def _drift_line(drift: Mapping[str, Any]) -> str:
    start = f"drift of model {drift['model']}"
    if drift["newest"] is None:
        return f"{start}: no check session since it went live"
    if drift["ratio"] is None:
        last = f"the last, {drift['newest']}, could not be used: {drift['reason']}"
    else:
        last = f"in the last, {drift['newest']}, errors are {number(drift['ratio'], 2)} times the predicted ones"
    sums = f"sums {number(drift['upper'], 2)} and {number(drift['lower'], 2)} of {number(drift['decision'], 2)}"
    checks = f"{drift['checks']} check session{'s' if drift['checks'] != 1 else ''}"
    verdict = {
        "none": "none",
        "worse": f"the machine has drifted from the model (since check session {drift['drifted_with']})",
        "better": "none; errors are smaller than the model predicts, which a new calibration would correct",
    }[drift["alarm"]]
    return f"{start}: {verdict}; {checks}, {last} ({sums})"
