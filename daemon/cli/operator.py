"""What an operator says to the running daemon: status, set-ups, sessions, jobs, devices."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from daemon.cli.gap_lines import gap_lines
from daemon.cli.model import model_lines
from daemon.cli.output import Command, json_option
from daemon.cli.status_lines import alarm_line, cleared_line, decoding_lines, gap_state_lines, station_line
from daemon.cli.talk import ask, say, talks, utc, who
from daemon.cli.terminal import coloured, echo
from daemon.config import read_config
from daemon.plain_text import shown
from daemon.present_state import duration
from daemon.scheduler import SESSION_KINDS

SHOT_TIMEOUT_S = 600.0
ALARMS_OLD_S = 30.0  # they are looked at every second


# ---- status ----------------------------------------------------------------------------------------------------------


@click.command(cls=Command)
@click.option("--frames", is_flag=True, help="Also every CAN identifier that was heard, with its rate.")
@talks
def status(frames: bool, **where: Any) -> Any:
    """How the rig's links, channels and station are, and what is going on."""
    return ask(where, "status", partial(_show_status, frames=frames))


def _show_status(console: Console, status: dict[str, Any], *, frames: bool) -> None:
    say(console, f"rig {status['rig']} ({status['mode']}), store {status['store']}")
    acquisition = status["acquisition"]
    _show_alarms(console, status["alarms"])
    for sentence in _store_lines(status):
        say(console, sentence)
    for line in gap_state_lines(acquisition):
        say(console, line)
    links = Table("link", "state", "captures", "per s", "queued", "dropped", title="links", title_justify="left")
    for link in acquisition["links"]:
        state = coloured("up", "green") if link["up"] else coloured("down", "red")
        links.add_row(
            link["name"],
            "starting" if link["up"] is None else state,
            f"{link['captures']}",
            f"{link['captures_per_s']:.0f}",
            f"{link['queued']}",
            f"{link['dropped']}",
        )
    console.print(links)
    channels = Table("channel", "value", "status", "age s", title="channels", title_justify="left")
    for channel in acquisition["channels"]:
        value = "" if channel["value"] is None else f"{channel['value']:.3f} {channel['unit']}"
        mark = "green" if channel["status"] == "ok" else "red"
        age = "never" if channel["age_s"] is None else f"{channel['age_s']:.1f}"
        channels.add_row(channel["name"], value, coloured(channel["status"].replace("_", " "), mark), age)
    console.print(channels)
    if frames:
        console.print(_frame_table(acquisition["frames"]))
    for station in acquisition["stations"]:
        say(console, station_line(station))
    for line in decoding_lines(acquisition["decoding"]):
        say(console, line)
    if status["session"]:
        _show_session(console, status["session"])
    for job in status["jobs"]:
        say(console, _job_line(job))
    models, gap = status["models"], status["gap"]
    for sentence in (*(model_lines(models) if models else ()), *(gap_lines(gap) if gap else ())):
        say(console, sentence)
    for event in reversed(status["events"]):
        say(console, f"{utc(event['utc_ns'])} {event['device']} {event['kind']}: {event['text']}")


def _store_lines(status: dict[str, Any]) -> Iterator[str]:
    """What the store is busy with, and what cannot be read from it; its faults are alarms."""
    if status["store_health"]["state"] == "checking":
        yield status["store_health"]["text"]
    if status["acquisition"]["is_behind"]:
        yield "captures wait to be decoded: readings and fixes come late, and jobs wait"
    for part, reason in status["unreadable"].items():
        yield f"{part}: cannot be read from the store ({reason})"


def _show_alarms(console: Console, alarms: dict[str, Any]) -> None:
    if alarms["looked_age_s"] > ALARMS_OLD_S:
        say(console, f"alarms were last looked at {duration(alarms['looked_age_s'])} ago: the daemon is held up")
    for alarm in alarms["active"]:
        style = "bold red" if alarm["severity"] == "critical" else "yellow"
        console.print(Text(alarm_line(alarm), style=style))
        console.print(Text(f"  {alarm['remedy']}"))
    if not alarms["active"]:
        say(console, "no alarms")


@click.command(cls=Command)
@click.option("--all", "everything", is_flag=True, help="Also those that are over, newest first.")
@talks
def alarms(everything: bool, **where: Any) -> Any:
    """What is wrong now, since when, and what to do about it."""

    def show(console: Console, found: dict[str, Any]) -> None:
        _show_alarms(console, found)
        for alarm in found["cleared"]:
            say(console, cleared_line(alarm))

    return ask(where, "alarms.list", show, all=everything)


def _frame_table(frames: list[dict[str, Any]]) -> Table:
    table = Table("link", "identifier", "what", "frames", "per s", "missed", title="frames", title_justify="left")
    for frame in frames:
        rate = "" if frame["rate_per_s"] is None else f"{frame['rate_per_s']:.0f}"
        missed = "" if frame["missed"] is None else str(frame["missed"])
        table.add_row(frame["link"], frame["identifier"], frame["names"], str(frame["count"]), rate, missed)
    return table


# ---- set-ups ---------------------------------------------------------------------------------------------------------


@click.group()
def setup() -> None:
    """Station set-ups: where and how the total station stands."""


@setup.command(cls=Command, name="new")
@click.argument("name")
@click.option("--instrument", default="", help="Maker and model.")
@click.option("--serial", default="", help="Serial number.")
@click.option("--tilt-arcsec", type=float, help="Residual tilt shown after levelling.")
@click.option("--ppm", type=float, help="Atmospheric correction set on the instrument.")
@click.option("--prism-constant", multiple=True, metavar="PRISM=MM", help="Prism constant set for a prism.")
@click.option(
    "--control-point",
    multiple=True,
    metavar="NAME=X,Y,Z",
    help="Known place of a control point in the station's frame, mm; without one its first shot defines it.",
)
@click.option("--note", default="")
@talks
def setup_new(prism_constant: tuple[str, ...], control_point: tuple[str, ...], **options: Any) -> Any:
    """Describe where the station stands now. A station that was moved is a new set-up."""
    where = {key: options.pop(key) for key in ("socket", "config", "as_json")}
    return ask(
        where,
        "setup.new",
        lambda console, result: say(console, f"set-up {result['id']} is in use"),
        id=options.pop("name"),
        prism_constants_mm={k: v[0] for k, v in _assignments("--prism-constant", prism_constant, "r=-30", 1).items()},
        control_points=_assignments("--control-point", control_point, "cp1=12000,3500,1800", 3),
        **options,
    )


def _assignments(option: str, texts: tuple[str, ...], example: str, count: int) -> dict[str, list[float]]:
    """NAME=NUMBER,... options as numbers."""
    result = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        try:
            result[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            result[name] = []
        if len(result[name]) != count:
            raise click.BadParameter(f"{text!r}: write it as {example}", param_hint=option)
    return result


@setup.command(cls=Command, name="list")
@talks
def setup_list(**where: Any) -> Any:
    """All set-ups with their control points."""

    def show(console: Console, setups: list[dict[str, Any]]) -> None:
        if not setups:
            say(console, "no set-ups yet; describe one with `rigcal setup new`")
            return
        table = Table("set-up", "instrument", "state", "tilt arcsec", "ppm", "control points")
        for s in setups:
            points = ", ".join(p["name"] for p in s["control_points"])
            tilt, ppm = ("" if s[k] is None else f"{s[k]:g}" for k in ("tilt_arcsec", "ppm"))
            table.add_row(s["id"], s["instrument"], s["state"], tilt, ppm, points)
        console.print(table)

    return ask(where, "setup.list", show)


# ---- sessions --------------------------------------------------------------------------------------------------------


@click.group()
def session() -> None:
    """Calibration sessions."""


@session.command(cls=Command, name="start")
@click.option("--prism", required=True, help="The prism that the station follows.")
@click.option("--kind", type=click.Choice(SESSION_KINDS), default="static_poses", show_default=True)
@click.option("--setup", help="Station set-up; the newest when not given.")
@click.option("--operator", default=lambda: os.environ.get("USER", ""), help="Who is responsible.")
@click.option("--id", help="Name of the session.")
@click.option("--note", default="")
@talks
def session_start(socket: Path | None, config: Path | None, as_json: bool, **about: Any) -> Any:
    """Open a session: from now on fixes on the prism become its observations."""

    def show(console: Console, result: dict[str, Any]) -> None:
        say(
            console,
            f"session {result['id']} is open: prism {result['prism']}, {result['kind']}, set-up {result['setup']}",
        )
        _advise(console, result["advice"])

    return ask({"socket": socket, "config": config, "as_json": as_json}, "session.start", show, **about)


@session.command(cls=Command, name="stop")
@talks
def session_stop(**where: Any) -> Any:
    """Close the open session; identification with missing effects, residual and report follow by themselves."""

    def show(console: Console, result: dict[str, Any]) -> None:
        _show_session(console, result)
        _advise(console, result["advice"])

    return ask(where, "session.stop", show)


@session.command(cls=Command, name="abort")
@talks
def session_abort(**where: Any) -> Any:
    """Close the open session as unusable."""
    return ask(where, "session.abort", _show_session)


@session.command(cls=Command, name="accept")
@click.argument("name")
@click.option("--operator", default=lambda: os.environ.get("USER", ""), help="Who is responsible.")
@talks
def session_accept(name: str, operator: str, **where: Any) -> Any:
    """Use closed session NAME although its control points were not shot at both ends, or did not hold."""
    return ask(where, "session.accept", _show_session, id=name, operator=operator)


@session.command(cls=Command, name="shoot")
@click.argument("point")
@talks
def session_shoot(point: str, **where: Any) -> Any:
    """Measure control point POINT (the station is aimed at it); its first shot defines its place."""

    def show(console: Console, result: dict[str, Any]) -> None:
        if result["misclosure_mm"] is None:
            say(console, f"{result['point']} is known from now on; shoot it again before you stop the session")
            return
        verdict, style = ("the set-up has moved", "red") if result["moved"] else ("the set-up holds", None)
        console.print(f"{result['point']}: misclosure {result['misclosure_mm']:.1f} mm, {verdict}", style=style)
        _advise(console, result["advice"])

    if not where["as_json"]:
        click.echo(f"measuring {shown(point)}: keep the station on it; Ctrl-C gives up", err=True)
    return ask(where, "session.shoot", show, timeout_s=SHOT_TIMEOUT_S, point=point)


@session.command(cls=Command, name="confirm-prism")
@click.option("--operator", default=lambda: os.environ.get("USER", ""), help="Who says so.")
@talks
def session_confirm_prism(operator: str, **where: Any) -> Any:
    """Say that the station is on the prism of the open session, although it looks like another one.

    Fixes count from now on; those that were in doubt before stay excluded.
    """

    def show(console: Console, result: dict[str, Any]) -> None:
        say(console, result["text"])
        _advise(console, result["advice"])

    return ask(where, "session.confirm-prism", show, operator=operator)


@session.command(cls=Command, name="list")
@talks
def session_list(**where: Any) -> Any:
    """All sessions."""

    def show(console: Console, sessions: list[dict[str, Any]]) -> None:
        if not sessions:
            say(console, "no sessions yet; `rigcal session start` opens one")
            return
        table = Table("session", "kind", "prism", "set-up", "state", "poses", "observations", "operator")
        for s in sessions:
            counts = (str(s["poses"]), str(s["observations"]))
            state = s["state"] if s["not_used"] is None else f"{s['state']}, not used"
            table.add_row(s["id"], s["kind"], s["prism"], s["setup"], state, *counts, who(s["operator"], s["user"]))
        console.print(table)

    return ask(where, "session.list", show)


@session.command(cls=Command, name="show")
@click.argument("name")
@talks
def session_show(name: str, **where: Any) -> Any:
    """One session, with its control points and jobs."""

    def show(console: Console, result: dict[str, Any]) -> None:
        _show_session(console, result)
        for job in result["jobs"]:
            say(console, _job_line(job))

    return ask(where, "session.show", show, id=name)


@session.command(cls=Command, name="export")
@click.argument("name")
@click.option("--config", type=click.Path(path_type=Path), required=True, help="Configuration of the store's daemon.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Directory for the files.")
@click.option("--format", "can_format", type=click.Choice(["log", "asc", "blf"]), default="log", show_default=True)
@json_option
def session_export(name: str, config: Path, out: Path, can_format: Any, *, as_json: bool) -> Any:
    """Write a session's CAN and serial captures as logs that `rigcal replay` reads, and its observations as CSV."""
    from daemon.export import export_session

    files = export_session(read_config(config), name, out, can_format)
    if not as_json:
        for file in files:
            echo(file)
    return {"files": [str(file) for file in files]}


def _show_session(console: Console, session: dict[str, Any]) -> None:
    say(
        console,
        f"session {session['id']} ({session['kind']}, prism {session['prism']}, set-up {session['setup']}) is "
        f"{session['state']}: {session['poses']} poses, {session['observations']} observations",
    )
    for reason, n in session["excluded"].items():
        say(console, f"  {n} excluded: {reason}")
    for suspicion in session.get("prism_suspicions", ()):
        what = f"{suspicion['text']}; its fixes do not count: {suspicion['remedy']}"
        console.print(Text.assemble((f"  since {utc(suspicion['since_utc_ns'])} ", "red"), shown(what)))
    for shot in session["control_shots"]:
        size = "defined" if shot["misclosure_mm"] is None else f"misclosure {shot['misclosure_mm']:.1f} mm"
        say(console, f"  control point {shot['point']} at the {shot['phase']}: {size}")
    if session["state"] == "open" and not session["control_shots"]:
        say(console, "  no control point has been shot yet: `rigcal session shoot NAME`, now and again before the end")
    for step in session["clock_steps"]:
        back = "back" if step["step_s"] < 0 else "forward"
        say(console, f"  {utc(step['at_utc_ns'])}: the computer's clock was set {back} by {abs(step['step_s']):.1f} s")
    if session["setup_moved"]:
        console.print("  the station has moved since this set-up was described", style="red")
    if session["not_used"] is not None:
        why = f"{session['not_used']}; to use it anyway: `rigcal session accept {session['id']}`"
        console.print(Text.assemble(("  calibration does not use this session: ", "red"), shown(why)))
    if session["accepted"] is not None:
        accepted = session["accepted"]
        by = who(accepted["by"], accepted["user"]) or "an operator"
        say(console, f"  accepted by {by}, although {accepted['despite']}")


def _advise(console: Console, advice: list[str]) -> None:
    for sentence in advice:
        say(console, f"  note: {sentence}")


# ---- jobs and devices ------------------------------------------------------------------------------------------------


@click.group()
def jobs() -> None:
    """Background jobs: gap workflow, residual training, reports, comparisons, drift of checks."""


@jobs.command(cls=Command, name="list")
@talks
def jobs_list(**where: Any) -> Any:
    """All jobs."""

    def show(console: Console, found: list[dict[str, Any]]) -> None:
        for job in found:
            say(console, _job_line(job))
        if not found:
            say(console, "no jobs yet; those of a session are queued some seconds after it was closed")

    return ask(where, "jobs.list", show)


@jobs.command(cls=Command, name="cancel")
@click.argument("number", type=int)
@talks
def jobs_cancel(number: int, **where: Any) -> Any:
    """Cancel a queued or running job and those that wait for it."""
    return ask(where, "jobs.cancel", say, id=number)


@jobs.command(cls=Command, name="retry")
@click.argument("number", type=int)
@talks
def jobs_retry(number: int, **where: Any) -> Any:
    """Queue a job again that did not end well."""
    return ask(where, "jobs.retry", say, id=number)


def _job_line(job: dict[str, Any]) -> str:
    name = f"job {job['id']} {job['kind']}" + (f" of {job['session_id']}" if job.get("session_id") else "")
    if job["state"] == "running":
        return f"{name}: running, {100 * job['progress']:.0f} %, {job['message'] or 'starting'}"
    more = job["error"] or (job.get("result") or {}).get("report")
    return f"{name}: {job['state']}" + (f", {more}" if more else "")


@click.group()
def devices() -> None:
    """CANopen devices of the rig."""


@devices.command(cls=Command, name="configure")
@click.option("--machine-is-parked", is_flag=True, help="The machine is parked and locked out.")
@talks
def devices_configure(machine_is_parked: bool, **where: Any) -> Any:
    """Check identity and resolution of the encoders, set their transmission, and start them.

    Needs a link with allow_transmit = true that lists the nodes.
    """

    return ask(where, "devices.configure", lambda c, r: say(c, r["text"]), machine_is_parked=machine_is_parked)


COMMANDS = {"alarms": alarms, "status": status, "setup": setup, "session": session, "jobs": jobs, "devices": devices}
