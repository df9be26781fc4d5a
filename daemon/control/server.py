"""The server of the control socket, which keeps accepting clients whatever fails.

One thread accepts connections. One thread per client reads its requests and carries them out, so that a slow command
delays no other client. A client that is idle, leaves a request unfinished or does not read its answers is disconnected.
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

POLL_S = 0.5  # how often the socket's file is checked while no one connects
PAUSE_S = 0.2  # pause after a failed accept: the missing resource will be missing a moment longer
CLOSE_S = 5.0
RECEIVED_BYTES = 1 << 16
# Errors that pass by themselves or are caused by the client; any other error is a fault of the socket.
_PASSING = LACKING | {errno.ECONNABORTED, errno.EINTR}
_CREDENTIALS = struct.Struct("3i")  # struct ucred of unix(7): pid, uid, gid
_NO_LISTENER = frozenset({errno.ECONNREFUSED, errno.ENOENT})


@dataclass(frozen=True)
class Limits:
    """Limits on the number of clients and on waiting for them; the duration of a command is not limited.

    Attributes:
        clients: largest number of clients at a time.
        line_s: wait for the end of a request that has begun.
        idle_s: wait for the start of the next request.
        send_s: wait for a further part of an answer to be read.
        give_way_s: when all places are taken, a client that for this long has sent no complete request, or has not read
            an answer, is disconnected.
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
        waiting_ns: when the wait for its next request, or for it to read an answer, began; None while a command is
            carried out.
        received: bytes of requests that are not yet parsed.
    """

    connection: socket.socket
    waiting_ns: int | None
    received: bytearray = field(default_factory=bytearray)
    thread: threading.Thread | None = None


class ControlServer:
    """Serves commands on a unix socket.

    Args:
        path: the socket; a file left behind by a killed daemon is replaced.
        handlers: command name -> function of the arguments that returns a value JSON can represent.
        group: group whose members may connect; the process's own group when None.
        limits: limits on its clients.

    Attributes:
        path: the socket.

    Raises:
        CommandError: the socket cannot be created there, or another process listens on it.
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
        """Return True if the thread that accepts clients has completed a loop within the last `within_s` seconds."""
        age_ns = self._clock.monotonic_ns() - self._alive_ns
        return self._acceptor.is_alive() and age_ns <= within_s * NS_PER_S

    def trouble(self) -> str | None:
        """Return why no one can connect at present, in a clause; None if clients can connect."""
        if not self._acceptor.is_alive():
            return f"the thread that accepts clients at {self.path} has ended"
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
        """Return a new listening socket, and the identity of its file."""
        try:
            if self.path.is_socket():
                if _is_served(self.path):
                    raise CommandError(
                        f"another process listens at {self.path}; stop it, or give this daemon a different `socket`",
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
        return CommandError(f"the control socket {self.path} cannot be created: {error.strerror}", FAILED)

    def _keep_bound(self) -> None:
        """Bind the socket again if its file was removed or replaced, because clients could no longer find it."""
        if _identity(self.path) == self._file:
            return
        listener, self._file = self._bind()
        log.warning("the control socket %s was removed or replaced; it was created again", self.path)
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
                trouble = f"the control socket {self.path} cannot accept clients: {error.strerror}"
                is_passing = error.errno in _PASSING
            except Exception as error:
                log.exception("the control socket has failed")
                trouble = f"the control socket {self.path} cannot accept clients: {error}"
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
            log.warning("the control socket %s accepts clients again", self.path)
        else:
            log.error("%s; retrying", trouble)

    # ---- clients -----------------------------------------------------------------------------------------------------

    def _admit(self, connection: socket.socket) -> None:
        now_ns = self._clock.monotonic_ns()
        client = _Client(connection, now_ns)
        with self._lock:
            is_full = len(self._clients) >= self._limits.clients and not self._make_room(now_ns)
            if not is_full:
                self._clients.add(client)
        if is_full:
            _turn_away(connection, f"the daemon already serves {self._limits.clients} clients; try again in a moment")
            return
        client.thread = threading.Thread(target=self._serve, args=(client,), name="control-client", daemon=True)
        try:
            client.thread.start()
        except RuntimeError:  # the system cannot start a thread
            client.thread = None
            with self._lock:
                self._clients.discard(client)
            _turn_away(connection, "the daemon's computer cannot start a thread for a client; try again in a moment")

    def _make_room(self, now_ns: int) -> bool:
        """Disconnect the client that has been idle longest; return False if all are busy or have just connected."""
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
                    self._send(client, answer)
                    if len(line) > MAX_LINE_BYTES:
                        return
        except OSError:
            log.debug("a control connection ended early", exc_info=True)
        finally:
            with self._lock:
                self._clients.discard(client)

    def _send(self, client: _Client, answer: bytes) -> None:
        """Send an answer; a client waits only while it takes nothing of it."""
        client.connection.settimeout(self._limits.send_s)
        left = memoryview(answer)
        while left:
            with self._lock:
                client.waiting_ns = self._clock.monotonic_ns()
            left = left[client.connection.send(left) :]

    def _next_line(self, client: _Client) -> bytes | None:
        """Return the client's next request; None if the client has closed, was disconnected or exceeded a limit."""
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

    def _answer(self, line: bytes, caller: Caller, is_cancelled: Callable[[], bool]) -> bytes:
        command: str | None = None
        try:
            command, arguments = parse_request(line)
            handler = self._handlers.get(command)
            if handler is None:
                raise CommandError(f"unknown command {command!r:.80}; known: {', '.join(sorted(self._handlers))}")
            if command not in READING:
                log.info("%s, requested by %s%s", command, caller, _on_behalf(arguments))
            with acting_for(caller, is_cancelled):
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
    """Return the operator named in a command, as the end of a log line."""
    operator = arguments.get(OPERATOR)
    return f" for {shown(operator, 100)}" if isinstance(operator, str) and operator else ""


def _hang_up(client: _Client) -> None:
    with contextlib.suppress(OSError):
        client.connection.shutdown(socket.SHUT_RDWR)


def _turn_away(connection: socket.socket, why: str) -> None:
    """Send a client the reason why it is not served, if that does not block, and close the connection."""
    with connection, contextlib.suppress(OSError):
        connection.setblocking(False)
        connection.send(refusal_line(why, FAILED))


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of the file at `path`; None if there is no file."""
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
    """Return True if the peer of a unix socket has closed it; a peer that has only shut down sending still listens."""
    poll = select.poll()
    poll.register(connection, 0)  # POLLHUP is always reported
    return any(state & select.POLLHUP for _, state in poll.poll(0))


def _peer_of(connection: socket.socket) -> Caller:
    """Return the process that has connected to a unix socket (SO_PEERCRED)."""
    pid, uid, _ = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    try:
        user = pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError, OSError):
        user = ""
    return Caller(user, uid, pid)
