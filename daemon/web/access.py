"""Permissions on the page: roles, tokens and a limit on wrong tokens.

A token is 256 random bits, shown once when it is made; the file keeps its SHA-256, the name of its owner and the role.
So much randomness needs no slow hash. The browser keeps the token in a cookie that no script can read. Removing a token
from the file revokes it at once.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import secrets
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from daemon.commands import FAILED, CommandError
from daemon.host.safe_output import write_file
from drivers.clock import NS_PER_S, Clock, SystemClock
from drivers.files import read_text

PREFIX = "rigcal_"  # by which people and secret scanners recognise a token
NAME_CHARACTERS = 60
_FILE_BYTES = 1 << 20
_WINDOW_S = 60.0
_WRONG_PER_ADDRESS = 10
_WRONG_IN_ALL = 100
_ADDRESSES = 1000


class Role(IntEnum):
    """A role; each includes the permissions of the roles before it."""

    READ = 1
    OPERATE = 2
    APPROVE = 3

    @classmethod
    def named(cls, name: str) -> Role:
        """Return the role with a name as on the command line and in the file."""
        return cls[name.upper()]

    @property
    def word(self) -> str:
        """Name of the role for people and files."""
        return self.name.lower()


ROLE_NAMES = tuple(role.word for role in Role)


@dataclass(frozen=True)
class Person:
    """A person at a browser.

    Attributes:
        name: name of the token's owner; "" for a person on the loopback interface without a token.
        role: role of the person.
    """

    name: str
    role: Role


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    role: str
    sha256: str
    created_utc_ns: int


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    tokens: tuple[_Entry, ...] = ()


class TokenFile:
    """The tokens of a page, in a JSON file that is read again whenever it has changed.

    Args:
        path: path of the file, which need not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._state: tuple[int, int, int] | None = None
        self._entries: tuple[_Entry, ...] = ()
        self._turn = threading.Lock()

    def add(self, name: str, role: Role, created_utc_ns: int) -> str:
        """Make a token and store its hash.

        Args:
            name: name of the owner.
            role: role of the owner.
            created_utc_ns: present time.

        Returns:
            The token, which cannot be recovered later.

        Raises:
            CommandError: the name is taken or invalid, or the file cannot be read or written.
        """
        if not 1 <= len(name) <= NAME_CHARACTERS or not name.isprintable() or not name.strip():
            raise CommandError(f"a token's name is 1 to {NAME_CHARACTERS} printable characters, not {name!r:.80}")
        token = PREFIX + secrets.token_urlsafe(32)
        entry = _Entry(name=name, role=role.word, sha256=_digest(token), created_utc_ns=created_utc_ns)
        with self._alone():
            entries = self.entries()
            if any(entry.name == name for entry in entries):
                raise CommandError(f"{name!r} has a token already; remove it first, or choose another name")
            self._write((*entries, entry))
        return token

    def remove(self, name: str) -> None:
        """Remove a token, which is refused from then on.

        Raises:
            CommandError: there is no token of that name, or the file cannot be read or written.
        """
        with self._alone():
            entries = self.entries()
            kept = tuple(entry for entry in entries if entry.name != name)
            if len(kept) == len(entries):
                known = ", ".join(entry.name for entry in entries) or "none"
                raise CommandError(f"there is no token of {name!r}; there are: {known}")
            self._write(kept)

    def entries(self) -> tuple[_Entry, ...]:
        """Return all tokens' names, roles and hashes.

        Raises:
            CommandError: the file cannot be read.
        """
        with self._turn:
            try:
                found = os.stat(self.path)
            except FileNotFoundError:
                self._state, self._entries = None, ()
                return ()
            except OSError as error:
                raise CommandError(f"{self.path}: cannot be read: {error.strerror}", FAILED) from error
            state = found.st_ino, found.st_mtime_ns, found.st_size
            if state != self._state:
                self._entries, self._state = self._read(), state
            return self._entries

    def find(self, token: str) -> Person | None:
        """Return the owner of a token; None if the token is unknown."""
        digest = _digest(token)
        for entry in self.entries():
            if secrets.compare_digest(entry.sha256, digest):
                return Person(entry.name, Role.named(entry.role))
        return None

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold a lock on the file's directory, so that processes change the file one after the other.

        The kernel releases the lock when the process ends, however it ends.
        """
        try:
            directory = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise CommandError(f"{self.path}: cannot be written: {error.strerror}", FAILED) from error
        try:
            fcntl.flock(directory, fcntl.LOCK_EX)
            yield
        finally:
            os.close(directory)

    def _read(self) -> tuple[_Entry, ...]:
        try:
            entries = _File.model_validate_json(read_text(self.path, _FILE_BYTES)).tokens
        except OSError as error:
            raise CommandError(f"{self.path}: cannot be read: {error.strerror}", FAILED) from error
        except (ValidationError, ValueError) as error:
            first = str(error).splitlines()[0]
            raise CommandError(
                f"{self.path}: not a token file ({first}); remove it and add the tokens again"
            ) from error
        for entry in entries:
            if entry.role not in ROLE_NAMES:
                raise CommandError(
                    f"{self.path}: {entry.name!r} has role {entry.role!r}; roles: {', '.join(ROLE_NAMES)}"
                )
        return entries

    def _write(self, entries: tuple[_Entry, ...]) -> None:
        """Write the file, readable and writable by its owner and readable by the group of its directory."""
        text = json.dumps({"tokens": [entry.model_dump() for entry in entries]}, indent=1) + "\n"
        try:
            write_file(self.path, text.encode())
            os.chown(self.path, -1, self.path.parent.stat().st_gid)
            self.path.chmod(0o640)
        except OSError as error:
            raise CommandError(f"{self.path}: cannot be written: {error.strerror}", FAILED) from error


class AttemptLimit:
    """Limits the number of wrong tokens per minute, from one address and from all addresses.

    A correct token is never delayed, even if others try wrong tokens from its address. A wrong token that is tried
    again is not a guess: a browser that keeps a removed token sends it for days.

    Args:
        clock: clock of the computer.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or SystemClock()
        self._wrong: dict[str, deque[int]] = {}
        self._all: deque[int] = deque(maxlen=_WRONG_IN_ALL)
        self._known: deque[str] = deque(maxlen=_ADDRESSES)

    def is_known(self, token: str) -> bool:
        """Return True for a wrong token that was counted already."""
        return _digest(token) in self._known

    def note(self, address: str, token: str) -> None:
        """Count a wrong token."""
        self._known.append(_digest(token))
        now_ns = self._clock.monotonic_ns()
        if address not in self._wrong and len(self._wrong) >= _ADDRESSES:
            self._wrong.pop(next(iter(self._wrong)))
        self._wrong.setdefault(address, deque(maxlen=_WRONG_PER_ADDRESS)).append(now_ns)
        self._all.append(now_ns)

    def wait_s(self, address: str) -> float:
        """Return how many seconds this address must wait before its next wrong token is answered; 0 for no wait."""
        own = self._wrong.get(address)
        return max(self._left_s(own, _WRONG_PER_ADDRESS) if own else 0.0, self._left_s(self._all, _WRONG_IN_ALL))

    def _left_s(self, times: deque[int], most: int) -> float:
        if len(times) < most:
            return 0.0
        return max(_WINDOW_S - (self._clock.monotonic_ns() - times[0]) / NS_PER_S, 0.0)


def role_refusal(person: Person, needed: Role) -> str:
    """Return a sentence that refuses an action for which a person's role is too low."""
    who = f"the token of {person.name}" if person.name else "this page, opened without a token,"
    return f"this needs the role {needed.word}, and {who} has the role {person.role.word}"


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
