"""Checkers that learns from backed-up scores and by rote, and what it must reach.

Mutants that die here: terms of the position now instead of the one before, of the other side's, a step size
that does not fall; alpha and beta exchanged or not turned round, a search that ends amid captures; a term of a row
beside it or of the other side's view; a win that is worth more when it is further away, or counted from the root where
it is remembered; a score taken from a shallower search, or for a position that only hashes alike.
"""

from __future__ import annotations

import itertools
from typing import Any

import checkers_slowly
import numpy as np
import pytest
from test_checkers import kings_at_random

from neuralq.systems import run_system, system_named
from neuralq.systems.checkers.kernels import new_game, play_positions
from neuralq.systems.checkers.memory import find, new_memory, remember
from neuralq.systems.checkers.oracle import difference_from_alpha_beta, difference_of_remembered, positions_of_games
from neuralq.systems.checkers.player import LEARNED, CheckersPlayer
from neuralq.systems.checkers.search import new_desk, search, shifted_score
from neuralq.systems.checkers.system import learned
from neuralq.systems.checkers.terms import MATERIAL_ONLY, NUM_TERMS, TERMS, write_terms
from neuralq.systems.checkers.terms import evaluate as weighed
from neuralq.systems.checkers.training import carry_out, new_program, pieces_at_random, play_match, study, train
from neuralq.tabular import new_stream
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.checkers import Position

# ---- checkers


def test_terms_are_those_counted_on_coordinates_and_turn_with_the_board() -> None:
    rng, terms = np.random.default_rng(3), np.zeros(NUM_TERMS)
    seen = np.zeros(NUM_TERMS)
    boards = [kings_at_random(rng) for _ in range(300)]
    for position in [*boards, *(one for plies in range(1, 40, 3) for one in positions_of_games(5, plies, plies))]:
        write_terms(position.own, position.other, position.kings, terms)
        slow = checkers_slowly.terms(checkers_slowly.read(position.fen))
        assert np.allclose(terms, slow, rtol=0, atol=1e-12), (position.fen, dict(zip(TERMS, terms - slow, strict=True)))
        seen += np.abs(terms)
        other = Position.from_fen("WB"[position.fen[0] == "W"] + position.fen[1:])
        turned = terms.copy()
        write_terms(other.own, other.other, other.kings, terms)
        assert np.allclose(terms, -turned, rtol=0, atol=1e-12)
        weights = rng.normal(size=NUM_TERMS)
        value = weighed(other.own, other.other, other.kings, weights, np.zeros(NUM_TERMS))
        assert value == pytest.approx(-weights @ turned)
    assert (seen > 0).all()


def test_the_search_is_alpha_beta_over_positions_and_a_memory_falsifies_nothing() -> None:
    for depth, plies in ((1, 12), (2, 45), (4, 30)):
        assert difference_from_alpha_beta(8, plies, depth) < 1e-12
    assert difference_of_remembered(6, 2, 3) < 1e-12
    weights, none, desk, stream = MATERIAL_ONLY.copy(), new_memory(0), new_desk(), new_stream(0)
    for start in positions_of_games(5, 8, seed=9):
        board, junk = (start.own, start.other, start.kings), {}
        for depth in (2, 3):  # of what is remembered of the positions after one ply
            memory = new_memory(64)
            for move in start.moves():
                remember(memory, move.position.own, move.position.other, move.position.kings, depth, -7.5)
            junk[depth] = search(*board, 4, weights, 0.01, memory, desk, stream)
        assert junk == {2: search(*board, 4, weights, 0.01, none, desk, stream), 3: 7.5}
    memory = new_memory(64)
    for i in range(200):  # 56 of them find room
        remember(memory, 1 + i, 1 << 20, 0, 2, float(i))
    assert memory.size[0] == 56 and find(memory, 57, 1 << 20, 0, 0) == -1
    assert all(memory.scores[find(memory, 1 + i, 1 << 20, 0, 2)] == i for i in range(56))
    remember(memory, 1, 1 << 20, 0, 1, 9.0)
    assert memory.scores[find(memory, 1, 1 << 20, 0, 2)] == 0.0 and find(memory, 1, 1 << 20, 0, 3) == -1
    remember(memory, 1, 1 << 20, 0, 3, 9.0)
    assert memory.scores[find(memory, 1, 1 << 20, 0, 3)] == 9.0
    assert [shifted_score(x, 3, 0.01) for x in (99.0, -99.0, 12.0)] == [98.97, -98.97, 12.0]


def test_a_win_says_how_far_away_it_is_and_so_does_a_remembered_one() -> None:
    near = Position.from_fen("B:W13:B6,K24")  # 6-9 13x6 would lose a man; other moves trap 13
    desk, stream, none = new_desk(), new_stream(0), new_memory(0)
    for fen, plies in (("B:W5:B1,K14", None), ("B:WK18:BK10,K27,K26", None), (near.fen, 3)):
        one = Position.from_fen(fen)
        board = one.own, one.other, one.kings
        score = search(*board, 9, MATERIAL_ONLY, 0.01, none, desk, stream)
        expected = checkmate(checkers_slowly.read(fen), 9)
        if expected is not None:
            assert score == pytest.approx(100 - 0.01 * expected) and plies in (None, expected)
        if expected is not None and expected > 2:
            memory = new_memory(1 << 12)
            for first in one.moves():
                for second in first.position.moves():
                    after = second.position
                    board_after = after.own, after.other, after.kings
                    remember(memory, *board_after, 7, search(*board_after, 7, MATERIAL_ONLY, 0.01, none, desk, stream))
            assert search(*board, 2, MATERIAL_ONLY, 0.01, memory, desk, stream) == pytest.approx(score, abs=1e-9)


def checkmate(board: checkers_slowly.Board, most: int) -> int | None:
    """In how many plies the side to move wins, if the other side holds out as long as it can; None for not at all."""
    ways = list(checkers_slowly.moves(board).values())
    for plies in range(1, most + 1, 2):
        if any(_is_lost(after, plies - 1) for after in ways):
            return plies
    return None


def _is_lost(board: checkers_slowly.Board, plies: int) -> bool:
    ways = list(checkers_slowly.moves(board).values())
    if not ways:
        return True
    return plies > 0 and all(checkmate(after, plies - 1) is not None for after in ways)


def test_the_compiled_games_are_those_of_a_loop_over_positions() -> None:
    num_games, epsilon = 3, 0.1
    ours = train(5, num_games, depth=2, step_sizes=(0.01, 0.0025), epsilon=epsilon)
    stream, desk, none, weights = new_stream(5), new_desk(), new_memory(0), MATERIAL_ONLY.copy()
    for game, step_size in enumerate((0.01, 0.005, 0.0025)):
        position, quiet, earlier = Position.initial(), 0, list[Any]()
        for ply in itertools.count(-4):
            ways = position.moves()
            if not ways or quiet >= 40:
                break
            if ply < 0:
                move = ways[int(len(ways) * uniform(stream))]
            else:
                board = position.own, position.other, position.kings
                score = search(*board, 2, weights, 0.01, none, desk, stream)
                if len(earlier) >= 2 and abs(score) <= 50:
                    terms = earlier[-2]
                    error = max(-12.0, min(12.0, score)) - float(weights @ terms)
                    weights[1:] += step_size * error * terms[1:]
                after = desk.moves[0, : len(ways), :3].tolist()
                by_board = {(one.position.own, one.position.other, one.position.kings): one for one in ways}
                shuffled = [by_board[own, other, kings] for own, other, kings in after]
                earlier.append(np.array(checkers_slowly.terms(checkers_slowly.read(position.fen))))
                best = desk.scores[: len(ways)].tolist().index(score)
                random = uniform(stream) < epsilon
                move = shuffled[int(len(ways) * uniform(stream))] if random else shuffled[best]
            is_king = position.pieces()[move.squares[0]][1]
            quiet = quiet + 1 if is_king and not move.taken else 0
            position = move.position
        assert np.allclose(ours[game], weights, rtol=0, atol=1e-12)
    assert np.abs(ours[-1] - MATERIAL_ONLY).max() > 0.01 and ours[-1][0] == 1.0


def test_a_player_ranks_moves_by_exact_scores_and_refuses_what_makes_no_sense() -> None:
    player = CheckersPlayer(depth=4, seed=0)
    for position in positions_of_games(10, 15, seed=4):
        ranked = player.ranked(position)
        assert ranked[0].score == pytest.approx(player.score(position))
        assert sorted(one.score for one in ranked)[::-1] == [one.score for one in ranked]
        assert {str(one.move) for one in ranked} == {str(move) for move in position.moves()}
    for wrong, says in (
        ({"depth": 1}, "depth must be a whole number of at least 2"),
        ({"depth": 21}, r"depth must lie in 2\.\.20, got 21"),
        ({"weights": [1.0]}, "weights must be 14 finite numbers"),
        ({"weights": [np.nan] * 14}, "weights must be 14 finite numbers"),
    ):
        with pytest.raises(ValueError, match=says):
            CheckersPlayer(**wrong)


# ---- what it must reach, and must not


@pytest.mark.slow
def test_learned_weights_beat_the_count_of_pieces_and_weights_at_random_do_not() -> None:
    matches = [learned(seed).match for seed in range(3)]
    scores = [match.score for match in matches]
    assert np.mean(scores) >= 0.64 and min(scores) >= 0.60
    assert sum(match.counts[2] for match in matches) <= 0.10 * sum(match.results.size for match in matches)
    assert np.allclose(train(0)[250:].mean(axis=0), LEARNED, rtol=0, atol=1e-6)  # what is shipped
    rng = np.random.default_rng(0)
    for seed in range(3):
        weights = np.append(1.0, rng.normal(size=NUM_TERMS - 1))
        assert play_match(new_program(weights), new_program(), seed).score < 0.5  # the control that must fail


def test_the_ply_penalty_takes_the_nearer_win_and_keeps_its_word() -> None:
    found = carry_out(11)
    mean = {penalty: one.plies.mean() for penalty, one in found.endgames.items()}
    assert len(found.announced) > 150 and all(one.won >= 0.99 for one in found.endgames.values())
    assert mean[0.01] <= 4.3 and mean[0.01] <= 0.8 * mean[0.0] < mean[-0.01]
    assert (found.endgames[0.01].plies <= found.announced).all()
    assert (found.endgames[0.0].plies > found.announced).mean() > 0.1


@pytest.mark.slow
def test_rote_learning_wins_more_and_looks_at_less_and_wanders_without_the_penalty() -> None:
    for seed in (21, 22):
        tests, wandering = study(seed), study(seed, 0.0)
        assert tests[-1].won >= tests[0].won + 0.2 and tests[-1].won >= 0.9
        assert tests[-1].nodes <= 0.5 * tests[0].nodes
        assert wandering[-1].won <= tests[-1].won - 0.2
        assert wandering[-1].won <= wandering[1].won  # and more of it does not help
    # What is remembered is what was searched.
    memory, program = new_memory(1 << 12), new_program()
    pupil, boards = program._replace(memory=memory, remembers=True), pieces_at_random(40, 5)
    for board in boards.tolist():
        play_positions(new_game(), np.array([board]), pupil, program, 1, new_stream(0), *np.zeros((2, 1), np.int64))
    for own, other, kings in boards.tolist():
        place = find(memory, own, other, kings, 3)
        score = search(own, other, kings, 3, program.weights, 0.01, new_memory(0), new_desk(), new_stream(1))
        assert memory.scores[place] == score


@pytest.mark.slow
def test_the_page_says_so() -> None:
    found = run_system(system_named("checkers"), 1)
    verdicts = {row.what: row.verdict for row in found.rows}
    assert not found.wrong and verdicts["a memory without the ply penalty wanders"] == "agrees"
    assert verdicts["rote learning plays better, looking no further"] == "agrees"
    median = {one.what: one.median for one in found.measured}
    assert median["random weights: score against pieces alone, 3 plies"] < 0.5
