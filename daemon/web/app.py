"""The routes of the page: its files, the live state, commands, and data from the store."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sqlite3
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from daemon.commands import REFUSED, CommandError
from daemon.store.errors import StoreError
from daemon.store.files import FileIdentity
from daemon.store.queries.history import drift_history, misclosure_history, model_changes
from daemon.store.reader import Reader
from daemon.web.access import NAME_CHARACTERS, AttemptLimit, Person, Role, TokenFile, role_refusal
from daemon.web.commands import COMMANDS, TIMEOUT_S, TIMEOUTS_S
from daemon.web.daemon_client import DaemonClient
from daemon.web.guard import REPORT_POLICY, Guard
from daemon.web.live import Full, LiveFeed
from daemon.web.residuals import SessionFixes
from daemon.web.settings import WebSettings
from daemon.web.shape import shape

log = logging.getLogger(__name__)

STATIC = Path(__file__).parent / "static"
SCREENS = ("now", "guide", "session", "models", "health", "history")
_COOKIE_S = 90 * 86_400
_TOKEN_CHARACTERS = 200

Handler = Callable[[Request], Awaitable[Response]]


class Refused(Exception):  # noqa: N818 - becomes an answer
    """A refused request; it is answered with a status and a sentence."""

    def __init__(self, status: int, sentence: str, **headers: str) -> None:
        super().__init__(sentence)
        self.status, self.headers = status, headers


def make_app(settings: WebSettings) -> Guard:
    """Return the ASGI application of a page."""
    return Guard(Page(settings).app, settings)


class Page:
    """The routes of the page.

    Args:
        settings: settings of the server.

    Attributes:
        app: ASGI application for requests that the guard has accepted.
    """

    def __init__(self, settings: WebSettings) -> None:
        self._settings = settings
        self._tokens, self._wrong = TokenFile(settings.tokens), AttemptLimit()
        self._daemon, self._feed = DaemonClient(settings.socket), LiveFeed(settings.socket)
        self._fixes = SessionFixes()
        self._shape: dict[str, Any] | None = None
        # With TLS the name begins with "__Host-": browsers accept such a cookie only from this host and over TLS.
        self._cookie = "__Host-rigcal" if settings.is_secure else "rigcal"
        routes = [
            *(Route(f"/{name}", self._shell) for name in ("", *SCREENS)),
            Route("/api/me", self._me),
            Route("/api/login", self._login, methods=["POST"]),
            Route("/api/logout", self._logout, methods=["POST"]),
            Route("/api/live", self._for(Role.READ, self._live)),
            Route("/api/command", self._command, methods=["POST"]),
            Route("/api/rig", self._for(Role.READ, self._rig)),
            Route("/api/history", self._for(Role.READ, self._history)),
            Route("/api/sessions/{id}/fixes", self._for(Role.READ, self._session_fixes)),
            Route("/report/{job}", self._for(Role.READ, self._report)),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        errors = {
            Refused: _refused,
            HTTPException: _http_error,
            CommandError: _command_error,
            StoreError: _store_error,
            sqlite3.Error: _store_error,
        }
        self.app = Starlette(routes=routes, exception_handlers=errors)  # type: ignore[arg-type]

    # ---- people ------------------------------------------------------------------------------------------------------

    async def _person(self, request: Request) -> Person | None:
        """Return the person of a request: by the token in the cookie, else by the rights on the loopback interface."""
        token = request.cookies.get(self._cookie)
        if token:
            person = await self._of_token(request, token)
            if person is not None:
                return person
        role = self._settings.role_without_token()
        return None if role is None else Person("", role)

    async def _of_token(self, request: Request, token: str) -> Person | None:
        """Return the owner of a token; None for a wrong one, which is refused after too many from one address."""
        person = self._tokens.find(token) if len(token) <= _TOKEN_CHARACTERS else None
        if person is not None or self._wrong.is_known(token):
            return person
        address = request.client.host if request.client else ""
        if wait_s := self._wrong.wait_s(address):
            raise Refused(
                429, f"too many wrong tokens; try again in {wait_s:.0f} s", **{"Retry-After": f"{wait_s:.0f}"}
            )
        self._wrong.note(address, token)
        log.warning("a wrong token from %s", address)
        return None

    async def _needs(self, request: Request, role: Role) -> Person:
        person = await self._person(request)
        if person is None:
            raise Refused(401, "sign in with a token; `rigcal web token add NAME --role ROLE` makes one")
        if person.role < role:
            raise Refused(403, role_refusal(person, role))
        return person

    def _for(self, role: Role, handler: Handler) -> Handler:
        async def guarded(request: Request) -> Response:
            await self._needs(request, role)
            return await handler(request)

        return guarded

    async def _me(self, request: Request) -> Response:
        person = await self._person(request)
        local = self._settings.user if self._settings.is_loopback else ""
        if person is None:
            return JSONResponse({"name": "", "role": None, "by_token": False, "local_user": local})
        by_token = bool(person.name)
        return JSONResponse({"name": person.name, "role": person.role.word, "by_token": by_token, "local_user": local})

    async def _login(self, request: Request) -> Response:
        token = (await _object(request)).get("token")
        person = await self._of_token(request, token.strip()) if isinstance(token, str) else None
        if person is None or not isinstance(token, str):
            raise Refused(401, "this token is not known here; was it removed?")
        answer = JSONResponse({"name": person.name, "role": person.role.word})
        about: dict[str, Any] = {
            "httponly": True,
            "samesite": "strict",
            "path": "/",
            "secure": self._settings.is_secure,
        }
        answer.set_cookie(self._cookie, token.strip(), max_age=_COOKIE_S, **about)
        return answer

    async def _logout(self, request: Request) -> Response:
        del request
        answer = JSONResponse({})
        answer.delete_cookie(self._cookie, path="/", secure=self._settings.is_secure, httponly=True, samesite="strict")
        return answer

    # ---- the page and its state --------------------------------------------------------------------------------------

    async def _shell(self, request: Request) -> Response:
        del request
        return FileResponse(STATIC / "index.html", media_type="text/html")

    async def _live(self, request: Request) -> Response:
        """Stream the state while the browser is connected and has access."""
        events = self._feed.events()
        try:
            first = await anext(events)
        except Full:
            raise Refused(
                503, "too many browsers are connected; close one or try again later", **{"Retry-After": "10"}
            ) from None

        async def all_events() -> Any:
            try:
                yield first
                async for event in events:
                    if await self._person(request) is None:
                        return  # the token was removed
                    yield event
            finally:
                await events.aclose()  # type: ignore[attr-defined]

        return StreamingResponse(all_events(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def _command(self, request: Request) -> Response:
        body = await _object(request)
        command, arguments = body.get("command"), body.get("arguments", {})
        if not isinstance(command, str) or command not in COMMANDS or not isinstance(arguments, dict):
            raise Refused(400, f"{command!r:.80} is not a command of the page")
        person = await self._needs(request, COMMANDS[command])
        if COMMANDS[command] > Role.READ:
            arguments = arguments | {"operator": self._operator(person, body.get("operator"))}
        result = await self._daemon.ask(command, arguments, timeout_s=TIMEOUTS_S.get(command, TIMEOUT_S))
        return JSONResponse({"result": result})

    def _operator(self, person: Person, said: object) -> str:
        """Return name and role of the person who gives a command; without a token, the name that the person entered."""
        name = person.name or (said if isinstance(said, str) else "") or self._settings.user
        if len(name) > NAME_CHARACTERS or not name.isprintable():
            raise Refused(400, f"a name has at most {NAME_CHARACTERS} printable characters")
        return f"{name} (page, {person.role.word})".strip()

    # ---- data from store and files -----------------------------------------------------------------------------------

    async def _rig(self, request: Request) -> Response:
        del request
        found = await self._daemon.ask("rig.show")
        if self._shape is None or self._shape["text"] != found["text"]:
            self._shape = {"text": found["text"], "shape": await asyncio.to_thread(shape, found["text"])}
        return JSONResponse(self._shape["shape"])

    async def _history(self, request: Request) -> Response:
        del request
        status = await self._daemon.ask("status")

        def read() -> dict[str, Any]:
            with Reader(Path(status["store"]), _file_of(status)) as reader:
                return {
                    "drift": drift_history(reader, status["rig"]),
                    "misclosures": misclosure_history(reader),
                    "changes": model_changes(reader, status["rig"]),
                }

        alarms = await self._daemon.ask("alarms.list", {"all": True})
        return JSONResponse(await asyncio.to_thread(read) | {"alarms": alarms["cleared"], "gap": status["gap"]})

    async def _session_fixes(self, request: Request) -> Response:
        status = await self._daemon.ask("status")
        live = (status["models"] or {}).get("live")
        model = None if live is None else await self._daemon.ask("model.show", {"id": live["id"]})
        session_id = request.path_params["id"]
        store = Path(status["store"]), _file_of(status)
        found = await asyncio.to_thread(self._fixes.read, *store, session_id, model)
        if found is None:
            raise Refused(404, f"there is no session {session_id!r:.80}")
        return JSONResponse(found)

    async def _report(self, request: Request) -> Response:
        """Send the report of a job, which is a separate page and runs in a sandbox."""
        jobs = await self._daemon.ask("jobs.list")
        wanted = request.path_params["job"]
        path = next(((job["result"] or {}).get("report") for job in jobs if str(job["id"]) == wanted), None)
        if path is None or not Path(path).is_file():
            raise Refused(404, f"job {wanted:.20} has no report")
        return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})


def _file_of(status: Mapping[str, Any]) -> FileIdentity | None:
    """Return the identity of the store that the daemon has open: a different file may have taken its name."""
    file = status.get("store_file")  # absent from a daemon that still runs after an upgrade
    return None if file is None else FileIdentity(*file)


async def _object(request: Request) -> dict[str, Any]:
    """Return the JSON object in a request."""
    with contextlib.suppress(ValueError, RecursionError):
        body = await request.json()
        if isinstance(body, dict):
            return body
    raise Refused(400, "a command is a JSON object")


async def _refused(_request: Request, error: Refused) -> Response:
    return JSONResponse({"error": str(error)}, error.status, error.headers)


async def _http_error(_request: Request, error: HTTPException) -> Response:
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)


async def _command_error(_request: Request, error: CommandError) -> Response:
    status = {2: 400, REFUSED: 409}.get(error.status, 502)
    return JSONResponse({"error": str(error), "status": error.status}, status)


async def _store_error(_request: Request, error: Exception) -> Response:
    log.warning("the store cannot be read: %s", error)
    return JSONResponse({"error": f"the store cannot be read: {error}"}, 502)
