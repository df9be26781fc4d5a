"""`rigcal session`: calibration sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from daemon.cli.client import ask, client_options, config_option, operator_option, socket_of, who
from daemon.cli.command import Command, json_option
from daemon.cli.lines.clock import latency_sentence
from daemon.cli.lines.jobs import show_jobs
from daemon.cli.lines.state import show_session
from daemon.cli.terminal import echo, echo_error, echo_table
from daemon.commands import SESSION_KINDS
from daemon.control.protocol import request

SHOT_TIMEOUT_S = 600.0


@click.group()
def session() -> None:
    """Calibration sessions."""


@session.command(cls=Command, name="start")
@click.option("--prism", required=True, help="The prism that the station follows.")
@click.option("--kind", type=click.Choice(SESSION_KINDS), default="static_poses", show_default=True)
@click.option("--setup", help="Station set-up; the one described or used last when not given.")
@operator_option
@click.option("--id", help="Name of the session.")
@click.option("--note", default="")
@client_options
def session_start(socket: Path | None, config: Path | None, as_json: bool, **about: Any) -> Any:
    """Open a session: from now on fixes on the prism become its observations."""

    def show(opened: Mapping[str, Any]) -> None:
        echo(f"session {opened['id']} is open: prism {opened['prism']}, {opened['kind']}, set-up {opened['setup']}")
        _advise(opened)

    return ask({"socket": socket, "config": config, "as_json": as_json}, "session.start", show, **about)


@session.command(cls=Command, name="stop")
@client_options
def session_stop(**where: Any) -> Any:
    """Close the open session; identification with missing effects, residual and report follow by themselves."""

    def show(closed: Mapping[str, Any]) -> None:
        show_session(closed)
        _advise(closed)

    return ask(where, "session.stop", show)


@session.command(cls=Command, name="abort")
@client_options
def session_abort(**where: Any) -> Any:
    """Close the open session as unusable."""
    return ask(where, "session.abort", show_session)


@session.command(cls=Command, name="accept")
@click.argument("name")
@operator_option
@client_options
def session_accept(name: str, operator: str, **where: Any) -> Any:
    """Use closed session NAME although its control points were not shot at both ends, or did not hold."""
    return ask(where, "session.accept", show_session, id=name, operator=operator)


@session.command(cls=Command, name="shoot")
@click.argument("point")
@client_options
def session_shoot(point: str, **where: Any) -> Any:
    """Measure control point POINT (the station is aimed at it); its first shot defines its place."""

    def show(shot: Mapping[str, Any]) -> None:
        if shot["misclosure_mm"] is None:
            echo(f"{shot['point']} is known from now on; shoot it again before you stop the session")
            return
        verdict, colour = ("the set-up has moved", "red") if shot["moved"] else ("the set-up holds", None)
        echo(f"{shot['point']}: misclosure {shot['misclosure_mm']:.1f} mm, {verdict}", fg=colour)
        _advise(shot)

    if not where["as_json"]:
        echo_error(f"measuring {point}: keep the station on it; Ctrl-C gives up")
    return ask(where, "session.shoot", show, timeout_s=SHOT_TIMEOUT_S, point=point)


@session.command(cls=Command, name="confirm-prism")
@operator_option
@client_options
def session_confirm_prism(operator: str, **where: Any) -> Any:
    """Say that the station is on the prism of the open session, although it looks like another one.

    Fixes count from now on; those that were in doubt before stay excluded.
    """

    def show(confirmed: Mapping[str, Any]) -> None:
        echo(confirmed["text"])
        _advise(confirmed)

    return ask(where, "session.confirm-prism", show, operator=operator)


@session.command(cls=Command, name="list")
@client_options
def session_list(**where: Any) -> Any:
    """List all sessions."""
    return ask(where, "session.list", _show_list)


@session.command(cls=Command, name="show")
@click.argument("name")
@client_options
def session_show(name: str, **where: Any) -> Any:
    """Show one session, with its control points and jobs."""

    def show(found: Mapping[str, Any]) -> None:
        show_session(found)
        if found["latency"] is not None:
            echo(f"  latency of the station's fixes: {latency_sentence(found['latency'])}")
        show_jobs(found["jobs"], [found] if found.get("no_job") else [])

    return ask(where, "session.show", show, id=name)


@session.command(cls=Command, name="export")
@click.argument("name")
@config_option
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Directory for the files.")
@click.option(
    "--format",
    "form",
    type=click.Choice(["log", "candump", "asc", "blf", "csv", "parquet", "mat"]),
    default="log",
    show_default=True,
    help="CAN logs of candump (log, candump) or Vector (asc, blf); or tables.",
)
@json_option
def session_export(name: str, config: Path, out: Path, form: Any, *, as_json: bool) -> Any:
    """Write what was captured or measured in a session to files.

    log, candump, asc, blf: CAN and serial captures as logs that `rigcal replay` reads, and the observations as CSV.
    csv, parquet, mat: the observations, all joint readings and all fixes as tables.
    """
    from daemon.config.config import read_config
    from daemon.sessions.export.captured_logs import export_session
    from daemon.sessions.export.tables import TABLE_FORMATS, export_tables

    settings = read_config(config)
    if form in TABLE_FORMATS:
        files = export_tables(settings.store_path, name, out, form)
    else:
        files = export_session(settings, name, out, "log" if form == "candump" else form)
    if not as_json:
        for file in files:
            echo(file)
        if not files:
            echo(f"session {name} has no rows, so no table was written")
    return {"files": [str(file) for file in files]}


@session.command(cls=Command, name="guide")
@click.option("--setup", help="Station set-up that exists; the one described or used last when not given.")
@click.option("--new-setup", metavar="NAME", help="Describe a new set-up of that name instead.")
@click.option("--instrument", help="Of the new set-up.")
@click.option("--tilt-arcsec", type=float, help="Of the new set-up.")
@click.option("--ppm", type=float, help="Of the new set-up.")
@click.option("--control-points", metavar="NAME,...", help="Shot at both ends of every session; cp1 for a new set-up.")
@click.option("--prisms", metavar="NAME,...", help="To measure, in this order; all of the rig when not given.")
@click.option(
    "--plan", type=click.Path(path_type=Path, dir_okay=False), metavar="CSV", help="Poses as `rigcal plan` wrote them."
)
@click.option("--poses", type=int, help="Most poses of a prism, where they are chosen on the spot.  [default: 20]")
@click.option("--check-poses", type=int, help="Poses of the check, 3 to 5; 0 for no check.  [default: 4]")
@click.option("--target", "target_mm", type=float, metavar="MM", help="Expected error at which it is enough.")
@click.option("--done", is_flag=True, help="The present step is carried out.")
@click.option("--skip", metavar="REASON", help="Leave the present step out.")
@click.option("--rest", metavar="REASON", help="Leave out all poses of this prism that are left.")
@click.option("--more", type=int, metavar="N", help="Measure N more poses although it is enough.")
@click.option("--stop", metavar="REASON", help="Abandon the guide.")
@click.option("--state", is_flag=True, help="Show the present step once.")
@operator_option
@client_options
def session_guide(socket: Path | None, config: Path | None, as_json: bool, **given: Any) -> Any:
    """Lead through a whole calibration: a session for each prism, then a check.

    Goes on with the guide that is open, else starts one. On a terminal Enter says that the step is done, s skips it and
    Ctrl-C leaves the guide open. With --json the state is printed once.
    """
    from daemon.cli.guide_terminal import lead, summary

    at = socket_of(socket, config)

    def say(command: str, **arguments: Any) -> Any:
        return request(at, command, {key: value for key, value in arguments.items() if value is not None})

    about = _guide_arguments(given)
    told = [
        ("guide.done", {}) if given["done"] else None,
        ("guide.skip", {"reason": given["skip"]}) if given["skip"] is not None else None,
        ("guide.skip", {"reason": given["rest"], "rest": True}) if given["rest"] is not None else None,
        ("guide.more", {"poses": given["more"]}) if given["more"] is not None else None,
        ("guide.stop", {"reason": given["stop"]}) if given["stop"] is not None else None,
        ("guide.state", {}) if given["state"] else None,
    ]
    commands = [command for command in told if command is not None]
    if len(commands) > 1 or (commands and about):
        raise click.UsageError("give one of --done, --skip, --rest, --more, --stop and --state, and nothing beside it")
    if commands:
        command, arguments = commands[0]
        state = say(command, **arguments)
    else:
        state = say("guide.state")
        is_open = state["guide"] is not None and state["guide"]["state"] == "open"
        if about or (not is_open and not as_json):
            state = say("guide.start", operator=given["operator"], **about)
        if not as_json:
            return {"guide": lead(say)}
    if not as_json:
        summary(state)
    return state


def _guide_arguments(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `guide.start` that were given."""
    from daemon.cli.guide_terminal import names, plan_rows

    described = {key: given[key] for key in ("instrument", "tilt_arcsec", "ppm") if given[key] is not None}
    if described and given["new_setup"] is None:
        raise click.UsageError("--instrument, --tilt-arcsec and --ppm describe a new set-up: give --new-setup NAME")
    about = {key: given[key] for key in ("setup", "poses", "check_poses", "target_mm")}
    about |= {"control_points": names(given["control_points"]), "prisms": names(given["prisms"])}
    about["new_setup"] = None if given["new_setup"] is None else {"id": given["new_setup"], **described}
    about["plan"] = None if given["plan"] is None else plan_rows(given["plan"])
    return {key: value for key, value in about.items() if value is not None}


def _advise(result: Mapping[str, Any]) -> None:
    for sentence in result["advice"]:
        echo(f"  note: {sentence}")


def _show_list(sessions: Sequence[Mapping[str, Any]]) -> None:
    if not sessions:
        echo("no sessions yet; `rigcal session start` opens one")
        return
    rows = [
        [
            found["id"],
            found["kind"],
            found["prism"],
            found["setup"],
            found["state"] if found["not_used"] is None else f"{found['state']}, not used",
            str(found["poses"]),
            str(found["observations"]),
            who(found["operator"], found["user"]),
        ]
        for found in sessions
    ]
    echo_table(("session", "kind", "prism", "set-up", "state", "poses", "observations", "operator"), rows)
    for found in sessions:
        if found.get("no_job"):
            echo(f"session {found['id']} has no job of its own: {found['no_job']}")
