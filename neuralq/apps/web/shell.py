"""What every page of this package stands behind: the host check, the headers, and the reading of what was sent.

A page of another site may know this machine's address, so a request must name this machine itself in its Host header,
and if it says which page it comes from, that must be ours. A question must be JSON by its own account, which a foreign
page may not send without being asked first. JSON knows no NaN and no infinity, though Python's reader does, and reads
1e999 as infinite; both are refused, and so is text that no UTF-8 can hold, for it could not be said back.
"""

from __future__ import annotations

import ipaddress
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Lifespan, Message, Receive, Scope, Send

from neuralq.apps.web.addresses import own_names

__all__ = ["HEADERS", "MAX_BODY_BYTES", "Guard", "Malformed", "read_body", "read_json", "refusal", "site"]

MAX_BODY_BYTES = 10_000
"""Larger bodies are refused; the largest sensible one has a few hundred bytes."""

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


class Malformed(ValueError):
    """The body is no JSON object."""

    status = 400


def read_json(body: bytes) -> Mapping[str, Any]:
    """The object that the body holds.

    Raises:
        Malformed: no UTF-8, half a surrogate pair, no JSON, NaN or infinity, too deeply nested, a name given twice, or
            not an object.

    Example:
        >>> read_json(b'{"gamma": NaN}')
        Traceback (most recent call last):
        neuralq.apps.web.shell.Malformed: the body must be a JSON object: NaN is not a number of JSON
    """

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is not a number of JSON")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a name is given twice")
        return found

    try:
        given = json.loads(body.decode("utf-8"), parse_constant=refuse, object_pairs_hook=once)
        json.dumps(given, ensure_ascii=False).encode("utf-8")
    except (ValueError, RecursionError) as error:  # a number of thousands of digits is a ValueError too
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        if isinstance(error, UnicodeEncodeError):
            reason = f"half a surrogate pair ({error.object[error.start]!r}) is no character"
        raise Malformed(f"the body must be a JSON object: {reason}") from None
    if not isinstance(given, dict):
        raise Malformed(f"the body must be a JSON object, got {type(given).__name__}")
    return given


async def read_body(request: Request) -> bytes:
    """The body, of which no more is read than is allowed.

    Raises:
        HTTPException: 415 for another content type than JSON, 413 for more than `MAX_BODY_BYTES`, 400 if it ends early.
    """
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


def refusal(error: Exception) -> HTTPException:
    """The answer to what was refused, with the status that the error brings along, or 422."""
    return HTTPException(getattr(error, "status", 422), str(error))


async def _http_error(request: Request, error: Exception) -> Response:
    """``{"error": ...}`` with the status that was raised."""
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code, headers=error.headers)


async def _failure(request: Request, error: Exception) -> Response:
    """Status 500; what went wrong is for the terminal."""
    return JSONResponse({"error": "the server failed; its terminal says why"}, 500, headers=HEADERS)


def site(
    static: Path, page: str, routes: Sequence[Route], host: str, lifespan: Lifespan[Starlette] | None = None
) -> Starlette:
    """An application with a page at ``/``, what it loads under ``/static``, and routes of its own, behind the guard.

    Args:
        static: folder of what the page loads.
        page: the page's file in it.
        routes: its own.
        host: address that it will be served on.
        lifespan: what goes on while it is served.
    """

    async def shown(request: Request) -> Response:
        return FileResponse(static / page)

    names, any_address = own_names(host)
    return Starlette(
        routes=[Route("/", shown), *routes, Mount("/static", StaticFiles(directory=static))],
        middleware=[Middleware(Guard, names=names, any_address=any_address)],
        exception_handlers={HTTPException: _http_error, Exception: _failure},
        lifespan=lifespan,
    )


class Guard:
    """Answers only to its own names and its own pages, and adds the headers.

    Args:
        app: what it stands before.
        names: hosts that it answers to, in lower case.
        any_address: whether it answers to every address given as a number as well.
    """

    def __init__(self, app: ASGIApp, names: frozenset[str], any_address: bool) -> None:
        self._app = app
        self._names = names
        self._any_address = any_address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Hands a request on, or refuses it."""
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
        origins = [value.decode("latin-1").lower() for name, value in scope["headers"] if name == b"origin"]
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            refusal = PlainTextResponse("This server does not answer to that host name.\n", 400)
            await refusal(scope, receive, with_headers)
        elif not {f"{scheme}://{hosts[0].lower()}" for scheme in ("http", "https")}.issuperset(origins):
            refusal = PlainTextResponse("This server does not answer to pages of other sites.\n", 403)
            await refusal(scope, receive, with_headers)
        else:
            await self._app(scope, receive, with_headers)

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
