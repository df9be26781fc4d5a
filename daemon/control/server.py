"""The daemon's side of the control socket: takes clients on, and never stops doing so.

One thread accepts, and one for each client reads its requests and carries them out, so that a slow command stops no
other. A client that only waits, that leaves a request unfinished or that does not read its answers is closed.
"""

from __future__ import annotations

import contextlib
import errno
import grp
import logging
import os
import pwd
import select
import socket
import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daemon.commands import FAILED, WRONG_USE, Caller, CommandError, Handler, acting_for
from daemon.control.command_table import OPERATOR, READING
from daemon.control.protocol import MAX_LINE_BYTES, answer_line, parse_request, refusal_line
from daemon.host.safe_output import shown
from daemon.store.errors import LACKING, NotInStoreError, StoreError
from drivers.clock import NS_PER_S, SystemClock

log = logging.getLogger(__name__)

POLL_S = 0.5  # how often the socket's file is looked after while no one connects
PAUSE_S = 0.2  # after an accept that failed: what it lacks will be lacking a moment longer
CLOSE_S = 5.0
RECEIVED_BYTES = 1 << 16
# Passes by itself, or is the client's own doing; anything else is a fault of the socket.
_PASSING = LACKING | {errno.ECONNABORTED, errno.EINTR}
_CREDENTIALS = struct.Struct("3i")  # struct ucred of unix(7): pid, uid, gid
_NO_LISTENER = frozenset({errno.ECONNREFUSED, errno.ENOENT})


@dataclass(frozen=True)
class Limits:
    """Limits on the clients of a server and its waits for them; a command may take as long as it likes.

    Attributes:
        clients: at a time.
        line_s: for the end of a request that has begun.
        idle_s: for the begin of the next request.
        send_s: for an answer to be read.
        give_way_s: a client that has waited this long without a whole request gives way when all places are taken.
    """

    clients: int = 32
    line_s: float = 10.0
    idle_s: float = 60.0
    send_s: float = 10.0
    give_way_s: float = 1.0


@dataclass(eq=False)
class _Client:
    """A connection.

    Attributes:
        waiting_ns: since when its next request is waited for; None while a command is carried out.
        received: bytes that no request was made of yet.
    """

    connection: socket.socket
    waiting_ns: int | None
    received: bytearray = field(default_factory=bytearray)
    thread: threading.Thread | None = None


class ControlServer:
    """Serves commands on a unix socket.

    Args:
        path: the socket; a file that a killed daemon left behind is replaced.
        handlers: command name -> function of the arguments, returning something JSON can hold.
        group: whose members may connect; those of the process's own group when None.
        limits: on its clients.

    Attributes:
        path: the socket.

    Raises:
        CommandError: the socket cannot be made there, or another process listens on it.
    """

    def __init__(
        self, path: Path, handlers: Mapping[str, Handler], *, group: str | None = None, limits: Limits | None = None
    ) -> None:
        self.path, self._handlers, self._group = path, handlers, group
        self._limits = limits or Limits()
        self._clock = SystemClock()  # people and sockets wait in real time, whatever the rig's clock does
        self._stopping = threading.Event()
        self._clients: set[_Client] = set()
        self._lock = threading.Lock()
        self._trouble: str | None = None
        self._listener, self._file = self._bind()
        self._alive_ns = self._clock.monotonic_ns()
        self._acceptor = threading.Thread(target=self._run, name="control", daemon=True)
        self._acceptor.start()

    def alive(self, within_s: float) -> bool:
        """Return True if the thread that accepts clients has come round within the last `within_s`."""
        age_ns = self._clock.monotonic_ns() - self._alive_ns
        return self._acceptor.is_alive() and age_ns <= within_s * NS_PER_S

    def trouble(self) -> str | None:
        """Return why no one can connect just now, in a clause; None where all is well."""
        if not self._acceptor.is_alive():
            return f"the thread that takes clients at {self.path} has ended"
        return self._trouble

    def close(self) -> None:
        """Stop serving; connections are closed and the socket file is removed."""
        self._stopping.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._acceptor.join(timeout=CLOSE_S)
        with self._lock:
            clients = list(self._clients)
            for client in clients:
                _hang_up(client)
        deadline_ns = self._clock.monotonic_ns() + int(CLOSE_S * NS_PER_S)
        for client in clients:
            if client.thread is not None:
                client.thread.join(timeout=max(deadline_ns - self._clock.monotonic_ns(), 0) / NS_PER_S)
        if _identity(self.path) == self._file:
            self.path.unlink(missing_ok=True)

    # ---- the socket --------------------------------------------------------------------------------------------------

    def _bind(self) -> tuple[socket.socket, tuple[int, int] | None]:
        """Return a new listening socket, and which file it is."""
        try:
            if self.path.is_socket():
                if _is_served(self.path):
                    raise CommandError(
                        f"another process listens at {self.path}; stop it, or give this daemon another `socket`",
                        FAILED,
                    )
                self.path.unlink()
            gid = -1 if self._group is None else grp.getgrnam(self._group).gr_gid
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        except KeyError:
            raise CommandError(f"{self.path}: there is no group {self._group!r}", FAILED) from None
        except OSError as error:
            raise self._unmade(error) from error
        made = False
        try:
            listener.bind(str(self.path))
            made = True
            os.chown(self.path, -1, gid)
            os.chmod(self.path, 0o660)
            listener.listen(128)
            listener.settimeout(POLL_S)
        except OSError as error:
            listener.close()
            if made:
                self.path.unlink(missing_ok=True)
            raise self._unmade(error) from error
        return listener, _identity(self.path)

    def _unmade(self, error: OSError) -> CommandError:
        return CommandError(f"the control socket {self.path} cannot be made: {error.strerror}", FAILED)

    def _keep_bound(self) -> None:
        """Bind the socket anew where its file was removed or replaced: no client would ever find it again."""
        if _identity(self.path) == self._file:
            return
        listener, self._file = self._bind()
        log.warning("the control socket %s was removed or replaced; it is made anew", self.path)
        self._listener.close()
        self._listener = listener

    def _run(self) -> None:
        while not self._stopping.is_set():
            trouble = None
            is_passing = True
            try:
                self._keep_bound()
                self._admit(self._listener.accept()[0])
            except TimeoutError:
                pass  # no one has connected
            except CommandError as error:
                trouble = str(error)
            except OSError as error:
                trouble = f"the control socket {self.path} takes no client: {error.strerror}"
                is_passing = error.errno in _PASSING
            except Exception as error:
                log.exception("the control socket has failed")
                trouble = f"the control socket {self.path} takes no client: {error}"
                is_passing = False
            if self._stopping.is_set():
                break
            self._note(trouble)
            if is_passing:
                self._alive_ns = self._clock.monotonic_ns()
            if trouble is not None:
                self._stopping.wait(PAUSE_S)
        self._listener.close()

    def _note(self, trouble: str | None) -> None:
        if trouble == self._trouble:
            return
        self._trouble = trouble
        if trouble is None:
            log.warning("the control socket %s serves again", self.path)
        else:
            log.error("%s; it is tried again", trouble)

    # ---- clients -----------------------------------------------------------------------------------------------------

    def _admit(self, connection: socket.socket) -> None:
        now_ns = self._clock.monotonic_ns()
        client = _Client(connection, now_ns)
        with self._lock:
            is_full = len(self._clients) >= self._limits.clients and not self._make_room(now_ns)
            if not is_full:
                self._clients.add(client)
        if is_full:
            _turn_away(connection, f"the daemon serves {self._limits.clients} clients already; try again in a moment")
            return
        client.thread = threading.Thread(target=self._serve, args=(client,), name="control-client", daemon=True)
        try:
            client.thread.start()
        except RuntimeError:  # the system has no thread to give
            client.thread = None
            with self._lock:
                self._clients.discard(client)
            _turn_away(connection, "the daemon's computer has no thread left for a client; try again in a moment")

    def _make_room(self, now_ns: int) -> bool:
        """Close the client that has waited longest for nothing; False where every one is at work, or has just come."""
        give_way_ns = now_ns - int(self._limits.give_way_s * NS_PER_S)
        idle = [(c.waiting_ns, c) for c in self._clients if c.waiting_ns is not None and c.waiting_ns <= give_way_ns]
        if not idle:
            return False
        _, longest = min(idle, key=lambda pair: pair[0])
        self._clients.discard(longest)
        _hang_up(longest)
        return True

    def _serve(self, client: _Client) -> None:
        try:
            with client.connection:
                caller = _peer_of(client.connection)
                while (line := self._next_line(client)) is not None:
                    answer = self._answer(line, caller, lambda: _is_closed_by_peer(client.connection))
                    client.connection.settimeout(self._limits.send_s)
                    client.connection.sendall(answer)
                    if len(line) > MAX_LINE_BYTES:
                        return
        except OSError:
            log.debug("a control connection ended early", exc_info=True)
        finally:
            with self._lock:
                self._clients.discard(client)

    def _next_line(self, client: _Client) -> bytes | None:
        """Return the client's next request; None when it has closed, given way, or kept the server waiting."""
        began_ns = self._clock.monotonic_ns()
        with self._lock:
            client.waiting_ns = began_ns
        received = client.received
        while b"\n" not in received and len(received) <= MAX_LINE_BYTES:
            limit_s = self._limits.line_s if received else self._limits.idle_s
            left_s = limit_s - (self._clock.monotonic_ns() - began_ns) / NS_PER_S
            if left_s <= 0:
                if received:
                    _turn_away(client.connection, f"the request was not finished within {limit_s:g} s")
                return None
            client.connection.settimeout(left_s)
            try:
                data = client.connection.recv(RECEIVED_BYTES)
            except TimeoutError:
                continue
            if not data:
                break
            if not received:
                began_ns = self._clock.monotonic_ns()
            received += data
        with self._lock:
            if client not in self._clients:
                return None
            client.waiting_ns = None
        if not received:
            return None
        line, _, rest = bytes(received).partition(b"\n")
        client.received = bytearray(rest)
        return line

    def _answer(self, line: bytes, caller: Caller, has_left: Callable[[], bool]) -> bytes:
        command: str | None = None
        try:
            command, arguments = parse_request(line)
            handler = self._handlers.get(command)
            if handler is None:
                raise CommandError(f"unknown command {command!r:.80}; known: {', '.join(sorted(self._handlers))}")
            if command not in READING:
                log.info("%s, asked for by %s%s", command, caller, _on_behalf(arguments))
            with acting_for(caller, has_left):
                return answer_line(handler(arguments))
        except CommandError as error:
            return refusal_line(str(error), error.status)
        except NotInStoreError as error:
            return refusal_line(str(error), WRONG_USE)
        except StoreError as error:
            log.error("command %s: %s", command, error)
            return refusal_line(str(error), FAILED)
        except Exception as error:  # a fault in one command must not end the daemon
            log.exception("command %s failed", command)
            return refusal_line(f"{command} failed inside the daemon: {error}; see its log", FAILED)


def _on_behalf(arguments: Mapping[str, Any]) -> str:
    """Return the operator whom a command names, as the end of a line of the log."""
    operator = arguments.get(OPERATOR)
    return f" for {shown(operator, 100)}" if isinstance(operator, str) and operator else ""


def _hang_up(client: _Client) -> None:
    with contextlib.suppress(OSError):
        client.connection.shutdown(socket.SHUT_RDWR)


def _turn_away(connection: socket.socket, why: str) -> None:
    """Tell a client why it is not served, if it can be told at once, and close."""
    with connection, contextlib.suppress(OSError):
        connection.setblocking(False)
        connection.send(refusal_line(why, FAILED))


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of the file at `path`; None where there is none."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _is_served(path: Path) -> bool:
    """Return True if a process listens on the socket at `path`, as far as that can be known."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        return probe.connect_ex(str(path)) not in _NO_LISTENER


def _is_closed_by_peer(connection: socket.socket) -> bool:
    """Return True if the other end of a unix socket is closed; one that has only ended its requests still listens."""
    poll = select.poll()
    poll.register(connection, 0)  # POLLHUP is always reported
    return any(state & select.POLLHUP for _, state in poll.poll(0))


def _peer_of(connection: socket.socket) -> Caller:
    """Return the process that has connected a unix socket (SO_PEERCRED)."""
    pid, uid, _ = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    try:
        user = pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError, OSError):
        user = ""
    return Caller(user, uid, pid)
