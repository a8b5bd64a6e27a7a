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
from collections import OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from neuralq.apps.web.catalogue import catalogue
from neuralq.apps.web.pool import Busy, Left, Pool, TooLong
from neuralq.apps.web.requests import ANSWERS, read_request
from neuralq.apps.web.shell import read_body, read_json, refusal, site

__all__ = ["application"]

NUM_WORKERS = 3
_STATIC = Path(__file__).parent / "static"
_MOST_REMEMBERED = 256


def application(host: str, plotly_script: Path) -> Starlette:
    """The application, to be served on ``host``.

    Example:
        >>> application("localhost", Path("plotly.min.js")).debug
        False
    """

    async def script(request: Request) -> Response:
        return FileResponse(plotly_script, media_type="text/javascript")

    async def chosen(request: Request) -> Response:
        return JSONResponse(await run_in_threadpool(catalogue))

    answers = (Route(f"/api/{kind}", _answer, methods=["POST"]) for kind in ANSWERS)
    routes = [Route("/plotly.min.js", script), Route("/api/lab", chosen), *answers]
    return site(_STATIC, "index.html", routes, host, _lifespan)


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
        spec = read_request(kind, read_json(await read_body(request)))
    except ValueError as error:
        raise refusal(error) from None
    known: OrderedDict[str, Response] = request.app.state.remembered
    key = f"{kind} {spec}"
    if key not in known:
        try:
            status, found = await request.app.state.pool.ask(kind, spec, request.is_disconnected)
        except (Busy, TooLong, Left) as error:
            raise refusal(error) from None
        except (ValueError, OSError) as error:  # the worker died in between: killed for its memory, for example
            raise HTTPException(500, "the computation ended early; ask again") from error
        if status >= 500:
            raise HTTPException(status, found["error"])
        known[key] = JSONResponse(found, status)
        while len(known) > _MOST_REMEMBERED:
            known.popitem(last=False)
    return Response(known[key].body, known[key].status_code, media_type="application/json")
