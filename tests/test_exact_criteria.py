"""Undiscounted episodes, finite horizons and average reward, against brute force over all policies or action sequences.

Mutants that die here: a cycle kept on a tie at γ = 1; an improper policy taken for a good one; a horizon one reward too
long; the policy of the wrong time; the gain of one class given to all; the bias not centred; the span of relative value
iteration reported as converged where the gain depends on the state.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from neuralq.exact import METHODS, evaluate_average, solve, solve_average, solve_finite_horizon
from neuralq.mdp import FiniteMDP


def random_model(seed: int, ending: float = 0.0) -> FiniteMDP:
    """Up to 4 states and 2 actions; sparse rows, so that there are several classes and dead ends; whole rewards."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    legal = rng.random((n, 2)) < 0.8
    legal[np.arange(n), rng.integers(0, 2, n)] = True
    s_tm1, a_tm1 = np.nonzero(legal)
    k = len(s_tm1)
    p = np.zeros((k, n))
    for row in p:
        reached = rng.choice(n, size=int(rng.integers(1, min(n, 2) + 1)), replace=False)
        row[reached] = rng.dirichlet(np.ones(len(reached))) if rng.random() < 0.7 else 1 / len(reached)
        row *= 1 - ending * rng.random() if rng.random() < 0.8 else 1 - ending
    return FiniteMDP(n, 2, s_tm1, a_tm1, sparse.csr_array(p), rng.integers(-2, 3, k).astype(float))


def policies(mdp: FiniteMDP) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
    """Every deterministic policy with its P and r."""
    dense = mdp.transition.toarray()
    for rows in itertools.product(*[range(mdp.row_starts[s], mdp.row_starts[s + 1]) for s in range(mdp.num_states)]):
        chosen = list(rows)
        yield mdp.a_tm1[chosen], dense[chosen], mdp.reward[chosen]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_episodes_that_always_end_by_enumeration(seed: int) -> None:
    mdp = random_model(seed, ending=0.4)
    values = [np.linalg.solve(np.eye(mdp.num_states) - p, r) for _, p, r in policies(mdp)]
    best = np.max(values, axis=0)
    assert any(v == pytest.approx(best, abs=1e-9) for v in values)  # exercise 13.4
    for method in METHODS:
        if method == "bellman-ford":
            continue
        answer = solve(mdp, 1.0, method)
        assert answer.converged, method
        assert np.abs(answer.v - best).max() <= answer.bound + 1e-11, method


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_stochastic_shortest_paths_by_enumeration(seed: int) -> None:
    # Every step costs, and episodes need not end: improper policies lose without bound.
    rng = np.random.default_rng(seed)
    mdp = random_model(seed)
    n = mdp.num_states + 1
    p = sparse.csr_array(np.hstack([mdp.transition.toarray() * 0.7, np.full((mdp.num_rows, 1), 0.3)]))
    mixed = sparse.csr_array(np.where(rng.random((mdp.num_rows, 1)) < 0.5, p.toarray(), np.hstack(
        [mdp.transition.toarray(), np.zeros((mdp.num_rows, 1))])))  # fmt: skip
    costly = FiniteMDP(n, 2, mdp.s_tm1, mdp.a_tm1, mixed, -rng.integers(1, 4, mdp.num_rows).astype(float))
    best = np.full(n - 1, -np.inf)
    for _, chain, reward in policies(mdp_without_goal(costly)):
        if np.abs(np.linalg.eigvals(chain)).max() < 1 - 1e-9:
            best = np.maximum(best, np.linalg.solve(np.eye(n - 1) - chain, reward))
    if np.isneginf(best).any():
        with pytest.raises(ValueError, match=r"gamma=1 needs episodes that end, but no p.* from state"):
            solve(costly, 1.0)
        return
    answer = solve(costly, 1.0)
    assert answer.v[:-1] == pytest.approx(best) and answer.v[-1] == 0
    assert answer.converged and np.abs(answer.v[:-1] - best).max() <= answer.bound + 1e-11


def mdp_without_goal(mdp: FiniteMDP) -> FiniteMDP:
    n = mdp.num_states - 1
    return FiniteMDP(n, 2, mdp.s_tm1, mdp.a_tm1, sparse.csr_array(mdp.transition[:, :n]), mdp.reward)


def graph(edges: dict[tuple[int, int], tuple[int, float]], num_states: int) -> FiniteMDP:
    """Deterministic: (s, a) -> (s', reward)."""
    return FiniteMDP.from_functions(
        num_states,
        1 + max(a for _, a in edges),
        lambda s: [a for s_tm1, a in edges if s_tm1 == s],
        lambda s, a: [(1.0, edges[s, a][0], edges[s, a][1], False)],
    )


def test_shortest_paths_and_their_cycles() -> None:
    # 0 → 1 → 3 costs 4, 0 → 1 → 2 → 3 costs 2 and 0 → 2 → 3 costs 3; 1 ⇄ 2 costs nothing: a tie that could cycle.
    edges = {
        (0, 0): (1, -1.0),
        (0, 1): (2, -2.0),
        (1, 0): (2, 0.0),
        (1, 1): (3, -3.0),
        (2, 0): (1, 0.0),
        (2, 1): (3, -1.0),
    }
    answer = solve(graph(edges, 4), 1.0)
    assert answer.method == "bellman-ford" and answer.converged and answer.bound == 0
    assert answer.v.tolist() == [-2.0, -1.0, -1.0, 0.0]
    assert answer.policy.tolist() == [0, 0, 1, -1]  # not 1 → 2 → 1 → …
    with pytest.raises(
        ValueError, match=r"cycle state (1 → state 2 → state 1|2 → state 1 → state 2) earns 0\.5 each time"
    ):
        solve(graph(edges | {(1, 0): (2, 0.5)}, 4), 1.0)
    with pytest.raises(ValueError, match="no path leads to an end from state 4"):
        solve(graph(edges | {(4, 0): (4, -1.0)}, 5), 1.0)
    with pytest.raises(ValueError, match="needs gamma=1 and actions with a certain outcome"):
        solve(graph(edges, 4), 0.9, "bellman-ford")
    early = solve(graph(edges, 4), 1.0, max_iterations=1)
    assert not early.converged and early.bound == np.inf


def test_policy_iteration_refuses_what_never_ends() -> None:
    loop = {0: [(0.5, 0, 1.0, False), (0.5, 1, 1.0, False)], 1: [(1.0, 0, 1.0, False)]}
    mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: loop[s])
    with pytest.raises(ValueError, match="no policy ends one from state 0; use gamma < 1"):
        solve(mdp, 1.0)
    leave = FiniteMDP.from_functions(
        2, 2, lambda s: [0, 1], lambda s, a: loop[s] if a == 0 else [(0.5, s, 0.0, True), (0.5, s, 0.0, True)]
    )
    with pytest.raises(ValueError, match="the best policy goes on for ever: from state 0 it never ends"):
        solve(leave, 1.0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3), st.sampled_from([0.0, 0.5, 1.0]))
def test_finite_horizons_by_enumeration(seed: int, horizon: int, gamma: float) -> None:
    mdp = random_model(seed, ending=0.3)
    last = np.random.default_rng(seed).standard_normal(mdp.num_states)
    best = np.full(mdp.num_states, -np.inf)
    for plan in itertools.product(list(policies(mdp)), repeat=horizon):  # a policy for every time
        v = last
        for _, p, r in reversed(plan):
            v = r + gamma * p @ v
        best = np.maximum(best, v)
        if mdp.num_states > 2 and horizon > 2:
            break
    answer = solve_finite_horizon(mdp, horizon, gamma, terminal_values=last)
    assert answer.v.shape == (horizon + 1, mdp.num_states) and answer.policy.shape == (horizon, mdp.num_states)
    if not (mdp.num_states > 2 and horizon > 2):
        assert answer.v[0] == pytest.approx(best, abs=1e-12)
    v = last
    for t in range(horizon - 1, -1, -1):  # the policy earns what is promised
        rows = mdp.row_index[np.arange(mdp.num_states), answer.policy[t]]
        v = mdp.reward[rows] + gamma * mdp.transition.toarray()[rows] @ v
        assert v == pytest.approx(answer.v[t], abs=1e-12)
        assert answer.optimal_actions[t, np.arange(mdp.num_states), answer.policy[t]].all()


def test_finite_horizons_refuse() -> None:
    mdp = graph({(0, 0): (1, 1.0)}, 2)
    for call, message in [
        (lambda: solve_finite_horizon(mdp, 0), "horizon must be a whole number of at least 1"),
        (lambda: solve_finite_horizon(mdp, 1, 1.5), "gamma must lie in"),
        (lambda: solve_finite_horizon(mdp, 1, terminal_values=[1.0]), r"must have shape \(2,\), got \(1,\)"),
        (lambda: solve_finite_horizon(mdp, 1, terminal_values=[np.nan, 0]), "of state 0 must be finite, got nan"),
        (lambda: solve_finite_horizon(mdp, 1, terminal_values=[0, 2]), "of state 1 must be 0, for its episode is over"),
        (lambda: solve_average(mdp, "magic"), "method must be one of"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


def long_run(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """lim (1/n) Σ P^t of a chain that may be periodic: powers of the lazy chain have the same limit."""
    lazy = (p + np.eye(len(p))) / 2
    for _ in range(60):
        lazy = lazy @ lazy
        lazy /= lazy.sum(axis=1, keepdims=True)
    return lazy


def test_values_at_the_end_of_a_horizon_are_those_that_were_given() -> None:
    ends = FiniteMDP.from_arrays([[[0.5, 0.5], [0.0, 0.0]]], [[1.0], [np.nan]])  # the second state is terminal
    assert solve_finite_horizon(ends, 1, 0.5, terminal_values=[8.0, 0.0]).v[0].tolist() == [1 + 0.5 * 0.5 * 8, 0.0]


@pytest.mark.parametrize(("off", "ties"), [(1.5, True), (2.5, False)])
def test_at_a_horizon_actions_tie_that_two_bounds_do_not_tell_apart(off: float, ties: bool) -> None:
    bound = solve_finite_horizon(FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[1.0, 1.0]]), 1).bound
    answer = solve_finite_horizon(FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[1.0, 1.0 - off * bound]]), 1)
    assert answer.optimal_actions[0, 0].tolist() == [True, ties]


def test_a_sweep_bounds_the_gain_by_half_the_span_of_its_change() -> None:
    flip = FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]], [[0.0], [4.0]])
    swept = solve_average(flip, "relative-value-iteration", max_iterations=1)
    assert swept.gain.tolist() == [2.0, 2.0] and swept.bound == pytest.approx(2.0) and not swept.converged


def test_a_class_counts_wherever_the_end_stands_among_them() -> None:
    """0 ends, 1 and 2 lead to each other: the end is a class too, and here not the last."""
    chain = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    found = evaluate_average(FiniteMDP.from_arrays([chain], [[1.0], [2.0], [3.0]], substochastic=True), [0, 0, 0])
    assert found.gain.tolist() == [0.0, 2.5, 2.5] and found.bias == pytest.approx([1.0, -0.25, 0.25])
    assert (found.recurrent_class >= 0).tolist() == [False, True, True]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_average_reward_by_enumeration(seed: int) -> None:
    mdp = random_model(seed)
    gains = []
    for actions, p, r in policies(mdp):
        found = evaluate_average(mdp, actions)
        limit = long_run(p)
        gains.append(limit @ r)
        assert found.gain == pytest.approx(gains[-1], abs=1e-8)
        assert found.gain + found.bias == pytest.approx(r + p @ found.bias, abs=1e-8)
        assert limit @ found.bias == pytest.approx(np.zeros(mdp.num_states), abs=1e-8)
        assert np.array_equal(found.recurrent_class >= 0, np.diag(limit) > 1e-9)
    best = np.max(gains, axis=0)
    answer = solve_average(mdp)
    assert answer.gain == pytest.approx(best, abs=1e-8) and answer.converged
    assert evaluate_average(mdp, answer.policy).gain == pytest.approx(best, abs=1e-8)
    swept = solve_average(mdp, "relative-value-iteration", tol=1e-6, max_iterations=1000)
    assert np.abs(swept.gain - best).max() <= swept.bound + 1e-9
    if np.ptp(best) > 1e-5:
        assert not swept.converged  # it says so: no single number is right


def test_average_reward_of_known_models() -> None:
    # Stay for 1, or go round 0 → 1 → 0 for (0 + 3) / 2 a step: the chain is periodic.
    mdp = graph({(0, 0): (0, 1.0), (0, 1): (1, 0.0), (1, 0): (0, 3.0)}, 2)
    for method in ("policy-iteration", "relative-value-iteration"):
        answer = solve_average(mdp, method)
        assert answer.gain == pytest.approx([1.5, 1.5]) and answer.policy.tolist() == [1, 0]
        assert answer.converged and not answer.multichain
    ends = solve_average(graph({(0, 0): (1, 5.0)}, 2))  # it rests for ever after 5
    assert ends.gain.tolist() == [0.0, 0.0] and ends.bias.tolist() == [5.0, 0.0]
    islands = solve_average(graph({(0, 0): (0, 1.0), (1, 0): (1, 5.0), (2, 0): (0, 0.0), (2, 1): (1, -9.0)}, 3))
    assert islands.multichain and islands.gain.tolist() == [1.0, 5.0, 5.0] and islands.policy[2] == 1
    stopped = solve_average(mdp, max_iterations=1)
    assert not stopped.converged and stopped.bound == np.inf
