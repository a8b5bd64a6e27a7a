"""A turn of backgammon, one step at a time: which steps may come next, and how a turn is written.

A step moves one checker by one die. Not every step that is legal by itself may begin a turn, for a turn must play both
dice if that is possible, and the larger one if only one can be played. So a step is offered only if some way to go on
from it ends in one of the boards in which the turn can end: those that `neuralq_envs.backgammon.rules.afterstates`
lists. All ways to play a roll form a graph of places (a board and the dice that are left); it is built once per roll
and then only walked.

Points are written as players do: 24 to 1 for the side to move, 25 for its bar and 0 for off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.position import check_dice
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, afterstates, is_legal, play

__all__ = ["BAR", "OFF", "CheckerStep", "PartialTurn", "WaysToPlay", "notation", "point_name"]

OFF = 0
BAR = 25

_Place = tuple[bytes, tuple[int, ...]]  # a board, own row first, and the dice that are left, the larger first


@dataclass(frozen=True, slots=True)
class CheckerStep:
    """One checker moved by one die.

    Args:
        source: 1 to 24, or 25 for the bar.
        target: 1 to 24, or 0 for off.
        die: 1 to 6; when bearing off it may be larger than the way.
        hit: whether it sent a checker of the other side to the bar.
    """

    source: int
    target: int
    die: int
    hit: bool


class WaysToPlay:
    """Every way to play a roll, step by step.

    Args:
        position: of the side that has rolled.
        dice: two numbers of 1 to 6.

    Raises:
        ValueError: dice that are not two numbers of 1 to 6.

    Example:
        >>> ways = WaysToPlay(Position.initial(), (6, 5))
        >>> sorted({step.source for step in ways.steps(ways.start)})  # the 24 point cannot move by 5
        [8, 13, 24]
    """

    def __init__(self, position: Position, dice: Sequence[int]) -> None:
        die_1, die_2 = check_dice(dice)
        self.dice = (die_1, die_2)
        left = (die_1,) * 4 if die_1 == die_2 else (max(self.dice), min(self.dice))
        self.start: _Place = (position.own + position.other, left)
        self.ends = _ends(position, self.dice)
        self._next = self._grown()

    def steps(self, place: _Place) -> dict[CheckerStep, _Place]:
        """The steps that may come next, each with where it leads; none if the turn ends here.

        Example:
            >>> ways = WaysToPlay(Position.initial(), (6, 5))
            >>> [notation([step]) for step in ways.steps(ways.start)]
            ['24/18', '13/7', '8/2', '13/8', '8/3']
        """
        return self._next[place]

    def paths(self) -> dict[bytes, tuple[CheckerStep, ...]]:
        """For each board in which the turn can end, own row first, one way to get there.

        Example:
            >>> ways = WaysToPlay(Position.initial(), (1, 1))
            >>> len(ways.paths()) == len(Position.initial().afterstates((1, 1)))
            True
        """
        found: dict[bytes, tuple[CheckerStep, ...]] = {}
        reached: dict[_Place, tuple[CheckerStep, ...]] = {self.start: ()}
        frontier = [self.start]
        for place in frontier:  # grows while it is read
            following = self.steps(place)
            if not following:
                found.setdefault(place[0], reached[place])
            for step, after in following.items():
                if after not in reached:
                    reached[after] = (*reached[place], step)
                    frontier.append(after)
        return found

    def _grown(self) -> dict[_Place, dict[CheckerStep, _Place]]:
        """The steps from every place that single steps lead to, those alone by which the turn can end as it must."""
        found: dict[_Place, dict[CheckerStep, _Place]] = {}
        frontier = [self.start]
        for place in frontier:  # grows while it is read
            if place in found:
                continue
            found[place] = _single_steps(place)
            frontier += found[place].values()
        can_end = set()
        for place in reversed(found):  # those with fewer dice left come first
            stuck = not found[place]
            found[place] = {step: after for step, after in found[place].items() if after in can_end}
            if found[place] or (stuck and place[0] in self.ends):
                can_end.add(place)
        return found


class PartialTurn:
    """A turn that is being played: it takes moves, refuses those that are not legal, and takes them back.

    A move is what one asks for with a checker and a point to put it on: one step, or several with the same checker.

    Args:
        ways: every way to play the roll.

    Example:
        >>> turn = PartialTurn(WaysToPlay(Position.initial(), (3, 1)))
        >>> {source: sorted(targets) for source, targets in turn.moves().items()}[8]
        [4, 5, 7]
        >>> [notation([step]) for step in turn.move(8, 5)], turn.dice_left, turn.is_complete
        (['8/5'], (1,), False)
    """

    def __init__(self, ways: WaysToPlay) -> None:
        self.ways = ways
        self._places = [ways.start]
        self._moves: list[tuple[CheckerStep, ...]] = []

    @property
    def steps(self) -> tuple[CheckerStep, ...]:
        """What has been played so far."""
        return tuple(step for move in self._moves for step in move)

    @property
    def num_moves(self) -> int:
        """How many moves can be taken back."""
        return len(self._moves)

    @property
    def board(self) -> bytes:
        """The board as it is now: the side to move, then the other side, 25 numbers each."""
        return self._places[-1][0]

    @property
    def dice_left(self) -> tuple[int, ...]:
        """The dice that have not been used."""
        return self._places[-1][1]

    @property
    def is_complete(self) -> bool:
        """Whether nothing more can be played."""
        return not self.ways.steps(self._places[-1])

    def moves(self) -> dict[int, dict[int, tuple[CheckerStep, ...]]]:
        """The steps of every legal move, by source and target.

        Several steps of one checker are one move where the order of the dice makes no difference; where it does (one
        order may hit) they are left to be made one by one. Of two dice that bear a checker off, the smaller is used.
        """
        sources = {step.source for step in self.ways.steps(self._places[-1])}
        return {source: self._targets(source) for source in sorted(sources, reverse=True)}

    def move(self, source: int, target: int) -> tuple[CheckerStep, ...]:
        """Moves a checker, and returns its steps.

        Raises:
            ValueError: the move is not legal; the message says why.

        Example:
            >>> PartialTurn(WaysToPlay(Position.initial(), (5, 5))).move(24, 19)
            Traceback (most recent call last):
            ValueError: 24/19 is not legal: the other side holds point 19
        """
        steps = self.moves().get(source, {}).get(target)
        if steps is None:
            raise ValueError(f"{point_name(source)}/{point_name(target)} is not legal: {self._reason(source, target)}")
        self._moves.append(steps)
        place = self._places[-1]
        for step in steps:
            place = self.ways.steps(place)[step]
        self._places.append(place)
        return steps

    def undo(self) -> tuple[CheckerStep, ...]:
        """Takes the last move back, and returns its steps.

        Raises:
            ValueError: nothing has been moved.

        Example:
            >>> PartialTurn(WaysToPlay(Position.initial(), (3, 1))).undo()
            Traceback (most recent call last):
            ValueError: there is nothing to take back, no checker has been moved in this turn
        """
        if not self._moves:
            raise ValueError("there is nothing to take back, no checker has been moved in this turn")
        self._places.pop()
        return self._moves.pop()

    def _targets(self, source: int) -> dict[int, tuple[CheckerStep, ...]]:
        """Where the checker can go, the fewest steps first."""
        found: dict[int, tuple[CheckerStep, ...]] = {}
        frontier: list[tuple[int, _Place, tuple[CheckerStep, ...]]] = [(source, self._places[-1], ())]
        while frontier:
            reached: dict[int, list[tuple[_Place, tuple[CheckerStep, ...]]]] = {}
            for point, place, path in frontier:
                for step, after in self.ways.steps(place).items():
                    if step.source == point:
                        reached.setdefault(step.target, []).append((after, (*path, step)))
            frontier = [(target, *way) for target, ways in reached.items() for way in ways if target != OFF]
            for target, ways in reached.items():
                if target not in found and len({after[0] for after, _ in ways}) == 1:
                    found[target] = min((path for _, path in ways), key=lambda path: path[-1].die)
        return found

    def _reason(self, source: int, target: int) -> str:
        own, other = self.board[:25], self.board[25:]
        dice = ", ".join(map(str, self.dice_left))
        if not self.dice_left:
            return "all dice have been used"
        if not own[source - 1]:
            return f"no checker of yours is on {'the bar' if source == BAR else f'point {source}'}"
        if own[BAR - 1] and source != BAR:
            return "a checker on the bar must enter first"
        if target >= source:
            return "checkers move towards point 1"
        if target != OFF and other[24 - target] > 1:
            return f"the other side holds point {target}"
        if target == OFF and any(own[6:]):
            return "checkers are borne off only when all are at home"
        if target == OFF and source < max(self.dice_left) and any(own[source:]):
            return f"a die larger than the point, of {dice}, bears off only the checker furthest back"
        if any(step.source == source and step.target == target for step in _single_steps(self._places[-1])):
            return "a turn must use both dice if it can, and the larger if only one can be used"
        return f"no way leads there with the dice that are left ({dice}); if orders differ, move one die at a time"


def notation(steps: Sequence[CheckerStep]) -> str:
    """The steps as players write them: ``24/18*/13 6/5(2)``; a star is a hit, and a number counts equal moves.

    Example:
        >>> twice, hit = CheckerStep(6, 5, 1, False), CheckerStep(13, 7, 6, True)
        >>> notation([twice, twice, hit, CheckerStep(7, 6, 1, False)])
        '13/7*/6 6/5(2)'
        >>> notation([])
        'no move'
    """
    chains: list[list[CheckerStep]] = []
    for step in steps:
        longer = next((chain for chain in chains if chain[-1].target == step.source), None)
        if longer is None:
            chains.append([step])
        else:
            longer.append(step)
    chains.sort(key=lambda chain: (-chain[0].source, -chain[-1].target))
    texts = []
    for text, same in groupby(map(_chain_text, chains)):
        times = len(list(same))
        texts.append(text if times == 1 else f"{text}({times})")
    return " ".join(texts) or "no move"


def point_name(point: int) -> str:
    """``bar``, ``off``, or the number.

    Example:
        >>> [point_name(point) for point in (25, 8, 0)]
        ['bar', '8', 'off']
    """
    return {BAR: "bar", OFF: "off"}.get(point, str(point))


def _chain_text(chain: Sequence[CheckerStep]) -> str:
    """What one checker did; points that it only passed are left out."""
    parts = [point_name(chain[0].source)]
    for i, step in enumerate(chain):
        if step.hit or i == len(chain) - 1:
            parts.append(point_name(step.target) + "*" * step.hit)
    return "/".join(parts)


def _ends(position: Position, dice: tuple[int, int]) -> frozenset[bytes]:
    """The boards in which the turn can end, own row first."""
    out = np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    count = afterstates(position.board, *dice, out)
    rows = np.ascontiguousarray(out[:count, ::-1]).tobytes()
    return frozenset(rows[i : i + 50] for i in range(0, 50 * count, 50))


def _single_steps(place: _Place) -> dict[CheckerStep, _Place]:
    """What the rules allow for one checker and one of the dice that are left."""
    rows, left = place
    board = np.frombuffer(rows, np.int8).reshape(2, 25).copy()
    found: dict[CheckerStep, _Place] = {}
    for die in dict.fromkeys(left):
        rest = list(left)
        rest.remove(die)
        for source in range(24, -1, -1):
            if rows[source] and is_legal(board, source, die):
                after = board.copy()
                hit = bool(play(after, source, die))
                step = CheckerStep(source + 1, max(source + 1 - die, OFF), die, hit)
                found[step] = (after.tobytes(), tuple(rest))
    return found
