"""The rules of checkers, its positions and its environment, against a version on coordinates and the known perft.

Mutants that die here: a direction exchanged or one bit further, the rim forgotten, a capture that is not forced, that
stops early, that goes on after a man is crowned, jumps the same piece twice or cannot come back to where it began; men
that move backwards, kings that do not; a man crowned a row early; the wrong side to move; squares counted from the
other corner for white; a draw a ply early or late, a step of a man counted as quiet; a reward of the wrong sign; 13
men.
"""

from __future__ import annotations

import re
from typing import Any

import checkers_slowly
import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import neuralq_envs
from neuralq_envs.checkers import Position
from neuralq_envs.checkers.rules import MAX_MOVES, START, jumpers, moves, perft, turned
from neuralq_envs.checkers.single_agent import CheckersEnv

neuralq_envs.register()


def test_ways_to_play_are_the_known_numbers() -> None:
    # Aart Bik's and Cake's perft of English draughts.
    known = [7, 49, 302, 1469, 7361, 36768, 179740, 845931, 3963680]
    assert [perft(*START, depth) for depth in range(1, 10)] == known


def kings_at_random(rng: np.random.Generator) -> Position:
    """Few pieces, many of them kings: boards in which captures go on."""
    squares = rng.permutation(np.arange(1, 33))[: rng.integers(5, 13)].tolist()
    sides: dict[str, list[str]] = {"B": [], "W": []}
    for number in squares:
        side = "BW"[rng.integers(2)]
        must = number >= 29 if side == "B" else number <= 4
        sides[side].append(f"{'K' * bool(must or rng.random() < 0.5)}{number}")
    return Position.from_fen(f"{'BW'[rng.integers(2)]}:W{','.join(sides['W'])}:B{','.join(sides['B'])}")


def same(position: Position) -> int:
    """Moves, all of which are those of the slow rules and leave what those leave."""
    slow = checkers_slowly.moves(checkers_slowly.read(position.fen))
    found = {move.squares: checkers_slowly.read(move.position.fen) for move in position.moves()}
    assert found == slow, position.fen
    return len(found)


def test_moves_are_those_of_the_rules_written_on_coordinates() -> None:
    rng = np.random.default_rng(0)
    longest = 0
    for _ in range(3):
        position = Position.initial()
        while same(position):
            ways = position.moves()
            position = ways[rng.integers(len(ways))].position
    for _ in range(200):
        position = kings_at_random(rng)
        same(position)
        longest = max([longest, *(len(move.taken) for move in position.moves())])
    assert longest >= 3


@pytest.mark.parametrize(
    ("fen", "expected"),
    [
        ("B:W6,7,14,15:BK2", ["2x11x18x9x2", "2x9x18x11x2"]),  # round the four and home
        ("B:W22,25,26:B18", ["18-23"]),  # where 22 would be jumped to there is another
        ("B:W26,27:B22", ["22x31"]),  # crowned, and 27 is not jumped
        ("B:W26,27:BK22", ["22x31x24"]),
        ("B:W18:B14,1", ["14x23"]),  # capturing is forced
        ("W:W5:B1", []),
    ],
)
def test_captures_go_on_come_home_and_end_at_the_crown(fen: str, expected: list[str]) -> None:
    assert sorted(str(move) for move in Position.from_fen(fen).moves()) == expected
    if not expected:
        assert Position.from_fen(fen).winner == 0


def test_no_board_overflows_the_room_for_moves() -> None:
    """A king's captures are trails in a graph of landing squares; 16 is the most from any square, over all graphs."""
    most = 0
    for corner in ((0, 1), (1, 0), (1, 2), (0, 3)):
        reached, frontier, edges = {corner}, [corner], set()
        while frontier:
            row, column = frontier.pop()
            for to in [(row + i, column + j) for i in (-2, 2) for j in (-2, 2)]:
                if checkers_slowly.on_board(*to):
                    edges.add(frozenset([(row, column), to]))
                    frontier += [to] if to not in reached else []
                    reached.add(to)
        for start in reached:
            for kept in range(1 << len(edges)):
                there = [one for i, one in enumerate(sorted(edges, key=sorted)) if kept >> i & 1]
                most = max(most, _trails(there, start))
    assert most == 16 and max(12 * most, 48) <= MAX_MOVES


def _trails(edges: list[frozenset[tuple[int, int]]], at: tuple[int, int], used: frozenset[int] = frozenset()) -> int:
    ways = [i for i, edge in enumerate(edges) if at in edge and i not in used]
    return sum(_trails(edges, next(iter(edges[i] - {at})), used | {i}) for i in ways) or bool(used)


def test_a_position_is_written_and_read() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        position = kings_at_random(rng)
        assert Position.from_fen(position.fen) == position
        assert turned(turned(position.own)) == position.own
    assert Position.initial().fen == "B:W21,22,23,24,25,26,27,28,29,30,31,32:B1,2,3,4,5,6,7,8,9,10,11,12"
    drawn = str(Position.from_fen("W:WK1,32:B4,K29")).splitlines()
    assert drawn[0] == ". W . . . . . b" and drawn[7] == "B . . . . . w ." and drawn[8] == "white to move"


MEN = ",".join(map(str, range(1, 14)))


@pytest.mark.parametrize(
    ("fen", "says"),
    [
        (f"B:W32:B{MEN}", "a side has at most 12 pieces, got 13 of black"),
        (f"W:B32:W{','.join(map(str, range(20, 33)))}", "a side has at most 12 pieces, got 13 of white"),
        ("B:W9:B9", "a square belongs to one side, got pieces of both on 9"),
        ("B:W9,9:B1", "a square holds one piece, got 9 twice for white"),
        ("B:W33:B1", "squares are 1 to 32, with a K before them for a king, got '33'"),
        ("B:W-3:B1", "squares are 1 to 32"),
        ("B:W٣:B1", "squares are 1 to 32"),
        ("B:W9:W1", "a position must be written like"),
        ("nonsense" * 20, "a position must be written like 'B:W21,22,K30:B1,2,K15'"),
    ],
)
def test_a_board_that_is_none_gets_one_clear_error(fen: str, says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(says)) as refused:
        Position.from_fen(fen)
    assert len(str(refused.value)) < 200 and "\n" not in str(refused.value)


def test_the_ways_out_that_errors_name_lead_out() -> None:
    for fen, square in (("B:W9:B31", "31"), ("W:W4:B9", "4"), ("B:W4:B9", "4")):
        with pytest.raises(ValueError, match="a man on its last row is a king") as refused:
            Position.from_fen(fen)
        written = re.search(r"write (K\d+) instead of (\d+)", str(refused.value))
        assert written is not None and written[2] == square
        Position.from_fen(fen.replace(square, written[1]))
    example = "B:W21,22,K30:B1,2,K15"
    assert Position.from_fen(example).fen == example
    with pytest.raises(ValueError, match="black, the learner, must be to move") as refused:
        CheckersEnv().reset(options={"position": "W:W32:B1"})
    assert str(refused.value).endswith("make the environment with player='white'")
    CheckersEnv(player="white").reset(options={"position": "W:W32:B1"})
    for bits, says in (
        ((1 << 8, 0, 0), "no squares"),
        ((1, 2, 4), "kings must be pieces"),
        ((1, 2, 0, 2), "turn must"),
    ):
        with pytest.raises(ValueError, match=says):
            Position(*bits)


# ---- the environment


@pytest.mark.parametrize("player", ["black", "white"])
def test_the_environment_passes_gymnasiums_check(player: str) -> None:
    check_env(gymnasium.make("neuralq/Checkers-v0", player=player).unwrapped)


def first(position: Position) -> Any:
    return position.moves()[0]


def test_a_capture_of_two_is_two_actions_and_then_the_opponent_answers() -> None:
    env = CheckersEnv(first, render_mode="ansi")
    seen, extra = env.reset(options={"position": "B:W9,18,30:B5"})
    # Square 5 is the learner's number 4; up to the left is 1. Both jumps go the same way.
    assert np.flatnonzero(extra["action_mask"]).tolist() == [17]
    assert seen.reshape(-1)[:160].reshape(5, 32).sum(axis=1).tolist() == [1, 0, 3, 0, 0]
    same_seen, reward, over, _, _ = env.step(np.int64(16))  # illegal
    assert (same_seen == seen).all() and reward == 0 and not over
    seen, reward, over, _, extra = env.step(np.int64(17))
    planes = seen[:160].reshape(5, 32)
    assert (reward, over) == (0.0, False) and planes[0].nonzero()[0].tolist() == [13] == planes[4].nonzero()[0].tolist()
    assert planes[2].nonzero()[0].tolist() == [17, 29] and np.flatnonzero(extra["action_mask"]).tolist() == [4 * 13 + 1]
    seen, reward, over, _, extra = env.step(np.int64(4 * 13 + 1))
    assert extra["position"].fen == "B:W26:B23" and not over and seen[:160].reshape(5, 32)[4].sum() == 0
    assert env.render().splitlines()[-1] == "black to move"


def test_the_end_pays_and_a_step_after_it_is_refused() -> None:
    env = CheckersEnv(first, player="white", render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        env.step(np.int64(0))
    _, extra = env.reset(options={"position": "W:WK18:B14"})
    (action,) = np.flatnonzero(extra["action_mask"])
    assert env.step(action)[1:4] == (1.0, True, False)
    assert env.render().shape == (384, 384, 3)
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(action)
    env = CheckersEnv(first)
    _, extra = env.reset(options={"position": "B:W16:B7"})  # 7-11 16x7
    assert env.step(np.int64(4 * 6 + 1))[1:3] == (-1.0, True)


def test_quiet_plies_make_a_draw_and_a_mans_step_begins_anew() -> None:
    def back_and_forth(position: Position) -> Any:
        return min(position.moves(), key=lambda move: move.squares)

    env = CheckersEnv(back_and_forth, most_quiet_plies=5)
    seen, extra = env.reset(options={"position": "B:WK32:B1,K5"})
    assert seen[160] == 0
    for ply in (2, 4):
        king = next(a for a in np.flatnonzero(extra["action_mask"]) if seen[32 + a // 4])
        seen, _, over, _, extra = env.step(king)
        assert seen[160] == np.float32(ply / 5) and not over
    man = next(a for a in np.flatnonzero(extra["action_mask"]) if seen[a // 4])
    counted, _, over, _, _ = env.step(man)
    assert counted[160] == np.float32(1 / 5) and not over  # the opponent's king alone
    env.reset(options={"position": "B:WK32:B1,K5"})
    quiet = [env.step(next(a for a in np.flatnonzero(env._seen()[1]["action_mask"]) if env._seen()[0][32 + a // 4]))]
    while not quiet[-1][2]:
        quiet.append(env.step(np.flatnonzero(env._seen()[1]["action_mask"])[-1]))
    assert len(quiet) == 3 and quiet[-1][1:3] == (0.0, True)


@pytest.mark.parametrize("num_steps", [1000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_pieces_are_conserved_for_many_random_steps(num_steps: int) -> None:
    env, rng = CheckersEnv(), np.random.default_rng(0)
    ended = []
    seen, extra = env.reset(seed=0)
    before, taken = [12, 12], 0
    for _ in range(num_steps):
        legal = np.flatnonzero(extra["action_mask"])
        seen, reward, over, cut, extra = env.step(rng.choice(legal))
        planes = seen[:160].reshape(5, 32)
        pieces = [int(planes[:2].sum()), int(planes[2:4].sum())]
        assert (planes.sum(axis=0) - planes[4] <= 1).all() and not planes[0, 28:].any() and not planes[2, :4].any()
        assert all(0 <= now <= was for now, was in zip(pieces, before, strict=True)) and not cut
        taken += sum(before) - sum(pieces)
        before = pieces
        assert bool(extra["action_mask"].any()) != over and (reward != 0) <= over
        if over:
            assert taken == 24 - sum(pieces)
            ended.append(reward)
            seen, extra = env.reset()
            before, taken = [12, 12], 0
    assert {1.0, -1.0} <= set(ended)


def test_jumpers_are_those_that_can_capture() -> None:
    rng = np.random.default_rng(2)
    out = np.empty((MAX_MOVES, 5), np.int64)
    for _ in range(100):
        one = kings_at_random(rng)
        found = jumpers(one.own, one.other, one.kings)
        count = moves(one.own, one.other, one.kings, out)
        assert bool(found) == any(move.taken for move in one.moves())
        assert not found or found == int(np.bitwise_or.reduce(out[:count, 3]))
