"""A link's loss is a record from the start of the run on."""

from __future__ import annotations

import contextlib
from pathlib import Path

from daemon.acquisition.acquisition import Acquisition
from daemon.store import Store
from drivers.clock import SystemClock
from drivers.readings import CanCapture, DeviceEvent, EventKind, Gap, GapReason
from tests.daemon.acquisition_support import ListLink, wait_until


def test_the_time_from_the_start_of_a_run_until_a_link_is_open_is_a_gap(tmp_path: Path) -> None:
    clock = SystemClock()
    begun = clock.now()
    with contextlib.closing(Store(tmp_path / "store.sqlite")) as store:
        store.begin_run(begun)
        up, first = begun.shifted(700_000_000), begun.shifted(750_000_000)
        opened = ListLink(
            "boom", [DeviceEvent("boom", up, EventKind.LINK_UP, "open"), CanCapture("boom", first, 1, b"")]
        )
        down = ListLink("station", [Gap("station", GapReason.LINK_DOWN, up)])
        replayed = ListLink(
            "log", [CanCapture("log", first, 1, b""), DeviceEvent("log", up, EventKind.LINK_UP, "open")]
        )
        acquisition = Acquisition([opened, down, replayed], {}, store, clock, on_records=lambda _: None)
        acquisition.start()
        for link in (opened, down, replayed):
            wait_until(link.done.is_set)
        acquisition.stop()
        gaps = store.rows("SELECT channel, reason, start_monotonic_ns, end_monotonic_ns FROM gaps ORDER BY 1, 3")
    start_ns, up_ns = begun.monotonic_ns, up.monotonic_ns
    assert [tuple(gap.values()) for gap in gaps] == [
        ("boom", "link_down", start_ns, up_ns),
        ("station", "link_down", start_ns, up_ns),
        ("station", "link_down", up_ns, None),
    ]
