"""`rigcal completion`: the script for completion of rigcal's commands and options in a shell."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from daemon.cli.command import Command
from daemon.cli.terminal import echo_text

PROGRAM = "rigcal"
VARIABLE = "_RIGCAL_COMPLETE"  # click derives this name from the program's


@click.command(cls=Command)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script for completion in a shell.

    With it the shell completes rigcal's commands and options. The Debian package and deploy/install.sh install it for
    all users. For one user of bash: `rigcal completion bash > ~/.local/share/bash-completion/completions/rigcal`.
    """
    shell_class = get_completion_class(shell)
    assert shell_class is not None  # click has all three
    script = shell_class(context.find_root().command, {}, PROGRAM, VARIABLE)
    echo_text(script.source_template % script.source_vars())  # `source` would run the shell to learn its version
