"""Traces and prediction: backward view == forward view, the torch learners, and Sutton's random walk.

Planted mistakes that these tests kill: the book's printed recursion of Q^λ (the state before the transition in the
bracket); decay by the discount out of the state; a trace kept over `last_t`; Watkins' cut after the pair was added, or
one step late; Peng's error for the present pair used for the earlier ones; visits of other pairs in α; the true online
term with the value after the update; batch increments added within a presentation.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from neuralq.exact import evaluate, solve
from neuralq.learners import OnlineLearner, OnlineSettings, PredictionLearner
from neuralq.mdp import FiniteMDP
from neuralq.q import TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.tabular import (
    EpsilonGreedy,
    Experience,
    Power,
    RunOptions,
    apply,
    apply_lambda,
    batch_td,
    over_seeds,
    predict,
    q_lambda,
    q_learning,
    sarsa_lambda,
    td_lambda,
    under_policy,
)
from neuralq.types import Transition

S, A = 5, 3
Array = NDArray[np.float64]


def stream(seed: int, length: int = 40) -> Experience:
    """Discounts that vary, terminations, time limits, and repeated pairs; states connect within a stream."""
    rng = np.random.default_rng(seed)
    last = rng.random(length) < 0.2
    ends = last & (rng.random(length) < 0.5)
    s_t = rng.integers(S, size=length)
    s_tm1 = np.where(np.append(True, last[:-1]), rng.integers(S, size=length), np.append(0, s_t[:-1]))
    discount = np.where(ends, 0.0, rng.uniform(0.5, 1.0, length))
    a = rng.integers(A, size=length + 1)
    return Experience(s_tm1, a[:-1], rng.normal(size=length), discount, s_t, last, a[1:])


def forward(q: Array, e: Experience, rule: str, lambda_: float) -> Array:
    """Σ over steps of (G − Q) at the pair, with λ-returns summed by recursion from the end of each stream."""
    change = np.zeros_like(q)
    g = np.zeros(len(e))
    for t in reversed(range(len(e))):
        boot = q[e.s_t[t], e.next_actions[t]] if rule == "sarsa" else q[e.s_t[t]].max()
        if rule == "expected-sarsa":
            boot = 0.7 * q[e.s_t[t]].max() + 0.3 * q[e.s_t[t]].mean()
        mix = 0.0 if t == len(e) - 1 or e.last_t[t] else lambda_
        if mix and rule == "watkins" and q[e.s_tm1[t + 1], e.a_tm1[t + 1]] < q[e.s_tm1[t + 1]].max():
            mix = 0.0
        if rule in ("naive", "expected-sarsa"):  # G − Q is the sum of the errors ahead
            ahead = g[t + 1] - q[e.s_tm1[t + 1], e.a_tm1[t + 1]] if mix else 0.0
            g[t] = e.r_t[t] + e.discount_t[t] * (boot + mix * ahead)
        else:
            later = g[t + 1] if mix else 0.0
            g[t] = e.r_t[t] + e.discount_t[t] * ((1 - mix) * boot + mix * later)
        change[e.s_tm1[t], e.a_tm1[t]] += g[t] - q[e.s_tm1[t], e.a_tm1[t]]
    return change


@pytest.mark.parametrize("rule", ["watkins", "peng", "naive", "sarsa", "expected-sarsa"])
@pytest.mark.parametrize("lambda_", [0.0, 0.6, 1.0])
def test_backward_view_equals_forward_view(rule: str, lambda_: float) -> None:
    for seed in range(3):
        e, q = stream(seed), np.random.default_rng(seed + 9).normal(size=(S, A))
        alpha = 1e-7  # values stay as good as fixed: the error of this is of order α
        learned = apply_lambda(q, e, lambda_=lambda_, rule=rule, step_size=alpha, policy=EpsilonGreedy(0.3))
        assert np.allclose((learned.q - q) / alpha, forward(q, e, rule, lambda_), atol=2e-5)


def test_the_printed_recursion_is_not_the_books_own_sum() -> None:
    rng = np.random.default_rng(0)
    t_max, gamma, lambda_ = 6, 0.9, 0.7
    q, r = rng.normal(size=(S, A)), rng.normal(size=t_max)
    # The first pair must occur once for its change to be its own.
    s, a = np.append(0, rng.integers(1, S, size=t_max)), rng.integers(A, size=t_max)
    last = np.arange(t_max) == t_max - 1
    e = Experience(s[:-1], a, r, np.full(t_max, gamma), s[1:], last)
    n_step = [sum(gamma**k * r[k] for k in range(n)) + gamma**n * q[s[n]].max() for n in range(1, t_max + 1)]
    book = sum((1 - lambda_) * lambda_ ** (n - 1) * n_step[n - 1] for n in range(1, t_max))
    book += lambda_ ** (t_max - 1) * n_step[-1]
    printed = 0.0
    for t in reversed(range(t_max)):
        tail = (1 - lambda_) * q[s[t]].max() + lambda_ * printed if t < t_max - 1 else q[s[t]].max()
        printed = r[t] + gamma * tail
    learned = apply_lambda(q, e, lambda_=lambda_, rule="peng", step_size=1e-8)
    ours = q[s[0], a[0]] + (learned.q - q)[s[0], a[0]] / 1e-8
    assert np.isclose(ours, book, atol=1e-5) and not np.isclose(ours, printed, atol=1e-2)


@pytest.mark.parametrize("rule", ["watkins", "peng", "naive"])
@pytest.mark.parametrize("trace", ["accumulating", "replacing"])
def test_lambda_zero_is_q_learning_bit_for_bit(rule: str, trace: str) -> None:
    mdp = FiniteMDP.garnet(S, A, 3, seed=1)
    for step_size in ("visits", 0.3, 1.0):
        options = RunOptions(max_episode_steps=6)
        plain = q_learning(mdp, 700, 0.9, step_size=step_size, seed=4, options=options)
        traced = q_lambda(
            mdp, 700, 0.9, lambda_=0.0, rule=rule, trace=trace, step_size=step_size, seed=4, options=options
        )
        assert np.array_equal(plain.q, traced.q) and np.array_equal(plain.visits, traced.visits)


@pytest.mark.parametrize("cut", ["watkins", "naive"])
@pytest.mark.parametrize("trace", ["accumulating", "replacing"])
def test_the_torch_learner_agrees_update_for_update(cut: str, trace: str) -> None:
    e = stream(7, 60)
    learner = OnlineLearner(
        TorchEngine(TableQ(S, A), Loss()), OnlineSettings(lambda_=0.8, step_size=0.2, trace=trace, cut=cut)
    )
    for t in range(len(e)):
        row = slice(t, t + 1)
        learner.update(Transition(*map(torch.from_numpy, (
            e.s_tm1[row], e.a_tm1[row], np.ones(1), e.r_t[row], e.discount_t[row], e.s_t[row],
            e.last_t[row]))))  # fmt: skip
        if t % 19 == 0 or t == len(e) - 1:
            part = Experience(*(x[: t + 1] for x in (e.s_tm1, e.a_tm1, e.r_t, e.discount_t, e.s_t, e.last_t)))
            ours = apply_lambda(np.zeros((S, A)), part, lambda_=0.8, rule=cut, trace=trace, step_size=0.2)
            assert np.abs(ours.q - learner.engine.all(torch.arange(S)).numpy()).max() < 1e-12


@pytest.mark.parametrize("kind", ["accumulating", "replacing", "true-online"])
def test_prediction_agrees_with_the_torch_learner(kind: str) -> None:
    e, trace = stream(8, 60), "dutch" if kind == "true-online" else kind
    engine = TorchEngine(TableQ(S, 1), Loss())
    learner = PredictionLearner(engine, OnlineSettings(lambda_=0.8, step_size=0.2, trace=trace))
    for t in range(len(e)):
        row = slice(t, t + 1)
        learner.update(Transition(*map(torch.from_numpy, (
            e.s_tm1[row], np.zeros(1, np.int64), np.ones(1), e.r_t[row], e.discount_t[row], e.s_t[row],
            e.last_t[row]))))  # fmt: skip
    ours = predict(np.zeros(S), e, lambda_=0.8, kind=kind, step_size=0.2)
    assert np.abs(ours.v - engine.all(torch.arange(S))[:, 0].numpy()).max() < 1e-12


def test_each_pair_moves_with_the_step_size_of_its_own_last_visit() -> None:
    # 0 visited twice, 1 once: α(0) = 1/3, α(1) = 1/2. Values 0, γ = λ = 1, all zero rewards but the last, 6.
    e = Experience([0, 0, 1], [0, 0, 0], [0.0, 0.0, 6.0], [1.0, 1.0, 0.0], [0, 1, 1], [False, False, True])
    q = apply_lambda(np.zeros((2, 1)), e, lambda_=1.0, rule="naive").q
    assert np.allclose(q[:, 0], [2 * 6 / 3, 6 / 2])


@pytest.mark.parametrize("learner", ["watkins", "peng", "naive", "sarsa", "expected"])
def test_one_long_run_finds_the_optimum_with_little_exploration(learner: str) -> None:
    mdp = FiniteMDP.garnet(5, 2, 2, seed=2)
    exact = solve(mdp, 0.7).q
    policy, options = EpsilonGreedy(1.0, 0.01, 200_000), RunOptions(record_every=250_000, exact_q=exact)
    if learner in ("sarsa", "expected"):
        band = over_seeds(lambda seed: sarsa_lambda(
            mdp, 250_000, 0.7, lambda_=0.5, expected=learner == "expected", policy=policy, step_size=0.01, seed=seed,
            options=options), 2)  # fmt: skip
    else:
        band = over_seeds(lambda seed: q_lambda(
            mdp, 250_000, 0.7, lambda_=0.5, rule=learner, policy=policy, step_size=0.01, seed=seed,
            options=options), 2)  # fmt: skip
    greedy = np.nanargmax(exact, axis=1)
    for run in band.runs:
        assert (run.policy == greedy).all()


def walk() -> FiniteMDP:
    """Sutton's random walk: five states, start in the middle, 1 for leaving on the right; V = 1/6, …, 5/6."""
    return FiniteMDP.from_functions(
        5, 1, lambda s: [0],
        lambda s, a: [(0.5, max(s - 1, 0), 0.0, s == 0), (0.5, min(s + 1, 4), float(s == 4), s == 4)],
        start=np.eye(5)[2],
    )  # fmt: skip


def most_likely(p: Array, r: Array) -> FiniteMDP:
    """A process of one action that ends with the missing probability."""
    return FiniteMDP.from_arrays([p], r[:, None], substochastic=True)


TRUTH = np.arange(1, 6) / 6


def training_set(seed: int) -> Experience:
    """Ten sequences."""
    options = RunOptions(record_experience=True)
    e = td_lambda(walk(), 400, 1.0, step_size=0.1, seed=seed, options=options).experience
    assert e is not None
    stop = np.flatnonzero(e.last_t)[9] + 1
    return Experience(*(x[:stop] for x in (e.s_tm1, e.a_tm1, e.r_t, e.discount_t, e.s_t, e.last_t)))


@pytest.mark.parametrize("seed", range(3))
def test_batch_td_zero_is_certainty_equivalence_and_td_one_least_squares(seed: int) -> None:
    e = training_set(seed)
    seen = np.unique(e.s_tm1)
    counts, outs = np.zeros((5, 5)), np.zeros(5)
    reward = np.zeros(5)
    for t in range(len(e)):
        outs[e.s_tm1[t]] += 1
        reward[e.s_tm1[t]] += e.r_t[t]
        counts[e.s_tm1[t], e.s_t[t]] += e.discount_t[t] > 0
    n = np.maximum(outs, 1)
    likely = evaluate(most_likely(counts / n[:, None], reward / n), np.zeros(5, int), 1.0)
    v, converged = batch_td(np.full(5, 0.5), e, lambda_=0.0, step_size=0.02)
    assert converged and np.abs(v - likely)[seen].max() < 1e-6
    ends = np.flatnonzero(e.last_t)
    returns = np.concatenate([np.full(b - a, e.r_t[b]) for a, b in zip([-1, *ends[:-1]], ends, strict=True)])
    design = np.eye(5)[e.s_tm1][:, seen]
    least, *_ = np.linalg.lstsq(design, returns, rcond=None)
    v, converged = batch_td(np.full(5, 0.5), e, lambda_=1.0, step_size=0.02)
    assert converged and np.abs(v[seen] - least).max() < 1e-6


def test_suttons_first_experiment_error_grows_with_lambda() -> None:
    lambdas = [0.0, 0.3, 0.7, 0.9, 1.0]
    errors = np.zeros((20, len(lambdas)))
    for i in range(len(errors)):
        e = training_set(100 + i)
        for j, lambda_ in enumerate(lambdas):
            v, _ = batch_td(np.full(5, 0.5), e, lambda_=lambda_, step_size=0.01, tol=1e-3)
            errors[i, j] = np.sqrt(np.mean((v - TRUTH) ** 2))
    mean = errors.mean(axis=0)
    assert (np.diff(mean) > 0).all() and mean[-1] > 1.25 * mean[0]


def test_suttons_second_experiment_an_intermediate_lambda_is_best_after_one_presentation() -> None:
    sets = [training_set(i) for i in range(100)]
    best = {}
    for lambda_, alphas in ((0.0, (0.15, 0.2, 0.25)), (0.3, (0.15, 0.2)), (1.0, (0.05, 0.1))):
        best[lambda_] = min(
            np.mean([np.sqrt(np.mean((predict(np.full(5, 0.5), e, lambda_=lambda_, step_size=alpha, update="episode").v
                                      - TRUTH) ** 2)) for e in sets])
            for alpha in alphas
        )  # fmt: skip
    assert best[0.3] <= best[0.0] + 0.003 and best[1.0] >= 1.7 * best[0.3]
    assert abs(best[0.0] - 0.092) < 0.012 and abs(best[1.0] - 0.18) < 0.03


def test_online_prediction_finds_the_walks_values_and_true_online_is_the_online_lambda_return() -> None:
    for kind in ("accumulating", "replacing", "true-online"):
        step_size = 0.002 if kind == "true-online" else Power(0.7)
        learned = td_lambda(walk(), 400_000, 1.0, lambda_=0.5, kind=kind, step_size=step_size)
        assert np.abs(learned.v - TRUTH).max() < 0.03
    # The on-line λ-return algorithm, recomputed from the start of the episode for every horizon.
    e, alpha, lambda_ = stream(3, 30), 0.3, 0.7
    v = np.zeros(S)
    begin = 0
    for end in np.flatnonzero(e.last_t) + 1:
        values_at = [v.copy()]  # bootstrap of horizon h uses the values at time h - 1
        for h in range(begin + 1, end + 1):
            theta = values_at[0].copy()
            for t in range(begin, h):
                g = e.r_t[h - 1] + e.discount_t[h - 1] * values_at[h - 1 - begin][e.s_t[h - 1]]
                for k in reversed(range(t, h - 1)):
                    boot = values_at[k - begin][e.s_t[k]]
                    g = e.r_t[k] + e.discount_t[k] * ((1 - lambda_) * boot + lambda_ * g)
                theta[e.s_tm1[t]] += alpha * (g - theta[e.s_tm1[t]])
            values_at.append(theta)
        v, begin = values_at[-1], end
    part = Experience(*(x[:begin] for x in (e.s_tm1, e.a_tm1, e.r_t, e.discount_t, e.s_t, e.last_t)))
    assert np.allclose(
        predict(np.zeros(S), part, lambda_=lambda_, kind="true-online", step_size=alpha).v, v, atol=1e-12
    )


def test_the_process_under_a_policy_has_its_values() -> None:
    mdp = FiniteMDP.garnet(5, 3, 3, seed=6)
    pi = np.random.default_rng(0).dirichlet(np.ones(3), size=5)
    process = under_policy(mdp, pi)
    assert np.allclose(evaluate(process, np.zeros(5, int), 0.8), evaluate(mdp, pi, 0.8))
    fixed = under_policy(mdp, [0, 1, 2, 0, 1])
    assert np.allclose(evaluate(fixed, np.zeros(5, int), 0.8), evaluate(mdp, [0, 1, 2, 0, 1], 0.8))


@pytest.mark.parametrize(("call", "message"), [
    (lambda: q_lambda(walk(), 5, 1.0, lambda_=1.5), "lambda_"),
    (lambda: q_lambda(walk(), 5, 1.0, rule="sarsa"), "rule"),
    (lambda: q_lambda(walk(), 5, 1.0, trace="dutch"), "trace"),
    (lambda: sarsa_lambda(walk(), 5, 1.0, expected=True, policy="ucb"), "confidence"),
    (lambda: td_lambda(FiniteMDP.garnet(3, 2, 2, seed=0), 5, 0.9), "one action"),
    (lambda: td_lambda(walk(), 5, 1.0, kind="true-online"), "constant"),
    (lambda: td_lambda(walk(), 5, 1.0, update="batch"), "update"),
    (lambda: under_policy(walk(), [[1.0, 0.0]]), "shape"),
    (lambda: under_policy(walk(), np.full((5, 1), 0.5)), "not 1"),
])  # fmt: skip
def test_bad_input_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]


def test_apply_and_apply_lambda_agree_at_zero() -> None:
    e = stream(5)
    assert np.array_equal(apply(np.zeros((S, A)), e, step_size=0.5).q,
                          apply_lambda(np.zeros((S, A)), e, lambda_=0.0, step_size=0.5).q)  # fmt: skip
