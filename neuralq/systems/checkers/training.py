"""Trainings of checkers from nothing, by backed-up scores and by rote, and the games that tell what came of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_whole
from neuralq.systems.checkers.kernels import Program, learn, new_game, play_pairs, play_positions
from neuralq.systems.checkers.memory import Memory, new_memory
from neuralq.systems.checkers.search import DECIDED, MOST_PLIES, WIN, new_desk, search
from neuralq.systems.checkers.terms import MATERIAL_ONLY, NUM_TERMS
from neuralq.tabular.kernels.backups import BackupRule
from neuralq.tabular.kernels.random_numbers import Seed, new_stream
from neuralq_envs.checkers.rules import SQUARES

__all__ = [
    "Endgames",
    "Match",
    "Wins",
    "carry_out",
    "look_deeper",
    "new_program",
    "pieces_at_random",
    "play_endgames",
    "play_match",
    "study",
    "train",
]

_QUIET, _QUIET_IN_TRAINING = 60, 40
_OPENING_PLIES = 4
_BITS = np.array([1 << bit for bit in range(SQUARES.bit_length()) if SQUARES >> bit & 1])


def new_program(
    weights: ArrayLike = MATERIAL_ONLY,
    depth: int = 3,
    ply_penalty: float = 0.01,
    epsilon: float = 0.0,
    memory: Memory | None = None,
    remembers: bool = False,
) -> Program:
    """A program with a desk of its own.

    Args:
        weights: of the terms, ``[14]``; copied.
        depth: plies of look-ahead; 0 moves at random.
        ply_penalty: what a win loses for each ply that it is away.
        epsilon: chance that a move is drawn at random.
        memory: of positions, or None.
        remembers: whether it puts in what it searches.

    Raises:
        ValueError: weights of another shape or that are not finite, or a depth beyond 20.

    Example:
        >>> new_program(depth=21)
        Traceback (most recent call last):
        ValueError: depth must lie in 0..20, got 21
    """
    copied = np.array(weights, dtype=np.float64)
    if copied.shape != (NUM_TERMS,) or not np.isfinite(copied).all():
        raise ValueError(f"weights must be {NUM_TERMS} finite numbers, got {copied.tolist()}")
    check_whole("depth", depth, minimum=0)
    if depth > MOST_PLIES:
        raise ValueError(f"depth must lie in 0..{MOST_PLIES}, got {depth}")
    kept = new_memory(0) if memory is None else memory
    return Program(copied, int(depth), float(ply_penalty), float(epsilon), bool(remembers), kept, new_desk())


def train(
    seed: Seed,
    num_games: int = 500,
    *,
    depth: int = 3,
    step_sizes: tuple[float, float] = (1e-3, 3e-4),
    epsilon: float = 0.05,
    rule: BackupRule = BackupRule(),  # noqa: B008 - frozen
) -> NDArray[np.float64]:
    """Games with itself from the advantage in pieces on; the weights after each game, ``[num_games, 14]``.

    Averaged over the last half they play better than the last ones (`play_match`).

    Args:
        seed: of the stream.
        num_games: to learn from; each begins with four moves at random.
        depth: plies of look-ahead.
        step_sizes: α of the first and of the last game; in between it falls geometrically.
        epsilon: chance that a move is drawn at random.
        rule: how a backed-up score corrects the weights.

    Raises:
        ValueError: fewer than one game, or a depth out of range.

    Example:
        >>> train(0, num_games=2).shape
        (2, 14)
    """
    check_whole("num_games", num_games)
    check_whole("depth", depth)
    history = np.zeros((num_games, NUM_TERMS))
    program = new_program(depth=depth, epsilon=epsilon)
    learn(
        new_game(), program, rule, *step_sizes, _OPENING_PLIES, _QUIET_IN_TRAINING, new_stream(seed), history,
        np.zeros((2, NUM_TERMS)),
    )  # fmt: skip
    return history


@dataclass(frozen=True, eq=False)
class Match:
    """Results of a match.

    Args:
        results: 1 for a win, 0 for a draw, −1 for a loss, ``[N, 2]``: of each opening, moving first and second.
    """

    results: NDArray[np.int64]

    @property
    def score(self) -> float:
        """Share of the points: a win counts 1, a draw ½."""
        return float(self.results.mean() + 1) / 2

    @property
    def counts(self) -> tuple[int, int, int]:
        """Wins, draws and losses."""
        won, drawn, lost = (int(np.count_nonzero(self.results == result)) for result in (1, 0, -1))
        return won, drawn, lost

    def __str__(self) -> str:
        won, drawn, lost = self.counts
        return f"{self.score:.3f} ({won} won, {drawn} drawn, {lost} lost)"


def play_match(first: Program, second: Program, seed: Seed, num_openings: int = 100) -> Match:
    """Openings of four moves at random, each played from both sides; the same seed gives the same openings.

    Args:
        first: whose results are counted.
        second: its opponent.
        seed: of the openings, and of the draws among equal moves.
        num_openings: two games each.

    Raises:
        ValueError: fewer than one opening.

    Example:
        >>> play_match(new_program(depth=1), new_program(depth=0), 0, num_openings=20).score > 0.8
        True
    """
    check_whole("num_openings", num_openings)
    results = np.zeros((num_openings, 2), np.int64)
    openings, moves = (new_stream(_part(seed, k)) for k in range(2))
    play_pairs(new_game(), first, second, _OPENING_PLIES, _QUIET, openings, moves, results)
    return Match(results)


@dataclass(frozen=True, eq=False)
class Endgames:
    """What came of positions that were played to their end.

    Args:
        results: 1 for a win of who was to move, 0 for a draw, −1 for a loss, ``[N]``.
        plies: how long each took, ``[N]``.
        nodes: positions that the first program looked at, in all.
        remembered: positions in its memory.
    """

    results: NDArray[np.int64]
    plies: NDArray[np.int64]
    nodes: int
    remembered: int

    @property
    def won(self) -> float:
        """Share that was won."""
        return float((self.results == 1).mean())


def pieces_at_random(num_positions: int, seed: Seed, num_own: int = 3) -> NDArray[np.int64]:
    """Kings on squares at random, ``num_own`` of the side to move against one; ``[N, 3]``.

    Example:
        >>> pieces_at_random(2, 0).shape
        (2, 3)
    """
    check_whole("num_positions", num_positions)
    order = np.random.default_rng(seed).random((num_positions, len(_BITS))).argsort(axis=1)
    bits = _BITS[order[:, : num_own + 1]]
    own, other = bits[:, :num_own].sum(axis=1), bits[:, num_own]
    return np.stack([own, other, own | other], axis=1)


def play_endgames(positions: NDArray[np.int64], first: Program, second: Program, seed: Seed) -> Endgames:
    """Plays positions to their end, ``first`` to move.

    Example:
        >>> found = play_endgames(pieces_at_random(5, 0), new_program(depth=5), new_program(depth=0), 0)
        >>> found.won, found.nodes > 0
        (1.0, True)
    """
    results, plies = np.zeros((2, len(positions)), np.int64)
    before = int(first.desk.counts[0])
    play_positions(new_game(), positions, first, second, _QUIET, new_stream(seed), results, plies)
    return Endgames(results, plies, int(first.desk.counts[0]) - before, int(first.memory.size[0]))


def study(
    seed: Seed,
    ply_penalty: float = 0.01,
    *,
    num_rounds: int = 8,
    num_games: int = 2000,
    num_tests: int = 300,
    depth: int = 3,
    defender_depth: int = 5,
) -> tuple[Endgames, ...]:
    """Learns three kings against one by rote, playing both sides, and is tested after every round on other positions.

    Advantage in pieces is the only term, so nothing but the memory tells how to go about it. The first test comes
    before any game, and is that of a program without a memory.

    Args:
        seed: of all draws; the tests are the same for the same seed.
        ply_penalty: what a win loses for each ply that it is away.
        num_rounds: of games, each with a test after it.
        num_games: of a round.
        num_tests: positions of each test.
        depth: plies that it looks ahead.
        defender_depth: of the single king in the tests, which has no memory.

    Example:
        >>> [found.remembered > 0 for found in study(0, num_rounds=1, num_games=20, num_tests=5)]
        [False, True]
    """
    pupil = new_program(depth=depth, ply_penalty=ply_penalty, memory=new_memory(1 << 18), remembers=True)
    tested, defender = pupil._replace(remembers=False), new_program(depth=defender_depth)
    tests = pieces_at_random(num_tests, _part(seed, 0))
    found = []
    for i in range(num_rounds + 1):
        if i > 0:
            play_endgames(pieces_at_random(num_games, _part(seed, 2 * i)), pupil, pupil, _part(seed, 2 * i + 1))
        found.append(play_endgames(tests, tested, defender, _part(seed, 1)))
    return tuple(found)


def look_deeper(
    seed: Seed, depths: tuple[int, ...] = (3, 5, 7), num_tests: int = 300, defender_depth: int = 5
) -> tuple[Endgames, ...]:
    """The tests of `study` for programs without a memory, one for each depth.

    Example:
        >>> first, = look_deeper(0, (3,), num_tests=20)
        >>> first.plies.tolist() == study(0, num_rounds=0, num_tests=20)[0].plies.tolist()
        True
    """
    tests = pieces_at_random(num_tests, _part(seed, 0))
    defender = new_program(depth=defender_depth)
    return tuple(play_endgames(tests, new_program(depth=depth), defender, _part(seed, 1)) for depth in depths)


@dataclass(frozen=True, eq=False)
class Wins:
    """Positions in which a search sees a win, played to their end.

    Args:
        announced: how many plies away the win was said to be, ``[N]``.
        endgames: of programs with each ply penalty, by that.
    """

    announced: NDArray[np.int64]
    endgames: Mapping[float, Endgames]


def carry_out(seed: Seed, ply_penalties: tuple[float, ...] = (0.01, 0.0, -0.01), num_tests: int = 300) -> Wins:
    """Three kings against one that moves at random, from where seven plies of search see the win.

    Example:
        >>> found = carry_out(0, (0.01,), num_tests=40)
        >>> bool((found.endgames[0.01].plies <= found.announced).all())
        True
    """
    depth, penalty, tests, announced = 7, 0.01, [], []
    program = new_program(depth=depth, ply_penalty=penalty)
    stream = new_stream(_part(seed, 0))
    for position in pieces_at_random(num_tests, _part(seed, 1)):
        own, other, kings = position.tolist()
        score = search(own, other, kings, depth, program.weights, penalty, program.memory, program.desk, stream)
        if score > DECIDED:
            tests.append(position)
            announced.append(round((WIN - score) / penalty))
    endgames = {
        one: play_endgames(
            np.array(tests), new_program(depth=depth, ply_penalty=one), new_program(depth=0), _part(seed, 2)
        )
        for one in ply_penalties
    }
    return Wins(np.array(announced), endgames)


def _part(seed: Seed, k: int) -> np.random.SeedSequence:
    """One of the independent parts of a seed; the same whenever it is asked for."""
    whole = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(whole.entropy, spawn_key=(*whole.spawn_key, k))
