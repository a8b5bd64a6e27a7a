"""Games in a browser against what this project has computed: backgammon against a trained agent, tic-tac-toe.

    GET  /            the page               GET  /static/...       its style and its scripts
    POST /api/start   a seat of one's own    POST /api/ACTION       what one does there; a JSON object each

A page asks for a seat and gets a token for it; with every action it sends the token and the revision of the state that
it shows. The state is kept here and only shown there: the rules are looked up here for every action, and an answer is
the whole state. What cannot be understood gets 400, a seat that is not there 404, an action on a state that has changed
meanwhile 409, and one that the rules forbid 422, each with ``{"error": "..."}``.
"""

from __future__ import annotations

import functools
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from neuralq.apps.web.play_requests import check_fields, point_of, seed_of
from neuralq.apps.web.shell import read_body, read_json, refusal, site

__all__ = ["MOST_SEATS", "Action", "Game", "Gone", "Offer", "Outdated", "Seats", "play_application"]

MOST_SEATS = 200
"""Of more seats the one that was left alone longest is given up."""

_STATIC = Path(__file__).parent / "static" / "play"


class Game(Protocol):
    """What sits at a seat."""

    def new(self, given: Mapping[str, Any]) -> None:
        """A new game."""

    def state(self) -> dict[str, Any]:
        """Everything that the page shows."""


@dataclass(frozen=True, slots=True)
class Action:
    """Something that can be done at a seat.

    Args:
        run: does it to the game; what it returns, if anything, is the answer instead of the state.
        fields: what it takes besides the seat and the revision.
        changes: whether it changes the state, and so needs the revision.
    """

    run: Callable[[Any, Mapping[str, Any]], dict[str, Any] | None]
    fields: tuple[str, ...] = ()
    changes: bool = True


@dataclass(frozen=True, slots=True)
class Offer:
    """A game that can be played.

    Args:
        page: the page's file.
        make: a game, whose draws are the generator's.
        new: what `Game.new` takes.
        actions: what else can be done, by name.
    """

    page: str
    make: Callable[[np.random.Generator], Game]
    new: tuple[str, ...]
    actions: Mapping[str, Action]


class Gone(LookupError):
    """There is no such seat."""

    status = 404


class Outdated(RuntimeError):
    """The state has changed since it was shown."""

    status = 409


@dataclass(slots=True)
class _Seat:
    """A game, how often its state has changed, and the lock of who acts there."""

    game: Game
    revision: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def do(self, action: Action, given: Mapping[str, Any]) -> dict[str, Any]:
        """What the action answers, or the state after it."""
        answer = action.run(self.game, given)
        self.revision += action.changes
        return {"revision": self.revision, **self.game.state()} if answer is None else answer


class Seats:
    """The games that are being played, each for who knows its token; safe to use from several threads.

    Args:
        offer: what is played.
        most: how many are kept.

    Attributes:
        actions: everything that can be done at a seat, by name.

    Example:
        >>> from neuralq.apps.web.play_tictactoe import tictactoe
        >>> seats = Seats(tictactoe())
        >>> state = seats.start({"seed": 0})
        >>> len(state["seat"]), state["revision"], state["player"]
        (22, 1, 'X')
    """

    def __init__(self, offer: Offer, most: int = MOST_SEATS) -> None:
        self._offer = offer
        new = Action(lambda game, given: game.new(given), offer.new)
        self.actions = {"new": new, "state": Action(lambda game, given: None, changes=False), **offer.actions}
        self._most = most
        self._taken: OrderedDict[str, _Seat] = OrderedDict()
        self._lock = threading.Lock()

    def start(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """A new seat with a new game; ``seed`` decides its dice, and what `Game.new` takes is handed on.

        Raises:
            ValueError: a field that is not there, or means nothing.
        """
        check_fields(given, ("seed", *self._offer.new))
        seat = _Seat(self._offer.make(np.random.default_rng(seed_of(given))))
        state = seat.do(self.actions["new"], given)
        token = secrets.token_urlsafe(16)
        with self._lock:
            self._taken[token] = seat
            while len(self._taken) > self._most:
                self._taken.popitem(last=False)
        return {"seat": token, **state}

    def act(self, name: str, given: Mapping[str, Any]) -> dict[str, Any]:
        """Does something at the seat that ``given`` names.

        Raises:
            ValueError: a field that is not there or means nothing, or an action that the rules forbid.
            Gone: there is no such seat.
            Outdated: the game has gone on since.
        """
        action = self.actions[name]
        token = given.get("seat")
        with self._lock:
            if not isinstance(token, str) or token not in self._taken:
                raise Gone("there is no such game here, the server may have been started anew; start a new game")
            self._taken.move_to_end(token)
            seat = self._taken[token]
        check_fields(given, ("seat", "revision", *action.fields))
        with seat.lock:
            if action.changes and point_of(given, "revision", 0, 2**53) != seat.revision:
                raise Outdated("the game has gone on meanwhile, perhaps in another tab; this is how it stands")
            return {"seat": token, **seat.do(action, given)}


def play_application(offer: Offer, host: str) -> Starlette:
    """The page of a game and its API, to be served on ``host``.

    Example:
        >>> from neuralq.apps.web.play_tictactoe import tictactoe
        >>> play_application(tictactoe(), "localhost").debug
        False
    """
    seats = Seats(offer)

    async def start(request: Request) -> Response:
        return await _answered(request, seats.start)

    async def act(request: Request) -> Response:
        return await _answered(request, functools.partial(seats.act, request.url.path.rpartition("/")[2]))

    routes = [Route(f"/api/{name}", act, methods=["POST"]) for name in seats.actions]
    return site(_STATIC, offer.page, [Route("/api/start", start, methods=["POST"]), *routes], host)


async def _answered(request: Request, what: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Response:
    """The answer, computed in a thread, or the status that says why there is none."""
    try:
        given = read_json(await read_body(request))
        return JSONResponse(await run_in_threadpool(what, given))
    except (ValueError, Gone, Outdated) as error:
        raise refusal(error) from None
