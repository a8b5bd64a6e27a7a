"""Exercise 13.3: tic-tac-toe learned against one opponent, and what that is worth against another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.apps.pages.grids import short
from neuralq.exact import Solution, evaluate, solve
from neuralq.mdp import FiniteMDP
from neuralq.runs.report.claims import ChapterPage, GridDrawing, Row, Square, claim, number, own, spread
from neuralq.tabular import Band, EpsilonGreedy, Learned, RunOptions, compile_model, over_seeds, q_learning
from neuralq_envs import tictactoe

__all__ = ["exercise_13_3"]

_NUM_STEPS = 600_000
# Exhaustive enumeration, the best against an opponent that moves at random: X wins .99479 and never loses, O wins
# .93228 and loses .00741 (another of its best answers wins and loses .00317 less).
_AGAINST_RANDOM = {"X": 0.99479, "O": 0.92487}


def exercise_13_3(num_seeds: int = 5) -> ChapterPage:
    """Exercise 13.3: Q-learning finds the best answer to the opponent it met, and is not safe against a better one.

    Args:
        num_seeds: independent runs.

    Source: Mitchell 1997, exercise 13.3.

    Example:
        >>> exercise_13_3(num_seeds=1).rows[0].verdict
        'agrees'
    """
    rows: list[Row] = [
        number("positions that play can reach", 5478, len(tictactoe.positions())),
        number("outcome when both play perfectly", 0, float(tictactoe.minimax_values()[0]), note="a draw"),
        *_random_opponent(),
    ]
    forced, optimal = tictactoe.mdp("forced"), tictactoe.mdp("optimal")
    best, safe = solve(forced, tictactoe.GAMMA), solve(optimal, tictactoe.GAMMA)
    met = _learned(forced, num_seeds)
    rows += _trained_on_forced(forced, optimal, best, met)
    rows += _trained_on_optimal(forced, optimal, safe, _learned(optimal, num_seeds))
    text = (
        "The opponent is part of the world: it wins if it can, blocks if it must, and otherwise moves at random. So "
        "the game is an MDP, the best answer to this opponent can be computed, and what was learned is judged exactly, "
        "not by sampling games. A win is worth 1, a loss −1, a draw 0; the learner plays X and begins.",
        "Q-learning finds the best answer to the opponent it trains with. That answer feeds on mistakes which a "
        "perfect player does not make: against one, a draw is the best there is.",
        "Who trains against the perfect player learns to draw, but never sees what comes after a mistake. In those "
        "positions its table is as it was at the start, and so it does badly against the weaker opponent: what is "
        "learned is good where training went.",
    )
    drawings = (
        _opening("best answer to the opponent that blocks: value of each first move", best.q[0]),
        _opening("the same, learned (one run)", met.q[0, 0]),
    )
    return ChapterPage("ex-13.3", "Tic-tac-toe", "13.3", text, tuple(rows), drawings)


def _random_opponent() -> list[Row]:
    rows = []
    for player, printed in _AGAINST_RANDOM.items():
        answer = solve(tictactoe.mdp("random", player), tictactoe.GAMMA)
        result = _expected(tictactoe.mdp("random", player), answer.policy)
        rows.append(number(f"random opponent, playing {player}: wins less losses, at best", printed, result, tol=5e-6))
    winner = tictactoe.mdp("random", "O", 1.0, 0.0, 0.0)
    wins = _expected(winner, solve(winner, tictactoe.GAMMA).policy)
    rows.append(own("random opponent, playing O: wins of who does not mind losing", wins))
    return rows


def _learned(mdp: FiniteMDP, num_seeds: int) -> Band:
    model = compile_model(mdp)

    def learn(seed: np.random.SeedSequence) -> Learned:
        # Half of all moves explore at first; values start at a win, so that every first move is tried.
        policy = EpsilonGreedy(0.5, final=0.05, num_steps=_NUM_STEPS)
        options = RunOptions(initial_q=1.0)
        return q_learning(model, _NUM_STEPS, tictactoe.GAMMA, policy=policy, seed=seed, options=options)

    return over_seeds(learn, num_seeds)


def _expected(mdp: FiniteMDP, policy: NDArray[np.int64]) -> float:
    """What a policy earns per game, exactly."""
    return float(evaluate(mdp, policy, tictactoe.GAMMA) @ mdp.start_distribution)


def _trained_on_forced(forced: FiniteMDP, optimal: FiniteMDP, best: Solution, met: Band) -> list[Row]:
    top = float(best.v @ forced.start_distribution)
    reached = [_expected(forced, run.policy) for run in met.runs]
    abroad = [_expected(optimal, run.policy) for run in met.runs]
    games = float(np.mean([run.num_episodes for run in met.runs]))
    close = float(np.median(reached)) >= 0.97 * top
    worst = max(abroad)
    return [
        own("best possible against the opponent that blocks", top, "mean result per game"),
        claim(
            f"learned in {games:,.0f} games against it",
            "nearly as much",
            spread(reached),
            close,
            "greedy, evaluated exactly",
        ),
        claim("the same policy against a perfect opponent", "at most a draw", spread(abroad), worst <= 1e-9),
    ]


def _trained_on_optimal(forced: FiniteMDP, optimal: FiniteMDP, safe: Solution, met: Band) -> list[Row]:
    home = [_expected(optimal, run.policy) for run in met.runs]
    away = [_expected(forced, run.policy) for run in met.runs]
    best = float(safe.v @ optimal.start_distribution)
    return [
        number("best possible against a perfect opponent", 0.0, best, note="a draw"),
        claim("learned against it", "0: never loses", spread(home), float(np.median(home)) >= -1e-9),
        own("the same policy against the opponent that blocks", spread(away)),
    ]


def _opening(title: str, q: NDArray[np.float64]) -> GridDrawing:
    return GridDrawing(title, 3, tuple(Square(short(float(value))) for value in q))
