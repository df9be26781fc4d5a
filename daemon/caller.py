"""Who gives a command, as the kernel knows it: kept beside the name that the client says."""

from __future__ import annotations

import contextlib
import pwd
import socket
import struct
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass

_CREDENTIALS = struct.Struct("3i")  # struct ucred of unix(7): pid, uid, gid


@dataclass(frozen=True)
class Caller:
    """The process at the other end of a control connection.

    Attributes:
        user: login name of `uid`; "" where the computer knows none.
        uid: user id, when it connected.
        pid: process id, when it connected.
    """

    user: str
    uid: int
    pid: int

    def __str__(self) -> str:
        return f"{self.user or 'user without a name'} (uid {self.uid}, pid {self.pid})"


_current: ContextVar[Caller | None] = ContextVar("caller", default=None)


def current_caller() -> Caller | None:
    """Return who gives the command that this thread carries out; None where no one does, as in a replay."""
    return _current.get()


def caller_columns(prefix: str = "") -> dict[str, str | int | None]:
    """Return the columns `<prefix>caller_user`, `..._uid` and `..._pid` of a row that a command makes or changes."""
    caller = current_caller()
    user, uid, pid = (None, None, None) if caller is None else (caller.user, caller.uid, caller.pid)
    return {f"{prefix}caller_user": user, f"{prefix}caller_uid": uid, f"{prefix}caller_pid": pid}


@contextlib.contextmanager
def acting_for(caller: Caller) -> Iterator[None]:
    """Make `caller` the current one of this thread."""
    token = _current.set(caller)
    try:
        yield
    finally:
        _current.reset(token)


def peer_of(connection: socket.socket) -> Caller:
    """Return the process that has connected a unix socket (SO_PEERCRED)."""
    pid, uid, _ = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    try:
        user = pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError, OSError):
        user = ""
    return Caller(user, uid, pid)
