"""Learning backgammon: the compiled kernels against slow readable NumPy, and against PyTorch with the project's rules.

Mutants that die here, each tried: in `play_online`, the view turned by (k + 1) mod K, the sign of the single output
dropped, traces kept between games, traces that fade before they are used, the trace of an input dropped at 1e-3 rather
than 1e-12, the old value computed after the turn; in `play_batch`, returns not turned around, λ and 1 − λ exchanged,
the value of the wrong side of the turn mixed in; the best afterstate for the other side chosen; a gammon settled as a
plain game; an opening roll that may be a double; a state that shares the optimiser's memory. In the torch engine: no
fading, the view of the wrong side, lockstep in which finished games play on, the last row's return not cut.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from backgammon_learning_slowly import (
    batch,
    best_afterstate,
    boards_of_random_games,
    drawn,
    online,
    play_in_turn,
    sigmoid,
    slow_batch,
    slow_choice,
    slow_gradients,
    slow_online,
    slow_outcome,
    slow_outputs,
    slow_roll,
    worst,
)

from neuralq.systems.backgammon import BackgammonAgent, SelfPlay, SelfPlaySettings, ValueNetwork, kernels, torch_engine
from neuralq.systems.backgammon.network import equities
from neuralq.systems.backgammon.torch_engine import TorchBatch, TorchValues
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.inputs import tesauro_dense
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, afterstates, result, roll

# Values and choices.


def test_the_slow_gradients_are_differences() -> None:
    board = boards_of_random_games(400, np.random.default_rng(0))[-1]
    for num_outputs in (1, 4, 6):
        net = drawn(num_outputs, 2)
        _, grads = slow_gradients(net, board)
        for i in range(net.flat.size):
            kept = net.flat[i]
            net.flat[i] = kept + 1e-5
            above = slow_outputs(net, board[None])[0][0]
            net.flat[i] = kept - 1e-5
            below = slow_outputs(net, board[None])[0][0]
            net.flat[i] = kept
            assert worst((above - below) / 2e-5, grads[:, i]) < 1e-9


@pytest.mark.parametrize("num_outputs", [1, 4, 6])
@pytest.mark.slow
def test_values_and_choices_are_those_of_all_inputs(num_outputs: int) -> None:
    rng = np.random.default_rng(2)
    boards = boards_of_random_games(3000, rng)
    going_on = np.array([result(board) == 0 for board in boards])
    assert not going_on.all()
    exact, rounded = drawn(num_outputs), drawn(num_outputs, dtype=np.float32)
    y = exact.outputs(boards)
    assert worst(y[going_on], slow_outputs(exact, boards[going_on])[0]) < 1e-14
    for board, found in zip(boards[~going_on], y[~going_on], strict=True):
        assert (found == slow_outcome(result(board), num_outputs)).all()
    assert worst(rounded.outputs(boards)[going_on], slow_outputs(rounded, boards[going_on])[0]) < 2e-6
    for i in rng.choice(np.flatnonzero(going_on), 150):
        dice = int(rng.integers(1, 7)), int(rng.integers(1, 7))
        position = Position.from_board(boards[i])
        assert Position.from_board(best_afterstate(exact, boards[i], *dice)) == slow_choice(exact, position, dice)


def test_the_sigmoid_of_float32_is_wrong_by_less_than_5e_7() -> None:
    z = np.linspace(-30, 30, 60_001, dtype=np.float32)
    found = z.copy()
    kernels._sigmoids(found)
    assert worst(found, sigmoid(z)) < 5e-7 and 0 <= found.min() and found.max() <= 1


def test_who_ends_a_game_gets_what_it_is_worth() -> None:
    own = [0] * 24
    lost = {
        1: [1, *own],
        2: [15, *own],
        3: [14, *own[:-2], 1, 0],
    }  # on its ace point; none off; one in the other's home
    for points, row in lost.items():
        board = np.array([row, [0] * 25], np.int8)  # the side to move has lost
        for seen, sign in ((board, -1), (board[::-1].copy(), 1)):
            for num_outputs in (1, 4, 6):
                net = drawn(num_outputs)
                assert (net.outputs(seen[None])[0] == slow_outcome(sign * points, num_outputs)).all()
                found = torch_engine.outcome(torch.tensor([sign * points]), num_outputs, torch.float64)
                assert (found[0].numpy() == slow_outcome(sign * points, num_outputs)).all()
                expected = sign * points
                assert BackgammonAgent(net).equity(Position.from_board(seen)) == expected


def check_symmetry(num_boards: int) -> None:
    """One side's chances are what the other's would be with the players exchanged: on a board that neither owns."""
    boards = boards_of_random_games(num_boards, np.random.default_rng(3))
    points = np.zeros((num_boards, 26), np.int8)  # 1 to 24 from player 0's side; its checkers count positive
    points[:, 1:25] = boards[:, 0, :24] - boards[:, 1, 23::-1]
    exchanged = -points[:, ::-1]  # player 1 stands where player 0 stood, as seen from the other end, and is to move
    theirs = np.stack([np.maximum(-exchanged[:, 24:0:-1], 0), np.maximum(exchanged[:, 1:25], 0)], 1)
    again = np.concatenate([theirs, boards[:, :, 24:]], 2)
    net = drawn(4, 40, dtype=np.float32)
    found, order = net.outputs(boards), np.random.default_rng(4).permutation(num_boards)
    assert (net.outputs(again[order]) == found[order]).all()
    agent = BackgammonAgent(net)
    for i in range(0, num_boards, num_boards // 100):
        position = Position.from_board(boards[i])
        mirrored = position.mirrored()
        assert mirrored.turn == 1 and agent.equity(mirrored) == agent.equity(position)
        assert (mirrored.inputs()[:98] == position.inputs()[98:196]).all()
    passed = net.outputs(boards[:, ::-1])
    assert (equities(passed) != -equities(found)).mean() > 0.9  # but who is to move matters


def test_the_value_does_not_know_which_player_moves() -> None:
    check_symmetry(100_000)


@pytest.mark.slow
def test_the_value_of_a_million_positions_does_not_know_which_player_moves() -> None:
    check_symmetry(1_000_000)


# Both views against the slow version and against hand arithmetic.


@pytest.mark.parametrize(("lambda_", "num_outputs"), [(0.0, 4), (0.7, 1), (0.7, 6), (1.0, 4)])
@pytest.mark.slow
def test_both_views_equal_the_slow_ones(lambda_: float, num_outputs: int) -> None:
    rates = np.array([0.2, 0.1])
    fast, slow = drawn(num_outputs), drawn(num_outputs)
    grad, tally = batch(fast, 2, lambda_, np.random.default_rng(5))
    slow_grad = slow_batch(slow, 2, lambda_, np.random.default_rng(5))
    assert tally[:3].sum() == 2 and worst(grad, slow_grad) < 1e-11 * max(1.0, abs(slow_grad).max())
    online(fast, rates, lambda_, np.random.default_rng(6))
    slow_online(slow, rates, lambda_, np.random.default_rng(6))
    assert worst(fast.flat, slow.flat) < 1e-11 and worst(fast.flat, drawn(num_outputs).flat) > 1e-3


@pytest.mark.parametrize("mistake", [{"by": 1}, {"by": 3}, {"by": 0}, {"keep": True}])
def test_the_slow_version_notices_mistakes(mistake: dict[str, int]) -> None:
    rates = np.full(2, 0.01)
    fast, slow = drawn(4), drawn(4)
    online(fast, rates, 0.9, np.random.default_rng(6))
    slow_online(slow, rates, 0.9, np.random.default_rng(6), **mistake)  # type: ignore[arg-type]
    assert worst(fast.flat, slow.flat) > 1e-5


@pytest.mark.parametrize("lambda_", [0.0, 0.5, 1.0])
def test_one_game_from_weights_of_zero_is_hand_arithmetic(lambda_: float) -> None:
    """All values are ½ and only the last turn is a surprise, of ½. So with s = ±1 for whoever moved first or second,
    the bias gets Σₜ λ^(T−1−t) · ½ · s_T s_t · ¼ = ⅛ (1 − (−λ)^T) / (1 + λ), and v half of that, for h = ½."""
    for seed in range(4):
        net = ValueNetwork(1, 1)
        grad, tally = batch(net, 1, lambda_, np.random.default_rng(seed))
        expected = (1 - (-lambda_) ** int(tally[3])) / (1 + lambda_) / 8
        assert grad[-2:] == pytest.approx([expected / 2, expected], abs=1e-7) and not grad[:-2].any()
        online(net, np.array([0.01]), lambda_, np.random.default_rng(seed))  # in the first player's view throughout
        assert net.flat[-2:] == pytest.approx([0.01 * expected / 2, 0.01 * expected], abs=1e-8)
        four = ValueNetwork(1, 4)
        grad, tally = batch(four, 1, 0.0, np.random.default_rng(seed))
        won = slow_outcome(1 + int(np.argmax(tally[:3])), 4)
        assert grad[-4:] == pytest.approx((won - 0.5) / 4, abs=1e-7)


@pytest.mark.parametrize("num_outputs", [1, 4])
@pytest.mark.parametrize("lambda_", [0.0, 0.6, 1.0])
@pytest.mark.slow
def test_the_backward_view_is_the_forward_view_when_steps_are_small(lambda_: float, num_outputs: int) -> None:
    before, net, small = drawn(num_outputs), drawn(num_outputs), 1e-7
    grad, _ = batch(net, 3, lambda_, np.random.default_rng(7))
    online(net, np.full(3, small), lambda_, np.random.default_rng(7))
    assert worst((net.flat - before.flat) / small, grad) < 1e-4 * np.abs(grad).max()


def test_the_opening_roll_is_no_double() -> None:
    rng = np.random.default_rng(0)
    openings = [roll(rng, True) for _ in range(3000)]
    later = [roll(rng, False) for _ in range(3000)]
    assert len(set(openings)) == 30 and all(a != b for a, b in openings)
    assert len(set(later)) == 36 and abs(sum(a == b for a, b in later) / 3000 - 1 / 6) < 5 * np.sqrt(5 / 36 / 3000)
    rng_a, rng_b = np.random.default_rng(1), np.random.default_rng(1)
    assert [roll(rng_a, i % 3 == 0) for i in range(300)] == [slow_roll(rng_b, i % 3 == 0) for i in range(300)]


# The torch engine.


def test_dense_inputs_in_torch_are_the_inputs() -> None:
    boards = boards_of_random_games(2000, np.random.default_rng(8))
    boards[0, :, :] = 0
    for i in range(16):  # each number of checkers on a point, on the bar and off
        boards[i] = 0
        boards[i, 0, 7], boards[i, 1, 24] = i, i
    for dtype in (torch.float32, torch.float64):
        found = torch_engine.dense_inputs(torch.from_numpy(boards), dtype).numpy()
        expected = np.empty_like(found)
        for row, board in zip(expected, boards, strict=True):
            tesauro_dense(board, 0, row)
        assert (found == expected).all()
    net = ValueNetwork.drawn(5, 4, np.random.default_rng(0), dtype=np.float64, expert=True)
    sample = boards_of_random_games(100, np.random.default_rng(9))
    assert worst(TorchValues(net)(torch.from_numpy(sample)).detach().numpy(), net.outputs(sample)) < 1e-14


def check_online_engines(lambda_: float, num_outputs: int, num_games: int, num_hidden: int) -> None:
    shape = SelfPlaySettings(
        num_games=max(200, num_games), num_hidden=num_hidden, num_outputs=num_outputs, lambda_=lambda_,
        step_size=0.1, step_size_end=0.01, dtype="float64",
    )  # fmt: skip
    compiled, plain = (SelfPlay(dataclasses.replace(shape, engine=engine), seed=3) for engine in ("compiled", "torch"))
    start = compiled.network.flat.copy()
    for learner in (compiled, plain):
        learner.play(num_games)
    assert (compiled.tally == plain.tally).all() and compiled.tally[:3].sum() == num_games
    assert compiled.state_dict()["dice"] == plain.state_dict()["dice"]
    assert worst(compiled.network.flat, plain.network.flat) <= 1e-10 < 1e-2 < worst(start, plain.network.flat)


@pytest.mark.parametrize(("lambda_", "num_outputs"), [(0.0, 1), (0.7, 4), (1.0, 6)])
@pytest.mark.slow
def test_torch_plays_and_learns_as_the_kernel_does(lambda_: float, num_outputs: int) -> None:
    check_online_engines(lambda_, num_outputs, 3, 6)


@pytest.mark.slow
@pytest.mark.parametrize("num_outputs", [1, 4])
@pytest.mark.parametrize("lambda_", [0.0, 0.7, 1.0])
def test_torch_and_the_kernel_agree_after_200_games(lambda_: float, num_outputs: int) -> None:
    check_online_engines(lambda_, num_outputs, 200, 40)


@pytest.mark.parametrize(("lambda_", "num_outputs"), [(0.0, 4), (0.7, 1), (0.7, 6), (1.0, 4)])
@pytest.mark.slow
def test_batches_in_torch_are_those_of_the_kernel(lambda_: float, num_outputs: int) -> None:
    net = drawn(num_outputs)
    values = TorchValues(net)
    total, tally = batch(net, 5, lambda_, np.random.default_rng(10))
    games = play_in_turn(values, 5, np.random.default_rng(10))
    assert games.num_turns.sum() == tally[3] and len(set(games.num_turns.tolist())) > 1
    found = torch_engine.batch_gradient(values, games, lambda_).numpy()
    assert worst(-found * tally[3], total) < 1e-10 * max(1.0, np.abs(total).max())
    # In lockstep each game has dice of its own, and is what the kernel plays with them.
    together = torch_engine.play_in_lockstep(values, [np.random.default_rng(i) for i in range(5)])
    alone = [batch(net, 1, lambda_, np.random.default_rng(i)) for i in range(5)]
    assert together.num_turns.tolist() == [int(tally[3]) for _, tally in alone]
    total = np.sum([grad for grad, _ in alone], axis=0)
    found = torch_engine.batch_gradient(values, together, lambda_).numpy() * together.num_turns.sum()
    assert worst(-found, total) < 1e-10 * max(1.0, np.abs(total).max())


@pytest.mark.slow
def test_steps_of_adam_in_torch_are_those_of_the_compiled_engine() -> None:
    settings = SelfPlaySettings(num_hidden=5, mode="batched", batch_games=2, step_size=0.01, dtype="float64")
    learner = SelfPlay(settings, seed=4)
    twin = learner.network.copy()
    dice = np.random.default_rng(0)
    dice.bit_generator.state = learner.state_dict()["dice"][0]
    plain = TorchBatch(twin, 2)
    learner.play(6)
    for first in range(0, 6, 2):
        rate = settings.step_sizes(np.array([first]))[0]
        plain.learn(play_in_turn(plain.values, 2, dice), float(rate), settings.lambda_)
    assert worst(twin.flat, learner.network.flat) <= 1e-10


def test_lockstep_refuses_a_generator_that_serves_two_games() -> None:
    rng = np.random.default_rng(0)
    for dice in ([], [rng, rng]):
        with pytest.raises(ValueError, match="a generator of its own"):
            torch_engine.play_in_lockstep(TorchValues(drawn(1)), dice)


# Settings and states.


def test_schedules_go_from_end_to_end_and_stay_there() -> None:
    settings = SelfPlaySettings(num_games=1000, step_size=0.1, step_size_end=0.001, lambda_=0.8, lambda_end=0.2)
    at = np.array([0, 250, 500, 1000, 5000])
    assert settings.step_sizes(at) == pytest.approx([0.1, 0.1 * 10**-0.5, 0.01, 0.001, 0.001], rel=1e-14)
    assert settings.lambdas(at) == pytest.approx([0.8, 0.65, 0.5, 0.2, 0.2], rel=1e-14)
    assert (SelfPlaySettings(lambda_=0.3).lambdas(at) == 0.3).all()


def test_what_is_not_given_suits_the_mode() -> None:
    plain, batched = SelfPlaySettings(), SelfPlaySettings(mode="batched")
    assert plain.step_size == 30 * plain.step_size_end > 10 * batched.step_size > batched.step_size_end
    assert SelfPlaySettings(step_size=0.06).step_size_end == pytest.approx(0.002)


def test_settings_that_would_be_ignored_are_refused() -> None:
    for wrong, says in [
        ({"engine": "jax"}, "engine must be one of"),
        ({"device": "cuda"}, "the compiled engine runs on the CPU"),
        ({"engine": "torch", "mode": "batched", "num_threads": 2}, "plays a batch in lockstep"),
        ({"num_threads": 2}, "online learning is one game after another"),
        ({"mode": "batched", "batch_games": 3, "num_threads": 2}, "cannot be shared evenly"),
    ]:
        with pytest.raises(ValueError, match=says):
            SelfPlaySettings(**wrong)  # type: ignore[arg-type]
    if not torch.cuda.is_available():
        for mode in ("online", "batched"):
            with pytest.raises(ValueError, match="a GPU that is not there"):
                SelfPlay(SelfPlaySettings(engine="torch", device="cuda", mode=mode), 0)


@pytest.mark.parametrize("engine", ["compiled", "torch"])
@pytest.mark.parametrize("mode", ["online", "batched"])
@pytest.mark.slow
def test_a_state_continues_bit_for_bit_and_does_not_change_under_the_feet(mode: str, engine: str) -> None:
    settings = SelfPlaySettings(num_hidden=4, mode=mode, engine=engine, batch_games=2, dtype="float64")
    learner = SelfPlay(settings, seed=5)
    learner.play(2)
    state = learner.state_dict()
    learner.play(4)
    for other in (SelfPlay(settings, seed=6), learner):
        after = learner.network.sha256(), learner.tally.tolist(), learner.num_games
        other.load_state_dict(state)
        assert other.num_games == 2
        other.play(4)
        assert (other.network.sha256(), other.tally.tolist(), other.num_games) == after
    other_mode = dataclasses.replace(settings, mode="online" if mode == "batched" else "batched", step_size=0.01)
    with pytest.raises(ValueError, match="another mode"):
        SelfPlay(other_mode, 0).load_state_dict(state)
    with pytest.raises(ValueError, match="keep the run's settings"):
        SelfPlay(dataclasses.replace(settings, num_hidden=5), 0).load_state_dict(state)


@pytest.mark.slow
def test_two_threads_play_the_same_games_every_time() -> None:
    settings = SelfPlaySettings(num_hidden=4, mode="batched", batch_games=4, num_threads=2, dtype="float64")
    found = []
    for _ in range(3):
        learner = SelfPlay(settings, seed=7)
        learner.play(16)
        found.append((learner.network.sha256(), learner.tally.tolist()))
    assert found[0] == found[1] == found[2]
    one = SelfPlay(dataclasses.replace(settings, num_threads=1), seed=7)
    one.play(16)
    assert one.network.sha256() != found[0][0]  # the number of threads is part of what a seed stands for


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("mode", ["online", "batched"])
def test_a_gpu_learns_the_same(mode: str) -> None:
    settings = SelfPlaySettings(num_hidden=6, mode=mode, engine="torch", batch_games=2, dtype="float64")
    here, there = (SelfPlay(dataclasses.replace(settings, device=device), 8) for device in ("cpu", "cuda"))
    for learner in (here, there):
        learner.play(4)
    assert (here.tally == there.tally).all() and worst(here.network.flat, there.network.flat) < 1e-10


# ----------------------------------------------------------------------------------------------------------------------
# Does it learn?


def points_against_random(net: ValueNetwork, num_games: int, rng: np.random.Generator) -> float:
    won, room = 0, np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    for game in range(num_games):
        board, turn = START.copy(), game % 2  # 0 is the network's
        while result(board) == 0:
            dice = slow_roll(rng, False)
            if turn == 0:
                board = best_afterstate(net, board, *dice)
            else:
                board = room[rng.integers(afterstates(board, *dice, room))].copy()
            turn = 1 - turn
        won += int(result(board)) * (1 if turn == 0 else -1)
    return won / num_games


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_three_thousand_games_beat_random_play_by_far(seed: int) -> None:
    """500 games give a standard error of about 0.05; weights as they are drawn come to between −0.2 and 1.6."""
    learner = SelfPlay(
        SelfPlaySettings(num_games=3000, num_hidden=40, lambda_=0.7, step_size=0.1, step_size_end=0.1), seed
    )
    learner.play(3000)
    assert points_against_random(learner.network, 500, np.random.default_rng(seed)) > 2.2


@pytest.mark.slow
def test_steps_in_the_wrong_direction_do_not() -> None:
    net = ValueNetwork.drawn(40, 4, np.random.default_rng(0))
    online(net, np.full(3000, -0.1), 0.7, np.random.default_rng(0))
    assert points_against_random(net, 500, np.random.default_rng(0)) < 1.9
