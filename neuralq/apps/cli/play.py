"""``neuralq play``: a page to play on, against a trained agent, a search, or the exact answer."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from neuralq.apps.cli import command_parser, print_result

if TYPE_CHECKING:
    from neuralq.apps.web.play import Offer

__all__ = ["play"]


def play(argv: list[str]) -> int:
    """Serve the page of a game until interrupted."""
    parser = _parser()
    options = parser.parse_args(argv)
    if not 0 <= options.port <= 65535:
        parser.error(f"--port must lie in 0..65535 (0 takes a free one), got {options.port}")
    _check(parser, options)
    from neuralq.apps.web.server import need, play_app, serve_app

    need("starlette", "uvicorn", what="the page to play on")
    title, make = _GAMES[options.game]
    offer = make(options)

    def announce(url: str) -> None:
        print_result({"game": options.game, "url": url}, True, [])

    serve_app(
        lambda: play_app(offer, options.host), options.host, options.port, title,
        open_browser=not options.no_browser, announce=announce if options.json else None,
    )  # fmt: skip
    return 0


def _check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """What goes with the game that was asked for, and how deep it looks if nothing is said."""
    if options.game != "backgammon" and options.agent is not None:
        parser.error("--agent is for backgammon; checkers is played by the weights shipped, tictactoe by exact values")
    if options.game == "tictactoe":
        if options.plies is not None:
            parser.error("--plies is for backgammon and checkers; tictactoe is played against the exact answer")
        return
    least, most, default = _PLIES[options.game]
    options.plies = default if options.plies is None else options.plies
    if not least <= options.plies <= most:
        parser.error(f"--plies must lie in {least}..{most} for {options.game}, got {options.plies}")


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "play",
        "Play in the browser: backgammon and checkers against what was learned, tic-tac-toe against the exact answer.",
        "neuralq play backgammon",
        "neuralq play backgammon --agent runs/my-run --plies 2",
        "neuralq play checkers --plies 9",
        "neuralq play tictactoe --port 8000 --no-browser",
    )
    parser.usage = "neuralq play GAME [options]"
    parser.add_argument("game", choices=tuple(_GAMES), metavar="GAME", help=", ".join(_GAMES))
    parser.add_argument(
        "--agent", metavar="RUN", help="a run of td-gammon, or its weights.safetensors (default: the agent shipped)"
    )
    parser.add_argument(
        "--plies", type=int, metavar="N", help="how deep it looks: backgammon 1 or 2 (default: 1), checkers 2 to 11 (7)"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to serve on (default: this machine only)")
    parser.add_argument("--port", type=int, default=0, help="port to serve on (default: 0, a free one)")
    parser.add_argument("--no-browser", action="store_true", help="do not open the page in the browser")
    return parser


def _backgammon(options: argparse.Namespace) -> Offer:
    from neuralq.apps.web.play_backgammon import backgammon
    from neuralq.systems.backgammon import BackgammonAgent
    from neuralq.systems.backgammon.run import load_agent
    from neuralq_envs.backgammon import Position

    agent = BackgammonAgent(load_agent(options.agent).network, options.plies)
    _say_prepared("about half a minute")
    agent.best_move(Position.initial(), (3, 1))
    return backgammon(agent)


def _checkers(options: argparse.Namespace) -> Offer:
    from neuralq.apps.web.play_checkers import checkers
    from neuralq.systems.checkers import CheckersPlayer
    from neuralq_envs.checkers import Position

    player = CheckersPlayer(depth=options.plies)
    _say_prepared("some seconds")
    player.score(Position.initial())
    return checkers(player)


def _tictactoe(options: argparse.Namespace) -> Offer:
    from neuralq.apps.web.play_tictactoe import tictactoe

    return tictactoe()


def _say_prepared(how_long: str) -> None:
    print(f"preparing (the first time on a machine this compiles, {how_long})", file=sys.stderr, flush=True)


_GAMES: dict[str, tuple[str, Callable[[argparse.Namespace], Offer]]] = {
    "backgammon": ("Backgammon", _backgammon),
    "checkers": ("Checkers", _checkers),
    "tictactoe": ("Tic-tac-toe", _tictactoe),
}
_PLIES = {"backgammon": (1, 2, 1), "checkers": (2, 11, 7)}
