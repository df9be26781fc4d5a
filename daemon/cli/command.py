"""What all commands share: exit status, error messages, JSON output, and the progress display of long commands."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from calibration.errors import DataError, ModelError, RigError, UnsafeError
from daemon.cli.terminal import echo_error, percent
from daemon.commands import CommandError
from daemon.host.safe_output import json_line, shown, shown_lines
from daemon.host.systemd import escape_unhandled_records
from drivers.errors import DescriptionError

if TYPE_CHECKING:
    from calibration.run_settings import Progress

DONE, FAILED, WRONG_INPUT, REFUSED = 0, 1, 2, 3
LINE_S = 15.0  # between lines of progress if standard error is not a terminal
_REDRAW_S = 0.2  # between updates of the progress bar on a terminal
_BAR = 40  # characters


def exit_status(error: BaseException) -> int:
    """Return 2 for wrong use or bad input, 3 for an unsafe result, else 1 (docs/reference/formats.md)."""
    if isinstance(error, CommandError):
        return error.status
    if isinstance(error, UnsafeError):
        return REFUSED
    bad_input = (RigError, DataError, ModelError, DescriptionError, click.UsageError)
    return WRONG_INPUT if isinstance(error, bad_input) else FAILED


def error_sentence(error: BaseException) -> str:
    """Return the error in one line, for people."""
    if isinstance(error, click.ClickException):
        return error.format_message()
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if type(error).__name__ == "ConfigError":
        return str(error)  # one line for each wrong key
    text = " ".join(str(error).split())
    if type(error).__module__.partition(".")[0] in ("calibration", "drivers", "daemon", "simulators"):
        return text or type(error).__name__
    return f"internal error, {type(error).__name__}: {text} (RIGCAL_DEBUG=1 adds a traceback)"


@dataclass(frozen=True)
class Delivered:
    """The result of a command together with an exit status that need not be 0."""

    result: Mapping[str, Any]
    status: int


class Command(click.Command):
    """A command that reports a failure as one sentence on standard error and an exit status, without a traceback.

    With `--json` the failure is also the one JSON object on standard output: `{"error": SENTENCE, "kind": CLASS}`.
    RIGCAL_DEBUG=1 in the environment adds the traceback.
    """

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        as_json = "--json" in args
        try:
            _refuse_empty(args)
            return super().make_context(info_name, args, parent, **extra)
        except click.UsageError as error:
            told = self._with_value(error)
            if as_json:
                print_json({"error": error_sentence(told), "kind": type(error).__name__})
            sentence = told.format_message()
            if told is error and shown_lines(sentence) == sentence:
                raise
            raise click.UsageError(shown_lines(sentence), error.ctx) from None

    def _with_value(self, error: click.UsageError) -> click.UsageError:
        """Return an error; one about an option without its value shows how that value is called."""
        if not isinstance(error, click.BadOptionUsage) or not error.message.endswith("requires an argument."):
            return error
        name = error.option_name
        values = [p.metavar or "VALUE" for p in self.params if name in p.opts and isinstance(p, click.Option)]
        return click.UsageError(f"Option {name} needs a value: {name} {values[0]}", error.ctx) if values else error

    def invoke(self, ctx: click.Context) -> Any:
        as_json = bool(ctx.params.get("as_json"))
        escape_unhandled_records()
        try:
            # The output of a library must not get into the result.
            with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
                returned = super().invoke(ctx)
        except (click.exceptions.Exit, click.Abort):
            raise
        except Exception as error:  # the last place to turn a failure into a sentence
            if isinstance(error, BrokenPipeError) and _reader_has_ended():
                raise  # click ends the command silently
            _end_badly(error, as_json=as_json)
        delivered = returned if isinstance(returned, Delivered) else Delivered(returned, DONE)
        if as_json:
            print_json(delivered.result)
        if delivered.status != DONE:
            raise click.exceptions.Exit(delivered.status)
        return None


def _refuse_empty(args: Sequence[str]) -> None:
    """Refuse an empty argument, as from an unset variable: it would count as none or as the current directory.

    Raises:
        click.UsageError: an argument is empty; the message names it.
    """
    for before, given in pairwise(["", *args]):
        option, equals, value = given.partition("=")
        is_empty_option = option.startswith("--") and equals and not value
        if given and not is_empty_option:
            continue
        named = option if is_empty_option else before if before.startswith("-") else "an argument"
        raise click.UsageError(f"{named} is empty; give it a value or omit it (is a shell variable not set?)")


def _reader_has_ended() -> bool:
    """Return True if nothing reads standard output any more, as after `| head`."""
    poll = select.poll()
    poll.register(1, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _end_badly(error: Exception, *, as_json: bool) -> NoReturn:
    if os.environ.get("RIGCAL_DEBUG") == "1":
        echo_error("".join(traceback.format_exception(error)), logging.DEBUG)
    sentence = error_sentence(error)
    if as_json:
        print_json({"error": sentence, "kind": type(error).__name__})
    echo_error(f"Error: {sentence}", logging.ERROR)
    raise click.exceptions.Exit(exit_status(error))


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the `--json` option; a `Command` then prints what its function returns."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")(function)


def out_file_option(metavar: str, help_text: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the required option `--out` of commands that write one file."""
    path = click.Path(dir_okay=False, path_type=Path)
    return click.option("--out", type=path, required=True, metavar=metavar, help=help_text)


def print_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object on one line."""
    click.echo(json_line(result))


def stream_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object per line while a command with `--json` runs, bypassing the redirected standard output."""
    click.echo(json_line(result), file=sys.__stdout__)


@contextlib.contextmanager
def progress_display(*, as_json: bool) -> Iterator[Progress]:
    """Show the progress of long work on standard error: as a bar on a terminal, else as a line every `LINE_S`.

    Short work shows nothing. The first calibration on a computer compiles kernels, which is announced.
    """
    from daemon.warm_up import is_compiled

    if not is_compiled():
        echo_error("Compiling kernels, only once on this computer; this takes half a minute or more")
    is_watched = sys.stderr.isatty() and not as_json
    every_s = _REDRAW_S if is_watched else LINE_S
    now = (0.0, "starting")
    over = threading.Event()

    def note(share: float, text: str) -> None:
        nonlocal now
        now = share, text

    def tell() -> None:
        seconds = 0.0
        while not over.wait(every_s):
            seconds += every_s
            share, text = now
            if is_watched:
                bar = "#" * min(round(_BAR * share), _BAR - 1)  # never full while work goes on
                click.echo(f"\r\x1b[K[{bar:{_BAR}}] {seconds:.0f} s  {shown(text)}", nl=False, err=True)
            else:
                echo_error(f"{seconds:.0f} s: {text} ({percent(share)})")
        if is_watched:
            click.echo("\r\x1b[K", nl=False, err=True)

    teller = threading.Thread(target=tell, name="progress", daemon=True)
    teller.start()
    try:
        yield note
    finally:
        over.set()
        teller.join()
