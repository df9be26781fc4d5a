"""What can go wrong with the store."""

from __future__ import annotations


class StoreError(Exception):
    """The store cannot be opened or used; the message names the file and what to do."""


class StoreBusyError(StoreError):
    """Another process writes to this store.

    Attributes:
        pid: that process, where it could be read.
    """

    def __init__(self, path: str, pid: int | None) -> None:
        holder = f"process {pid}" if pid is not None else "another process"
        super().__init__(
            f"{path}: {holder} holds this store; stop it first (`rigcal status` shows it), or configure another file"
        )
        self.pid = pid
