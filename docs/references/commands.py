"""docs/reference/commands.md: every command with its arguments and options, generated from the commands themselves."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import click

from daemon.cli.main import main
from docs.references.markdown import table

_HEAD = """# Commands

Every command with its arguments and options. `--help` of each command shows the same text.
This page is generated from the code: `python -m docs.references`.

Exit status of all commands: 0 done, 1 failed, 2 wrong usage or bad input, 3 refused because the result would be unsafe
to use. Only `rigcal health` differs: it has the exit statuses of monitoring plugins. With `--json`, standard output is
one JSON object and nothing else ([files and outputs](formats.md)). Where standard output is not a terminal, the output
has no colours and no animation.

`rigcal completion bash | zsh | fish` prints a script with which the shell completes commands and options on the Tab
key; the Debian package and `deploy/install.sh` install all three scripts.
"""


def page() -> str:
    """Return the text of docs/reference/commands.md."""
    context = click.Context(main, info_name="rigcal")
    return _HEAD + "".join(f"\n{part}" for part in _parts(context, main))


def _parts(context: click.Context, command: click.Command) -> Iterator[str]:
    """Yield the section of a command, then those of its subcommands."""
    if isinstance(command, click.Group):
        if context.parent is not None:
            yield f"## {context.command_path}\n\n{_text(command)}\n"
        for name in command.list_commands(context):
            sub = command.get_command(context, name)
            assert sub is not None
            if not sub.hidden:
                yield from _parts(click.Context(sub, context, name), sub)
        return
    level = "##" if context.parent is not None and context.parent.parent is None else "###"
    usage = " ".join((context.command_path, *command.collect_usage_pieces(context)))
    lines = [f"{level} {context.command_path}", "", "```text", usage, "```", "", _text(command)]
    records = [
        record
        for parameter in command.get_params(context)
        if "--help" not in parameter.opts and (record := parameter.get_help_record(context)) is not None
    ]
    if records:
        lines += ["", *table(("option", ""), ((f"`{_one_line(names)}`", _one_line(text)) for names, text in records))]
    yield "\n".join(lines) + "\n"


def _text(command: click.Command) -> str:
    """Return a command's help with one line for each paragraph."""
    text = textwrap.dedent(command.help or "").replace("\b\n", "").strip()
    return "\n\n".join(_one_line(paragraph) for paragraph in text.split("\n\n"))


def _one_line(text: str) -> str:
    return " ".join(text.split())
