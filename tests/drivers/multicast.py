"""The bus between processes, for tests."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterator

import can

from drivers.can.ports import CanLinkConfig
from drivers.can_link import CanLink
from drivers.clock import SystemClock

GROUP = "239.74.163.2"
_ports = itertools.count(20_000 + os.getpid() * 16 % 40_000)  # 16 for each of the processes that may test at once


def unused_port() -> int:
    """A port of its own for every test."""
    return next(_ports)


@contextlib.contextmanager
def multicast_bus(port: int) -> Iterator[can.BusABC]:
    """A participant."""
    bus = can.Bus(GROUP, "udp_multicast", port=port, hop_limit=0, ignore_config=True)
    try:
        yield bus
    finally:
        bus.shutdown()


def multicast_link(port: int, **more: object) -> CanLink:
    config = CanLinkConfig(
        name="boom",
        interface="udp_multicast",
        channel=GROUP,
        options={"port": port, "hop_limit": 0},
        **more,
    )
    return CanLink(config, SystemClock())
