"""Who gives a command, as the kernel knows it: kept beside the name that the client says."""

from __future__ import annotations

import contextlib
import pwd
import select
import socket
import struct
from collections.abc import Callable, Iterator
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
_has_left: ContextVar[Callable[[], bool]] = ContextVar("has_left", default=lambda: False)


def current_caller() -> Caller | None:
    """Return who gives the command that this thread carries out; None where no one does, as in a replay."""
    return _current.get()


def caller_columns(prefix: str = "") -> dict[str, str | int | None]:
    """Return the columns `<prefix>caller_user`, `..._uid` and `..._pid` of a row that a command makes or changes."""
    caller = current_caller()
    user, uid, pid = (None, None, None) if caller is None else (caller.user, caller.uid, caller.pid)
    return {f"{prefix}caller_user": user, f"{prefix}caller_uid": uid, f"{prefix}caller_pid": pid}


def caller_has_left() -> bool:
    """Return whether nobody waits any more for the command that this thread carries out (Ctrl-C, a lost terminal)."""
    return _has_left.get()()


@contextlib.contextmanager
def acting_for(caller: Caller, has_left: Callable[[], bool] = lambda: False) -> Iterator[None]:
    """Make `caller` the current one of this thread; `has_left` tells when it no longer waits for the answer."""
    token, left_token = _current.set(caller), _has_left.set(has_left)
    try:
        yield
    finally:
        _current.reset(token)
        _has_left.reset(left_token)


def is_closed_by_peer(connection: socket.socket) -> bool:
    """Return whether the other end of a unix socket is closed; one that has only ended its requests still listens."""
    poll = select.poll()
    poll.register(connection, 0)  # POLLHUP is always reported
    return any(state & select.POLLHUP for _, state in poll.poll(0))


def peer_of(connection: socket.socket) -> Caller:
    """Return the process that has connected a unix socket (SO_PEERCRED)."""
    pid, uid, _ = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    try:
        user = pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError, OSError):
        user = ""
    return Caller(user, uid, pid)
