"""The local web server of ``ddco-pyro label``: a :class:`Session` over HTTP, and the page that shows it.

It listens on this machine alone. Every path begins with a random token, and a foreign ``Host`` is refused.
"""

from __future__ import annotations

import secrets
import shutil
import socket
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.resources import files
from json import JSONDecodeError
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import uvicorn
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from ddco_pyro.errors import BadInput, Failed, reason

if TYPE_CHECKING:
    from ddco_pyro.labelling.session import Session

LOOPBACK = "127.0.0.1"

PATIENCE = 2
"""Seconds that requests under way have when the server stops."""

PAGE, CANVAS = files("ddco_pyro") / "labelling" / "static", files("ddco_pyro") / "drawing" / "canvas.js"
"""The folder of the page, and a script that it shares with reports."""

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' "
    "data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every answer."""


@dataclass(frozen=True)
class Listening:
    """A socket of this machine and the token of who may use it."""

    socket: socket.socket
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    @classmethod
    def at(cls, port: int = 0) -> Listening:
        """Listen on a port; 0 is any that is free.

        :raises Failed: the port is taken or not allowed.
        """
        try:
            return cls(socket.create_server((LOOPBACK, port)))
        except (OSError, OverflowError) as error:
            why = reason(OSError(*error.args))
            raise Failed(f"port {port}: {why}; choose another one with --port") from error

    @property
    def address(self) -> str:
        """Where the page is; the token is part of it."""
        return f"http://{LOOPBACK}:{self.socket.getsockname()[1]}/{self.token}/"


@contextmanager
def running(sessions: Sequence[Session], listening: Listening) -> Iterator[Thread]:
    """Serve sessions in a thread while the context lasts."""
    settings = uvicorn.Config(
        application(sessions, listening.token),
        log_config=None, log_level="critical", lifespan="off", ws="none", server_header=False,
        timeout_graceful_shutdown=PATIENCE,
    )  # fmt: skip
    server = uvicorn.Server(settings)
    thread = Thread(target=server.run, kwargs={"sockets": [listening.socket]}, name="server")
    thread.start()
    try:
        yield thread
    finally:
        server.should_exit = True
        thread.join()
        listening.socket.close()


def serve(sessions: Sequence[Session], listening: Listening, ready: Callable[[], None] = lambda: None) -> str:
    """Serve sessions until an interrupt; then save and close them.

    :param ready: called when the page can be asked for.
    :returns: a line that says what was saved.
    """
    try:
        with suppress(KeyboardInterrupt), running(sessions, listening) as thread:
            ready()
            thread.join()
        return sessions[0].save() if sessions[0].dirty else "nothing new to save"
    finally:
        for session in sessions:
            session.close()


def application(sessions: Sequence[Session], token: str) -> Starlette:
    """The web application of the sessions of a run's levels, for requests to ``/token/``."""

    async def canvas(request: Request) -> Response:
        return FileResponse(str(CANVAS))

    async def headed(request: Request, answer: Callable[[Request], Awaitable[Response]]) -> Response:
        found = await answer(request)
        found.headers.update(HEADERS)
        return found

    async def refused(request: Request, error: Exception) -> Response:
        if isinstance(error, HTTPException):
            return JSONResponse({"error": error.detail}, error.status_code)
        return JSONResponse({"error": reason(error)}, 500)

    levels = [Mount(f"/level/{number}", routes=_answers(session)) for number, session in enumerate(sessions)]
    page = Mount("/", StaticFiles(directory=str(PAGE), html=True))
    return Starlette(
        routes=[Mount(f"/{token}", routes=[*levels, Route("/canvas.js", canvas), page])],
        middleware=[
            Middleware(BaseHTTPMiddleware, dispatch=headed),
            Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
        ],
        exception_handlers={HTTPException: refused},
    )


def _answers(session: Session) -> list[Route]:
    """The routes of the session's methods, each of which runs in a thread."""

    def view(index: int) -> dict[str, Any]:
        with session.lock:  # both are of one revision
            demo = session.demo(index)
            return {"state": session.state(), "demo": demo}

    def picture(**of: int) -> Response:
        return Response(session.picture(**of), media_type="image/jpeg")

    def exported(form: str) -> Response:
        folder = Path(tempfile.mkdtemp(prefix="ddco-pyro-"))
        try:
            path = session.export(form, folder)
            if path.is_dir():
                path = Path(shutil.make_archive(str(path), "zip", path))
            return FileResponse(path, filename=path.name, background=BackgroundTask(shutil.rmtree, folder))
        except BaseException:
            shutil.rmtree(folder)
            raise

    def route(path: str, call: Callable[..., Any], method: str) -> Route:
        async def answer(request: Request) -> Response:
            try:
                body = [await request.json()] if method == "POST" else []
                found = await run_in_threadpool(call, *body, **request.path_params)
            except (BadInput, JSONDecodeError) as error:
                raise HTTPException(400, reason(error)) from error
            except Exception as error:
                raise HTTPException(500, reason(error)) from error
            return found if isinstance(found, Response) else JSONResponse(found)

        return Route(f"/{path}", answer, methods=[method])

    gets: dict[str, Callable[..., Any]] = {
        "poll": session.progress,
        "state": session.state,
        "view/{index:int}": view,
        "demo/{index:int}/nearest/{step:int}": session.nearest,
        "demo/{index:int}/picture/{camera:int}/{step:int}": picture,
        "export/{form}": exported,
    }
    posts: dict[str, Callable[..., Any]] = {
        "edit": session.edit,
        "refit": lambda asked: session.refit(),
        "cancel": lambda asked: session.cancel(),
        "save": lambda asked: {"message": session.save()},
    }
    return [
        *(route(path, call, "GET") for path, call in gets.items()),
        *(route(path, call, "POST") for path, call in posts.items()),
    ]
