"""One-step tabular learning: the kernels against slow loops, other packages' arithmetic, and the exact answer.

`slow` below is the definition of every rule in plain Python. Planted mistakes that these tests kill: the bootstrap kept
at termination, or dropped at a time limit; visits counted before the update (first α = 1); the next action of Sarsa
drawn after the update; double Q-learning valuing an action with the table that chose it; an alias table with its halves
exchanged; illegal actions in the maximum; an exploring draw that can fall on an illegal action.
"""

from __future__ import annotations

import runpy
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuralq import rules
from neuralq.exact import solve
from neuralq.learners import ReplayLearner, ReplaySettings
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq.q import TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.tabular import (
    EpsilonGreedy,
    Experience,
    KToTheQ,
    Power,
    RandomPolicy,
    RunOptions,
    Softmax,
    UpperConfidence,
    apply,
    compile_model,
    double_q,
    expected_sarsa,
    over_seeds,
    q_learning,
    sarsa,
)
from neuralq.tabular.kernels.acting import Table, choose
from neuralq.tabular.kernels.random_numbers import new_stream, uniform
from neuralq.tabular.policies import acting_code
from neuralq.tabular.theory import robbins_monro_sums, sweep_errors
from neuralq.types import Transition

RECORD = RunOptions(record_experience=True, max_episode_steps=3)


def uneven(seed: int = 0, discount: float = 1.0) -> FiniteMDP:
    """Random MDP with a terminal state, missing actions, and rows that may end."""
    rng = np.random.default_rng(seed)
    s, a = 6, 3
    p = rng.dirichlet(np.ones(s) * 0.5, size=(a, s)) * rng.choice([1.0, 0.7], size=(a, s, 1))
    r = rng.normal(size=(s, a))
    r[rng.random((s, a)) < 0.3] = np.nan
    r[np.arange(s - 1), rng.integers(a, size=s - 1)] = 1.0
    r[s - 1] = np.nan
    mdp = FiniteMDP.from_arrays(p, r, substochastic=True)
    row_discount = np.full(mdp.num_rows, discount)
    return FiniteMDP(s, a, mdp.s_tm1, mdp.a_tm1, mdp.transition, mdp.reward, row_discount)


def figure_13_2() -> FiniteMDP:
    """The 2 x 3 grid with the absorbing goal G top right; actions N, E, S, W; 100 for entering G."""
    p, r = np.zeros((4, 6, 6)), np.full((6, 4), np.nan)
    for s in (0, 1, 3, 4, 5):
        for a, (dy, dx) in enumerate([(-1, 0), (0, 1), (1, 0), (0, -1)]):
            y, x = s // 3 + dy, s % 3 + dx
            if 0 <= y < 2 and 0 <= x < 3:
                p[a, s, 3 * y + x] = 1.0
                r[s, a] = 100.0 * (3 * y + x == 2)
    return FiniteMDP.from_arrays(p, r)


NAN = np.nan
FIGURE_Q = [[NAN, 90, 72.9, NAN], [NAN, 100, 81, 81], [NAN] * 4, [81, 81, NAN, NAN], [90, 90, NAN, 72.9],
            [100, NAN, NAN, 81]]  # fmt: skip


def slow(q: np.ndarray, e: Experience, rule: str, alpha_of: object, epsilon: float = 0.3) -> np.ndarray:
    """Every rule as it is written in the books."""
    q, n = q.copy(), np.zeros(q.shape)
    for t in range(len(e)):
        s, a, s_t = e.s_tm1[t], e.a_tm1[t], e.s_t[t]
        n[s, a] += 1
        target = e.r_t[t]
        if e.discount_t[t] > 0:
            if rule == "q-learning":
                bootstrap = np.nanmax(q[s_t])
            elif rule == "sarsa":
                bootstrap = q[s_t, e.next_actions[t]]
            else:
                bootstrap = (1 - epsilon) * np.nanmax(q[s_t]) + epsilon * np.nanmean(q[s_t])
            target += e.discount_t[t] * bootstrap
        alpha = alpha_of(n[s, a])  # type: ignore[operator]
        q[s, a] = target if alpha == 1 else q[s, a] + alpha * (target - q[s, a])
    return q


def test_the_random_stream_is_xoshiro256_plus_plus() -> None:
    state, mask = [1, 2, 3, 4], (1 << 64) - 1

    def rotate(x: int, k: int) -> int:
        return ((x << k) | (x >> (64 - k))) & mask

    numbers = []
    for _ in range(50):
        numbers.append((rotate((state[0] + state[3]) & mask, 23) + state[0]) & mask)
        t = (state[1] << 17) & mask
        state[2] ^= state[0]
        state[3] ^= state[1]
        state[1] ^= state[2]
        state[0] ^= state[3]
        state[2] ^= t
        state[3] = rotate(state[3], 45)
    assert numbers[:4] == [41943041, 58720359, 3588806011781223, 3591011842654386]  # the authors' reference values
    stream = np.array([1, 2, 3, 4], dtype=np.uint64)
    assert [uniform(stream) for _ in numbers] == [(x >> 11) / 2**53 for x in numbers]


@pytest.mark.parametrize("mdp", [uneven(1), uneven(2, 0.8), FiniteMDP.garnet(9, 2, 7, seed=1)])
def test_alias_tables_hold_the_model(mdp: FiniteMDP) -> None:
    model = compile_model(mdp).arrays
    for row in range(mdp.num_rows):
        pair = mdp.s_tm1[row] * mdp.num_actions + mdp.a_tm1[row]
        lo, hi = int(model.first[pair]), int(model.first[pair + 1])
        share = np.zeros(mdp.num_states + 1)
        for j in range(lo, hi):
            for k, weight in ((j, model.keep[j]), (int(model.alias[j]), 1 - model.keep[j])):
                into = mdp.num_states if model.ends[k] else int(model.s_t[k])
                share[into] += weight / (hi - lo)
        inside = np.where(mdp.is_terminal, 0, mdp.transition[[row]].toarray()[0] * mdp.row_discount[row])
        assert np.allclose(share, [*inside, 1 - inside.sum()], atol=1e-12)
        assert np.allclose(model.reward[lo:hi], mdp.reward[row])


@pytest.mark.parametrize("step_size", ["visits", 0.3, 1.0, Power(0.7), [0.5, 0.25], lambda n: 1 / n**2])
@pytest.mark.parametrize("rule", ["q-learning", "sarsa", "expected-sarsa"])
def test_kernels_equal_slow_loops_bit_for_bit(rule: str, step_size: object) -> None:
    mdp = uneven(3)
    learner = {"q-learning": q_learning, "sarsa": sarsa, "expected-sarsa": expected_sarsa}[rule]
    policy = EpsilonGreedy(0.3)
    learned = learner(mdp, 400, 0.9, policy=policy, step_size=step_size, seed=1, options=RECORD)
    e = learned.experience
    assert e is not None
    formula = {"visits": lambda n: 1 / (1 + n), "Power": lambda n: n**-0.7, "list": lambda n: 0.5 if n == 1 else 0.25}
    key = step_size if isinstance(step_size, str) else type(step_size).__name__
    alpha = step_size if callable(step_size) else formula.get(key, lambda n: step_size)
    start = np.where(mdp.legal, 0.0, np.nan)
    expected = slow(start, e, rule, alpha)
    exactly = key != "Power"  # pow may round differently
    assert np.array_equal(learned.q, expected, equal_nan=True) if exactly else np.allclose(
        learned.q, expected, rtol=1e-12, equal_nan=True
    )  # fmt: skip
    again = apply(start, e, rule=rule, step_size=step_size, policy=policy)
    assert np.array_equal(again.q, learned.q, equal_nan=True)
    assert np.array_equal(again.visits, learned.visits) and learned.visits.sum() == 400
    limited = e.last_t & (e.discount_t > 0)
    assert limited.any() and (e.last_t & ~limited).any(), "both ends must occur"
    assert learned.num_episodes == e.last_t.sum() and learned.episode_lengths.max() == 3


@pytest.mark.parametrize("policy", [EpsilonGreedy(0.3), EpsilonGreedy(0.9, 0.1, 500), EpsilonGreedy(0.2, ties="lowest"),
                                    RandomPolicy()], ids=str)  # fmt: skip
@pytest.mark.parametrize("limit", [None, 5])
def test_the_fast_loop_makes_the_same_draws_and_updates(policy: object, limit: int | None) -> None:
    mdp = uneven(4, 0.95)
    runs = [
        q_learning(mdp, 3000, 0.9, policy=policy, seed=7, options=RunOptions(
            record_experience=record, max_episode_steps=limit, record_every=700))
        for record in (False, True)
    ]  # fmt: skip
    assert np.array_equal(runs[0].q, runs[1].q, equal_nan=True)
    assert np.array_equal(runs[0].visits, runs[1].visits) and runs[0].num_episodes == runs[1].num_episodes


def test_double_q_learning_values_with_the_other_table() -> None:
    mdp = uneven(5)
    learned = double_q(mdp, 500, 0.9, policy="random", step_size=0.3, seed=2, options=RECORD)
    e = learned.experience
    assert e is not None
    # The coin of `apply` is the stream's own: replay with the same stream and flip it here.
    replayed = apply(np.where(mdp.legal, 0.0, np.nan), e, rule="double-q", step_size=0.3, seed=5)
    stream, halves = new_stream(5), np.stack([np.where(mdp.legal, 0.0, np.nan)] * 2)
    for t in range(len(e)):
        mine = 0 if uniform(stream) < 0.5 else 1
        s, a, target = e.s_tm1[t], e.a_tm1[t], e.r_t[t]
        if e.discount_t[t] > 0:
            target += e.discount_t[t] * halves[1 - mine, e.s_t[t], np.nanargmax(halves[mine, e.s_t[t]])]
        halves[mine, s, a] += 0.3 * (target - halves[mine, s, a])
    assert np.array_equal(replayed.q, halves.mean(axis=0), equal_nan=True)


def test_double_q_learning_overestimates_less() -> None:
    # One state, eight actions that each end with reward ±1 at even odds: every Q is 0, the largest estimate is not.
    eight = FiniteMDP.from_functions(1, 8, lambda s: range(8), lambda s, a: [(0.5, 0, 1.0, True), (0.5, 0, -1.0, True)])
    start = FiniteMDP.from_functions(
        2, 8, lambda s: range(8) if s else [0],
        lambda s, a: [(0.5, 1, 1.0, True), (0.5, 1, -1.0, True)] if s else [(1.0, 1, 0.0, False)], start=[1.0, 0.0],
    )  # fmt: skip
    assert eight.num_rows == 8
    plain = over_seeds(lambda seed: q_learning(start, 400, 1.0, policy="random", step_size=0.1, seed=seed), 40)
    double = over_seeds(lambda seed: double_q(start, 400, 1.0, policy="random", step_size=0.1, seed=seed), 40)
    assert plain.q[:, 0, 0].mean() > 0.2
    assert abs(double.q[:, 0, 0].mean()) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_table_13_1_finds_figure_13_2_from_below(seed: int) -> None:
    mdp = figure_13_2()
    exact = solve(mdp, 0.9).q
    options = RunOptions(record_every=1, exact_q=exact, record_experience=True)
    learned = q_learning(mdp, 1500, 0.9, policy="random", step_size="deterministic", seed=seed, options=options)
    assert np.allclose(learned.q, FIGURE_Q, atol=1e-12, equal_nan=True)
    curve, e = learned.curve, learned.experience
    assert curve is not None and e is not None
    assert (curve.decrease == 0).all() and (curve.lowest >= 0).all()  # 13.3.3: monotone, never negative
    assert (curve.excess <= 1e-12).all() and curve.distance[-1] < 1e-12
    sweeps = sweep_errors(np.where(mdp.legal, 0.0, np.nan), e, exact)
    assert len(sweeps.ends) >= 5 and (sweeps.errors[1:] <= 0.9 * sweeps.errors[:-1] + 1e-12).all()  # theorem 13.1
    rough = np.where(mdp.legal, np.random.default_rng(seed).normal(0, 200, (6, 4)), np.nan)
    sweeps = sweep_errors(rough, e, exact)
    assert (sweeps.errors[1:] <= 0.9 * sweeps.errors[:-1] + 1e-12).all()


def test_the_deterministic_rule_leaves_the_truth_on_a_stochastic_model_and_averaging_finds_it() -> None:
    mdp = FiniteMDP.garnet(5, 2, 3, seed=3)
    exact = solve(mdp, 0.8).q
    options = RunOptions(initial_q=exact, record_every=100, exact_q=exact)
    run = q_learning(mdp, 20_000, 0.8, policy="random", step_size="deterministic", options=options)
    assert run.curve is not None and (run.curve.distance > 0.1).all()  # rule 13.7 leaves Q and stays away
    curve = RunOptions(record_every=100_000, exact_q=exact)
    band = over_seeds(
        lambda seed: q_learning(mdp, 1_000_000, 0.8, policy="random", step_size=Power(0.7), seed=seed, options=curve), 4
    )
    assert band.distance[:, -1].max() < 0.05 and (band.distance[:, -1] < band.distance[:, 0]).all()
    band = over_seeds(lambda seed: q_learning(mdp, 1_000_000, 0.8, policy="random", seed=seed, options=curve), 4)
    # With 1/(1 + n) the error falls as n^-(1 - γ) (Szepesvári 1998): ten times the data give a factor 10^-.2 = .63.
    assert np.abs(band.distance[:, -1] / band.distance[:, 0] - 10**-0.2).max() < 0.1
    assert (np.diff(band.interval(), axis=0) >= 0).all()


def test_robbins_and_monro_tell_good_step_sizes_from_bad_ones() -> None:
    n = 4000
    cases = [("visits", True, True), (0.1, True, False), (lambda n: n**-2.0, False, True)]
    for step_size, diverges, square_converges in cases:
        sums, squares = robbins_monro_sums(step_size, n)
        assert (sums[-1] - sums[n // 2] > 0.1) == diverges  # a divergent series still grows; ln 2 for 13.11
        assert (squares[-1] - squares[n // 2] < 0.1) == square_converges
    assert np.isclose(robbins_monro_sums("visits", 1000)[0][-1], np.log(1001) + np.euler_gamma - 1, atol=1e-3)


@pytest.mark.parametrize(("policy", "probabilities"), [
    (EpsilonGreedy(0.4, ties="lowest"), lambda q: rules.epsilon_greedy(q, 0.4)),
    (EpsilonGreedy(0.4), lambda q: rules.epsilon_greedy(q, 0.4, random_ties=True)),
    (EpsilonGreedy(0.6, 0.2, 10), lambda q: rules.epsilon_greedy(q, 0.4, random_ties=True)),
    (RandomPolicy(), lambda q: rules.epsilon_greedy(q, 1.0)),
    (KToTheQ(2.0, 0.2), lambda q: rules.k_to_the_q(q, 3.0)), (KToTheQ(0.5), lambda q: rules.k_to_the_q(q, 0.5)),
    (Softmax(3.0, 1.0, 10), lambda q: rules.softmax(q, 2.0)),
])  # fmt: skip
def test_policies_have_the_probabilities_of_the_rules(policy: object, probabilities: object) -> None:
    row = [0.5, 2.0, -np.inf, 2.0, 1.0]
    table = Table(np.array([row]), np.zeros((1, 5), np.int64), np.array([4], np.uint64))
    code, stream, draws = acting_code(policy), new_stream(3), 20_000  # type: ignore[arg-type]
    drawn = np.bincount([choose(table, np.uint64(0), 5, code, stream) for _ in range(draws)], minlength=5) / draws
    expected = probabilities(torch.tensor(row, dtype=torch.float64)).numpy()  # type: ignore[operator]
    assert np.abs(drawn - expected).max() < 4.5 * np.sqrt(0.25 / draws) and drawn[2] == 0


def test_large_values_do_not_overflow_the_boltzmann_policies() -> None:
    table = Table(np.array([[1e300, -1e300]]), np.zeros((1, 2), np.int64), np.array([2], np.uint64))
    assert choose(table, np.uint64(0), 0, KToTheQ(2.0).code(), new_stream(0)) == 0
    assert choose(table, np.uint64(0), 0, KToTheQ(0.5).code(), new_stream(0)) == 1


def test_confidence_bounds_try_everything_and_then_weigh_it() -> None:
    table = Table(np.array([[1.0, 0.9, -np.inf]]), np.array([[4, 0, 0]]), np.array([2], np.uint64))
    policy = UpperConfidence(1.0).code()
    assert choose(table, np.uint64(0), 0, policy, new_stream(0)) == 1
    table.visits[0, 1] = 4
    assert choose(table, np.uint64(0), 0, policy, new_stream(0)) == 0
    table.visits[0, 0] = 40  # 1 + √(ln 45 / 40) = 1.31 < .9 + √(ln 45 / 4) = 1.88
    assert choose(table, np.uint64(0), 0, policy, new_stream(0)) == 1


def test_optimism_explores_where_greed_from_zero_does_not() -> None:
    mdp = figure_13_2()
    lazy = EpsilonGreedy(0.0, ties="lowest")
    optimistic = RunOptions(initial_q=1000.0, restarts="uniform")
    learned = q_learning(mdp, 3000, 0.9, policy=lazy, step_size=1.0, options=optimistic)
    assert (learned.visits[mdp.legal] > 0).all() and np.isclose(np.nanmax(learned.q), 100)
    greedy = q_learning(mdp, 3000, 0.9, policy=lazy, step_size=1.0)
    assert (greedy.visits[mdp.legal] == 0).any()


@pytest.mark.parametrize("rule", ["q_learning", "double"])
def test_torch_learners_and_kernels_agree_update_for_update(rule: str) -> None:
    mdp = FiniteMDP.garnet(6, 3, 3, seed=4)
    run = q_learning(mdp, 120, 0.9, policy="random", options=RunOptions(record_experience=True, max_episode_steps=7))
    e = run.experience
    assert e is not None
    settings = ReplaySettings(
        optimiser="sgd",
        learning_rate=0.2,
        loss="squared",
        max_grad_norm=None,
        target_rule=rule,
        target_period_updates=1,
    )
    learner = ReplayLearner(TorchEngine(TableQ(6, 3), Loss()), settings)
    for t in range(len(e)):
        piece = slice(t, t + 1)
        learner.update(Transition(*map(torch.from_numpy, (
            e.s_tm1[piece], e.a_tm1[piece], np.ones(1), e.r_t[piece], e.discount_t[piece], e.s_t[piece],
            e.last_t[piece]))))  # fmt: skip
        if t in (0, 40, len(e) - 1):
            part = Experience(e.s_tm1[:t + 1], e.a_tm1[:t + 1], e.r_t[:t + 1], e.discount_t[:t + 1], e.s_t[:t + 1],
                              e.last_t[:t + 1])  # fmt: skip
            ours = apply(np.zeros((6, 3)), part, step_size=0.2).q
            assert np.abs(ours - learner.engine.all(torch.arange(6)).numpy()).max() < 1e-12


def test_gymnasium_environments_get_the_same_updates() -> None:
    mdp = figure_13_2()
    options = RunOptions(record_experience=True, max_episode_steps=12)
    learned = q_learning(mdp.as_env(), 900, 0.9, policy="random", step_size=1.0, options=options)
    assert np.allclose(np.delete(learned.q, 2, 0), np.delete(FIGURE_Q, 2, 0), atol=1e-9, equal_nan=True)
    e = learned.experience
    assert e is not None
    again = apply(np.where(mdp.legal, 0.0, np.nan), e, step_size=1.0)
    assert np.array_equal(np.delete(again.q, 2, 0), np.delete(learned.q, 2, 0), equal_nan=True)
    assert (learned.visits[~mdp.legal] == 0).all() and learned.visits.sum() == 900
    assert (e.last_t & (e.discount_t > 0)).any() and learned.episode_lengths.max() == 12
    follows = sarsa(mdp.as_env(), 300, 0.9, step_size=0.5, options=options).experience
    assert follows is not None
    within = ~follows.last_t[:-1]
    assert (follows.next_actions[:-1][within] == follows.a_tm1[1:][within]).all()


def test_gymnasium_time_limits_and_seeds() -> None:
    env = gymnasium.make("FrozenLake-v1", max_episode_steps=20)
    options = RunOptions(record_experience=True)
    runs = [q_learning(env, 400, 0.9, policy="random", seed=seed, options=options) for seed in (1, 1, 2)]
    assert np.array_equal(runs[0].q, runs[1].q) and not np.array_equal(runs[0].visits, runs[2].visits)
    with pytest.raises(TypeError, match="Discrete"):
        q_learning(gymnasium.make("CartPole-v1"), 10, 0.9)


def test_many_seeds_are_independent_and_threads_change_nothing() -> None:
    model = compile_model(uneven(6), restarts="uniform")
    options = RunOptions(record_every=50, record_experience=True)
    bands = [over_seeds(lambda seed: q_learning(model, 200, 0.9, seed=seed, options=options), 3, num_threads=n)
             for n in (1, 2)]  # fmt: skip
    assert np.array_equal(bands[0].q, bands[1].q, equal_nan=True)
    assert len({run.q.tobytes() for run in bands[0].runs}) == 3
    assert bands[0].steps.tolist() == [50, 100, 150, 200] and np.isnan(bands[0].distance).all()


def test_states_that_look_alike_share_their_values() -> None:
    mdp = uneven(8)
    same = [q_learning(source, 800, 0.9, seed=1) for source in (mdp, AliasedMDP(mdp, np.arange(6)))]
    assert np.array_equal(same[0].q, same[1].q, equal_nan=True)
    # A corridor of three that looks the same everywhere, −1 per step: with α = γ = 1 the one value falls by 1 with
    # every step, and is −1 after the last of an episode.
    walk = FiniteMDP.from_functions(
        3, 1, lambda s: [0], lambda s, a: [(1.0, min(s + 1, 2), -1.0, s == 2)], start=[1, 0, 0]
    )
    model = compile_model(AliasedMDP(walk, np.zeros(3, dtype=int)))
    assert [float(q_learning(model, n, 1.0, step_size=1.0).q[0, 0]) for n in (1, 2, 3, 4)] == [-1.0, -2.0, -1.0, -2.0]
    assert q_learning(model, 30, 1.0, step_size=1.0).num_episodes == 10
    with pytest.raises(ValueError, match="other legal actions"):
        AliasedMDP(mdp, np.zeros(6, dtype=int))
    with pytest.raises(ValueError, match="6 whole numbers"):
        AliasedMDP(mdp, np.zeros(5, dtype=int))


def test_frequencies_follow_the_model() -> None:
    mdp = uneven(7)
    e = q_learning(mdp, 60_000, 0.9, policy="random", options=RunOptions(record_experience=True)).experience
    assert e is not None
    row = int(mdp.row_index[e.s_tm1[0], e.a_tm1[0]])
    here = (e.s_tm1 == e.s_tm1[0]) & (e.a_tm1 == e.a_tm1[0])
    on = here & (e.discount_t > 0)
    expected = np.where(mdp.is_terminal, 0.0, mdp.transition[[row]].toarray()[0])
    seen = np.bincount(e.s_t[on], minlength=6) / here.sum()
    assert np.abs(seen - expected).max() < 4.5 * np.sqrt(0.25 / here.sum())
    starts = np.bincount(e.s_tm1[1:][e.last_t[:-1]], minlength=6) / e.last_t[:-1].sum()
    assert np.abs(starts - mdp.start_distribution).max() < 4.5 * np.sqrt(0.25 / e.last_t.sum())


@given(st.integers(0, 10_000))
def test_deterministic_models_are_solved_from_any_start(seed: int) -> None:
    mdp = FiniteMDP.garnet(4, 2, 1, seed=seed)
    start = np.random.default_rng(seed).normal(size=(4, 2)) * 10
    options = RunOptions(initial_q=start, max_episode_steps=5)
    learned = q_learning(mdp, 5_000, 0.7, policy="random", step_size="deterministic", seed=seed, options=options)
    assert np.allclose(learned.q, solve(mdp, 0.7, method="policy-iteration").q, atol=1e-8)
    assert np.allclose(learned.v, np.max(learned.q, axis=1)) and learned.policy.shape == (4,)


@pytest.mark.parametrize(("call", "message"), [
    (lambda m: q_learning(m, 0, 0.9), "num_steps"), (lambda m: q_learning(m, 5, 1.5), "gamma"),
    (lambda m: q_learning(m, 5, 0.9, policy="epsilon"), "policy must be one of"),
    (lambda m: q_learning(m, 5, 0.9, step_size="fast"), "step_size must be one of"),
    (lambda m: q_learning(m, 5, 0.9, step_size=1.5), "step_size must lie"),
    (lambda m: q_learning(m, 5, 0.9, step_size=[0.5, -0.1]), "-0.1 at visit 2"),
    (lambda m: q_learning(m, 5, 0.9, options=RunOptions(initial_q=np.zeros(3))), "initial_q"),
    (lambda m: q_learning(m, 5, 0.9, options=RunOptions(initial_q=np.nan)), "initial_q must be finite"),
    (lambda m: q_learning(m, 5, 0.9, options=RunOptions(exact_q=[[0.0]], record_every=1)), "exact_q"),
    (lambda m: RunOptions(exact_q=[[0.0]]), "record_every"), (lambda m: RunOptions(restarts="goal"), "restarts"),
    (lambda m: q_learning(compile_model(m), 5, 0.9, options=RunOptions(restarts="uniform")), "built in"),
    (lambda m: expected_sarsa(m, 5, 0.9, policy="ucb"), "confidence bounds"),
    (lambda m: EpsilonGreedy(1.2), "epsilon"), (lambda m: KToTheQ(0.0), "k must be"), (lambda m: Power(0.0), "omega"),
    (lambda m: apply([[0.0]], Experience([1], [0], [0.0], [0.0], [0], [True])), "s_tm1.0. must lie in 0..0, got 1"),
    (lambda m: apply([[0.0]], Experience([0], [0], [0.0], [0.9], [0], [True]), rule="sarsa"), "next action"),
    (lambda m: Experience([0], [0], [0.0, 1.0], [0.9], [0], [True]), "r_t must have shape"),
    (lambda m: over_seeds(lambda s: q_learning(m, 5, 0.9, seed=s), 2).distance, "record_every"),
])  # fmt: skip
def test_bad_input_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(uneven())  # type: ignore[operator]


def test_other_sources_are_refused() -> None:
    with pytest.raises(TypeError, match="FiniteMDP"):
        q_learning(3, 5, 0.9)  # type: ignore[arg-type]


def test_the_benchmark_runs() -> None:
    script = runpy.run_path(str(Path(__file__).parents[1] / "scripts" / "bench_tabular.py"))
    model = compile_model(FiniteMDP.from_gymnasium(gymnasium.make(script["ENV"])))
    # Far from the speed it is about, so that a busy machine fails nothing; the script prints the real ratio.
    assert script["compiled"](model, 200_000, 0) > 20 * script["plain_python"](2_000, 0)
