"""The engine against two other programs: OpenSpiel and GNU Backgammon's library, turn by turn, as sets of boards.

Both belong to the extra ``backgammon-test`` and are only ever asked, so that a test without them skips and says so.
Games are played at random, cautiously (as few blots as can be, which makes primes, races and long bear-offs), and by
GNU Backgammon's own network at 0 plies; the tests count what has been compared.
"""

from __future__ import annotations

import importlib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.rules import ROLLS

Dice = tuple[int, int]
Player = Callable[[Position, Dice, list[Position]], Position]


def package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        pytest.skip(f"{name} is not installed: pip install 'neuralq[backgammon-test]'")


def kinds_of(position: Position, found: list[Position]) -> Iterator[str]:
    """What a turn is an example of."""
    if position.own[24]:
        yield "dance" if found[0].other == position.own else "bar"
    furthest = [max(i for i, n in enumerate(row) if n) for row in (position.own, position.other)]
    if sum(furthest) < 23:
        yield "race"
    if furthest[0] < 6:
        yield "bear-off" if sum(furthest) < 23 else "bear-off against contact"


ENOUGH = {"dance": 50, "bar": 200, "race": 400, "bear-off": 300, "bear-off against contact": 50}


def cautious(rng: np.random.Generator) -> Player:
    """As few blots as can be, then the shortest way."""

    def choose(position: Position, dice: Dice, found: list[Position]) -> Position:
        blots = [sum(n == 1 for n in after.other[:24]) + 0.01 * after.pips[1] for after in found]
        return found[int(np.argmin(blots))]

    return choose


def at_random(rng: np.random.Generator) -> Player:
    return lambda position, dice, found: found[int(rng.integers(len(found)))]


# ---- GNU Backgammon: a board is [the other side, the side to move], each 25 numbers from its own side.


def gnubg_board(position: Position) -> list[list[int]]:
    return [list(position.other), list(position.own)]


def gnubg_afterstates(gnubg: Any, position: Position, dice: Dice) -> set[Position]:
    keys = gnubg.moves(gnubg_board(position), *dice)
    boards = [gnubg.board_from_position_key(key) for key in keys] or [gnubg_board(position)]
    return {Position(bytes(other), bytes(own)) for other, own in boards}  # the sides have not been exchanged


def gnubg_player(evaluate: Callable[[Position], float]) -> Player:
    """Takes the afterstate that is worst for the other side."""
    return lambda position, dice, found: min(found, key=evaluate)


def gnubg_equity(gnubg: Any) -> Callable[[Position], float]:
    def equity(position: Position) -> float:
        if position.winner is not None:
            return -position.points
        win, gammon, backgammon, lost_gammon, lost_backgammon = gnubg.probabilities(gnubg_board(position), 0)
        return float(2 * win - 1 + gammon + backgammon - lost_gammon - lost_backgammon)

    return equity


def compare_with_gnubg(num_turns: int, player_name: str, seed: int) -> Counter[str]:
    gnubg = package("gnubg_nn")
    rng, seen = np.random.default_rng(seed), Counter[str]()
    player = {
        "random": at_random(rng),
        "cautious": cautious(rng),
        "gnubg": gnubg_player(gnubg_equity(gnubg)),
    }[player_name]
    position = Position.initial()
    for _ in range(num_turns):
        dice = tuple(rng.integers(1, 7, size=2).tolist())
        found = position.afterstates(dice)
        assert len(set(found)) == len(found)
        assert gnubg_afterstates(gnubg, position, dice) == set(found), (position, dice)
        seen.update(kinds_of(position, found))
        seen["afterstates"] += len(found)
        position = player(position, dice, found)
        position = Position.initial() if position.winner is not None else position
    return seen


def test_gnu_backgammon_knows_the_same_ids() -> None:
    gnubg = package("gnubg_nn")
    rng, position = np.random.default_rng(0), Position.initial()
    for _ in range(1000):
        text = gnubg.position_id(gnubg_board(position))
        assert text == position.gnubg_id
        assert [list(side) for side in gnubg.board_from_position_id(text)] == gnubg_board(position)
        found = position.afterstates(ROLLS[int(rng.integers(21))])
        position = found[int(rng.integers(len(found)))]
        position = Position.initial() if position.winner is not None else position


def test_gnu_backgammon_finds_the_same_turns() -> None:
    seen = Counter[str]()
    for seed, player in enumerate(["random", "cautious", "gnubg"]):
        seen += compare_with_gnubg(2000, player, seed)
    assert all(seen[kind] >= least for kind, least in ENOUGH.items()), seen


@pytest.mark.slow
def test_gnu_backgammon_finds_the_same_turns_on_many_boards() -> None:
    seen = Counter[str]()
    for seed, player in enumerate(["random", "cautious", "gnubg"]):
        seen += compare_with_gnubg(20_000, player, 10 + seed)
    assert all(seen[kind] >= 5 * least for kind, least in ENOUGH.items()), seen


def test_gnu_backgammon_agrees_about_the_end() -> None:
    gnubg, rng = package("gnubg_nn"), np.random.default_rng(1)
    ends, position = Counter[int](), Position.initial()
    while sum(ends.values()) < 300:
        found = position.afterstates(tuple(rng.integers(1, 7, size=2).tolist()))
        position = found[int(rng.integers(len(found)))]
        if position.winner is not None:
            # Seen by the loser, whom the library gives the probabilities of losing a gammon and a backgammon.
            chances = gnubg.probabilities(gnubg_board(position), 0)
            points = 1 + chances[3] + chances[4]
            assert chances[0] == 0 and points == position.points, (position, chances)
            ends[position.points] += 1
            position = Position.initial()
    assert set(ends) == {1, 2, 3}


# ---- OpenSpiel: player 0 moves from point 0 up, player 1 from point 23 down; a double is two actions of one player.


def spiel_position(state: Any, mover: int) -> Position:
    rows = [[state.board(player, place) for place in range(24)] for player in (0, 1)]
    rows[0].reverse()
    own, other = (bytes([*rows[player], state.board(player, 100)]) for player in (mover, 1 - mover))
    return Position(own, other, turn=mover)


def spiel_ends(state: Any, mover: int) -> dict[Position, Any]:
    """Each board in which the turn can end, with a state of OpenSpiel's that has it."""
    found: dict[Position, Any] = {}
    halves: dict[Position, Any] = {}
    for action in state.legal_actions():
        after = state.child(action)
        if not after.is_terminal() and after.current_player() == mover:
            halves[spiel_position(after, mover)] = after
        else:
            found[spiel_position(after, 1 - mover)] = after
    for half in halves.values():  # the second action of a double
        found |= spiel_ends(half, mover)
    return found


def compare_with_spiel(num_turns: int, player: Player, rng: np.random.Generator) -> Counter[str]:
    game = package("pyspiel").load_game("backgammon(scoring_type=full_scoring)")
    seen, state = Counter[str](), game.new_initial_state()
    for _ in range(num_turns):
        outcomes, chances = zip(*state.chance_outcomes(), strict=True)
        outcome = int(rng.choice(outcomes, p=chances))
        rolled = re.search(r"roll: (\d)(\d)", state.action_to_string(-1, outcome))
        assert rolled
        dice = int(rolled[1]), int(rolled[2])
        state.apply_action(outcome)
        mover = state.current_player()
        position = spiel_position(state, mover)
        ends, found = spiel_ends(state, mover), position.afterstates(dice)
        assert set(ends) == set(found), (position, dice)
        points = {after: after.points for after in found}
        assert all(end.returns()[mover] == points[after] for after, end in ends.items() if end.is_terminal())
        assert all(end.is_terminal() == (points[after] > 0) for after, end in ends.items())
        seen.update(kinds_of(position, found))
        seen["afterstates"] += len(found)
        state = ends[player(position, dice, found)]
        state = game.new_initial_state() if state.is_terminal() else state
    return seen


def test_open_spiel_finds_the_same_turns() -> None:
    rng = np.random.default_rng(2)
    seen = compare_with_spiel(1000, at_random(rng), rng) + compare_with_spiel(1000, cautious(rng), rng)
    assert all(seen[kind] >= least // 4 for kind, least in ENOUGH.items()), seen


@pytest.mark.slow
def test_open_spiel_finds_the_same_turns_on_many_boards() -> None:
    rng, seen = np.random.default_rng(3), Counter[str]()
    for player in (at_random(rng), cautious(rng)):
        seen += compare_with_spiel(4000, player, rng)
    assert all(seen[kind] >= least for kind, least in ENOUGH.items()), seen


def test_the_network_of_gnu_backgammon_plays_the_same_turns_as_open_spiel() -> None:
    """Positions of trained play, the other kind of game than random play makes."""
    player, rng = gnubg_player(gnubg_equity(package("gnubg_nn"))), np.random.default_rng(4)
    assert compare_with_spiel(1000, player, rng)["afterstates"] > 10_000
