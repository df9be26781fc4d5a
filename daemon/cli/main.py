"""`rigcal`: every command there is."""

from __future__ import annotations

import importlib

import click

# Command -> where it is defined. Imported when used: status must not wait for what only calibration needs.
COMMANDS = {
    "alarms": "operator",
    "bench": "bench",
    "calibrate": "offline",
    "compare": "compare",
    "config": "run",
    "demo": "demo",
    "devices": "operator",
    "effects": "effects",
    "evaluate": "offline",
    "gap": "gap",
    "inverse": "inverse",
    "jobs": "operator",
    "model": "model",
    "plan": "plan",
    "predict": "offline",
    "replay": "run",
    "run": "run",
    "session": "operator",
    "setup": "operator",
    "status": "operator",
    "tip": "tip",
}


class _Commands(click.Group):
    """The commands, each imported when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - as above
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"daemon.cli.{COMMANDS[cmd_name]}")
        command = module.COMMANDS[cmd_name]
        assert isinstance(command, click.Command)
        return command


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="rigcal")
def main() -> None:
    """Make a drilling boom's kinematic model true."""


if __name__ == "__main__":
    main()
