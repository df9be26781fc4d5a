"""Targets that deliver messages from the machine: a webhook, and a command that sends an e-mail."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import select
import signal
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from email.message import EmailMessage
from functools import partial
from typing import IO, Any, Protocol
from urllib.parse import urlsplit

from daemon.host.safe_output import shown
from daemon.host.systemd import network_hint
from daemon.monitoring.notice import Message
from drivers.clock import NS_PER_S, SystemClock

WEBHOOK_TIMEOUT_S = 10.0  # for a whole delivery, as COMMAND_TIMEOUT_S
COMMAND_TIMEOUT_S = 30.0
_QUOTED = 200  # characters of a server's or a command's output in an error message
_LONGEST_LINE_BYTES = 998  # of an e-mail, RFC 5322
_KEPT_BYTES = 4096  # of the end of a command's output
_PIPE_BYTES = 65536  # capacity of a pipe


class DeliveryError(Exception):
    """A message was not delivered; the text is the reason, without secrets of the configuration."""


class Target(Protocol):
    """A target of notices."""

    @property
    def name(self) -> str:
        """Name of the target in the store, in `status` and in the metrics."""

    def deliver(self, message: Message) -> None:
        """Deliver a message, or raise DeliveryError."""

    def cancel(self) -> None:
        """Cancel a delivery in progress, from a different thread; harmless if there is none."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Treats a redirection as an error: a POST that follows it would become a GET without the message."""

    def redirect_request(self, *_arguments: Any, **_more: Any) -> None:
        return None


class _Connection(http.client.HTTPConnection):
    """Passes its socket to `opened` as soon as it is connected, before TLS starts."""

    opened: Callable[[socket.socket], None]

    def connect(self) -> None:
        super().connect()
        self.opened(self.sock)


class _TlsConnection(http.client.HTTPSConnection, _Connection):
    """Calls `_Connection.connect`, then starts TLS."""


class _Handler(urllib.request.HTTPHandler, urllib.request.HTTPSHandler):
    """Opens connections that pass their sockets to `opened`."""

    def __init__(self, opened: Callable[[socket.socket], None]) -> None:
        super().__init__()
        self._opened = opened

    def http_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(partial(self._made, _Connection), request)

    def https_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(partial(self._made, _TlsConnection), request)

    def _made(self, kind: type[_Connection], host: str, **more: Any) -> _Connection:
        connection = kind(host, **more)
        connection.opened = self._opened
        return connection


class _Post(threading.Thread):
    """A request with a timeout for the whole request; the timeout of urllib restarts with every read.

    Args:
        request: to be sent.
        longest_s: timeout from the look-up of the host name to the end of the answer.
    """

    def __init__(self, request: urllib.request.Request, longest_s: float) -> None:
        super().__init__(name="webhook", daemon=True)
        self._request, self._longest_s = request, longest_s
        self._turn = threading.Lock()
        self._lines: list[socket.socket] = []
        self._is_over = False
        self._error: Exception | None = None

    def send(self) -> None:
        """Send the request and wait for the answer; raises the errors of urllib, and TimeoutError after `longest_s`."""
        self.start()
        self.join(self._longest_s)
        if self.is_alive():
            self._cancel()
            raise TimeoutError(f"no complete answer within {self._longest_s:g} s")
        if self._error is not None:
            raise self._error

    def run(self) -> None:
        opener = urllib.request.build_opener(_NoRedirect, _Handler(self._opened))
        try:
            with opener.open(self._request, timeout=self._longest_s) as answer:
                answer.read(_QUOTED)
        except Exception as error:  # noqa: BLE001 - raised by `send` in the waiting thread
            self._error = error
        finally:
            with self._turn:
                for line in self._lines:
                    line.close()
                self._lines.clear()

    def _opened(self, line: socket.socket) -> None:
        with self._turn:
            self._lines.append(line.dup())  # a duplicate, as TLS takes over the socket itself
        if self._is_over:
            self._cancel()

    def _cancel(self) -> None:
        self._is_over = True
        with self._turn:
            for line in self._lines:
                with contextlib.suppress(OSError):
                    line.shutdown(socket.SHUT_RDWR)


class Webhook:
    """Posts a message as JSON; chat services show its key `text`.

    Args:
        url: http or https. It may contain a secret, and is never logged or shown.
    """

    name = "webhook"

    def __init__(self, url: str) -> None:
        self._url = url
        self._host = urlsplit(url).hostname or ""

    def deliver(self, message: Message) -> None:
        body = json.dumps(message.data).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "rigcal"}
        request = urllib.request.Request(self._url, body, headers, method="POST")
        try:
            _Post(request, WEBHOOK_TIMEOUT_S).send()
        except urllib.error.HTTPError as error:
            with error:
                raise DeliveryError(f"{self._host} answers {error.code} {shown(error.reason, _QUOTED)}") from None
        except urllib.error.URLError as error:
            raise DeliveryError(f"{self._host}: {_reason(error.reason)}") from None
        except (OSError, http.client.HTTPException) as error:
            raise DeliveryError(f"{self._host}: {_reason(error)}") from None

    def cancel(self) -> None:
        """Do nothing: the delivery ends by its timeout."""


class Command:
    """Passes a message to a command on standard input, as an e-mail without recipients (RFC 5322).

    The message is kept in memory and not in a file, so that an alarm about a full disk can be sent.

    Args:
        arguments: the program and its arguments, without a shell.
    """

    name = "command"

    def __init__(self, arguments: Sequence[str]) -> None:
        self._arguments = list(arguments)
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._is_cancelled = False

    def deliver(self, message: Message) -> None:
        program = self._arguments[0]
        try:
            with _memory_file() as given:
                given.write(_email(message))
                given.seek(0)
                with self._turn:
                    if self._is_cancelled:
                        raise DeliveryError("rigcal is stopping")
                    self._process = subprocess.Popen(
                        self._arguments,
                        stdin=given,
                        stdout=subprocess.PIPE,
                        stderr=subprocess.STDOUT,
                        start_new_session=True,
                    )
                output = self._last_said(self._process).decode(errors="replace").strip()
        except OSError as error:
            raise DeliveryError(f"{program}: {_reason(error)}") from None
        status = self._process.wait()
        if status != 0:
            last = shown(output.rpartition("\n")[2], _QUOTED)
            raise DeliveryError(f"{program} ended with status {status}" + (f": {last}" if last else ""))

    def _last_said(self, process: subprocess.Popen[bytes]) -> bytes:
        """Wait for the end of a process and return the end of its output, which may be gigabytes.

        Children that it leaves running may keep its output open, so wait for the process and not for its output.
        """
        assert process.stdout is not None
        clock = SystemClock()
        until_ns = clock.monotonic_ns() + round(COMMAND_TIMEOUT_S * NS_PER_S)
        said = b""
        with process.stdout, _end_of(process) as end:
            output = process.stdout.fileno()
            either = select.poll()
            either.register(output, select.POLLIN)
            either.register(end, select.POLLIN)
            while (left_ns := until_ns - clock.monotonic_ns()) > 0:
                ready = {descriptor for descriptor, _ in either.poll(left_ns / 1e6)}
                if output in ready:
                    new = os.read(output, _PIPE_BYTES)
                    said = (said + new)[-_KEPT_BYTES:]
                    if not new:
                        either.unregister(output)
                if end in ready:
                    return said
        self._kill()
        process.wait()
        raise DeliveryError(f"{self._arguments[0]} did not end within {COMMAND_TIMEOUT_S:g} s")

    def cancel(self) -> None:
        with self._turn:
            self._is_cancelled = True
            self._kill()

    def _kill(self) -> None:
        process = self._process
        if process is not None and process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@contextlib.contextmanager
def _end_of(process: subprocess.Popen[bytes]) -> Iterator[int]:
    """Yield a descriptor that becomes readable when a process has ended."""
    end = os.pidfd_open(process.pid)
    try:
        yield end
    finally:
        os.close(end)


def _email(message: Message) -> bytes:
    email = EmailMessage()
    email["Subject"] = message.subject
    email["Auto-Submitted"] = "auto-generated"  # RFC 3834: suppresses automatic replies
    is_long = any(len(line) > _LONGEST_LINE_BYTES for line in message.text.encode().splitlines())
    email.set_content(message.text, cte="quoted-printable" if is_long else "8bit")
    return bytes(email)


def _memory_file() -> IO[bytes]:
    return os.fdopen(os.memfd_create("rigcal-notice"), "w+b")


def _reason(error: object) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return shown(text or type(error).__name__, _QUOTED) + network_hint(error)
