"""A whole daemon, with its store and its sockets, on a rig without devices: for what does not depend on readings."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from daemon.composition import Parts, joiner
from daemon.config.config import Config
from daemon.config.sections import JobsSection
from daemon.host.systemd import Notifier
from daemon.service import Daemon
from daemon.store.store import Store
from drivers.can_link import CanLink
from drivers.clock import SystemClock
from tests.daemon.support.jobs import SOURCE


@contextlib.contextmanager
def idle_daemon(
    directory: Path, notifier: Notifier | None = None, links: Sequence[CanLink] = (), **settings: Any
) -> Iterator[Config]:
    """A daemon that runs while the block does; its store is in `directory`, and so is its control socket."""
    config = Config(rig="swdt82", state_directory=directory, jobs=JobsSection(enabled=False), **settings)
    store = Store(config.store_path)
    parts = Parts(
        "live", SOURCE.rig, SOURCE.text, SystemClock(), links, {}, joiner(config, SOURCE.rig), can_links=links
    )
    daemon = Daemon(config, store, parts)
    with running(daemon, store, notifier):
        yield config


@contextlib.contextmanager
def running(daemon: Daemon, store: Store, notifier: Notifier | None = None) -> Iterator[None]:
    """Runs a daemon in a thread while the block does; its store is closed behind it."""
    stop = threading.Event()
    thread = threading.Thread(target=daemon.run, args=(stop, notifier or Notifier({})))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        store.close()
