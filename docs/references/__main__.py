"""`python -m docs.references [FILE ...]`: regenerates pages of docs/reference, by default all."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from docs.references import (
    alarms,
    commands,
    configuration,
    control_socket,
    effects,
    metrics,
    python,
    rig_keys,
    rooms,
    schema,
)

REFERENCE = Path(__file__).parents[1] / "reference"
PAGES: Mapping[str, Callable[[], str]] = {
    "alarms.md": alarms.page,
    "commands.md": commands.page,
    "configuration.md": configuration.page,
    "control-socket.md": control_socket.page,
    "effects.md": effects.page,
    "metadata.yaml": schema.metadata,
    "metrics.md": metrics.page,
    "python.md": python.page,
    "rig-keys.md": rig_keys.page,
    "rooms.svg": rooms.picture,
    "schema.md": schema.page,
}


def main() -> None:
    """Write the pages."""
    for name in sys.argv[1:] or PAGES:
        (REFERENCE / name).write_text(PAGES[name](), encoding="utf-8")


if __name__ == "__main__":
    main()
