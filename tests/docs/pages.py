"""The pages of the documentation, their blocks of commands, and the real command line that must know them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click

from daemon.cli.main import main

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
ELSEWHERE = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "deploy/README.md")
_FENCE = re.compile(r'^( *)```(\w+)(?: title="([^"]+)")?\n(.*?)^\1```$', re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(?<!`)`(rigcal [^`]+)`(?!`)")
_SEPARATORS = re.compile(r"\s(?:&&|\|\||\||;|>)(?:\s|$)")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes:
        page: of which page, relative to the repository.
        line: where it begins, from 1.
        language: of the fence.
        title: of the fence; a block of commands with a title is not run, the title says why.
        text: what is in it.
    """

    page: str
    line: int
    language: str
    title: str
    text: str

    @property
    def commands(self) -> list[str]:
        """Its lines without comments, those that go on joined."""
        lines = (line.partition(" #")[0].strip() for line in self.text.replace("\\\n", " ").splitlines())
        return [line for line in lines if line and not line.startswith("#")]


def pages() -> list[str]:
    """Return every page that somebody wrote or generated."""
    return sorted([*ELSEWHERE, *(path.relative_to(ROOT).as_posix() for path in DOCS.rglob("*.md"))])


def blocks(page: str) -> list[Block]:
    text = (ROOT / page).read_text(encoding="utf-8")
    return [
        Block(page, text.count("\n", 0, found.start()) + 1, found[2], found[3] or "", found[4])
        for found in _FENCE.finditer(text)
    ]


def inline_commands(page: str) -> Iterator[str]:
    """Yield what a page calls a command in a sentence."""
    text = _FENCE.sub("", (ROOT / page).read_text(encoding="utf-8"))
    for found in _INLINE.finditer(text):
        yield " ".join(found[1].replace("\\|", "|").split())


def fault_of(line: str) -> str:
    """Return what the command line does not know in a line of a block; empty if it knows all of it."""
    for part in _SEPARATORS.split(line):
        words = shlex.split(part)
        words = words[1:] if words[:1] == ["sudo"] else words
        if words[:1] == ["rigcal"]:
            try:
                _parse(words[1:])
            except click.ClickException as error:
                return f"{part}: {error.format_message()}"
    return ""


def _parse(words: list[str]) -> None:
    """Take the words of a command as the program does, but for files that have to be there."""
    command, context, words = _command(words)
    values, _, _ = command.make_parser(context).parse_args(list(words))
    for parameter in command.params:
        value = values.get(parameter.name)
        if parameter.required and value in (None, ()):
            raise click.MissingParameter(param=parameter, ctx=context)
        if isinstance(parameter.type, click.Choice):
            for one in value if isinstance(value, list | tuple) else [value]:
                if one is not None:
                    parameter.type.convert(one, parameter, context)


def _command(words: list[str]) -> tuple[click.Command, click.Context, list[str]]:
    """Return the command that words begin with, its context, and the words that are left."""
    command: click.Command = main
    context = click.Context(main, info_name="rigcal")
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        found = command.get_command(context, words[0])
        if found is None:
            raise click.UsageError(f"no command {words[0]!r}")
        command, context, words = found, click.Context(found, context, words[0]), words[1:]
    return command, context, words


def fault_of_mention(text: str) -> str:
    """Return what the command line does not know of a command in a sentence: `rigcal COMMAND --option ...`."""
    words = text.split()[1:]
    if not words or not words[0][0].islower():
        return ""
    try:
        command, context, rest = _command(words)
    except click.ClickException as error:
        return f"{text}: {error.format_message()}"
    known = {name for one in command.get_params(context) for name in (*one.opts, *one.secondary_opts)}
    known |= {"--help", "--version"}
    for word in re.findall(r"(?<![\w-])--[a-z][a-z-]*", " ".join(rest)):
        if word not in known:
            return f"{text}: {context.command_path} has no {word}"
    return ""
