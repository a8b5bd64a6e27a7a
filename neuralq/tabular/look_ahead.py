"""Alpha-beta search in any game of two sides that take turns and see everything (Knuth & Moore 1975)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

from neuralq.checks import check_whole

__all__ = ["Backup", "alpha_beta"]

P = TypeVar("P")


class Backup(NamedTuple, Generic[P]):
    """What a search brings back.

    Args:
        score: for the side that is to move.
        line: the positions that follow when both sides do their best, up to the one whose value the score is.
    """

    score: float
    line: tuple[P, ...]


def alpha_beta(
    position: P,
    depth: int,
    following: Callable[[P], Sequence[P]],
    evaluate: Callable[[P], float],
    is_quiet: Callable[[P], bool] = lambda position: True,
    alpha: float = -math.inf,
    beta: float = math.inf,
) -> Backup[P]:
    """The minimax score of a position, without the parts of the tree that cannot change it.

    Args:
        position: whatever the functions understand.
        depth: plies to look ahead, at least 0.
        following: the positions to which a move leads, the other side to move; none where the game is over.
        evaluate: of a position where the search or the game ends, for the side that is to move there.
        is_quiet: whether a search may end here; one that may not is looked into beyond ``depth``.
        alpha: a score of at most this may come out too high, but not above it.
        beta: a score of at least this may come out too low, but not below it.

    Raises:
        ValueError: a depth below 0.

    Example:
        Take one or two of five matches; who cannot has lost. Two leave three, which is lost for the other side.

        >>> following = lambda left: [left - taken for taken in (1, 2) if taken <= left]
        >>> alpha_beta(5, 5, following, lambda left: -1.0 if left == 0 else 0.0)
        Backup(score=1.0, line=(3, 2, 0))
    """
    check_whole("depth", depth, minimum=0)
    after = following(position)
    if not after or (depth == 0 and is_quiet(position)):
        return Backup(evaluate(position), ())
    best: Backup[P] = Backup(-math.inf, ())
    for one in after:
        found = alpha_beta(one, max(depth - 1, 0), following, evaluate, is_quiet, -beta, -max(alpha, best.score))
        if -found.score > best.score:
            best = Backup(-found.score, (one, *found.line))
        if best.score >= beta:
            break
    return best
