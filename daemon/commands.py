"""What the parts that carry out operators' commands need: the caller, checked arguments, errors."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FAILED, WRONG_USE, REFUSED = 1, 2, 3
CHECK = "check"
SESSION_KINDS = ("single_joint", "multi_joint", "static_poses", CHECK)
HOW_TO_END = "stop or abort it first: `rigcal session stop`, or `rigcal session abort` if it is unusable"
NO_POSE = "no pose of it can be used"  # reason why a session is not used, to which acceptance adds none
OTHER_RIG_FILE = "it was recorded with another rig file: "  # beginning of the reason why a session is not used
HOW_TO_READ_AGAIN = "to read its captures with this one, `rigcal session export` it, and `rigcal replay` the files"
LOOK_S = 0.5  # how often a command that waits checks whether its caller is still connected
MAX_TEXT_CHARACTERS = 500
MAX_ENTRIES = 100

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

Handler = Callable[[Mapping[str, Any]], Any]


class CommandError(Exception):
    """A command that was not carried out.

    Attributes:
        status: exit status: 1 failed, 2 wrong use or bad input, 3 refused because the result would be unsafe.
    """

    def __init__(self, message: str, status: int = WRONG_USE) -> None:
        super().__init__(message)
        self.status = status


INSTALLED_CONFIG = Path("/etc/rigcal/rigcal.toml")  # configuration of the service
INSTALLED_SOCKET = Path("/run/rigcal/control.sock")


def reading_socket(control_path: Path) -> Path:
    """Return the path of the read-only control socket, in the directory of the control socket."""
    return control_path.with_name("status.sock")


# ---- the caller ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Caller:
    """The process at the other end of a control connection.

    Attributes:
        user: login name of `uid`; "" if `uid` has none.
        uid: user id at the time of connecting.
        pid: process id at the time of connecting.
    """

    user: str
    uid: int
    pid: int

    def __str__(self) -> str:
        return f"{self.user or 'user without a name'} (uid {self.uid}, pid {self.pid})"


_current: ContextVar[Caller | None] = ContextVar("caller", default=None)
_is_cancelled: ContextVar[Callable[[], bool]] = ContextVar("is_cancelled", default=lambda: False)


def current_caller() -> Caller | None:
    """Return the caller of the command that this thread carries out; None if there is none, as in a replay."""
    return _current.get()


def caller_columns(prefix: str = "") -> dict[str, str | int | None]:
    """Return the columns `<prefix>caller_user`, `..._uid` and `..._pid` for a row that a command adds or changes."""
    caller = current_caller()
    user, uid, pid = (None, None, None) if caller is None else (caller.user, caller.uid, caller.pid)
    return {f"{prefix}caller_user": user, f"{prefix}caller_uid": uid, f"{prefix}caller_pid": pid}


def is_cancelled() -> bool:
    """Return True if the caller of this thread's command has disconnected (Ctrl-C, a closed terminal)."""
    return _is_cancelled.get()()


def raise_if_cancelled() -> None:
    """Raise CommandError if the caller of this thread's command has disconnected."""
    if is_cancelled():
        raise CommandError("cancelled, because its caller has disconnected; work done so far is kept", FAILED)


@contextlib.contextmanager
def acting_for(caller: Caller | None, is_cancelled: Callable[[], bool] = lambda: False) -> Iterator[None]:
    """Set the current caller of this thread.

    Args:
        caller: the caller; None for nobody.
        is_cancelled: returns True once the caller has disconnected.
    """
    token, left_token = _current.set(caller), _is_cancelled.set(is_cancelled)
    try:
        yield
    finally:
        _current.reset(token)
        _is_cancelled.reset(left_token)


class CommandTurn:
    """Reentrant lock that is held while a command is carried out: commands wait for their turn.

    A command whose caller disconnects while it waits is not carried out: entering raises CommandError, within half a
    second or as soon as its turn comes.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if self._lock.acquire(blocking=False):
            return
        while not self._lock.acquire(timeout=LOOK_S):
            raise_if_cancelled()
        try:
            raise_if_cancelled()
        except CommandError:
            self._lock.release()
            raise

    def __exit__(self, *_: object) -> None:
        self.leave()

    def enter_if_free(self) -> bool:
        """Enter without waiting; return False if a command of another thread is being carried out."""
        return self._lock.acquire(blocking=False)

    def leave(self) -> None:
        """Leave, as the end of a `with` block does."""
        self._lock.release()


# ---- arguments -------------------------------------------------------------------------------------------------------


def identifier(arguments: Mapping[str, Any], key: str, what: str, default: str = "") -> str:
    """Return the name under `key`; CommandError if it is not a valid name.

    Args:
        arguments: of the command.
        key: of the argument.
        what: the argument in words, for the error message.
        default: used if the argument is missing or empty.
    """
    name = arguments.get(key)
    if name is None or name == "":
        name = default
    if not isinstance(name, str) or not _ID.fullmatch(name):
        raise CommandError(f"{what} is 1 to 64 letters, digits, '.', '_' or '-', not {name!r:.80}")
    return name


def text_argument(arguments: Mapping[str, Any], key: str) -> str:
    """Return the short text under `key`, "" if missing; CommandError if it is not a short printable text."""
    value = arguments.get(key, "")
    if not isinstance(value, str) or len(value) > MAX_TEXT_CHARACTERS or not value.isprintable():
        raise CommandError(
            f"{key} must be a text of at most {MAX_TEXT_CHARACTERS} printable characters, not {value!r:.80}"
        )
    return value


def mapping_argument(arguments: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return the object under `key`, empty if missing; CommandError if it is not an object or too large."""
    value = arguments.get(key, {})
    if not isinstance(value, dict) or len(value) > MAX_ENTRIES:
        raise CommandError(f"{key} must be an object of at most {MAX_ENTRIES} entries, not {value!r:.80}")
    return value


def number_argument(arguments: Mapping[str, Any], key: str, limit: float = 1e6) -> float | None:
    """Return the number under `key`, None if missing; CommandError if it is not finite or above `limit`."""
    value = arguments.get(key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (is_number and abs(value) <= limit):
        raise CommandError(f"{key:.80} must be a finite number of at most {limit:g}, not {value!r:.80}")
    return value
