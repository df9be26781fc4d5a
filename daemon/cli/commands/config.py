"""`rigcal config`: the configuration file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from daemon.cli.command import Command, json_option
from daemon.cli.lines.fill_in import fill_in_lines, fill_in_note
from daemon.cli.terminal import echo, echo_list
from daemon.commands import INSTALLED_CONFIG


@click.group()
def config() -> None:
    """Check the configuration file."""


@config.command("check", cls=Command)
@click.argument("path", type=click.Path(path_type=Path), default=INSTALLED_CONFIG)
@json_option
def config_check(path: Path, *, as_json: bool) -> dict[str, Any]:
    """Check a configuration without opening any device.

    Also checks its rig, and the DBC and EDS files that they name. Lines of the rig file that `rigcal init` marked FILL
    IN are listed. PATH is /etc/rigcal/rigcal.toml by default.
    """
    from daemon.composition import decoders
    from daemon.config.config import read_config
    from daemon.rig_files import load_rig, read_rig_text

    settings = read_config(path)
    source = load_rig(settings.rig, named_in=path)
    links = decoders(settings, source)
    text, name, _ = read_rig_text(settings.rig)
    if not as_json:
        echo(f"{path}: valid: rig {source.rig.name}, links {', '.join(links) or 'none'}")
        if note := fill_in_note(text):
            echo_list("Please note", [f"{name}: {note}"])
    return {"rig": source.rig.name, "links": list(links), "fill_in": fill_in_lines(text)}
