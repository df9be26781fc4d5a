"""docs/reference/control-socket.md: every command of the control socket with its arguments."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.control.command_table import COMMANDS, Command
from docs.references.markdown import table

_HEAD = """# Control socket

The daemon listens at a Unix socket (`/run/rigcal/control.sock` as a service). One JSON object a line, each way:

```json
{"command": "session.start", "arguments": {"prism": "r"}}
{"ok": true, "result": {...}}
{"ok": false, "status": 2, "error": "one sentence"}
```

`status` is the exit status that a command line ends with. A request holds at most 1 MiB, finite numbers, whole numbers
of at most 64 bits, and 20 levels of lists and objects.

A command that is given an argument it does not know, or not given one that it needs, is refused with status 2. What
does not look only changes something, and takes `operator` as well: who is responsible. It is kept with sessions, guides
and decisions on models, and stands in the log for every command.

Commands that only look are also served at `status.sock` beside the control socket, for members of `read_group`. What
the `guide.*` commands answer is in [Guides on the socket](guide-socket.md), with those of a simulated rig that is moved
by hand.

This page is made from the code: `python -m docs.references`.
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
    yield from (f"## {name}", "", does if command.changes else f"{does} *Only looks.*", "")
    rows = [(f"`{key}`", "needed", meaning) for key, meaning in command.needed.items()]
    rows += [(f"`{key}`", "", meaning) for key, meaning in command.optional.items()]
    if rows:
        yield from (*table(("argument", "", "meaning"), rows), "")
