"""What checkers must be exactly: the number of ways to play, and scores that a memory does not falsify."""

from __future__ import annotations

import numpy as np

from neuralq.runs.report.claims import Row, claim, number
from neuralq.systems.checkers.memory import new_memory, remember
from neuralq.systems.checkers.search import new_desk, search
from neuralq.systems.checkers.terms import evaluate
from neuralq.systems.checkers.training import carry_out, new_program
from neuralq.tabular.kernels.random_numbers import new_stream
from neuralq.tabular.look_ahead import alpha_beta
from neuralq_envs.checkers import Position
from neuralq_envs.checkers.rules import START, jumpers, perft

__all__ = ["PERFT", "difference_from_alpha_beta", "difference_of_remembered", "oracle", "positions_of_games"]

PERFT = (7, 49, 302, 1469, 7361, 36768, 179740, 845931, 3963680)
"""Ways to play 1 to 9 moves, as every program that knows the rules counts them (Bik; Cake)."""


def oracle() -> tuple[Row, ...]:
    """All of it, as rows."""
    ways = tuple(int(perft(*START, i + 1)) for i in range(len(PERFT)))
    late = carry_out(0, (0.01,), num_tests=100)
    return (
        claim("ways to play 1 to 9 moves", " ".join(map(str, PERFT)), " ".join(map(str, ways)), ways == PERFT),
        number(
            "largest difference of a score from an alpha-beta search in Python", 0.0, difference_from_alpha_beta(),
            tol=1e-12, note="positions of random games, three plies and captures",
        ),
        number(
            "largest difference of a remembered score from the searched one", 0.0, difference_of_remembered(),
            tol=1e-12, note="three plies, then two that are remembered, against five",
        ),
        number(
            "wins that take longer than announced", 0.0, float((late.endgames[0.01].plies > late.announced).sum()),
            tol=0.0, note=f"{len(late.announced)} wins of three kings against one",
        ),
    )  # fmt: skip


def positions_of_games(num_positions: int, num_plies: int, seed: int = 0) -> list[Position]:
    """Positions after so many moves at random in which the game goes on.

    Example:
        >>> [position.turn for position in positions_of_games(2, 7)]
        [1, 1]
    """
    rng, found = np.random.default_rng(seed), list[Position]()
    while len(found) < num_positions:
        position = Position.initial()
        for _ in range(num_plies):
            moves = position.moves()
            position = moves[rng.integers(len(moves))].position if moves else position
        if position.winner is None:
            found.append(position)
    return found


def difference_from_alpha_beta(num_positions: int = 6, num_plies: int = 30, depth: int = 3) -> float:
    """How far the compiled search is from `neuralq.tabular.alpha_beta` over positions and their moves.

    Example:
        >>> difference_from_alpha_beta(num_positions=1, depth=2) < 1e-12
        True
    """
    program = new_program(np.random.default_rng(1).normal(size=14) / 4)
    weights, desk, stream, worst = program.weights, new_desk(), new_stream(0), 0.0

    def following(position: Position) -> list[Position]:
        return [move.position for move in position.moves()]

    def value(position: Position) -> float:
        if position.winner is not None:
            return -100.0
        return float(evaluate(position.own, position.other, position.kings, weights, desk.terms))

    def is_quiet(position: Position) -> bool:
        return not jumpers(position.own, position.other, position.kings)

    for one in positions_of_games(num_positions, num_plies):
        # Without a penalty, for alpha_beta does not tell evaluate how far away a position is.
        ours = search(one.own, one.other, one.kings, depth, weights, 0.0, program.memory, desk, stream)
        worst = max(worst, abs(ours - alpha_beta(one, depth, following, value, is_quiet).score))
    return worst


def difference_of_remembered(num_positions: int = 5, depth: int = 3, remembered_depth: int = 2) -> float:
    """How far a search that ends in remembered scores is from one that looks as far by itself.

    Example:
        >>> difference_of_remembered(num_positions=1, depth=1)
        0.0
    """
    program = new_program(np.random.default_rng(2).normal(size=14) / 4)
    weights, none, desk, stream, worst = program.weights, new_memory(0), new_desk(), new_stream(0), 0.0
    for start in positions_of_games(num_positions, 6):  # no king is near, so no position comes again
        memory, leaves = new_memory(1 << 15), [start]
        for _ in range(depth):
            leaves = [move.position for position in leaves for move in position.moves()]
        for leaf in leaves:
            board = leaf.own, leaf.other, leaf.kings
            score = search(*board, remembered_depth, weights, 0.01, none, desk, stream)
            remember(memory, *board, remembered_depth, score)
        board = start.own, start.other, start.kings
        with_memory = search(*board, depth, weights, 0.01, memory, desk, stream)
        alone = search(*board, depth + remembered_depth, weights, 0.01, none, desk, stream)
        worst = max(worst, abs(with_memory - alone))
    return worst
