"""Earlier runs of the daemon, as the store knows them."""

from __future__ import annotations

from daemon.store.store import Store
from drivers.clock import Stamp


def previous_run(store: Store) -> Stamp | None:
    """When the run before the present one was last known to be alive; None before the first."""
    runs = store.rows("SELECT * FROM daemon_runs WHERE id < ? ORDER BY id DESC LIMIT 1", (store.run_id,))
    return (store.stamp(runs[0], "ended_") or store.stamp(runs[0], "alive_")) if runs else None
