"""`rigcal model`: the live model, candidates, and export for other programs."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.client import ask, client_options, operator_option, socket_of, utc, who
from daemon.cli.command import Command
from daemon.cli.offline import replaced
from daemon.cli.terminal import echo, echo_error, echo_table
from daemon.control.protocol import request
from daemon.host.safe_output import write_file
from daemon.report.words import INTERVAL_SIGMAS, PLUS_MINUS
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.export.model_export import Format


@click.group()
def model() -> None:
    """List, compare, accept, roll back and export models."""


@model.command(cls=Command, name="list")
@client_options
def model_list(**where: Any) -> Any:
    """List all models with their comparisons."""
    return ask(where, "model.list", _show_list)


@model.command(cls=Command, name="show")
@click.argument("number", type=int, required=False)
@client_options
def model_show(number: int | None, **where: Any) -> Any:
    """Show a model, by default the live one.

    Shows its directory, effects, comparison with the live model, and history.
    """
    return ask(where, "model.show", _show, id=number)


@model.command(cls=Command, name="compare")
@click.argument("number", type=int)
@client_options
def model_compare(number: int, **where: Any) -> Any:
    """Compare model NUMBER with the live model.

    The comparison uses the check sessions that neither was trained on. For the newest model this happens automatically
    after each training and each check session.
    """
    return ask(where, "model.compare", echo, id=number)


@model.command(cls=Command, name="accept")
@click.argument("number", type=int)
@operator_option
@client_options
def model_accept(number: int, operator: str, **where: Any) -> Any:
    """Make candidate NUMBER the live model.

    Its error on check sessions that it was not trained on must be significantly smaller than that of the live model.
    For the first model that goes live, the error must not be larger than that of its own nominal stage (the drawings).
    Otherwise it is refused (exit status 3), as are damaged files and a model of a different rig file. `rigcal model
    list` shows the comparisons.
    """
    return ask(where, "model.accept", _changed, id=number, operator=operator)


@model.command(cls=Command, name="reject")
@click.argument("number", type=int)
@click.option("--reason", required=True, help="Reason, stored with the model.")
@operator_option
@client_options
def model_reject(number: int, reason: str, operator: str, **where: Any) -> Any:
    """Retire model NUMBER: a candidate, or the live model.

    Nobody can then accept the candidate by mistake. If the model was live, there is no corrected position from then on,
    until a candidate is accepted or a model that was live before is put back.
    """
    return ask(where, "model.reject", echo, id=number, reason=reason, operator=operator)


@model.command(cls=Command, name="rollback")
@click.argument("number", type=int, required=False)
@operator_option
@client_options
def model_rollback(number: int | None, operator: str, **where: Any) -> Any:
    """Make an earlier live model live again.

    By default this is the predecessor of the live model; NUMBER may be any model that was live before.
    """
    return ask(where, "model.rollback", _changed, id=number, operator=operator)


@model.command(cls=Command, name="zeros-checked")
@operator_option
@client_options
def model_zeros_checked(operator: str, **where: Any) -> Any:
    """Confirm the joints' zeros after an encoder has jumped.

    The model is then used again. First check that the zero is unchanged, or set it back. The model is the live one, or
    the newest candidate if none is live; sessions with the same zeros are used again, too.
    """
    return ask(where, "model.zeros-checked", echo, operator=operator)


class _ExportCommand(Command):
    """A command whose help lists the export formats."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        with formatter.section("Formats"):
            formatter.write_dl([(made.name, made.about) for made in _formats().values()])


def _formats() -> Mapping[str, Format]:
    from calibration.export.formats import formats

    return formats()


def _completed(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    return [name for name in _formats() if name.startswith(incomplete)]


@model.command(cls=_ExportCommand, name="export")
@click.argument("number", type=int, required=False)
@click.option("--model", "directory", type=click.Path(path_type=Path), metavar="DIR", help="Directory of a model.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Directory of the result.")
@click.option(
    "--format",
    "names",
    multiple=True,
    shell_complete=_completed,
    metavar="FORMAT",
    help="Format to write; json and grid by default. May be repeated.",
)
@click.option("--prism", "prisms", multiple=True, help="Prism of the grid; all by default. May be repeated.")
@click.option(
    "--rows",
    type=click.IntRange(64, 1_000_000),
    default=20_000,
    show_default=True,
    help="Largest number of poses in the grid; more poses are interpolated more accurately.",
)
@client_options
def model_export(
    number: int | None,
    directory: Path | None,
    out: Path,
    names: tuple[str, ...],
    prisms: tuple[str, ...],
    rows: int,
    socket: Path | None,
    config: Path | None,
    *,
    as_json: bool,
) -> Any:
    """Write a model for other programs.

    The output states what each format omits and the error that this causes. With --model no daemon is needed; otherwise
    model NUMBER of the running daemon is exported, the live one by default.

    docs/how-to/export.md describes how to use each format. The error is measured over the joint values of the training
    data.
    """
    if directory is not None and number is not None:
        raise click.UsageError("give either a model's NUMBER or --model DIR")
    prepare()
    from calibration.export.formats import chosen_formats

    chosen = chosen_formats(names)
    if directory is None:
        found = request(socket_of(socket, config), "model.show", {} if number is None else {"id": number})
        directory = Path(found["path"])
    from calibration.export.model_export import Export
    from daemon.models.model_files import model_sha256, read_model

    export = Export(read_model(directory), model_sha256(directory), prisms, rows)
    contents = {made.file: made.content(export) for made in chosen}
    out.mkdir(parents=True, exist_ok=True)
    notes = {name: replaced(out / name) for name in contents}
    for name, data in contents.items():
        write_file(out / name, data)
    left_out = {made.file: made.left_out(export) for made in chosen}
    result: dict[str, Any] = {
        "model": str(directory),
        "files": [str(out / name) for name in contents],
        "leaves_out": {file: left.as_dict() for file, left in left_out.items()},
    }
    has_grid = any(made.has_grid for made in chosen)
    warnings: Sequence[str] = export.summary["warnings"] if has_grid else ()
    result |= export.summary if has_grid else {}
    if not as_json:
        for made in chosen:
            echo(f"{out / made.file}{notes[made.file]}", bold=True)
            for sentence in left_out[made.file].sentences:
                echo(f"  {sentence}")
        for sentence in warnings:
            echo_error(f"Warning: {sentence}", logging.WARNING)
    return result


def _show_list(models: Sequence[Mapping[str, Any]]) -> None:
    if not models:
        echo("no models yet; the jobs of a closed session make them (`rigcal jobs list`)")
        return
    rows = []
    for model in models:
        compared = model["comparison"]
        verdict = compared["sentence"] if compared else "not compared yet"
        if compared and (stale := compared.get("stale_because")):
            verdict = f"out of date, compared {stale}: {verdict}"
        made = utc(model["created_utc_ns"])
        rows.append([str(model["id"]), model["state"], model["stage"], made, str(model["sessions"]), verdict])
    echo_table(("model", "state", "stage", "made", "sessions", "comparison"), rows)


def _show(model: Mapping[str, Any]) -> None:
    echo(f"model {model['id']} of rig {model['rig']} ({model['stage']}) is {model['state']}: {model['path']}")
    echo(f"  trained on {', '.join(model['sessions'])}; manifest SHA-256 {model['manifest_sha256']}")
    effects = model["metrics"].get("effects", ())
    if not effects:
        echo("  it has no named effects")
    for effect in effects:
        sizes = (
            f"{name} {c['value']:.4g} {PLUS_MINUS} {INTERVAL_SIGMAS * c['standard_error']:.2g} {c['unit']} (95 %)"
            for name, c in effect["coefficients"].items()
        )
        form = f" ({effect['form']})" if effect["form"] else ""
        echo(f"  effect {effect['family']}@{effect['where']}{form}: {', '.join(sizes)}")
    compared = model["metrics"].get("comparison")
    if compared is not None:
        other = "no live model" if compared["live"] is None else f"model {compared['live']}, then live"
        echo(f"  compared with {other}, check sessions {', '.join(compared['sessions']) or 'none'}:")
        echo(f"  {compared['sentence']}")
        for setup in compared.get("refitted", ()):
            echo(f"  the base at set-up {setup} was fitted to these same fixes, for both models")
        for setup in compared.get("left_out", ()):
            echo(f"  set-up {setup} was skipped: it is unknown and its fixes do not determine a base")
    for change in model["history"]:
        by = f" by {name}" if (name := who(change["operator"], change["user"])) else ""
        echo(f"  {utc(change['utc_ns'])} {change['state']}{by}: {change['reason']}")


def _changed(result: Mapping[str, Any]) -> None:
    before = f"; model {result['retired']} is retired" if result["retired"] is not None else ""
    why = f": {result['reason']}" if "reason" in result else ""
    echo(f"model {result['live']} is live{before}{why}")
