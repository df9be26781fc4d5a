"""A table or a view in words. An instant is three columns, with a prefix where a row has several of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

INSTANT = {
    "utc_ns": "{}: ns since 1970 on the computer's clock, UTC, which may have been set wrongly",
    "monotonic_ns": "{}: ns on the monotonic clock of its boot",
    "boot_id": "{}: the boot of that clock",
}


@dataclass(frozen=True)
class Words:
    """A table or a view in words.

    Attributes:
        title: its name for people.
        description: what a row is.
        columns: name -> meaning, but those of instants and the joints and signals of a view.
        instants: prefix of an instant's three columns -> what happened then; "" where they have no prefix.
        label: the column by which a row is named where other tables refer to it.
        has_channels: a view with columns of joints, and of signals where it is of observations.
    """

    title: str
    description: str
    columns: Mapping[str, str] = field(default_factory=dict)
    instants: Mapping[str, str] = field(default_factory=dict)
    label: str | None = None
    has_channels: bool = False

    def meanings(self) -> dict[str, str]:
        """Every column that is described -> its meaning."""
        of_instants = {
            f"{prefix}{name}": meaning.format(event)
            for prefix, event in self.instants.items()
            for name, meaning in INSTANT.items()
        }
        return {**self.columns, **of_instants}
