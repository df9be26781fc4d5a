"""The store: one SQLite file, one connection that writes, any number of read-only ones."""

from daemon.store.errors import StoreBusyError, StoreError
from daemon.store.reader import Reader
from daemon.store.store import WHOLE_DAEMON, Store

__all__ = ["WHOLE_DAEMON", "Reader", "Store", "StoreBusyError", "StoreError"]
