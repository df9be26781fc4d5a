"""A store with a channel, and acquisition on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from daemon.acquisition.acquisition import Acquisition
from daemon.store import Store
from drivers.clock import SystemClock
from drivers.readings import LinkLoop
from tests.daemon.support.acquisition import Make, NumberDecoder


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    store = Store(path)
    store.declare_channels({"theta1": "deg"}, {})
    yield store
    store.close()


@pytest.fixture
def acquire(store: Store) -> Iterator[Make]:
    """Makes an Acquisition on the store and stops it after the test."""
    made: list[Acquisition] = []

    def make(
        links: Sequence[LinkLoop], decoders: dict[str, Callable[[], NumberDecoder]] | None = None, **options: object
    ) -> Acquisition:
        options.setdefault("on_records", lambda _: None)
        options.setdefault("batch_seconds", 0.01)
        clock = options.pop("clock", None) or SystemClock()
        one = Acquisition(links, {"boom": NumberDecoder} if decoders is None else decoders, store, clock, **options)  # type: ignore[arg-type] # options of any type
        made.append(one)
        return one

    yield make
    for one in made:
        one.stop()
