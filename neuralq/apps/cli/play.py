"""``neuralq play``: a page to play on, against a trained agent or against the exact answer."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

from neuralq.apps.cli import command_parser

if TYPE_CHECKING:
    from neuralq.apps.web.play import Offer

__all__ = ["play"]


def play(argv: list[str]) -> int:
    """Serve the page of a game until interrupted."""
    parser = _parser()
    options = parser.parse_args(argv)
    if not 0 <= options.port <= 65535:
        parser.error(f"--port must lie in 0..65535 (0 takes a free one), got {options.port}")
    if options.game == "tictactoe" and (options.agent is not None or options.plies != 1):
        parser.error("--agent and --plies are for backgammon; tictactoe is played against the exact answer")
    from neuralq.apps.web.server import need, play_app, serve_app

    need("starlette", "uvicorn", what="the page to play on")
    if options.game == "backgammon":
        title, offer = "Backgammon", _backgammon(options.agent, options.plies)
    else:
        from neuralq.apps.web.play_tictactoe import tictactoe

        title, offer = "Tic-tac-toe", tictactoe()

    def announce(url: str) -> None:
        print(json.dumps({"game": options.game, "url": url}), flush=True)

    serve_app(
        lambda: play_app(offer, options.host), options.host, options.port, title,
        open_browser=not options.no_browser, announce=announce if options.json else None,
    )  # fmt: skip
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "play",
        "Play in the browser: backgammon against a trained agent, or tic-tac-toe against the exact answer.",
        "neuralq play backgammon",
        "neuralq play backgammon --agent runs/my-run --plies 2",
        "neuralq play tictactoe --port 8000 --no-browser",
    )
    parser.usage = "neuralq play GAME [options]"
    parser.add_argument("game", choices=("backgammon", "tictactoe"), metavar="GAME", help="backgammon or tictactoe")
    parser.add_argument(
        "--agent", metavar="RUN", help="a run of td-gammon, or its weights.safetensors (default: the agent shipped)"
    )
    parser.add_argument("--plies", type=int, default=1, choices=(1, 2), help="how deep it looks (default: 1)")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve on (default: this machine only)")
    parser.add_argument("--port", type=int, default=0, help="port to serve on (default: 0, a free one)")
    parser.add_argument("--no-browser", action="store_true", help="do not open the page in the browser")
    return parser


def _backgammon(path: str | None, plies: int) -> Offer:
    from neuralq.apps.web.play_backgammon import backgammon
    from neuralq.systems.backgammon import BackgammonAgent
    from neuralq.systems.backgammon.run import load_agent
    from neuralq_envs.backgammon import Position

    agent = BackgammonAgent(load_agent(path).network, plies)
    print("preparing (the first time on a machine this compiles, about half a minute)", file=sys.stderr, flush=True)
    agent.best_move(Position.initial(), (3, 1))
    return backgammon(agent)
