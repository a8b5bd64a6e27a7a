"""The backgammon engine: rules, position IDs and inputs; `test_backgammon_play` has pictures and environments.

The rules are tested by positions small enough to be solved by hand, by the slow second implementation of
`backgammon_slowly` (absolute board, sets, once with the mover as white and once as black), and by invariants along
random games (`test_backgammon_fuzz`). `test_backgammon_oracles` compares with two other programs.

Mutants that die here: the smaller die where only one can be played; one die where both can be played in one order;
bearing off with a checker outside or, by a larger die, behind; other checkers before the bar; a fifth move of a
double; a blot that stays; a gammon for a loser who has borne off; a backgammon that overlooks the bar; rows not
exchanged after a pass; the sides of an ID exchanged; its bits from the most significant; (n − 3) / 2 at n = 3 of
Tesauro's units taken as n / 2; a board written twice.
"""

from __future__ import annotations

import base64

import numpy as np
import pytest
from backgammon_slowly import Checkers, row, slow_afterstates

from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.rules import (
    MAX_AFTERSTATES,
    ROLL_PROBABILITIES,
    ROLLS,
    START,
    random_game,
    result,
)
from neuralq_envs.backgammon.single_agent import roll_opening


def place(own: Checkers, other: Checkers | None = None) -> Position:
    """The other side's points are counted from its own end; by default one checker on its bar, out of the way."""
    return Position(row(own), row(other or {25: 1}))


def own_after(position: Position, dice: tuple[int, int]) -> list[Checkers]:
    """The mover's checkers in each afterstate, where it is the other side."""
    return [{i + 1: n for i, n in enumerate(after.other) if n} for after in position.afterstates(dice)]


def same(found: list[Checkers], expected: list[Checkers]) -> bool:
    def key(checkers: Checkers) -> list[tuple[int, int]]:
        return sorted(checkers.items())

    return sorted(map(key, found)) == sorted(map(key, expected))


# The other side's point p is the mover's point 25 - p: two checkers there close it.
RULES = {
    # 10/4 and 10/8 are both open, 2 is closed (its 23): only one die can be played, so the larger.
    "larger": (place({10: 1}, {23: 2}), (6, 2), [{4: 1}]),
    # 4 is closed as well (its 21): the smaller is all there is.
    "smaller": (place({10: 1}, {23: 2, 21: 2}), (6, 2), [{8: 1}]),
    # 8 is closed (its 17): both dice can be played, the 6 first.
    "one order": (place({10: 1}, {17: 2}), (6, 2), [{2: 1}]),
    # 2 is closed. 7/6 would leave no six (8/2 closed, and no bearing off with a checker on 8): 8/7 7/1 is forced.
    "both dice": (place({8: 1, 7: 1}, {23: 2}), (6, 1), [{7: 1, 1: 1}]),
    "dance": (place({25: 1, 6: 2}, {4: 2, 3: 2}), (4, 3), [{25: 1, 6: 2}]),
    # A three enters on 22; on 21 (its 4) the four is closed. Entered, the four goes 22/18 or 6/2.
    "bar first": (place({25: 1, 6: 1}, {4: 2}), (4, 3), [{18: 1, 6: 1}, {22: 1, 2: 1}]),
    # Two on the bar, the four is closed: one enters, the other stays, and nothing else may move.
    "two on the bar": (place({25: 2, 6: 1}, {4: 2}), (4, 3), [{25: 1, 22: 1, 6: 1}]),
    "double on the bar": (place({25: 3, 6: 1}), (2, 2), [{23: 2, 21: 1, 6: 1}, {23: 3, 4: 1}]),
    # 24/22/20, then 18 is closed (its 7).
    "half a double": (place({24: 1}, {7: 2}), (2, 2), [{20: 1}]),
    # A double has four moves, not five.
    "double": (place({24: 1}), (2, 2), [{16: 1}]),
    # The six bears off from 6, then the five from the highest point, 4; or 6/1, and then the six from 4.
    "bear off": (place({6: 1, 4: 1, 1: 1}), (6, 5), [{1: 1}, {1: 2}]),
    # While a checker is on 6, the five and the four must move it; then the other die is larger than the highest point.
    "not over those behind": (place({6: 1, 3: 1}), (5, 4), [{1: 1}, {2: 1}]),
    # 6/1 5/4; 6/1 1/off or 6/5/off; 5/off 1/off.
    "exactly": (place({6: 1, 5: 1, 1: 1}), (5, 1), [{4: 1, 1: 2}, {5: 1, 1: 1}, {6: 1}]),
    # 7/6 lets the six bear off, 7/1 the one; or 7/1 6/5.
    "home first": (place({7: 1, 6: 1}), (6, 1), [{6: 1}, {5: 1, 1: 1}]),
    # 1 is closed (its 24). 7/6 lets the five bear off from 5; before that it is 7/2, with 5/4.
    "not from outside": (place({7: 1, 5: 1}, {24: 2}), (5, 1), [{6: 1}, {4: 1, 2: 1}]),
    # Three fives bear off all there is.
    "over before the fourth": (place({5: 3}), (5, 5), [{}]),
}


@pytest.mark.parametrize("name", RULES)
def test_a_position_solved_by_hand(name: str) -> None:
    position, dice, expected = RULES[name]
    found = own_after(position, dice)
    assert same(found, expected), found
    assert same(own_after(position, dice[::-1]), expected)


def test_hitting_sends_the_blot_to_the_bar_and_another_way_may_not_hit() -> None:
    position = place({8: 1}, {20: 1, 2: 1})  # a blot on the mover's 5
    found = {after.own for after in position.afterstates((3, 1))}
    assert found == {row({25: 1, 2: 1}), row({20: 1, 2: 1})}  # 8/5*/4 and 8/7/4
    both = place({8: 1}, {20: 1, 18: 1})  # and one on the 7
    assert {after.own for after in both.afterstates((3, 1))} == {row({25: 1, 18: 1}), row({25: 1, 20: 1})}
    entering = place({25: 1}, {5: 1, 4: 2, 3: 1})  # 21 is closed, so 3 first: bar/22*, and 22/18
    assert [after.own for after in entering.afterstates((4, 3))] == [row({25: 1, 5: 1, 4: 2})]


def test_the_opening_moves_are_the_ones_that_players_know() -> None:
    # With 6-5 "lover's leap" 24/13, and by hand: sixes 24/18, 13/7, 8/2 (6/off no); fives 13/8, 8/3; after 24/18 also
    # 18/13, after 13/7 also 7/2, which is 13/2 either way.
    expected = [
        {24: 1, 13: 6, 8: 3, 6: 5},
        {24: 1, 18: 1, 13: 4, 8: 4, 6: 5},
        {24: 1, 18: 1, 13: 5, 8: 2, 6: 5, 3: 1},
        {24: 2, 13: 3, 8: 4, 7: 1, 6: 5},
        {24: 2, 13: 4, 8: 2, 7: 1, 6: 5, 3: 1},
        {24: 2, 13: 4, 8: 3, 6: 5, 2: 1},
        {24: 2, 13: 5, 8: 1, 6: 5, 3: 1, 2: 1},
    ]
    start = Position.initial()
    assert same(own_after(start, (6, 5)), expected)
    assert all(after.own == start.own and after.turn == 1 for after in start.afterstates((6, 5)))


def test_a_turn_without_a_legal_move_only_passes_the_dice_on() -> None:
    closed_out = place({25: 1, 6: 5}, {1: 2, 2: 2, 3: 2, 4: 2, 5: 2, 6: 2})
    for dice in ROLLS:
        (after,) = closed_out.afterstates(dice)
        assert (after.own, after.other, after.turn) == (closed_out.other, closed_out.own, 1)
        assert after == closed_out.passed() and after != closed_out
        assert after.passed() == closed_out and after.passed().turn == 0


@pytest.mark.parametrize(
    ("loser", "points"),
    [
        ({1: 14}, 1),  # one has been borne off
        ({7: 15}, 2),
        ({18: 1, 1: 14}, 2),  # the winner's 7 point
        ({20: 1, 1: 14}, 3),  # its 5 point
        ({24: 1, 1: 14}, 3),
        ({25: 1, 1: 14}, 3),
        ({25: 1, 1: 13}, 1),
    ],
)
@pytest.mark.parametrize("turn", [0, 1])
def test_the_points_of_a_win(loser: Checkers, points: int, turn: int) -> None:
    last = Position(row({4: 1}), row(loser), turn)
    assert last.winner is None and last.points == 0
    (after,) = last.afterstates((6, 2))
    assert after.winner == turn and after.points == points and result(after.board) == -points
    assert after.passed().winner == turn and after.passed().points == points and result(after.passed().board) == points
    with pytest.raises(ValueError, match=f"the game is over, player {turn} has won"):
        after.afterstates((6, 2))


def by_letter(own: bytes, other: bytes) -> str:
    """The ID as the manual tells it: a string of ones and zeros, packed by hand."""
    bits = "".join("1" * n + "0" for n in [*other, *own]).ljust(80, "0")
    key = bytes(int(bits[i : i + 8][::-1], 2) for i in range(0, 80, 8))
    return base64.b64encode(key).decode()[:14]


def test_position_ids_are_gnu_backgammons() -> None:
    # The first is in the manual of GNU Backgammon ("A technical description of the Position ID"); the second is what
    # it gives after 8/5 6/5, the other side being to move; the third has 15 checkers on the bar and 15 off.
    assert Position.initial().gnubg_id == "4HPwATDgc/ABMA"
    after = Position.from_gnubg_id("sGfwATDgc/ABMA")
    assert after.own == row({24: 2, 13: 5, 8: 3, 6: 5}) and after.other == row({24: 2, 13: 5, 8: 2, 6: 4, 5: 2})
    assert after in Position.initial().afterstates((3, 1))
    lost = Position.from_gnubg_id("AAAAAAAA/v8AAA")
    assert lost.own == row({25: 15}) and lost.off == (0, 15) and (lost.winner, lost.points) == (1, 3)


def positions_of_play(num_positions: int, seed: int) -> list[Position]:
    rng, found, position = np.random.default_rng(seed), [], Position.initial()
    while len(found) < num_positions:
        choices = position.afterstates(tuple(rng.integers(1, 7, size=2).tolist()))
        position = choices[int(rng.integers(len(choices)))]
        position = Position.initial() if position.winner is not None else position
        found.append(position)
    return found


def test_every_position_of_play_survives_its_id() -> None:
    for position in positions_of_play(2000, seed=0):
        text = position.gnubg_id
        assert text == by_letter(position.own, position.other)
        assert Position.from_gnubg_id(text) == position == Position.from_board(position.board)
        assert hash(Position.from_gnubg_id(text, turn=1)) == hash(position)
        assert eval(repr(position)).turn == position.turn and eval(repr(position)) == position


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("4HPwATDgc/ABM", "14 characters"),
        ("4HPwATDgc/ABMA:cAkAAAAAAAAA", "part before the colon|before it"),
        ("4HPwATDgc/ABM!", "14 characters"),
        ("4HPwATDgc/ABM\u00e4", "14 characters"),
        ("4HPwATDgc/ABMB", "14 characters"),  # bits in the last character that belong to no byte
        ("4HPwATDgc/ABcA", "at most 15 checkers"),
        ("4HPwATDgc/ABMI", "14 characters"),
        ("//////////////", "14 characters"),
        ("AAAAAAAAAAAAAA", "one side at most has borne off"),
        ("AACABAAAAAAAAA", "a point belongs to one side"),
        ("AQAA/P8DAAAAAA", "at most 15 checkers"),
    ],
)
def test_an_id_that_is_no_position_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Position.from_gnubg_id(text)


def test_boards_dice_and_players_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 15 checkers"):
        Position(row({6: 16}), row({1: 1}))
    with pytest.raises(ValueError, match="on point 6"):
        place({6: 1}, {19: 2})
    with pytest.raises(ValueError, match=r"\[2, 25\]"):
        Position.from_board(np.zeros((2, 24), dtype=int))
    with pytest.raises(ValueError, match="whole numbers of 0 to 15"):
        Position.from_board(-Position.initial().board)
    with pytest.raises(ValueError, match="turn must be 0 or 1"):
        Position.initial(turn=2)
    for dice in [(0, 1), (1, 7), (1,), (1, 2, 3), (1.5, 2)]:
        with pytest.raises(ValueError, match="dice must be two numbers"):
            Position.initial().afterstates(dice)
    with pytest.raises(ValueError, match="seat must be"):
        Position.initial().text(seat=2)


def compare_with_the_slow_rules(num_turns: int, seed: int) -> None:
    rng, dances, bear_offs = np.random.default_rng(seed), 0, 0
    for i, position in enumerate(positions_of_play(num_turns, seed + 1)):
        dice = tuple(rng.integers(1, 7, size=2).tolist())
        found = position.afterstates(dice)
        assert len(set(found)) == len(found), (position, dice)
        assert slow_afterstates(position, dice, mover_is_white=i % 2 == 0) == set(found), (position, dice)
        dances += position.own[24] > 0 and found[0].other == position.own
        bear_offs += found[0].off[1] > position.off[0]
    assert dances > num_turns // 50 and bear_offs > num_turns // 50


def test_the_rules_are_those_of_the_slow_version() -> None:
    compare_with_the_slow_rules(1500, seed=2)


@pytest.mark.slow
def test_the_rules_are_those_of_the_slow_version_on_many_turns() -> None:
    compare_with_the_slow_rules(10_000, seed=10)


def scattered(rng: np.random.Generator) -> Position:
    """Checkers anywhere: positions that play seldom or never reaches, with stacks, many blots and both bars."""
    rows = np.zeros((2, 25), dtype=np.int64)
    points = rng.permutation(24)
    shared = int(rng.integers(2, 23))
    for side, places in enumerate((points[:shared], 23 - points[shared:])):
        places = np.append(places, 24) if rng.random() < 0.3 else places
        places = places[places < 6] if rng.random() < 0.3 and (places < 6).any() else places
        np.add.at(rows[side], rng.choice(places, size=int(rng.integers(1, 16))), 1)
    return Position.from_board(rows)


def test_the_rules_are_those_of_the_slow_version_where_checkers_lie_anywhere() -> None:
    rng = np.random.default_rng(3)
    for i in range(700):
        position, dice = scattered(rng), tuple(rng.integers(1, 7, size=2).tolist())
        found = position.afterstates(dice)
        assert len(set(found)) == len(found)
        assert slow_afterstates(position, dice, mover_is_white=i % 2 == 0) == set(found), (position, dice)


def test_no_turn_found_by_climbing_comes_near_the_size_of_the_buffer() -> None:
    # Fifteen blots in front of an empty board: many ways to play a double, still far from the bound C(18, 4).
    blots = place({point: 1 for point in range(10, 25)})
    counts = [len(blots.afterstates((die, die))) for die in range(1, 7)]
    assert 1000 < max(counts) < MAX_AFTERSTATES == 18 * 17 * 16 * 15 // 24


def mirrored_inputs(x: np.ndarray) -> np.ndarray:
    """The inputs of the same board with the players exchanged: two blocks of 98, and who is to move."""
    return np.concatenate([x[98:196], x[:98], x[197:], x[196:197]])


def test_exchanging_the_players_exchanges_nothing_else() -> None:
    for position in positions_of_play(300, seed=5):
        mirror = position.mirrored()
        assert mirror == position and mirror.turn == 1 - position.turn and mirror.mirrored().turn == position.turn
        assert np.array_equal(mirror.inputs(), mirrored_inputs(position.inputs()))
        found, reflected = position.afterstates((6, 3)), mirror.afterstates((6, 3))
        assert found == reflected and all(a.turn == 1 - b.turn for a, b in zip(found, reflected, strict=True))
        assert position.text(seat=0).replace("O", "_").replace("X", "O").replace("_", "X") == mirror.text(seat=1)


def test_tesauros_units_by_hand() -> None:
    x = Position(row({1: 1, 2: 2, 3: 3, 4: 4, 25: 2}), row({6: 7}), turn=1).inputs()
    expected = np.zeros(198)
    expected[98:114] = [1, 0, 0, 0, 1, 1, 0, 0, 1, 1, 1, 0, 1, 1, 1, 0.5]  # player 1's points 1 to 4
    expected[98 + 96 :] = [1, np.float32(3 / 15), 0, 1]  # two on the bar, three off; player 1 is to move
    expected[20:24], expected[97] = [1, 1, 1, 2], np.float32(8 / 15)  # player 0's seven checkers
    assert x.tolist() == expected.tolist()


@pytest.mark.slow
def test_a_random_player_plays_to_the_end_and_both_sides_win_equally_often() -> None:
    out, rng = np.empty((MAX_AFTERSTATES, 2, 25), np.int8), np.random.default_rng(6)
    games = np.array([random_game(START, rng, out) for _ in range(4000)])
    points, turns = games[:, 0], games[:, 1]
    assert set(np.abs(points).tolist()) == {1, 2, 3}
    # Four standard errors; moving first is worth little in a random game, and 96 turns is what an independent
    # implementation of random play has measured (97 plies).
    assert abs(points.mean()) < 4 * points.std() / np.sqrt(4000) + 0.05
    assert abs(turns.mean() - 97) < 4 * turns.std() / np.sqrt(4000) + 0.5


def test_the_rolls_are_21_and_their_probabilities_make_one() -> None:
    assert len(set(ROLLS)) == 21 and sum(ROLL_PROBABILITIES) == pytest.approx(1)
    chances = dict(zip(ROLLS, ROLL_PROBABILITIES, strict=True))
    assert chances[3, 3] == 1 / 36 and chances[6, 5] == 2 / 36
    rng = np.random.default_rng(7)
    starts = [roll_opening(rng) for _ in range(2000)]
    assert all(mine != theirs and (mine > theirs) == (player == 0) for player, (mine, theirs) in starts)
    assert abs(np.mean([player for player, _ in starts]) - 0.5) < 4 * 0.5 / np.sqrt(2000)
