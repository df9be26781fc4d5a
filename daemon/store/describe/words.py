"""Description of a table or a view. An instant has three columns, with a prefix where a row has several instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

INSTANT = {
    "utc_ns": "{}: ns since 1970 on the computer's clock, UTC, which may have been wrong",
    "monotonic_ns": "{}: ns on the monotonic clock of its boot",
    "boot_id": "{}: the boot of that clock",
}


@dataclass(frozen=True)
class Words:
    """Description of a table or a view.

    Attributes:
        title: its title.
        description: what a row represents.
        columns: name -> meaning, without the columns of instants, and without a view's joints and signals.
        instants: prefix of an instant's three columns -> what happened at that instant; "" for no prefix.
        label: column that names a row where other tables refer to it.
        has_channels: a view with columns of joints; a view of observations also has columns of signals.
    """

    title: str
    description: str
    columns: Mapping[str, str] = field(default_factory=dict)
    instants: Mapping[str, str] = field(default_factory=dict)
    label: str | None = None
    has_channels: bool = False

    def meanings(self) -> dict[str, str]:
        """Return every described column -> its meaning."""
        of_instants = {
            f"{prefix}{name}": meaning.format(event)
            for prefix, event in self.instants.items()
            for name, meaning in INSTANT.items()
        }
        return {**self.columns, **of_instants}
