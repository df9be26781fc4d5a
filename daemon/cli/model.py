"""`rigcal model`: which model is live, what waits to be accepted, and a model for other programs."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from daemon.cli.output import Command
from daemon.cli.talk import ask, say, socket_of, talks, utc, who
from daemon.cli.terminal import echo, echo_error
from daemon.control import request
from daemon.files import write_file

_operator = click.option(
    "--operator", default=lambda: os.environ.get("USER", ""), help="Who decides; kept with the decision."
)


@click.group()
def model() -> None:
    """Models of the rig: candidates, the live one, and those that it replaced."""


@model.command(cls=Command, name="list")
@talks
def model_list(**where: Any) -> Any:
    """All models, with how they compared with the live one on check sessions."""

    def show(console: Console, models: list[dict[str, Any]]) -> None:
        if not models:
            say(console, "no models yet; the jobs of a closed session make them (`rigcal jobs list`)")
            return
        table = Table("model", "state", "stage", "made", "sessions", "comparison")
        for m in models:
            compared = m["comparison"]
            verdict = compared["sentence"] if compared else "not compared yet"
            if compared and compared["is_stale"]:
                then = "when none was live" if compared["live"] is None else f"with model {compared['live']}, live then"
                verdict = f"out of date, compared {then}: {verdict}"
            table.add_row(str(m["id"]), m["state"], m["stage"], utc(m["created_utc_ns"]), str(m["sessions"]), verdict)
        console.print(table)

    return ask(where, "model.list", show)


@model.command(cls=Command, name="show")
@click.argument("number", type=int, required=False)
@talks
def model_show(number: int | None, **where: Any) -> Any:
    """Model NUMBER (the live one by default): where it lies, its comparison, who put it live and when."""
    return ask(where, "model.show", _show, id=number)


@model.command(cls=Command, name="compare")
@click.argument("number", type=int)
@talks
def model_compare(number: int, **where: Any) -> Any:
    """Compare model NUMBER with the one that is live now, on the check sessions that neither was trained on.

    This happens by itself after each training and each check session, for the newest model.
    """
    return ask(where, "model.compare", say, id=number)


@model.command(cls=Command, name="accept")
@click.argument("number", type=int)
@_operator
@talks
def model_accept(number: int, operator: str, **where: Any) -> Any:
    """Make candidate NUMBER the live model.

    It must have been compared on check sessions that it was not trained on, and must have shown there a smaller error
    than the live model, by more than chance; the first model that goes live must show no larger error than its own
    nominal stage (the drawings). Else it is refused (exit status 3), as are damaged files and a model of another rig
    file. `rigcal model list` shows how each compared.
    """
    return ask(where, "model.accept", _changed, id=number, operator=operator)


@model.command(cls=Command, name="rollback")
@click.argument("number", type=int, required=False)
@_operator
@talks
def model_rollback(number: int | None, operator: str, **where: Any) -> Any:
    """Put back the model that the live one replaced, or model NUMBER, which was live once."""
    return ask(where, "model.rollback", _changed, id=number, operator=operator)


@model.command(cls=Command, name="zeros-checked")
@_operator
@talks
def model_zeros_checked(operator: str, **where: Any) -> Any:
    """Use the live model again after a joint's encoder has jumped, its zero being checked or set back."""
    return ask(where, "model.zeros-checked", say, operator=operator)


@model.command(cls=Command, name="export")
@click.argument("number", type=int, required=False)
@click.option("--model", "directory", type=click.Path(path_type=Path), metavar="DIR", help="A model's directory.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Where to write.")
@click.option("--prism", "prisms", multiple=True, help="Prisms of the grid; all when not given. May be repeated.")
@click.option(
    "--rows",
    type=click.IntRange(64, 1_000_000),
    default=20_000,
    show_default=True,
    help="Greatest number of poses in the grid; more of them are interpolated more closely.",
)
@talks
def model_export(
    number: int | None,
    directory: Path | None,
    out: Path,
    prisms: tuple[str, ...],
    rows: int,
    socket: Path | None,
    config: Path | None,
    *,
    as_json: bool,
) -> Any:
    """Write a model for other programs: calibration.json and corrections.csv.

    With --model no daemon is needed; else model NUMBER of the running daemon is taken, the live one by default.
    calibration.json holds parameters with units and standard errors, effects, bases, accuracy and provenance;
    corrections.csv holds, at the nodes of a grid of joint values, where each prism is nominally and by the model, in
    the base frame. Between nodes the difference is meant to be interpolated linearly.
    """
    if directory is not None and number is not None:
        raise click.UsageError("give either a model's NUMBER or --model DIR")
    if directory is None:
        found = request(socket_of(socket, config), "model.show", {} if number is None else {"id": number})
        directory = Path(found["path"])
    from daemon.numba_cache import prepare

    prepare()
    from daemon.model_export import exported

    files, summary = exported(directory, prisms, rows)
    out.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        write_file(out / name, data)
    result = {"model": str(directory), "files": [str(out / name) for name in files], **summary}
    if not as_json:
        for file in result["files"]:
            echo(file)
        echo(
            f"{summary['rows']} rows; interpolated between them, corrections of {summary['correction_rms_mm']:.2g} mm "
            f"RMS are within {summary['p95_mm']:.2g} mm of the model's in 95 % of random poses "
            f"({summary['max_mm']:.2g} mm at most)"
        )
        for sentence in summary["warnings"]:
            echo_error(f"Warning: {sentence}", logging.WARNING)
    return result


def model_lines(models: Mapping[str, Any]) -> list[str]:
    """What `status` says of the live model and of the newest candidate."""
    live, candidate = models["live"], models["candidate"]
    lines = [f"model {live['id']} ({live['stage']}) is live" if live else "no model is live"]
    if candidate is not None:
        start = f"model {candidate['id']} ({candidate['stage']}) is a candidate"
        if candidate["is_acceptable"]:
            lines.append(f"{start}: {candidate['comparison']['sentence']}")
            lines.append(f"  `rigcal model accept {candidate['id']}` makes it the live one")
        else:
            lines.append(f"{start}, and would be refused now: {candidate['refused_because']}")
    return lines


def _show(console: Console, shown: dict[str, Any]) -> None:
    say(console, f"model {shown['id']} of rig {shown['rig']} ({shown['stage']}) is {shown['state']}: {shown['path']}")
    say(console, f"  trained on {', '.join(shown['sessions'])}; manifest SHA-256 {shown['manifest_sha256']}")
    compared = shown["metrics"].get("comparison")
    if compared is not None:
        other = "no live model" if compared["live"] is None else f"model {compared['live']}, live then"
        say(console, f"  beside {other}, check sessions {', '.join(compared['sessions']) or 'none'}:")
        say(console, f"  {compared['sentence']}")
        for setup in compared.get("refitted", ()):
            say(console, f"  the base at set-up {setup} was fitted on these very fixes, for both alike")
        for setup in compared.get("left_out", ()):
            say(console, f"  set-up {setup} is unknown and its fixes place no base: left out")
    for change in shown["history"]:
        by = f" by {name}" if (name := who(change["operator"], change["user"])) else ""
        say(console, f"  {utc(change['utc_ns'])} {change['state']}{by}: {change['reason']}")


def _changed(console: Console, result: dict[str, Any]) -> None:
    before = f"; model {result['retired']} is retired" if result["retired"] is not None else ""
    why = f": {result['reason']}" if "reason" in result else ""
    say(console, f"model {result['live']} is live{before}{why}")


COMMANDS = {"model": model}
