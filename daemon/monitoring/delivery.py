"""Ways in which a message leaves the machine: a webhook, and a command that sends an e-mail."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Sequence
from email.message import EmailMessage
from typing import IO, Any, Protocol
from urllib.parse import urlsplit

from daemon.host.safe_output import shown
from daemon.host.systemd import network_hint
from daemon.monitoring.notice import Message

WEBHOOK_TIMEOUT_S = 10.0
COMMAND_TIMEOUT_S = 30.0
_QUOTED = 200  # characters of what a server or a command says


class DeliveryError(Exception):
    """A message that was not delivered; the text says why, and holds no secret of the configuration."""


class Target(Protocol):
    """A way out of the machine."""

    @property
    def name(self) -> str:
        """Its name in the store, in `status` and in the metrics."""

    def deliver(self, message: Message) -> None:
        """Deliver a message, or raise DeliveryError."""

    def cancel(self) -> None:
        """Give up a delivery that is under way, from another thread; harmless when there is none."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Makes an error of a redirection: a POST that follows one arrives as a GET, without its message."""

    def redirect_request(self, *_arguments: Any, **_more: Any) -> None:
        return None


class Webhook:
    """Posts a message as JSON; its key `text` is what chat services show.

    Args:
        url: http or https. It may hold a secret, and is never told.
    """

    name = "webhook"

    def __init__(self, url: str) -> None:
        self._url = url
        self._host = urlsplit(url).hostname or ""
        self._opener = urllib.request.build_opener(_NoRedirect)

    def deliver(self, message: Message) -> None:
        body = json.dumps(message.data).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "rigcal"}
        request = urllib.request.Request(self._url, body, headers, method="POST")
        try:
            with self._opener.open(request, timeout=WEBHOOK_TIMEOUT_S) as answer:
                answer.read(_QUOTED)
        except urllib.error.HTTPError as error:
            with error:
                raise DeliveryError(f"{self._host} answers {error.code} {shown(error.reason, _QUOTED)}") from None
        except urllib.error.URLError as error:
            raise DeliveryError(f"{self._host}: {_reason(error.reason)}") from None
        except (OSError, http.client.HTTPException) as error:
            raise DeliveryError(f"{self._host}: {_reason(error)}") from None

    def cancel(self) -> None:
        """Do nothing: it ends by its own time-out."""


class Command:
    """Gives a message to a command on its standard input, as an e-mail without recipients (RFC 5322).

    The message is kept in memory, not in a file: a full disk is told of too.

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
            with _memory_file() as given, _memory_file() as said:
                given.write(_email(message))
                given.seek(0)
                with self._turn:
                    if self._is_cancelled:
                        raise DeliveryError("rigcal is being stopped")
                    self._process = subprocess.Popen(
                        self._arguments, stdin=given, stdout=said, stderr=subprocess.STDOUT, start_new_session=True
                    )
                status = self._wait(self._process)
                said.seek(0)
                output = said.read().decode(errors="replace").strip()
        except OSError as error:
            raise DeliveryError(f"{program}: {_reason(error)}") from None
        if status != 0:
            last = shown(output.rpartition("\n")[2], _QUOTED)
            raise DeliveryError(f"{program} ended with status {status}" + (f": {last}" if last else ""))

    def _wait(self, process: subprocess.Popen[bytes]) -> int:
        try:
            return process.wait(COMMAND_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._kill()
            process.wait()
            raise DeliveryError(f"{self._arguments[0]} did not end within {COMMAND_TIMEOUT_S:g} s") from None

    def cancel(self) -> None:
        with self._turn:
            self._is_cancelled = True
            self._kill()

    def _kill(self) -> None:
        process = self._process
        if process is not None and process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def _email(message: Message) -> bytes:
    email = EmailMessage()
    email["Subject"] = message.subject
    email["Auto-Submitted"] = "auto-generated"  # RFC 3834: no holiday notice answers it
    email.set_content(message.text, cte="8bit")
    return bytes(email)


def _memory_file() -> IO[bytes]:
    return os.fdopen(os.memfd_create("rigcal-notice"), "w+b")


def _reason(error: object) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return shown(text or type(error).__name__, _QUOTED) + network_hint(error)
