"""Matches between players of backgammon, two-ply search, and errors by GNU Backgammon's values.

The oracles are slow: a match played with `Position` objects, turn for turn with the same dice; two plies as a plain sum
over the 36 rolls; hand-made turns with a hit, from the bar and off the board; numpy's standard errors. What needs
gnubg-nn (extra ``gnubg``) skips without it; what it could answer wrongly is answered by a stand-in.

Mutants that die here, each tried: an opening double · the same side first in every game · one pair's dice for all
pairs · the second game of a pair with dice of its own · points seen by the opponent · the standard error of games
instead of pairs · ddof=0 · random players that never take the last afterstate · blocks in the order in which workers
finish them · scratch that workers share · an answer taken without a look at the legal turns · a hit that leaves the
checker on its point · doubles weighted like other rolls · replies that are best for us instead of the other side · a
backgammon at the end of a reply counted as the outputs say · a window or a number of candidates that is not kept ·
chances not turned around · losses measured from the first afterstate.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from neuralq.apps.cli import main
from neuralq.checks import MissingExtra
from neuralq.systems.backgammon import BackgammonAgent, ValueNetwork, match, opponents
from neuralq.systems.backgammon.error_rate import decisions, error_rate
from neuralq.systems.backgammon.match import MatchResult, Side, play_match, turn_taker
from neuralq.systems.backgammon.opponents import GnubgPlayer, IllegalTurn
from neuralq.systems.backgammon.search import MAX_CANDIDATES, WINDOW, choose_two_ply, look_ahead
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, afterstates

Dice = tuple[int, int]
Mover = Callable[[Position, Dice], Position]


def network(seed: int, num_outputs: int = 4) -> ValueNetwork:
    """With opinions strong enough that no two turns are nearly as good."""
    return ValueNetwork.drawn(12, num_outputs, np.random.default_rng(seed), scale=1.0, dtype=np.float32)


A, B = network(2), network(1)


def needs_gnubg() -> None:
    pytest.importorskip("gnubg_nn", reason="gnubg-nn is not installed: pip install 'neuralq[gnubg]'")


def value(net: ValueNetwork, position: Position) -> float:
    """What the side to move expects, at one ply, from the definition."""
    if position.winner is not None:
        return position.points if position.winner == position.turn else -position.points
    y = net.outputs(position.board[None])[0]
    return float(2 * y[0] - 1 if len(y) == 1 else y[0] + 2 * y[1] - y[2] - 2 * y[3])


def one_ply(net: ValueNetwork) -> Mover:
    return lambda position, dice: min(position.afterstates(dice), key=lambda after: value(net, after))


def looked_ahead(net: ValueNetwork, after: Position) -> tuple[float, np.ndarray]:
    """What the side that leaves ``after`` expects at two plies: points and outputs, over all 36 pairs of dice."""
    total, outputs = 0.0, np.zeros(net.num_outputs)
    for dice in itertools.product(range(1, 7), repeat=2):
        reply = min(after.afterstates(dice), key=lambda board: value(net, board))
        total += value(net, reply) / 36
        outputs += net.outputs(reply.board[None])[0] / 36
    return total, outputs


def slow_game(players: Sequence[Mover], first: int, dice: np.random.Generator) -> tuple[int, int]:
    """Points of player 0, and turns."""
    position, turns = Position.initial(turn=first), 0
    while position.winner is None:
        roll = 1 + int(6 * dice.random()), 1 + int(6 * dice.random())
        if turns == 0 and roll[0] == roll[1]:
            continue
        position = players[position.turn](position, roll)
        turns += 1
    return (position.points if position.winner == 0 else -position.points), turns


@pytest.mark.parametrize("duplicate", [False, True])
@pytest.mark.slow
def test_match_is_that_of_the_slow_rules(duplicate: bool) -> None:
    played = play_match(A, BackgammonAgent(B), 6, 5, duplicate=duplicate)
    players = [one_ply(A), one_ply(B)]
    for game in range(6):
        dice = np.random.default_rng((5, 0, game // 2 if duplicate else game))
        assert slow_game(players, game % 2, dice) == (played.points[game], played.turns[game])
    assert len(set(played.turns)) > 1


def test_every_turn_is_the_slow_one() -> None:
    take_turn, rng = turn_taker(Side.of(A, "player", 1)), np.random.default_rng(3)
    position, board = Position.initial(), START.copy()
    for _ in range(40):
        dice = int(rng.integers(1, 7)), int(rng.integers(1, 7))
        position = one_ply(A)(position, dice)
        take_turn(board, *dice, rng)
        assert Position.from_board(board) == position
        if position.winner is not None:
            break


def test_two_plies_in_a_match_are_those_of_the_agent() -> None:
    played = play_match(A, B, 2, 5, plies=2)
    players: list[Mover] = [BackgammonAgent(A, plies=2).best_move, one_ply(B)]
    for game in range(2):
        found = slow_game(players, game, np.random.default_rng((5, 0, game)))
        assert found == (played.points[game], played.turns[game])
    as_agent = play_match(BackgammonAgent(A, plies=2), B, 2, 5)
    assert as_agent.turns.tolist() == played.turns.tolist() != play_match(A, B, 2, 5).turns.tolist()


class StandIn:
    """Takes the first afterstate and writes down what it was asked: (its name, whether the game begins, its dice)."""

    asked: list[tuple[str, bool, Dice]] = []  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.name = name

    def choose(self, board: np.ndarray, die_1: int, die_2: int, count: int, boards: np.ndarray) -> int:
        self.asked.append((self.name, bool((board == START).all()), (die_1, die_2)))
        return 0


def dice_of_games(monkeypatch: pytest.MonkeyPatch, num_games: int, duplicate: bool) -> list[tuple[str, list[Dice]]]:
    """Who moved first, and all rolls, of each game of "gnubg" against "pubeval"."""
    monkeypatch.setattr(match, "GnubgPlayer", StandIn)
    monkeypatch.setattr(match, "require_gnubg", lambda: None)
    monkeypatch.setattr(StandIn, "asked", [])
    play_match("gnubg", "pubeval", num_games, 4, duplicate=duplicate)
    games: list[tuple[str, list[Dice]]] = []
    for name, begins, dice in StandIn.asked:
        if begins:
            games.append((name, []))
        games[-1][1].append(dice)
    return games


def test_pairs_have_the_same_dice_and_the_other_side_first(monkeypatch: pytest.MonkeyPatch) -> None:
    games = dice_of_games(monkeypatch, 60, duplicate=True)
    assert [name for name, _ in games] == ["gnubg", "pubeval"] * 30
    for (_, first), (_, second) in zip(games[::2], games[1::2], strict=True):
        common = min(len(first), len(second))
        assert common > 20 and first[:common] == second[:common]
    assert len({tuple(dice[:8]) for _, dice in games}) == 30


def test_games_have_dice_of_their_own_and_begin_without_a_double(monkeypatch: pytest.MonkeyPatch) -> None:
    games = dice_of_games(monkeypatch, 200, duplicate=False)
    assert [name for name, _ in games] == ["gnubg", "pubeval"] * 100
    assert len({tuple(dice[:8]) for _, dice in games}) == 200
    assert all(dice[0][0] != dice[0][1] for _, dice in games)
    later = [dice for _, rolls in games for dice in rolls[1:]]
    # 36 cells, about 400 each: chi-square with 35 degrees of freedom stays below 75 but once in 10^4 times
    counts = np.unique(np.array(later) @ [6, 1], return_counts=True)[1]
    assert len(counts) == 36 and ((counts - counts.mean()) ** 2 / counts.mean()).sum() < 75


def test_compiled_dice_are_those_of_asked_players() -> None:
    drawn, other = match.rolls(np.random.default_rng(9)), np.random.default_rng(9)
    assert [next(drawn) for _ in range(300)] == [match.roll(other, i == 0) for i in range(300)]


def test_a_player_gets_nothing_from_itself_with_duplicate_dice() -> None:
    played = play_match(A, A, 40, 0, duplicate=True)
    assert (played.points[::2] == -played.points[1::2]).all() and (played.turns[::2] == played.turns[1::2]).all()
    assert played.points_per_game == 0 and played.standard_error == 0
    assert play_match(A, A, 40, 0).points_per_game != 0


def test_sides_exchanged_are_signs_exchanged() -> None:
    one, other = play_match(A, B, 40, 3, duplicate=True), play_match(B, A, 40, 3, duplicate=True)
    assert (one.points[::2] == -other.points[1::2]).all() and (one.points[1::2] == -other.points[::2]).all()


def test_standard_errors_are_numpys() -> None:
    points = np.random.default_rng(0).choice([-3, -2, -1, 1, 2, 3], 60)
    turns = np.full(60, 50)
    assert MatchResult(points, turns).standard_error == pytest.approx(np.std(points, ddof=1) / np.sqrt(60))
    pairs = [(points[i] + points[i + 1]) / 2 for i in range(0, 60, 2)]
    assert MatchResult(points, turns, True).standard_error == pytest.approx(np.std(pairs, ddof=1) / np.sqrt(30))
    assert MatchResult(points[:1], turns[:1]).plain()["standard_error"] is None


def test_rates_are_counted_by_hand() -> None:
    found = MatchResult(np.array([1, 2, 3, -1, -2, -3, -3, 1]), np.arange(8)).plain()
    assert found == {
        "num_games": 8, "points_per_game": -0.25, "standard_error": found["standard_error"], "win_rate": 0.5,
        "gammon_rate": 0.25, "backgammon_rate": 0.125, "lost_gammon_rate": 0.375, "lost_backgammon_rate": 0.25,
        "turns_per_game": 3.5, "duplicate": False,
    }  # fmt: skip


@pytest.mark.slow
def test_random_players_are_equals() -> None:
    played = play_match("random", "random", 1500, 1)
    assert abs(played.points_per_game) < 4 * played.standard_error < 0.25


def test_random_players_take_every_afterstate_alike() -> None:
    take_turn, rng = turn_taker(Side.of("random", "player", 1)), np.random.default_rng(0)
    counts: dict[bytes, int] = {}
    for _ in range(3200):
        board = START.copy()
        take_turn(board, 3, 1, rng)
        counts[board.tobytes()] = counts.get(board.tobytes(), 0) + 1
    # 16 afterstates, 200 each: chi-square with 15 degrees of freedom stays below 45 but once in 10^4 times
    assert len(counts) == 16 and sum((n - 200) ** 2 / 200 for n in counts.values()) < 45


def test_workers_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    play_block = match._play_block

    def late(task: Any) -> Any:
        if task[1].start == 0:  # so that the first block is the last that is done
            time.sleep(0.5)
        return play_block(task)

    monkeypatch.setattr(match, "_play_block", late)
    one, two = (play_match(A, "random", 120, 6, workers=workers) for workers in (1, 2))
    assert one.points.tolist() == two.points.tolist() and one.turns.tolist() == two.turns.tolist()
    assert play_match(A, "random", 60, 6).points.tolist() == one.points[:60].tolist()


def test_progress_counts_up_to_the_end() -> None:
    seen: list[tuple[int, int]] = []
    play_match("random", "random", 120, 0, progress=lambda played, so_far: seen.append((played, so_far.num_games)))
    assert seen == [(50, 50), (100, 100), (120, 120)]


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        ((A, "gnu", 10, 0), {}, "opponent must be one of 'random', 'pubeval', 'gnubg', got 'gnu'"),
        ((A, "random", 0, 0), {}, "num_games must be a whole number of at least 1"),
        ((A, "random", 11, 0), {"duplicate": True}, "got num_games=11; play 12"),
        ((A, "random", 10, 0), {"plies": 3}, "plies must be one of 1, 2, got 3"),
        ((A, "random", 10, 0), {"workers": 0}, "workers must be"),
    ],
)
def test_refusals(arguments: tuple[Any, ...], options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        play_match(*arguments, **options)


# Three boards to look ahead from: the middle of a game; the other side may lose a backgammon; the last checkers.
MIDDLE = Position.from_gnubg_id("sGfwATDgc/ABMA")
LATE = Position.from_board([[2, 2] + 23 * [0], [0] * 17 + [4, 3, 3, 3, 2, 0, 0, 0]])
LAST = Position.from_board([[1, 2] + 23 * [0], [2, 1] + 23 * [0]])


@pytest.mark.parametrize("net", [A, network(3, 1)], ids=["four outputs", "one output"])
@pytest.mark.parametrize("position", [MIDDLE, LATE, LAST], ids=["middle", "late", "last"])
def test_two_plies_are_the_sum_over_all_rolls(position: Position, net: ValueNetwork) -> None:
    ahead = np.empty(net.num_outputs)
    equity = look_ahead(position.board, net.w, net.v, net.c, net.scratch, ahead)
    expected, outputs = looked_ahead(net, position)
    assert equity == pytest.approx(expected, abs=1e-7) and ahead == pytest.approx(outputs, abs=1e-7)


@pytest.mark.parametrize("dice", [(6, 4), (2, 1), (1, 1), (6, 6)])
@pytest.mark.parametrize("position", [MIDDLE, LATE, LAST], ids=["middle", "late", "last"])
def test_best_turn_at_two_plies(position: Position, dice: Dice) -> None:
    net = A
    found = sorted(position.afterstates(dice), key=lambda after: value(net, after))
    best = [after for after in found[:MAX_CANDIDATES] if value(net, after) <= value(net, found[0]) + WINDOW]
    worth = [-value(net, after) if after.winner is not None else looked_ahead(net, after)[0] for after in best]
    ranked = BackgammonAgent(net, plies=2).ranked_turns(position, dice)
    assert [turn.equity for turn in ranked[: len(best)]] == pytest.approx(sorted(worth, reverse=True), abs=1e-7)
    assert ranked[0].position == best[int(np.argmax(worth))] == BackgammonAgent(net, 2).best_move(position, dice)
    assert [turn.position for turn in ranked[len(best) :]] == found[len(best) :]
    assert [turn.equity for turn in ranked[len(best) :]] == pytest.approx([-value(net, p) for p in found[len(best) :]])
    scratch = net.scratch
    count = afterstates(position.board, *dice, scratch.boards)
    chosen = scratch.boards[choose_two_ply(count, net.w, net.v, net.c, scratch)]
    assert Position.from_board(chosen) == ranked[0].position


def test_candidates_are_cut_by_number_and_by_window() -> None:
    """The cases above must have both kinds in them."""
    within = []
    for dice in [(6, 4), (2, 1), (1, 1)]:
        values = sorted(value(A, after) for after in MIDDLE.afterstates(dice))
        within.append(sum(x <= values[0] + WINDOW for x in values))
    assert max(within) > MAX_CANDIDATES and 1 < min(within) < MAX_CANDIDATES


@pytest.mark.parametrize(
    ("name", "dice"),
    [("Di9ioAPfVxAAUA", (6, 5)), ("W3orgADKPuAFQA", (5, 6)), ("cHPwQiCOHuIJQA", (1, 4)), ("7x8gAAp/gxIIQg", (4, 5))],
    ids=["window", "window again", "number", "number again"],
)
def test_a_turn_that_is_no_candidate_is_not_chosen_even_if_it_is_the_best(name: str, dice: Dice) -> None:
    position = Position.from_gnubg_id(name)
    found = sorted(position.afterstates(dice), key=lambda after: value(A, after))
    within = sum(value(A, after) <= value(A, found[0]) + WINDOW for after in found[:MAX_CANDIDATES])
    worth = [looked_ahead(A, after)[0] for after in found]
    assert 1 < within <= int(np.argmax(worth))
    count = afterstates(position.board, *dice, A.scratch.boards)
    chosen = A.scratch.boards[choose_two_ply(count, A.w, A.v, A.c, A.scratch)]
    assert Position.from_board(chosen).board.tolist() == found[int(np.argmax(worth[:within]))].board.tolist()


def test_chances_at_two_plies_are_those_of_the_side_that_moves() -> None:
    turn = BackgammonAgent(A, plies=2).ranked_turns(MIDDLE, (6, 4), 1)[0]
    y = looked_ahead(A, turn.position)[1]
    y /= y.sum()
    expected = y[0] + y[1], y[1], y[3]
    assert (turn.chances.win, turn.chances.gammon, turn.chances.lost_gammon) == pytest.approx(expected, abs=1e-7)
    net = network(3, 1)
    turn = BackgammonAgent(net, plies=2).ranked_turns(MIDDLE, (6, 4), 1)[0]
    assert turn.chances.win == pytest.approx(looked_ahead(net, turn.position)[1][0], abs=1e-7)


def test_other_plies_are_refused() -> None:
    with pytest.raises(ValueError, match="plies must be one of 1, 2, got 0"):
        BackgammonAgent(A, plies=0)


def answering(monkeypatch: pytest.MonkeyPatch, moves: Sequence[Dice]) -> None:
    """A stand-in for gnubg-nn that always answers so, each of its functions in its own way."""
    flat = [point - 1 for pair in moves for point in pair]
    package = SimpleNamespace(best_move=lambda *_: tuple(moves), pub_best_move=lambda *_: flat)
    monkeypatch.setattr(opponents, "require_gnubg", lambda: package)


def chosen_by(name: str, board: np.ndarray, dice: Dice) -> Position:
    boards = np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    count = afterstates(board, *dice, boards)
    return Position.from_board(boards[GnubgPlayer(name).choose(board, *dice, count, boards)])


@pytest.mark.parametrize("name", ["gnubg", "pubeval"])
def test_answers_are_played_on_our_board(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, [(8, 5), (6, 5)])
    assert chosen_by(name, START, (3, 1)) == Position.from_gnubg_id("sGfwATDgc/ABMA")  # as in GNU Backgammon
    # On the bar against a blot on our 22 point, which is its 3 point: 25/22*, then 2/off is not yet allowed, so 8/6.
    board = np.zeros((2, 25), np.int8)
    board[0, [24, 7, 5]], board[1, [2, 5]] = [1, 4, 10], [1, 14]
    answering(monkeypatch, [(25, 22), (8, 6)])
    after = chosen_by(name, board, (3, 2)).board
    expected = np.zeros((2, 25), np.int8)
    expected[1, [21, 7, 5]], expected[0, [24, 5]] = [1, 3, 11], [1, 14]
    assert after.tolist() == expected.tolist()
    bear_off = np.zeros((2, 25), np.int8)
    bear_off[0, [3, 0]], bear_off[1, 5] = [1, 2], 15
    answering(monkeypatch, [(4, 0), (1, 0)])
    assert chosen_by(name, bear_off, (6, 1)).off == (0, 14)


@pytest.mark.parametrize("moves", [[(8, 5)], [], [(8, 5), (6, 4)], [(24, 21), (24, 23), (6, 5)], [(2, 1), (8, 5)]])
@pytest.mark.parametrize("name", ["gnubg", "pubeval"])
def test_illegal_answers_are_refused(name: str, moves: list[Dice], monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, moves)
    with pytest.raises(IllegalTurn, match=f"{name} played .* with 3 and 1 on .* no legal turn"):
        chosen_by(name, START, (3, 1))


@pytest.mark.parametrize("name", ["gnubg", "pubeval"])
def test_without_the_package(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gnubg_nn", None)
    with pytest.raises(MissingExtra, match=r"need the package gnubg-nn: pip install 'neuralq\[gnubg\]'.*GPL"):
        play_match(A, name, 10, 0)
    with pytest.raises(MissingExtra, match="gnubg-nn"):
        error_rate(A)


def test_losses_are_those_of_the_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in that knows nothing but the checkers borne off, on one decision."""
    from neuralq.systems.backgammon import error_rate as module

    board = np.zeros((2, 25), np.int8)
    board[0, [4, 3, 0]], board[1, 5] = [1, 1, 1], 14
    monkeypatch.setattr(module, "require_gnubg", lambda: None)
    monkeypatch.setattr(module, "gnubg_equity", lambda after, _: -0.25 * (15 - after[1].sum()))
    monkeypatch.setattr(module, "decisions", lambda num_decisions, seed: iter([(board, 5, 1)] * num_decisions))
    found = error_rate(A, 1)
    chosen = one_ply(A)(Position.from_board(board), (5, 1))
    most = max(after.off[1] for after in Position.from_board(board).afterstates((5, 1)))
    assert most == 14 and found.losses.tolist() == [0.25 * (most - chosen.off[1])]
    lots = error_rate("random", 200)
    assert set(lots.losses) == {
        0.25 * (most - after.off[1]) for after in Position.from_board(board).afterstates((5, 1))
    }
    assert lots.share_of_best == np.mean(lots.losses == 0)
    assert lots.standard_error == pytest.approx(np.std(lots.losses, ddof=1) / np.sqrt(200))


def test_gnubg_makes_no_errors_by_its_own_values() -> None:
    needs_gnubg()
    assert error_rate("gnubg", 100).losses.max() < 1e-6
    chance, net = error_rate("random", 100), error_rate(A, 100)
    assert chance.mean > 0.2 and net.mean > 0 and chance.num_decisions == 100


def test_decisions_are_the_same_each_time_and_real() -> None:
    needs_gnubg()
    first, again = ([(b.tobytes(), *dice) for b, *dice in decisions(60, 0)] for _ in range(2))
    assert first == again and len(set(first)) > 55
    assert first != [(b.tobytes(), *dice) for b, *dice in decisions(60, 1)]
    assert all(len(Position.from_board(b).afterstates(dice)) > 1 for b, *dice in decisions(60, 0))


def test_values_are_read_from_the_right_side() -> None:
    needs_gnubg()
    package = opponents.require_gnubg()
    ahead = Position.from_board([[0, 3] + 23 * [0], [0, 0, 0, 0, 0, 13, 2] + 18 * [0]])
    assert opponents.gnubg_equity(ahead.board, package) > 1 > -1 > opponents.gnubg_equity(ahead.passed().board, package)
    # GNU Backgammon's cubeless equity of the opening position for the side on roll, at zero plies: +0.070
    assert opponents.gnubg_equity(START, package) == pytest.approx(0.07, abs=0.02)


@pytest.mark.parametrize("name", ["gnubg", "pubeval"])
def test_match_against_the_package(name: str) -> None:
    needs_gnubg()
    played = play_match(A, name, 30, 2)
    assert played.points_per_game < -1.0  # a network that has learned nothing
    assert played.points.tolist() == play_match(A, name, 30, 2).points.tolist()
    assert play_match(name, name, 10, 2, duplicate=True).points_per_game == 0


@pytest.mark.slow
def test_processes_change_nothing() -> None:
    needs_gnubg()
    one, two = (play_match(A, "gnubg", 120, 6, workers=workers) for workers in (1, 2))
    assert one.points.tolist() == two.points.tolist() and one.turns.tolist() == two.turns.tolist()


@pytest.mark.slow
def test_pubeval_against_gnubg_is_as_strong_as_measured_elsewhere() -> None:
    """−0.675 ± 0.029 points per game: measured with another engine's dice and rules and the same package."""
    needs_gnubg()
    played = play_match("pubeval", "gnubg", 3000, 0)
    assert abs(played.points_per_game + 0.675) < 4 * np.hypot(played.standard_error, 0.029)


@pytest.fixture
def weights(tmp_path: Path) -> str:
    A.save(tmp_path / "a.safetensors")
    return str(tmp_path / "a.safetensors")


Capture = pytest.CaptureFixture[str]


def test_command_plays_a_match(weights: str, capsys: Capture) -> None:
    arguments = ["evaluate", weights, "--against", weights, "--games", "20", "--duplicate", "--seed", "3", "--workers"]
    assert main([*arguments, "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["points_per_game"] == 0 and found["num_games"] == 20 and found["duplicate"] is True
    assert main(["evaluate", weights, "--games", "20", "--json", "--plies", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    expected = play_match(A, "random", 20, 0, plies=2)
    assert found["against"] == "random" and found["points_per_game"] == expected.points_per_game
    assert main(["evaluate", weights, "--games", "20", "--seed", "3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"{play_match(A, 'random', 20, 3).points_per_game:+.4f} ±" in lines[0] and "turns per game" in lines[1]


def test_command_measures_errors(weights: str, capsys: Capture) -> None:
    needs_gnubg()
    assert main(["evaluate", weights, "--error-rate", "--decisions", "40", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["num_decisions"] == 40 and found["mean_loss"] == error_rate(A, 40).mean


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--against", "nobody"], 2, "must be random, pubeval, gnubg, a run or a file of weights, got 'nobody'"),
        (["--games", "0"], 1, "num_games must be"),
        (["--games", "5", "--duplicate"], 1, "play 6"),
        (["--error-rate", "--against", "gnubg"], 2, "give one of the two"),
        (["--error-rate", "--games", "5"], 2, "leave them out"),
        (["--against", "gnubg"], 1, "pip install 'neuralq[gnubg]'"),
    ],
)
def test_command_refuses(
    weights: str, arguments: list[str], status: int, words: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gnubg_nn", None)
    assert main(["evaluate", weights, *arguments]) == status
    captured = capsys.readouterr()
    assert words in captured.err and len(captured.err.splitlines()) == 1 and not captured.out


def test_command_refuses_runs_of_other_kinds(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "config.json").write_text('{"env": "CartPole-v1"}')
    assert main(["evaluate", str(tmp_path), "--against", "random"]) == 1
    assert "there is no TD-Gammon run in" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path / "nothing"), "--against", "random"]) == 1
    assert "cannot be read as weights" in capsys.readouterr().err
