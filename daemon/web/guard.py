"""Checks of every request before anything processes it, and headers of every answer.

A request must name this computer by one of its own names; otherwise it may come from a page whose name was pointed at
this computer (DNS rebinding). A request that may change something must come from the page itself, by its Origin, and
contain JSON, which no form of a foreign page can send. The body must be small.
"""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from daemon.web.settings import WebSettings

BODY_BYTES = 64 << 10
_SAFE_METHODS = frozenset({"GET", "HEAD"})
CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; manifest-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Reports are whole pages with a style sheet and pictures inside; in a sandbox they have no scripts and no origin.
REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; frame-ancestors 'none'"
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": CONTENT_POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=(), usb=(), serial=()",
    "Cache-Control": "no-cache",
}


class Guard:
    """Refuses requests that no page of this computer would send, and adds security headers to answers.

    Args:
        app: application that receives the accepted requests.
        settings: settings of the server, with the names of this computer.
    """

    def __init__(self, app: ASGIApp, settings: WebSettings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(scope["method"], scope["path"], Headers(scope=scope))
        if refusal is not None:
            status, sentence = refusal
            await JSONResponse({"error": sentence}, status)(scope, receive, send_guarded)
            return
        await self._app(scope, _bounded(receive), send_guarded)

    def _refusal(self, method: str, path: str, headers: Headers) -> tuple[int, str] | None:
        """Return status and sentence for a refused request; None for an accepted one."""
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not self._settings.is_own_host(_name(hosts[0])):
            return 421, "this is not a name of this computer; if it should be, add it to [web] names"
        if path.startswith("/api/") and headers.get("sec-fetch-site") in ("cross-site", "same-site"):
            return 403, "a foreign page sent this request; only the page itself may"
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > BODY_BYTES:
            return 413, _TOO_LARGE
        return None if method in _SAFE_METHODS else self._foreign(hosts[0], headers)

    def _foreign(self, host: str, headers: Headers) -> tuple[int, str] | None:
        """Return status and sentence for a changing request that the page itself did not send; else None."""
        scheme = "https" if self._settings.is_secure else "http"
        if headers.get("origin") != f"{scheme}://{host}":
            return 403, "a request that changes something must come from the page itself; reload the page"
        if headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return 415, "a command must be JSON"
        return None


_TOO_LARGE = f"a request has at most {BODY_BYTES} bytes"


def _bounded(receive: Receive) -> Receive:
    """Return a source of the same messages that refuses a too long body, for requests without a stated length."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > BODY_BYTES:
            raise HTTPException(413, _TOO_LARGE)
        return message

    return bounded


def _name(host: str) -> str:
    """Return the name in a Host header without its port; "" if the header is invalid."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
