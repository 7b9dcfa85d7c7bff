"""The local web server of ``ddco-pyro label``: a :class:`Session` over HTTP, and the page that shows it.

It listens on this machine alone. The first part of every path is a random token; a foreign ``Host`` or ``Origin`` is
refused.
"""

from __future__ import annotations

import json
import secrets
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import uvicorn
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ddco_pyro.errors import BadInput, Failed, reason

if TYPE_CHECKING:
    from ddco_pyro.labelling.session import Session

LOOPBACK = "127.0.0.1"

MOST_BYTES = 64 * 2**10
"""Bytes of a request's body."""

PATIENCE = 2
"""Seconds that requests under way have when the server stops."""

PAGE, CANVAS = files("ddco_pyro") / "labelling" / "static", files("ddco_pyro") / "drawing" / "canvas.js"
"""The folder of the page, and a script that it shares with reports."""

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
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
        found = socket.socket()
        try:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            found.bind((LOOPBACK, port))
            found.listen()
        except (OSError, OverflowError) as error:
            found.close()
            raise Failed(f"port {port}: {reason(OSError(*error.args))}; choose another one with --port") from error
        return cls(found)

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self.socket.getsockname()[1])

    @property
    def address(self) -> str:
        """Where the page is; the token is part of it."""
        return f"http://{LOOPBACK}:{self.port}/{self.token}/"


@contextmanager
def running(session: Session, listening: Listening) -> Iterator[Thread]:
    """Serve a session in a thread while the context lasts."""
    settings = uvicorn.Config(
        application(session, listening.token, listening.port),
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


def serve(session: Session, listening: Listening, ready: Callable[[], None] = lambda: None) -> str:
    """Serve a session until an interrupt; then save it and close it.

    :param ready: called when the page can be asked for.
    :returns: a line that says what was saved.
    """
    try:
        with suppress(KeyboardInterrupt), running(session, listening) as thread:
            ready()
            thread.join()
        return session.save() if session.state()["dirty"] else "nothing new to save"
    finally:
        session.close()


def application(session: Session, token: str, port: int) -> Starlette:
    """The web application of a session, for requests to ``127.0.0.1:port/token/``."""

    async def canvas(request: Request) -> Response:
        return FileResponse(str(CANVAS))

    page = Mount("/", StaticFiles(directory=str(PAGE), html=True))
    routes = [*_answers(session), Route("/canvas.js", canvas), page]
    guards = [
        Middleware(Guard, token=token, port=port),
        Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
    ]
    return Starlette(
        routes=routes, middleware=guards, exception_handlers={HTTPException: _refused, ValueError: _refused}
    )


class Guard:
    """Refuses requests of others, and gives every answer the headers that keep a browser from harm."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self.app, self.token = app, token
        self.origins = [None, *(f"http://{host}:{port}" for host in (LOOPBACK, "localhost"))]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""

        async def headed(message: Message) -> None:
            if message["type"] == "http.response.start":
                extra = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        if scope["type"] != "http":
            return
        first, slash, _ = scope["path"].removeprefix("/").partition("/")
        if Headers(scope=scope).get("origin") not in self.origins:
            app: ASGIApp = _error(403, "this address is not the page's")
        elif not slash or not secrets.compare_digest(first.encode(), self.token.encode()):
            app = _error(404, "there is nothing here")
        else:
            app, scope = self.app, {**scope, "root_path": f"/{first}"}
        await app(scope, receive, headed)


def _answers(session: Session) -> list[Route]:
    """The routes of the session's methods, each of which runs in a thread."""

    def view(request: Request) -> dict[str, Any]:
        with session.lock:  # both are of one revision
            demo = session.demo(request.path_params["index"])
            return {"state": session.state(), "demo": demo}

    def nearest(request: Request) -> list[dict[str, Any]]:
        return session.nearest(request.path_params["index"], request.path_params["step"])

    def picture(request: Request) -> Response:
        content = session.picture(request.path_params["index"], request.path_params["step"])
        return Response(content, media_type="image/jpeg")

    def exported(request: Request) -> Response:
        folder = Path(tempfile.mkdtemp(prefix="ddco-pyro-"))

        def remove() -> None:
            shutil.rmtree(folder)

        try:
            path = session.export(request.path_params["format"], folder)
            if path.is_dir():
                path = Path(shutil.make_archive(str(path), "zip", path))
            return FileResponse(path, filename=path.name, background=BackgroundTask(remove))
        except BaseException:
            remove()
            raise

    def route(path: str, call: Callable[..., Any], method: str) -> Route:
        async def answer(request: Request) -> Response:
            arguments = [request] if method == "GET" else [await _asked(request)]
            try:
                found = await run_in_threadpool(call, *arguments)
            except BadInput as error:
                raise HTTPException(400, reason(error)) from error
            except Exception as error:
                raise HTTPException(500, reason(error)) from error
            return found if isinstance(found, Response) else JSONResponse(found)

        return Route(f"/{path}", answer, methods=[method])

    gets = {
        "poll": lambda asked: session.progress(),
        "state": lambda asked: session.state(),
        "view/{index:int}": view,
        "demo/{index:int}/nearest/{step:int}": nearest,
        "demo/{index:int}/picture/{step:int}": picture,
        "export/{format}": exported,
    }
    posts = {
        "edit": session.edit,
        "refit": lambda asked: session.refit(),
        "cancel": lambda asked: session.cancel(),
        "save": lambda asked: {"message": session.save()},
    }
    return [
        *(route(path, call, "GET") for path, call in gets.items()),
        *(route(path, call, "POST") for path, call in posts.items()),
    ]


async def _asked(request: Request) -> dict[str, Any]:
    """The object in a request's body."""
    if request.headers.get("content-type") != "application/json":
        raise HTTPException(415, "the body has to be application/json")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise HTTPException(413, f"the body is longer than {MOST_BYTES} bytes")
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise HTTPException(400, "the body is no JSON") from error
    if not isinstance(found, dict):
        raise HTTPException(400, "the body has to be a JSON object")
    return found


def _error(status: int, message: str, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"error": message}, status, headers)


async def _refused(request: Request, error: Exception) -> Response:
    """What is said of an error; starlette refuses numbers of thousands of digits by a ValueError."""
    if isinstance(error, HTTPException):
        return _error(error.status_code, error.detail, error.headers)
    return _error(400, reason(error))
