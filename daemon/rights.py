"""Which commands only read: those whom a site lets look, and not change, may give these alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from daemon.control import REFUSED, CommandError, Handler, how_to_be_let_in

# Every command that is not named here changes something.
READING = frozenset(
    {
        "status",
        "setup.list",
        "session.list",
        "session.show",
        "jobs.list",
        "model.list",
        "model.show",
        "tip",
        "alarms.list",
    }
)


def reading_only(handlers: Mapping[str, Handler], control_path: Path) -> dict[str, Handler]:
    """Return handlers of the same commands; those that change something are refused.

    Args:
        handlers: of all commands.
        control_path: the socket that carries them out, whose group the refusal names.
    """
    return {
        name: handler if name in READING else partial(_refuse, name, control_path) for name, handler in handlers.items()
    }


def _refuse(command: str, control_path: Path, _arguments: Mapping[str, Any]) -> NoReturn:
    raise CommandError(
        f"you may look and not change anything, as {command} does: {how_to_be_let_in(control_path)}", REFUSED
    )
