"""The store: one SQLite file, one connection that writes, any number of read-only ones. All SQL is in this room.

migrations  the tables
connection  transactions, rows by table and column;  store  what acquisition writes;  reader  read-only views
queries  sessions, set-ups, jobs, models, alarms and so on: one module a subject
captures, rows  values as they are stored;  files  which files, and the lock;  health  damage, and free space
views, describe  the store for other programs, and in words
errors  the errors, and the sentences that tell them
"""

from daemon.store.errors import StoreBusyError, StoreError
from daemon.store.reader import Reader
from daemon.store.store import WHOLE_DAEMON, Store

__all__ = ["WHOLE_DAEMON", "Reader", "Store", "StoreBusyError", "StoreError"]
