"""A turn of backgammon step by step: what is offered, what is refused and why, and how turns are written.

Legal steps are compared with a brute force of its own, on a board of plain lists: the longest way to play the dice.

Mutants that die: a step offered after which only one of two dice can be played; the smaller die offered where only one
can; several steps as one move where one order hits; a hit not counted; of two dice that bear off the larger taken, with
the smaller one left over.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from backgammon_slowly import row

pytest.importorskip("starlette", reason="the extra web is not installed")
from neuralq.apps.web.play_turns import BAR, OFF, CheckerStep, PartialTurn, WaysToPlay, notation
from neuralq_envs.backgammon import Position

Side = tuple[int, ...]  # checkers on the points 1 to 24 at 1 to 24 and on the bar at 25; at 0 those that are off


def one_step(own: Side, other: Side, source: int, die: int) -> tuple[Side, Side] | None:
    """The board after one checker has moved, or None if the rules forbid it."""
    if own[source] == 0 or (own[BAR] and source != BAR):
        return None
    target = source - die
    if target <= 0:
        furthest = max(point for point in range(1, 26) if own[point])
        if furthest > 6 or (target < 0 and furthest > source):
            return None
        target = OFF
    if target and other[25 - target] > 1:
        return None
    mine, theirs = list(own), list(other)
    mine[source] -= 1
    mine[target] += 1
    if target and theirs[25 - target] == 1:
        theirs[25 - target] = 0
        theirs[BAR] += 1
    return tuple(mine), tuple(theirs)


def singles(own: Side, other: Side, left: tuple[int, ...]) -> dict[tuple[int, int], tuple[Side, Side, tuple[int, ...]]]:
    """Every step by itself, by source and die, with the board after it and the dice that are left then."""
    found = {}
    for die in set(left):
        rest = list(left)
        rest.remove(die)
        for source in range(1, 26):
            after = one_step(own, other, source, die)
            if after is not None:
                found[source, die] = (*after, tuple(rest))
    return found


@cache
def longest(own: Side, other: Side, left: tuple[int, ...]) -> int:
    """How many dice can be played."""
    return max((1 + longest(*after) for after in singles(own, other, left).values()), default=0)


def strictly_allowed(own: Side, other: Side, left: tuple[int, ...]) -> set[tuple[int, int]]:
    """The steps with which a turn may go on: those that use as many dice as can be used, the larger if only one can."""
    found, most = singles(own, other, left), longest(own, other, left)
    keep = {step for step, after in found.items() if 1 + longest(*after) == most}
    if most == 1 and len(set(left)) == 2:
        keep = {step for step in keep if step[1] == max(left)} or keep
    return keep


def ends(own: Side, other: Side, left: tuple[int, ...]) -> set[tuple[Side, Side]]:
    found = singles(own, other, left)
    further = [ends(*found[step]) for step in strictly_allowed(own, other, left)]
    return set().union(*further) if further else {(own, other)}


def allowed(own: Side, other: Side, left: tuple[int, ...]) -> set[tuple[int, int]]:
    """As above; and who bears off the last checker at once need not take the longer way to the same board."""
    steps = strictly_allowed(own, other, left)
    for step, after in singles(own, other, left).items():
        if not any(after[0][1:]) and after[:2] in ends(own, other, left):
            steps.add(step)
    return steps


def sides(board: bytes) -> tuple[Side, Side]:
    own, other = board[:25], board[25:]
    return (15 - sum(own), *own), (15 - sum(other), *other)


def positions(num: int, rng: np.random.Generator) -> Iterator[tuple[Position, tuple[int, int]]]:
    """Of games played at random, and checkers strewn at random, over the whole board or at home."""
    position = Position.initial()
    for i in range(num):
        dice = tuple(rng.integers(1, 7, 2).tolist())
        if i % 3 == 0:
            yield strewn(rng), dice
            continue
        yield position, dice
        ways = position.afterstates(dice)
        position = ways[rng.integers(len(ways))]
        if position.winner is not None:
            position = Position.initial()


def strewn(rng: np.random.Generator) -> Position:
    high = int(rng.choice([6, 12, 25]))
    own: dict[int, int] = {}
    for point in rng.integers(1, high + 1, rng.integers(1, 16)).tolist():
        own[point] = own.get(point, 0) + 1
    other: dict[int, int] = {}
    for point in rng.integers(1, 26, 15).tolist():
        if own.get(25 - point, 0) == 0 or point == 25:
            other[point] = other.get(point, 0) + 1
    return Position(row(own), row(other or {25: 1}))


def check_walk(position: Position, dice: tuple[int, int], rng: np.random.Generator) -> None:
    """Offered steps and moves are the allowed ones, at every place of a walk to the end of the turn and back."""
    ways = WaysToPlay(position, dice)
    assert ways.ends == {after.other + after.own for after in position.afterstates(dice)} == set(ways.paths())
    turn = PartialTurn(ways)
    boards = []
    while True:
        own, other = sides(turn.board)
        offered = {(step.source, step.die): step for step in ways.steps(turn._places[-1])}
        assert set(offered) == allowed(own, other, turn.dice_left), (position, dice, turn.steps)
        for (source, die), step in offered.items():
            assert step.target == max(source - die, 0)
            assert step.hit == (step.target > 0 and other[25 - step.target] == 1)
        moves = turn.moves()
        assert {(source, step.target) for (source, _), step in offered.items()} <= {
            (source, target) for source, targets in moves.items() for target in targets
        }
        check_moves(turn)
        if not moves:
            break
        boards.append(turn.board)
        source = list(moves)[rng.integers(len(moves))]
        targets = list(moves[source])
        turn.move(source, targets[rng.integers(len(targets))])
    assert turn.is_complete and turn.board in ways.ends
    while boards:
        turn.undo()
        assert turn.board == boards.pop()


def check_moves(turn: PartialTurn) -> None:
    """Each move is a chain of allowed steps of one checker, and every order of the dice leaves the same board."""
    for source, targets in turn.moves().items():
        for target, steps in targets.items():
            assert steps[0].source == source and steps[-1].target == target
            ends = set()
            for order in {tuple(step.die for step in steps), tuple(step.die for step in steps[::-1])}:
                board, left, point = sides(turn.board), turn.dice_left, source
                for die in order:
                    if (point, die) not in allowed(*board, left):
                        break
                    *after, left = singles(*board, left)[point, die]
                    board, point = (after[0], after[1]), max(point - die, 0)
                else:
                    ends.add(board)
            assert len(ends) == 1, (turn.board, steps)


@pytest.mark.parametrize(("num", "seed"), [(400, 20), pytest.param(2000, 21, marks=pytest.mark.slow)])
def test_offered_steps_are_those_that_brute_force_allows(num: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for position, dice in positions(num, rng):
        check_walk(position, dice, rng)
    longest.cache_clear()


def test_only_the_larger_die_and_only_what_uses_both() -> None:
    # By hand: 24/18 with the 6 and 24/19 with the 5 are both possible, but from neither does it go on; 6 is larger.
    ways = WaysToPlay(Position(row({24: 1}), row({12: 2})), (5, 6))  # their 12 is our 13, which is 24 − 6 − 5
    assert [notation([step]) for step in ways.steps(ways.start)] == ["24/18"]
    with pytest.raises(ValueError, match=r"24/19 is not legal: a turn must use both dice.*larger"):
        PartialTurn(ways).move(24, 19)
    # After 10/9 no 3 can be played, for 6 and 2 are theirs; 10/7 5/4 uses both dice.
    ways = WaysToPlay(Position(row({10: 1, 5: 1}), row({19: 2, 23: 2})), (3, 1))
    assert [notation([step]) for step in ways.steps(ways.start)] == ["10/7", "5/4"]
    with pytest.raises(ValueError, match="10/9 is not legal: a turn must use both dice"):
        PartialTurn(ways).move(10, 9)


def test_one_move_of_two_steps_where_one_order_hits_is_left_to_two_moves() -> None:
    # 8/5*/4 with the 3 first hits on 5; 8/7/4 does not.
    turn = PartialTurn(WaysToPlay(Position(row({8: 1}), row({20: 1, 6: 2})), (3, 1)))
    assert sorted(turn.moves()[8]) == [5, 7]
    with pytest.raises(ValueError, match=r"8/4 is not legal: .*one die at a time"):
        turn.move(8, 4)
    assert notation((*turn.move(8, 5), *turn.move(5, 4))) == "8/5*/4"


def test_turns_as_players_write_them() -> None:
    assert (
        notation([CheckerStep(25, 20, 5, True), CheckerStep(13, 8, 5, False), CheckerStep(13, 8, 5, False)])
        == "bar/20* 13/8(2)"
    )
    assert (
        notation([CheckerStep(13, 8, 5, False), CheckerStep(24, 19, 5, False), CheckerStep(8, 3, 5, True)])
        == "24/19 13/3*"
    )
    assert notation([CheckerStep(4, 0, 6, False), CheckerStep(4, 0, 6, False)]) == "4/off(2)"


@pytest.mark.parametrize(
    ("own", "other", "dice", "move", "says"),
    [
        ({24: 2, 6: 5}, {6: 5}, (3, 1), (23, 20), "no checker of yours is on point 23"),
        ({25: 1, 6: 5}, {6: 1}, (3, 1), (6, 3), "a checker on the bar must enter first"),
        ({6: 5}, {6: 1}, (3, 1), (6, 6), "checkers move towards point 1"),
        ({6: 5}, {22: 2}, (3, 1), (6, 3), "the other side holds point 3"),
        ({7: 1, 1: 1}, {6: 1}, (6, 5), (1, 0), "only when all are at home"),
        ({6: 1, 2: 1}, {6: 1}, (3, 1), (2, 0), "bears off only the checker furthest back"),
        ({6: 5}, {6: 1}, (3, 1), (6, 4), "no way leads there with the dice that are left"),
    ],
)
def test_what_is_not_legal_is_refused_with_the_reason(
    own: dict[int, int], other: dict[int, int], dice: tuple[int, int], move: tuple[int, int], says: str
) -> None:
    turn = PartialTurn(WaysToPlay(Position(row(own), row(other)), dice))
    with pytest.raises(ValueError, match=says):
        turn.move(*move)
