"""docs/reference/control-socket.md: every command of the control socket with its arguments."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.control.command_table import COMMANDS, Command
from docs.references.markdown import table

_HEAD = """# Control socket

The daemon listens on a Unix socket (`/run/rigcal/control.sock` as a service). Each request and each answer is one JSON
object on one line:

```json
{"command": "session.start", "arguments": {"prism": "r"}}
{"ok": true, "result": {...}}
{"ok": false, "status": 2, "error": "one sentence"}
```

`status` is the exit status with which the command line ends. A request has at most 1 MiB, finite numbers, integers of
at most 64 bits, and 20 levels of lists and objects.

A command with an unknown argument, or without a required one, is refused with status 2. Every command that is not
marked as *read-only* changes something, and also accepts `operator`, the name of the responsible person. The name is
stored with sessions, guides and decisions on models, and is logged for every command.

Keep the connection open until the answer arrives. Commands on sessions and guides wait for one another, for example for
the end of a shot, and a command whose client disconnects while it waits is not carried out.

Read-only commands are also served on `status.sock`, in the same directory as the control socket, for members of
`read_group`. [Guides on the socket](guide-socket.md) describes the answers of the `guide.*` commands and those of a
simulated rig that is moved by hand.

This page is generated from the code: `python -m docs.references`.
"""


def page() -> str:
    """Return the text of docs/reference/control-socket.md."""
    return (
        "\n".join((_HEAD, *(line for name, command in COMMANDS.items() for line in _section(name, command)))).rstrip()
        + "\n"
    )


def _section(name: str, command: Command) -> Iterator[str]:
    """Yield the lines of a command's section."""
    does = f"{command.does[:1].upper()}{command.does[1:]}."
    yield from (f"## {name}", "", does if command.changes else f"{does} *Read-only.*", "")
    rows = [(f"`{key}`", "required", meaning) for key, meaning in command.needed.items()]
    rows += [(f"`{key}`", "", meaning) for key, meaning in command.optional.items()]
    if rows:
        yield from (*table(("argument", "", "meaning"), rows), "")
