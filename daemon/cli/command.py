"""Every command's end: exit status, one sentence or one JSON object; and the progress of long ones."""

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
from typing import TYPE_CHECKING, Any, NoReturn

import click

from calibration.errors import DataError, ModelError, RigError, UnsafeError
from daemon.cli.terminal import echo_error, percent
from daemon.commands import CommandError
from daemon.host.safe_output import json_line, shown, shown_lines
from drivers.errors import DescriptionError

if TYPE_CHECKING:
    from calibration.run_settings import Progress

DONE, FAILED, WRONG_INPUT, REFUSED = 0, 1, 2, 3
LINE_S = 15.0  # between two lines of progress where no person is watching
_REDRAW_S = 0.2  # between two looks of the progress on a terminal
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
    """Return what went wrong in one line, for people."""
    if isinstance(error, click.ClickException):
        return error.format_message()
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if type(error).__name__ == "ConfigError":
        return str(error)  # a line for each wrong key
    text = " ".join(str(error).split())
    if type(error).__module__.partition(".")[0] in ("calibration", "drivers", "daemon", "simulators"):
        return text or type(error).__name__
    return f"internal error, {type(error).__name__}: {text} (RIGCAL_DEBUG=1 shows where)"


@dataclass(frozen=True)
class Delivered:
    """The result of a command that delivers it although its exit status is not 0."""

    result: Mapping[str, Any]
    status: int


class Command(click.Command):
    """A command whose every failure is one sentence on standard error and an exit status, never a traceback.

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
            if as_json:
                print_json({"error": error_sentence(error), "kind": type(error).__name__})
            sentence = error.format_message()
            if shown_lines(sentence) == sentence:
                raise
            raise click.UsageError(shown_lines(sentence), error.ctx) from None

    def invoke(self, ctx: click.Context) -> Any:
        as_json = bool(ctx.params.get("as_json"))
        try:
            # What a library prints must not end up in the result.
            with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
                returned = super().invoke(ctx)
        except (click.exceptions.Exit, click.Abort):
            raise
        except Exception as error:  # the last place where a failure can become a sentence
            if isinstance(error, BrokenPipeError) and _reader_has_ended():
                raise  # click ends the command without a word
            _end_badly(error, as_json=as_json)
        delivered = returned if isinstance(returned, Delivered) else Delivered(returned, DONE)
        if as_json:
            print_json(delivered.result)
        if delivered.status != DONE:
            raise click.exceptions.Exit(delivered.status)
        return None


def _refuse_empty(args: Sequence[str]) -> None:
    """Refuse an empty argument, as of a variable that is not set: it would pass for none, or for the present directory.

    Raises:
        click.UsageError: says which.
    """
    for before, given in pairwise(["", *args]):
        option, equals, value = given.partition("=")
        is_empty_option = option.startswith("--") and equals and not value
        if given and not is_empty_option:
            continue
        named = option if is_empty_option else before if before.startswith("-") else "an argument"
        raise click.UsageError(
            f"{named} is empty; give it a value, or leave it out (is a variable of the shell not set?)"
        )


def _reader_has_ended() -> bool:
    """True if nothing reads standard output any more, as after `| head`."""
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


def print_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object on one line."""
    click.echo(json_line(result))


def stream_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object on a line of its own, while a command with `--json` goes on: standard output is kept."""
    click.echo(json_line(result), file=sys.__stdout__)


@contextlib.contextmanager
def progress_display(*, as_json: bool) -> Iterator[Progress]:
    """Show on standard error how far long work is: a bar where a person is watching, else a line now and then.

    Short work says nothing. The first calibration of a computer compiles what it runs, which is said beforehand.
    """
    from daemon.warm_up import is_compiled

    if not is_compiled():
        echo_error("Compiling kernels first, once on this computer: half a minute or more")
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
                bar = "#" * min(round(_BAR * share), _BAR - 1)  # full only when there is nothing left to show
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
