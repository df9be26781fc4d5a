"""`rigcal`: finds its commands in the folder `commands`, one file each.

`commands/NAME.py` defines the command or group NAME as a function of that name. A module is imported to show its help
or run its command, so at its top level it imports nothing heavy. For a name that is a Python keyword, file and function
have a trailing underscore (`import_.py`).
"""

from __future__ import annotations

import difflib
import importlib
import keyword
import pkgutil

import click

from daemon.cli import commands
from daemon.version import VERSION


class _Commands(click.Group):
    """The group of all commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        return sorted(module.name.removesuffix("_") for module in pkgutil.iter_modules(commands.__path__))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.list_commands(ctx):
            return None
        name = f"{cmd_name}_" if keyword.iskeyword(cmd_name) else cmd_name
        command = getattr(importlib.import_module(f"{commands.__name__}.{name}"), name)
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Resolve as click does, and suggest similar commands, which click does only for loaded commands."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx))
            if not near:
                raise
            raise click.UsageError(f"{error.message} Did you mean {' or '.join(map(repr, near))}?", ctx) from None


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(VERSION, prog_name="rigcal")
def main() -> None:
    """Calibrate the kinematic model of a drilling boom."""


if __name__ == "__main__":
    main()
