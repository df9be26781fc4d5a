"""The store: one SQLite file, one writing connection, any number of read-only ones. All SQL is in this package.

migrations  the tables
connection  transactions, rows by table and column;  store  the rows of acquisition;  reader  read-only views
queries  sessions, set-ups, jobs, models, alarms and so on: one module per subject
captures, rows  values as they are stored;  files  the files and the lock;  health  damage, and free space
views, describe  the store for other programs, and its description
errors  the errors and their messages
"""

from daemon.store.errors import StoreBusyError, StoreError
from daemon.store.reader import Reader
from daemon.store.store import WHOLE_DAEMON, Store

__all__ = ["WHOLE_DAEMON", "Reader", "Store", "StoreBusyError", "StoreError"]
