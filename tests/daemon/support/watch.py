"""A store whose health is watched."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from daemon.store import Store
from daemon.store.health import StoreWatch
from drivers.clock import Clock, ManualClock
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.store import at, table


@contextlib.contextmanager
def watched(
    path: Path, *, ends_in_order: bool = True, clock: Clock | None = None
) -> Iterator[tuple[Store, StoreWatch]]:
    """A run on a store; one that does not end in order is as if it had been killed."""
    with contextlib.closing(Store(path)) as store:
        store.begin_run(at(0))
        watch = StoreWatch(store, clock or ManualClock(at(0)))
        watch.start()
        yield store, watch
        watch.stop()
        if ends_in_order:
            store.end_run(at(1))


def settled(watch: StoreWatch) -> str:
    """Its state once no check is under way."""

    def is_settled() -> bool:
        watch.look()
        return watch.health.state != "checking"

    wait_until(is_settled)
    return watch.health.state


def results(path: Path) -> list[str | None]:
    """What the checks for damage have found, as the store has it."""
    return [row["result"] for row in table(path, "store_checks")]
