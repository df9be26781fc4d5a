"""`rigcal completion`: the script by which a shell completes rigcal's commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from daemon.cli.command import Command
from daemon.cli.terminal import echo_text

PROGRAM = "rigcal"
VARIABLE = "_RIGCAL_COMPLETE"  # click's name for it, made of the program's


@click.command(cls=Command)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script that makes a shell complete commands and options of rigcal.

    The Debian package and deploy/install.sh put it in place for all users. For one user of bash:
    `rigcal completion bash > ~/.local/share/bash-completion/completions/rigcal`.
    """
    shell_class = get_completion_class(shell)
    assert shell_class is not None  # click has all three
    script = shell_class(context.find_root().command, {}, PROGRAM, VARIABLE)
    echo_text(script.source_template % script.source_vars())  # `source` would run the shell to learn its version
