"""``neuralq evaluate`` for players of backgammon: matches, and errors by GNU Backgammon's values."""

from __future__ import annotations

import argparse
from pathlib import Path

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.systems.backgammon.agent import BackgammonAgent
from neuralq.systems.backgammon.error_rate import ErrorRate, error_rate
from neuralq.systems.backgammon.match import OPPONENTS, MatchResult, play_match
from neuralq.systems.backgammon.run import load_agent

__all__ = ["evaluate_backgammon"]


def evaluate_backgammon(argv: list[str]) -> int:
    """Play a match with a trained network, or measure its errors."""
    options = _parser().parse_args(argv)
    if options.error_rate and options.against is not None:
        raise Failure("--against is for a match and --error-rate is none; give one of the two", 2)
    if options.error_rate and (options.duplicate or options.games is not None or options.workers != 1):
        raise Failure("--games, --duplicate and --workers are for a match; leave them out with --error-rate", 2)
    agent = load_agent(options.run)
    if options.error_rate:
        _report_errors(options, error_rate(agent, options.decisions, options.seed, plies=options.plies))
    else:
        _report_match(options, agent)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "evaluate",
        "Play a match with a network that has learned backgammon: money play without a cube.",
        "neuralq evaluate RUN --against random",
        "neuralq evaluate RUN --against gnubg --games 20000 --workers 2 --duplicate",
        "neuralq evaluate RUN --against OTHER_RUN --plies 2 --games 1000",
        "neuralq evaluate RUN --error-rate",
    )
    parser.add_argument("run", help="run folder of `neuralq train td-gammon`, or a .safetensors file of weights")
    parser.add_argument(
        "--against",
        metavar="OPPONENT",
        help=f"{', '.join(OPPONENTS)} (the last two: extra gnubg), a run or a file of weights (default: random)",
    )
    parser.add_argument("--games", type=int, metavar="N", help="of the match (default: 5000)")
    parser.add_argument("--plies", type=int, choices=(1, 2), default=1, help="how far RUN looks ahead (default: 1)")
    parser.add_argument(
        "--duplicate", action="store_true", help="each pair of games with the same dice and the other side first"
    )
    parser.add_argument("--seed", type=int, default=0, help="of dice, or of the decisions (default: 0)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="games at a time (default: 1)")
    parser.add_argument(
        "--error-rate", action="store_true", help="points lost per decision by GNU Backgammon's values (extra gnubg)"
    )
    parser.add_argument("--decisions", type=int, default=1000, metavar="N", help="of the error rate (default: 1000)")
    return parser


def _report_match(options: argparse.Namespace, agent: BackgammonAgent) -> None:
    games = 5000 if options.games is None else options.games
    against = options.against or "random"
    opponent = against if against in OPPONENTS else _opponent(against)
    with ProgressBar(games, _tell) as bar:
        match = play_match(
            agent, opponent, games, options.seed,
            duplicate=options.duplicate, plies=options.plies, workers=options.workers,
            progress=lambda played, match: bar((played, match)),
        )  # fmt: skip
    sure = "" if match.standard_error != match.standard_error else f" ± {match.standard_error:.4f} (standard error)"
    lines = [
        f"{match.points_per_game:+.4f}{sure} points per game against {against}, {match.num_games} games"
        + (" with duplicate dice" if match.duplicate else ""),
        f"won {match.win_rate:.1%}, with a gammon {match.gammon_rate:.1%}, a backgammon {match.backgammon_rate:.1%}; "
        f"lost a gammon {match.lost_gammon_rate:.1%}, a backgammon {match.lost_backgammon_rate:.1%}; "
        f"{match.turns_per_game:.1f} turns per game",
    ]
    plain = {"run": str(options.run), "against": against, "plies": options.plies, "seed": options.seed}
    print_result({**plain, **match.plain()}, options.json, lines)


def _opponent(path: str) -> BackgammonAgent:
    if not Path(path).exists():
        raise Failure(f"--against must be {', '.join(OPPONENTS)}, a run or a file of weights, got {path!r}", 2)
    return load_agent(path)


def _report_errors(options: argparse.Namespace, found: ErrorRate) -> None:
    plain = {
        "run": str(options.run),
        "plies": options.plies,
        "seed": options.seed,
        "num_decisions": found.num_decisions,
        "mean_loss": found.mean,
        "standard_error": found.standard_error if found.num_decisions > 1 else None,
        "share_of_best": found.share_of_best,
    }
    sure = f" ± {found.standard_error:.4f} (standard error)" if found.num_decisions > 1 else ""
    lines = [
        f"{found.mean:.4f}{sure} points lost per decision by GNU Backgammon's values, {found.num_decisions} decisions",
        f"{found.share_of_best:.1%} lost nothing",
    ]
    print_result(plain, options.json, lines)


def _tell(report: tuple[int, MatchResult]) -> Told:
    played, match = report
    return Told(played, [f"{match.points_per_game:+.3f} points per game"], f"{played:,} games")
