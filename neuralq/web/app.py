"""The page and its API as a Starlette application.

    GET  /               the page             GET  /static/...       its style and its scripts
    GET  /plotly.min.js  plotly's own script  GET  /api/lab          what can be chosen
    POST /api/diagnose, /api/run, /api/critical, /api/prescribe      a JSON object each

A request that cannot be understood gets 400, one that is too large 413, one that is no JSON by its own account 415, one
that asks for something impossible 422, one too many 503, and one that takes too long 504, each with
``{"error": "..."}``. Nothing is stored and nothing is executed, so a request can at worst cost time, and that is
bounded by the ranges of the numbers, by a deadline, and by the number of worker processes.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections import OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from neuralq.web.catalogue import catalogue
from neuralq.web.pool import Busy, Left, Pool, TooLong
from neuralq.web.requests import ANSWERS, MAX_BODY_BYTES, Malformed, read_json, read_request

__all__ = ["HEADERS", "application"]

NUM_WORKERS = 3
_STATIC = Path(__file__).parent / "static"
_MOST_REMEMBERED = 256

HEADERS = {
    # The style attribute and element are plotly's, which writes its own; scripts come from here, and none is a string.
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-cache",
}
"""Sent with every answer."""


def application(names: frozenset[str], *, any_address: bool, plotly_script: Path) -> Starlette:
    """The application.

    Args:
        names: hosts that it answers to, in lower case.
        any_address: whether it answers to every address given as a number as well.
        plotly_script: plotly's script.

    Example:
        >>> application(frozenset({"localhost"}), any_address=False, plotly_script=Path("plotly.min.js")).debug
        False
    """

    async def page(request: Request) -> Response:
        return FileResponse(_STATIC / "index.html")

    async def script(request: Request) -> Response:
        return FileResponse(plotly_script, media_type="text/javascript")

    async def chosen(request: Request) -> Response:
        return JSONResponse(await run_in_threadpool(catalogue))

    return Starlette(
        routes=[
            Route("/", page),
            Route("/plotly.min.js", script),
            Route("/api/lab", chosen),
            *(Route(f"/api/{kind}", _answer, methods=["POST"]) for kind in ANSWERS),
            Mount("/static", StaticFiles(directory=_STATIC)),
        ],
        middleware=[Middleware(_Guard, names=names, any_address=any_address)],
        exception_handlers={HTTPException: _http_error, Exception: _failure},
        lifespan=_lifespan,
    )


@asynccontextmanager
async def _lifespan(app: Starlette) -> AsyncIterator[None]:
    app.state.pool = Pool(NUM_WORKERS)
    app.state.remembered = OrderedDict()
    building = asyncio.ensure_future(run_in_threadpool(catalogue))  # a second that the first visitor need not wait
    await app.state.pool.warm()
    try:
        yield
    finally:
        await building
        await app.state.pool.close()


async def _answer(request: Request) -> Response:
    """Check a request, and have a worker answer it unless the answer is known."""
    kind = request.url.path.rpartition("/")[2]
    try:
        spec = read_request(kind, read_json(await _body(request)))
    except Malformed as error:
        raise HTTPException(400, str(error)) from None
    except ValueError as error:
        raise HTTPException(422, str(error)) from None
    known: OrderedDict[str, Response] = request.app.state.remembered
    key = f"{kind} {spec}"
    if key not in known:
        status, found = await _asked(request, kind, spec)
        if status >= 500:
            raise HTTPException(status, found["error"])
        known[key] = JSONResponse(found, status)
        while len(known) > _MOST_REMEMBERED:
            known.popitem(last=False)
    return Response(known[key].body, known[key].status_code, media_type="application/json")


async def _asked(request: Request, kind: str, spec: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    pool: Pool = request.app.state.pool
    try:
        return await pool.ask(kind, spec, request.is_disconnected)
    except Busy:
        raise HTTPException(503, "too many computations are waiting; try again in a moment") from None
    except TooLong:
        raise HTTPException(
            504, f"this takes more than {pool.deadline_seconds:g} s; from Python it may take as long as it likes"
        ) from None
    except Left:
        raise HTTPException(499, "who asked went away") from None
    except (ValueError, OSError) as error:  # the worker died in between: killed for its memory, for example
        raise HTTPException(500, "the computation ended early; ask again") from error


async def _body(request: Request) -> bytes:
    """The body, of which no more is read than is allowed."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":  # a foreign page may send any other type without being asked about it first
        raise HTTPException(415, f"the content type must be application/json, got {kind[:60] or 'none'}")
    declared = request.headers.get("content-length", "0")
    too_large = HTTPException(413, f"the body must have at most {MAX_BODY_BYTES} bytes")
    if not declared.isdecimal() or int(declared[:20]) > MAX_BODY_BYTES:
        raise too_large
    body = b""
    try:
        async for chunk in request.stream():
            body += chunk
            if len(body) > MAX_BODY_BYTES:
                raise too_large
    except ClientDisconnect:
        raise HTTPException(400, "the body ended early") from None
    return body


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code, headers=error.headers)


async def _failure(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": "the server failed; its terminal says why"}, 500, headers=HEADERS)


class _Guard:
    """Answers only to its own names, and adds the headers."""

    def __init__(self, app: ASGIApp, names: frozenset[str], any_address: bool) -> None:
        self._app = app
        self._names = names
        self._any_address = any_address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # no web sockets here

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        if len(hosts) == 1 and self._is_own(hosts[0]):
            await self._app(scope, receive, with_headers)
        else:
            refusal = PlainTextResponse("This server does not answer to that host name.\n", 400)
            await refusal(scope, receive, with_headers)

    def _is_own(self, host: str) -> bool:
        name, colon, port = host.rpartition(":") if not host.endswith("]") else (host, "", "")
        if not colon:
            name = host
        elif not port.isdecimal():
            return False
        name = name.lower().removeprefix("[").removesuffix("]")
        if name in self._names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return self._any_address
