"""Matches: how many points per game one player wins from another, and how sure that is.

A game begins with a roll that is no double. Who moves first alternates; in a match with duplicate dice the second
game of each pair has the same rolls as the first with the other side moving first, so what luck gives to one player
it gives back to the other, and the standard error is that of pairs. A player that does not draw lots therefore gets
exactly nothing from itself.

Every game draws its rolls, and the choices of random players, from generators of their own that are seeded with the
match's seed and the number of the game (rolls: of the pair). So a result does not depend on how games are shared out
to workers, and the first games of a long match are those of a short one.

Games among networks and random players run wholly in a compiled loop; GNU Backgammon's players are asked turn by turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.jit import kernel
from neuralq.runs.children import safe_path
from neuralq.systems.backgammon.agent import BackgammonAgent
from neuralq.systems.backgammon.kernels import Scratch, choose
from neuralq.systems.backgammon.network import ValueNetwork
from neuralq.systems.backgammon.opponents import GnubgPlayer, require_gnubg
from neuralq.systems.backgammon.search import choose_two_ply
from neuralq.types import Array
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, Board, afterstates, copy_board, result, roll

__all__ = ["OPPONENTS", "MatchResult", "Player", "Side", "play_match", "rolls", "turn_taker"]

Player: TypeAlias = "str | BackgammonAgent | ValueNetwork"
"""A network with or without an agent around it, or one of `OPPONENTS`."""

OPPONENTS = ("random", "pubeval", "gnubg")

_BLOCK = 50  # games that a worker plays in one go


@dataclass(frozen=True, eq=False)
class MatchResult:
    """The games of a match, as the player (not the opponent) sees them.

    Args:
        points: won (positive) or lost in each game: ±1, ±2 for a gammon, ±3 for a backgammon, ``[n]``.
        turns: of each game, ``[n]``.
        duplicate: whether games 2k and 2k + 1 had the same rolls.

    Example:
        >>> result = MatchResult(np.array([2, -1, 1, 1]), np.array([50, 60, 61, 57]), duplicate=True)
        >>> result.points_per_game, result.standard_error, result.win_rate, result.gammon_rate
        (0.75, 0.25, 0.75, 0.25)
    """

    points: NDArray[np.int64]
    turns: NDArray[np.int64]
    duplicate: bool = False

    @property
    def num_games(self) -> int:
        """How many."""
        return len(self.points)

    @property
    def points_per_game(self) -> float:
        """Mean points."""
        return float(self.points.mean())

    @property
    def standard_error(self) -> float:
        """Of `points_per_game`: s / √n, over the means of pairs where dice are duplicate; NaN for fewer than two."""
        independent = self.points.reshape(-1, 2).mean(1) if self.duplicate else self.points
        if len(independent) < 2:
            return float("nan")
        return float(independent.std(ddof=1) / np.sqrt(len(independent)))

    @property
    def win_rate(self) -> float:
        """Share of games won."""
        return float((self.points > 0).mean())

    @property
    def gammon_rate(self) -> float:
        """Share of games won with a gammon or a backgammon."""
        return float((self.points > 1).mean())

    @property
    def backgammon_rate(self) -> float:
        """Share of games won with a backgammon."""
        return float((self.points > 2).mean())

    @property
    def lost_gammon_rate(self) -> float:
        """Share of games lost with a gammon or a backgammon."""
        return float((self.points < -1).mean())

    @property
    def lost_backgammon_rate(self) -> float:
        """Share of games lost with a backgammon."""
        return float((self.points < -2).mean())

    @property
    def turns_per_game(self) -> float:
        """Mean number of turns of both sides together."""
        return float(self.turns.mean())

    def plain(self) -> dict[str, float | int | bool | None]:
        """All figures by name, for JSON; no standard error is None."""
        names = (
            "num_games", "points_per_game", "standard_error", "win_rate", "gammon_rate", "backgammon_rate",
            "lost_gammon_rate", "lost_backgammon_rate", "turns_per_game", "duplicate",
        )  # fmt: skip
        figures = {name: getattr(self, name) for name in names}
        return {name: None if value != value else value for name, value in figures.items()}


def play_match(
    player: Player,
    opponent: Player,
    num_games: int,
    seed: int,
    *,
    duplicate: bool = False,
    plies: int = 1,
    workers: int = 1,
    progress: Callable[[int, MatchResult], None] | None = None,
) -> MatchResult:
    """Plays ``num_games`` games of money play without a cube; ``player`` moves first in every other, from the first on.

    Args:
        player: a network, an agent, "random", "pubeval" or "gnubg".
        opponent: the same choices.
        num_games: even with duplicate dice.
        seed: of the dice and of random players.
        duplicate: whether each pair of games has the same rolls, with the other side moving first.
        plies: how far ``player`` looks, if it is a network: 1, or 2 (`neuralq.systems.backgammon.search`); an agent's
        own
            number of plies, and an opponent's, is kept where it is greater.
        workers: threads, or where gnubg or pubeval plays processes, which then need a script that can be imported
            (``if __name__ == "__main__"``). The result does not depend on it.
        progress: is told how many games are done and the result so far, every few games.

    Raises:
        ValueError: an unknown opponent, no game, an odd number of duplicate games, other plies.
        MissingExtra: pubeval or gnubg is asked for and gnubg-nn is not installed.
        IllegalTurn: pubeval or gnubg has broken the rules.

    Example:
        >>> played = play_match("random", "random", 20, seed=0)
        >>> played.num_games, abs(played.points_per_game) < 3
        (20, True)
    """
    check_whole("num_games", num_games)
    check_whole("workers", workers)
    check_choice("plies", plies, (1, 2))
    if duplicate and num_games % 2 != 0:
        raise ValueError(f"duplicate dice need pairs of games, got num_games={num_games}; play {num_games + 1}")
    sides = Side.of(player, "player", plies), Side.of(opponent, "opponent", 1)
    points, turns = np.zeros(num_games, np.int64), np.zeros(num_games, np.int64)
    for first, block in _blocks(sides, num_games, seed, duplicate, workers):
        stop = first + len(block)
        points[first:stop], turns[first:stop] = block.T
        if progress is not None:
            progress(stop, MatchResult(points[:stop], turns[:stop], duplicate))
    return MatchResult(points, turns, duplicate)


@dataclass(frozen=True)
class Side:
    """A player as it can be sent to a worker: its name, or its weights and how far it looks."""

    name: str
    network: ValueNetwork | None = None
    plies: int = 1

    @classmethod
    def of(cls, player: Player, role: str, plies: int) -> Side:
        """What ``player`` is, looking so far at least; ``role`` is what an error calls it.

        Raises:
            ValueError: none of `OPPONENTS`.
            MissingExtra: pubeval or gnubg without gnubg-nn.

        Example:
            >>> Side.of("random", "player", 1).is_compiled
            True
        """
        if isinstance(player, BackgammonAgent):
            return cls("network", player.network, max(plies, player.plies))
        if isinstance(player, ValueNetwork):
            return cls("network", player, plies)
        check_choice(role, player, OPPONENTS)
        if player != "random":
            require_gnubg()
        return cls(player)

    @property
    def is_compiled(self) -> bool:
        """Whether nobody outside has to be asked."""
        return self.name in ("random", "network")


_Sides: TypeAlias = tuple[Side, Side]


def _blocks(
    sides: _Sides, num_games: int, seed: int, duplicate: bool, workers: int
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """(number of the first game, points and turns ``[games, 2]``) in order."""
    starts = range(0, num_games, _BLOCK)
    tasks = [(sides, range(first, min(first + _BLOCK, num_games)), seed, duplicate) for first in starts]
    if workers == 1 or len(tasks) == 1:
        yield from zip(starts, map(_play_block, tasks), strict=True)
        return
    compiled = all(side.is_compiled for side in sides)
    pool: Executor = (
        ThreadPoolExecutor(workers) if compiled else ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    )
    with safe_path(), pool:
        try:
            yield from zip(starts, pool.map(_play_block, tasks), strict=True)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # whoever leaves early waits for no more than has begun


def _play_block(task: tuple[_Sides, range, int, bool]) -> NDArray[np.int64]:
    """Points of the first side, and turns, of these games ``[games, 2]``."""
    sides, games, seed, duplicate = task
    play = _compiled_games(sides) if all(side.is_compiled for side in sides) else _asked_games(sides)
    return np.array([play(game % 2, *_generators(game, seed, duplicate)) for game in games], np.int64)


def _generators(game: int, seed: int, duplicate: bool) -> tuple[np.random.Generator, np.random.Generator]:
    """Of a game's rolls, and of its random choices."""
    dice_of = game // 2 if duplicate else game
    return np.random.default_rng((seed, 0, dice_of)), np.random.default_rng((seed, 1, game))


_Game: TypeAlias = Callable[[int, np.random.Generator, np.random.Generator], tuple[int, int]]
"""Who moves first, rolls, choices -> points of side 0, turns."""


def _compiled_games(sides: _Sides) -> _Game:
    networks = [side.network.copy() if side.network is not None else None for side in sides]
    dtype = next((net.dtype for net in networks if net is not None), np.float32)
    weights: list[Any] = []
    for net in networks:
        net = net or ValueNetwork(1, 4, dtype)  # for a random player, whose weights nobody asks
        weights += [net.w, net.v, net.c, net.scratch]
    plies = [side.plies if side.network is not None else 0 for side in sides]

    def play(first: int, dice: np.random.Generator, choices: np.random.Generator) -> tuple[int, int]:
        return _play_game(first, dice, choices, plies[0], plies[1], *weights)

    return play


def _asked_games(sides: _Sides) -> _Game:
    take_turn = [turn_taker(side) for side in sides]

    def play(first: int, dice: np.random.Generator, choices: np.random.Generator) -> tuple[int, int]:
        board, drawn, mover, turns, points = START.copy(), rolls(dice), first, 0, 0
        while points == 0:
            take_turn[mover](board, *next(drawn), choices)
            mover = 1 - mover
            turns += 1
            points = result(board)
        return (points if mover == 0 else -points), turns

    return play


def turn_taker(side: Side) -> Callable[[Board, int, int, np.random.Generator], None]:
    """A function that plays a turn in place: of a board, its dice, and a generator for a player that draws lots.

    Example:
        >>> take_turn, board = turn_taker(Side.of("random", "player", 1)), START.copy()
        >>> take_turn(board, 3, 1, np.random.default_rng(0))
        >>> board[1].sum().item(), (board[1] == START[0]).all().item()  # now seen by the other side
        (15, False)
    """
    if side.is_compiled:
        net = ValueNetwork(1) if side.network is None else side.network.copy()
        weights = net.w, net.v, net.c, net.scratch
        if side.network is None:
            return lambda board, die_1, die_2, choices: _take_turn(board, die_1, die_2, 0, choices.random(), *weights)
        return lambda board, die_1, die_2, choices: _take_turn(board, die_1, die_2, side.plies, 0.0, *weights)
    other, boards = GnubgPlayer(side.name), np.empty((MAX_AFTERSTATES, 2, 25), np.int8)

    def ask(board: Board, die_1: int, die_2: int, choices: np.random.Generator) -> None:
        count = afterstates(board, die_1, die_2, boards)
        board[:] = boards[other.choose(board, die_1, die_2, count, boards)]

    return ask


def rolls(dice: np.random.Generator) -> Iterator[tuple[int, int]]:
    """The rolls of a game, the first of which is no double, as the compiled games draw them from the same generator.

    Many are drawn at a time: to call a kernel with a generator takes as long as a turn.

    Example:
        >>> drawn = rolls(np.random.default_rng(2))
        >>> [next(drawn) for _ in range(4)]
        [(5, 1), (4, 5), (2, 1), (2, 4)]
    """
    opening = True
    while True:
        for die_1, die_2 in (1 + 6 * dice.random((128, 2))).astype(np.int64).tolist():
            if die_1 != die_2 or not opening:
                opening = False
                yield die_1, die_2


@kernel
def _take_turn(
    board: Board, die_1: int, die_2: int, plies: int, lot: float, w: Array, v: Array, c: Array, s: Scratch
) -> None:
    """In place; plies of 0 stand for a player that draws lots, and then ``lot`` in [0, 1) is what it has drawn."""
    count = afterstates(board, die_1, die_2, s.boards)
    if plies == 0:
        best = int(count * lot)
    elif count == 1:
        best = 0
    elif plies == 1:
        best = choose(count, w, v, c, s)
    else:
        best = choose_two_ply(count, w, v, c, s)
    copy_board(s.boards[best], board)


@kernel
def _play_game(
    first: int, dice: np.random.Generator, choices: np.random.Generator, plies_0: int, plies_1: int,
    w0: Array, v0: Array, c0: Array, s0: Scratch, w1: Array, v1: Array, c1: Array, s1: Scratch,
) -> tuple[int, int]:  # fmt: skip
    """Points of side 0, and turns."""
    board = START.copy()
    mover, turns, points = first, 0, 0
    while points == 0:
        die_1, die_2 = roll(dice, turns == 0)
        plies = plies_0 if mover == 0 else plies_1
        lot = choices.random() if plies == 0 else 0.0
        if mover == 0:
            _take_turn(board, die_1, die_2, plies, lot, w0, v0, c0, s0)
        else:
            _take_turn(board, die_1, die_2, plies, lot, w1, v1, c1, s1)
        mover = 1 - mover
        turns += 1
        points = result(board)
    return (points if mover == 0 else -points), turns
