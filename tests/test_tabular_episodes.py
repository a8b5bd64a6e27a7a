"""n-step targets, episodes updated backwards, replayed transitions, and average reward.

Planted mistakes that these tests kill: a window that survives the end of its stream, or bootstraps at termination; the
reward of the last step counted with the wrong power of γ; updates in forward order; draws from transitions that the
ring has overwritten; the gain updated on exploring steps.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from neuralq.exact import solve
from neuralq.mdp import FiniteMDP
from neuralq.tabular import (
    EpsilonGreedy,
    Experience,
    RandomPolicy,
    RunOptions,
    apply_episodes,
    apply_n_step,
    episodic_q_learning,
    n_step,
    over_seeds,
    q_learning,
    r_learning,
    sarsa,
)
from neuralq.tabular.kernels.random_numbers import new_stream, uniform

S, A = 5, 3


def stream(seed: int, length: int = 60) -> Experience:
    """Discounts that vary, terminations, time limits; the stream does not end with its last row."""
    rng = np.random.default_rng(seed)
    last = rng.random(length) < 0.15
    last[-1] = False
    ends = last & (rng.random(length) < 0.5)
    discount = np.where(ends, 0.0, rng.uniform(0.5, 1.0, length))
    a = rng.integers(A, size=length + 1)
    s = rng.integers(S, size=(2, length))
    return Experience(s[0], a[:-1], rng.normal(size=length), discount, s[1], last, a[1:])


def slow_n_step(q: np.ndarray, e: Experience, n: int, rule: str, alpha: float) -> np.ndarray:
    """Each pair when its n-th reward has come, or its stream ends: the target written as a sum."""
    q, begin = q.copy(), 0
    for end in range(len(e)):
        due = range(max(begin, end - n + 1), end + 1) if e.last_t[end] else [end - n + 1]
        for t in due:
            if t < begin:
                continue
            target, factor = 0.0, 1.0
            for k in range(t, end + 1):
                target += factor * e.r_t[k]
                factor *= e.discount_t[k]
            boot = q[e.s_t[end], e.next_actions[end]] if rule == "sarsa" else q[e.s_t[end]].max()
            if rule == "expected-sarsa":
                boot = q[e.s_t[end]].mean()
            target += factor * boot
            q[e.s_tm1[t], e.a_tm1[t]] += alpha * (target - q[e.s_tm1[t], e.a_tm1[t]])
        if e.last_t[end]:
            begin = end + 1
    return q


@pytest.mark.parametrize("rule", ["q-learning", "sarsa", "expected-sarsa"])
@pytest.mark.parametrize("n", [1, 2, 5, 100])
def test_n_step_targets_are_their_sums(rule: str, n: int) -> None:
    start = np.random.default_rng(0).normal(size=(S, A))
    for seed in range(3):
        e = stream(seed)
        learned = apply_n_step(start, e, n=n, rule=rule, step_size=0.3, policy=RandomPolicy())
        assert np.allclose(learned.q, slow_n_step(start, e, n, rule, 0.3), atol=1e-12)


def test_one_step_is_the_one_step_rule_bit_for_bit() -> None:
    mdp, options = FiniteMDP.garnet(S, A, 3, seed=0), RunOptions(max_episode_steps=6)
    for rule, learn in (("q-learning", q_learning), ("sarsa", sarsa)):
        one = n_step(mdp, 500, 0.9, n=1, rule=rule, seed=3, options=options)
        plain = learn(mdp, 500, 0.9, seed=3, options=options)
        assert np.array_equal(one.q, plain.q) and np.array_equal(one.visits, plain.visits)


def test_large_n_on_greedy_episodes_is_monte_carlo() -> None:
    # Deterministic corridor of 4: rewards 0, 0, 0, 8 and γ = .5; after one episode every value is its return.
    mdp = FiniteMDP.from_functions(4, 1, lambda s: [0], lambda s, a: [(1.0, min(s + 1, 3), 8.0 * (s == 3), s == 3)],
                                   start=[1, 0, 0, 0])  # fmt: skip
    assert n_step(mdp, 4, 0.5, n=4, step_size=1.0).q[:, 0].tolist() == [1.0, 2.0, 4.0, 8.0]
    assert n_step(mdp, 4, 0.5, n=2, step_size=1.0).q[:, 0].tolist() == [0.0, 0.0, 4.0, 8.0]


def slow_episodes(q: np.ndarray, e: Experience, order: str, num_replayed: int, seed: int, capacity: int) -> np.ndarray:
    q, n, begin, stream_ = q.copy(), np.zeros(q.shape), 0, new_stream(seed)

    def update(t: int) -> None:
        s, a = e.s_tm1[t], e.a_tm1[t]
        n[s, a] += 1
        target = e.r_t[t] + (e.discount_t[t] * q[e.s_t[t]].max() if e.discount_t[t] else 0.0)
        q[s, a] += 1 / (1 + n[s, a]) * (target - q[s, a])

    for end in np.flatnonzero(e.last_t):
        rows = range(max(begin, end + 1 - capacity), end + 1)
        for t in reversed(rows) if order == "reverse" else rows:
            update(t)
        ring = {k % capacity: k for k in range(max(0, end + 1 - capacity), end + 1)}
        for _ in range(num_replayed):
            update(ring[int(uniform(stream_) * len(ring))])
        begin = end + 1
    return q


@pytest.mark.parametrize("order", ["reverse", "forward"])
@pytest.mark.parametrize("num_replayed", [0, 7])
def test_episodes_are_updated_in_order_and_then_replayed(order: str, num_replayed: int) -> None:
    for seed in range(3):
        e, start = stream(seed), np.random.default_rng(seed).normal(size=(S, A))
        learned = apply_episodes(start, e, order=order, num_replayed=num_replayed, seed=seed)
        assert np.allclose(learned.q, slow_episodes(start, e, order, num_replayed, seed, len(e)), atol=1e-13)
        ends = np.flatnonzero(e.last_t)
        assert learned.num_backups == ends[-1] + 1 + num_replayed * len(ends)
        assert learned.visits.sum() == len(e)


def test_a_small_store_keeps_the_newest_transitions() -> None:
    mdp = FiniteMDP.garnet(S, A, 2, seed=1)
    options = RunOptions(record_experience=True, max_episode_steps=13)
    learned = episodic_q_learning(mdp, 130, 0.9, policy="random", num_replayed=0, capacity=5, options=options)
    e = learned.experience
    assert e is not None
    assert np.allclose(learned.q, slow_episodes(np.zeros((S, A)), e, "reverse", 0, 0, 5), atol=1e-13)


def corridor(length: int) -> FiniteMDP:
    """States in a row, one action to the right, 1 at the end."""
    return FiniteMDP.from_functions(
        length, 1, lambda s: [0], lambda s, a: [(1.0, min(s + 1, length - 1), float(s == length - 1), s == length - 1)],
        start=np.eye(length)[0],
    )  # fmt: skip


def test_backwards_one_episode_is_enough_and_forwards_it_takes_as_many_as_the_path_is_long() -> None:
    for length in (3, 8):
        mdp = corridor(length)
        back = episodic_q_learning(mdp, length, 0.9, step_size="deterministic")
        assert (back.q > 0).all() and np.allclose(back.q[:, 0], solve(mdp, 0.9).v)
        for episodes in range(1, length + 1):
            steps = episodes * length
            forward = episodic_q_learning(mdp, steps, 0.9, step_size="deterministic", order="forward")
            online = q_learning(mdp, steps, 0.9, step_size="deterministic")
            assert (forward.q > 0).sum() == episodes and np.array_equal(forward.q, online.q)


def test_replay_needs_fewer_real_steps() -> None:
    mdp = FiniteMDP.garnet(8, 2, 1, seed=3)
    exact = solve(mdp, 0.9, method="policy-iteration").q
    options = RunOptions(max_episode_steps=10, record_every=400, exact_q=exact)
    plain, replayed = (
        over_seeds(lambda seed, n=n: episodic_q_learning(
            mdp, 400, 0.9, policy="random", step_size="deterministic", num_replayed=n, seed=seed, options=options), 10)
        for n in (0, 100)
    )  # fmt: skip
    assert np.median(replayed.distance[:, -1]) < 0.1 * np.median(plain.distance[:, -1])


def best_gain(mdp: FiniteMDP) -> float:
    """The largest reward per step over all deterministic policies, from stationary distributions."""
    s, a = mdp.num_states, mdp.num_actions
    p = mdp.transition.toarray().reshape(s, a, s)
    r = mdp.reward.reshape(s, a)
    gains = []
    for policy in product(range(a), repeat=s):
        chosen = p[np.arange(s), policy]
        system = np.vstack([chosen.T - np.eye(s), np.ones(s)])
        stationary = np.linalg.lstsq(system, np.append(np.zeros(s), 1.0), rcond=None)[0]
        gains.append(stationary @ r[np.arange(s), policy])
    return max(gains)


def test_r_learning_finds_the_best_gain() -> None:
    mdp = FiniteMDP.garnet(4, 2, 4, seed=2)
    policy = EpsilonGreedy(0.5, 0.05, 200_000)
    band = over_seeds(lambda seed: r_learning(
        mdp, 400_000, beta=0.0005, step_size=0.02, policy=policy, seed=seed), 3)  # fmt: skip
    for run in band.runs:
        assert abs(run.average_reward - best_gain(mdp)) < 0.06
    # One state: ρ moves only on best actions. Rewards 1 and 2 under a random policy: the gain is 2, not 1.5.
    two = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[1.0, 2.0]])
    assert abs(r_learning(two, 4000, policy="random").average_reward - 2.0) < 1e-6


@pytest.mark.parametrize(("call", "message"), [
    (lambda: n_step(corridor(3), 5, 0.9, n=0), "n must be"),
    (lambda: n_step(corridor(3), 5, 0.9, rule="td"), "rule"),
    (lambda: n_step(corridor(3), 5, 0.9, rule="expected-sarsa", policy="ucb"), "confidence"),
    (lambda: episodic_q_learning(corridor(3), 5, 0.9, order="random"), "order"),
    (lambda: episodic_q_learning(corridor(3), 5, 0.9, num_replayed=-1), "num_replayed"),
    (lambda: r_learning(corridor(3), 5), "for ever"), (lambda: r_learning(corridor(3).as_env(), 5), "for ever"),
    (lambda: r_learning(corridor(3), 5, beta=2.0), "for ever"),
])  # fmt: skip
def test_bad_input_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
