"""Control: Q-learning and Sarsa, piece by piece, on problems whose numbers are known.

Mutants that die here: max over the behaviour's actions only, or over this state's; illegal actions that win; an end
that bootstraps; ties to the highest action; ε shared among all but the greedy; the greedy policy of old weights in the
piece; Sarsa's visits those of the behaviour; the weight of visits or the ratio of the next action missing; restarts
missing from the visits.
"""

from __future__ import annotations

import numpy as np
import pytest
from lab_laws import Floats, assert_law, process_of, uneven_problem
from scipy import sparse

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import stream
from neuralq.lab.methods.chains import chain_of, epsilon_greedy, greedy_policy, greedy_values, solve_chain, visits_of
from neuralq.lab.methods.control import Q_LEARNING, SARSA, piece_of_policy
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem
from neuralq_envs.counterexamples.baird import star_control
from neuralq_envs.counterexamples.chains import stationary_distribution
from neuralq_envs.counterexamples.chattering import chattering


def pairs_of(process: Process) -> np.ndarray:
    """The table of rows, known to be there."""
    assert process.row_of is not None
    return process.row_of


def test_the_law() -> None:
    """Random weights lie in several regions."""
    process = process_of(3, pairs=True)
    rng = np.random.default_rng(1)
    seen = {greedy_policy(process, pairs_of(process), rng.normal(size=3)).tobytes() for _ in range(30)}
    assert len(seen) >= 6
    for seed in range(4):
        assert_law(process, Q_LEARNING, seed)
        assert_law(process, SARSA, seed, epsilon=0.3)
        assert_law(process, SARSA, seed, epsilon=1.0)


def test_the_piece_is_exact_value_iteration_on_a_table() -> None:
    """With a table of pairs, all updated at α/D: one sweep of r + γ P max Q, from the model's own arrays."""
    problem = uneven_problem(5, pairs=True)
    table = linear_process(problem)
    process = table.with_features(np.eye(table.num_rows))
    mdp, Q = problem.mdp, np.random.default_rng(0).normal(size=table.num_rows)
    best = np.full(mdp.num_states, -np.inf)
    np.maximum.at(best, mdp.s_tm1, Q)
    sweep = mdp.reward + problem.gamma * (mdp.transition.toarray() @ best)
    M, c = Q_LEARNING.expected(process, {}).at(Q, 1.0)  # type: ignore[misc]
    np.testing.assert_allclose((M @ Q + c - Q) / process.D, sweep - Q, rtol=1e-10)


def test_visits_are_the_policys_own() -> None:
    """Against the long-run distribution of the model, which is computed elsewhere and by another factorisation."""
    problem = uneven_problem(6, pairs=True)
    process = linear_process(problem)
    policy = greedy_policy(process, pairs_of(process), np.ones(3), epsilon=0.2)
    s, a = process.pairs.T  # type: ignore[union-attr]
    share = stationary_distribution(problem.mdp, policy)
    np.testing.assert_allclose(visits_of(process, pairs_of(process), policy), share[s] * policy[s, a], atol=1e-12)
    P = chain_of(process, pairs_of(process), problem.target_policy)
    np.testing.assert_allclose(P, process.P, atol=1e-14)


def test_ties_go_to_the_lowest_action_and_illegal_ones_never_win() -> None:
    process = process_of(3, pairs=True)
    policy = greedy_policy(process, pairs_of(process), np.zeros(3))
    assert policy.tolist() == [[1.0, 0.0, 0.0]] * 3
    assert greedy_values(process, pairs_of(process), np.ones((4, 3)))[:, 1, 2].tolist() == [-np.inf] * 4
    assert epsilon_greedy(pairs_of(process), np.array([2, 1, 0]), 0.3).round(12).tolist() == [
        [0.1, 0.1, 0.8], [0.15, 0.85, 0.0], [0.8, 0.1, 0.1],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("solid", "slowest", "highest"),
    [
        (None, -0.0341786, ("38.0893", "2010.963", "63565.35")),
        (0.5, -0.1196252, ("163.305", "1.0663e7", "1.65975e12")),
    ],
)
def test_baird_control(solid: float | None, slowest: float, highest: tuple[str, ...]) -> None:
    """Expected Q-learning, α = .01: max|Q| after 1000, 10000 and 20000 sweeps.

    Numbers from an independent float64 iteration of S&B 2018, exercise 11.3, as printed; least eigenvalues are 1/7 and
    1/2 of the star's −.2392504643.
    """
    problem = star_control(solid_probability=solid)
    process = linear_process(problem)
    expected = Q_LEARNING.expected(process, {})  # type: ignore[misc]
    row_of, theta, found = pairs_of(process), problem.initial_weights.copy(), []
    solid_everywhere = greedy_policy(process, row_of, theta)
    assert solid_everywhere.tolist() == [[0.0, 1.0]] * 7
    A, _ = piece_of_policy(process, solid_everywhere)
    assert np.linalg.eigvals(A).real.min() == pytest.approx(slowest, abs=5.1e-8)
    assert np.linalg.eigvals(A).real.min() == pytest.approx(-0.2392504643 * (solid or 1 / 7), rel=1e-8)
    M, c = expected.at(theta, 0.01)
    for sweep in range(1, 20_001):
        if sweep % 10 == 0:  # the piece stays for the whole run
            M, c = expected.at(theta, 0.01)
        theta = M @ theta + c
        if sweep in (1000, 10_000, 20_000):
            found.append(np.abs(process.X @ theta).max())
            assert np.array_equal(greedy_policy(process, row_of, theta), solid_everywhere)
    for value, printed in zip(found, highest, strict=True):
        digits = len(printed.partition("e")[0].replace(".", ""))
        assert float(f"{value:.{digits - 1}e}") == float(printed)  # to every digit that was printed


def test_chattering_policies() -> None:
    """By hand: A = .95 + 4 · .05 and b = .95 − 2 · .05 while a is greedy; 3.85 and −1.85 while b is."""
    process = linear_process(chattering())
    pieces = [SARSA.expected(process, {"epsilon": 0.1}).at(np.array([w]), 1.0) for w in (-1.0, 1.0)]  # type: ignore[misc]
    fixed = [(c / (1 - M[0]))[0] for M, c in pieces]
    assert fixed == pytest.approx([0.739130, -0.480519], abs=5.1e-7)  # each lies where the other action is greedy
    drift = [c[0] for _, c in pieces]
    assert drift == pytest.approx([0.85, -1.85], rel=1e-12)
    share = -drift[1] / (drift[0] - drift[1])
    assert share == pytest.approx(0.685185, abs=5.1e-7)


def test_chattering_runs() -> None:
    """Expected and sampled Sarsa both slide at w = 0 and spend 37/54 of the time with a greedy."""
    process = linear_process(chattering())
    expected = SARSA.expected(process, {"epsilon": 0.1})  # type: ignore[misc]
    w, count = np.array([1.0]), 0
    for step in range(12_000):
        M, c = expected.at(w, 0.001)
        w = M @ w + c
        count += bool(step >= 2000 and w[0] <= 0)
    assert abs(w[0]) < 0.002
    assert count / 10_000 == pytest.approx(0.685185, abs=2e-3)
    seeds = 400
    learner = SARSA.learner(process, np.ones((seeds, 1)), {"epsilon": 0.1})  # type: ignore[misc]
    samples, greedy_a = stream(process, "iid", seeds, np.random.default_rng(0)), np.zeros(seeds)
    for step in range(2000):
        learner.update(next(samples), 0.005)
        if step >= 800:
            greedy_a += learner.theta[:, 0] <= 0
    share = greedy_a / 1200
    error = share.std(ddof=1) / np.sqrt(seeds)
    assert abs(share.mean() - 0.685185) < 4 * error + 0.01  # an O(α) bias of a finite step
    assert np.abs(learner.theta).max() < 1.5


def test_q_learning_finds_the_optimum_of_a_table() -> None:
    """Sampled chains against value iteration written out."""
    mdp = FiniteMDP.garnet(3, 2, 2, seed=4)
    process = linear_process(Problem.from_mdp(mdp, np.eye(6).reshape(3, 2, 6), gamma=0.8))
    Q = np.zeros(6)
    for _ in range(300):
        best = np.full(3, -np.inf)
        np.maximum.at(best, mdp.s_tm1, Q)
        Q = mdp.reward + 0.8 * (mdp.transition.toarray() @ best)
    learner = Q_LEARNING.learner(process, np.zeros((50, 6)), {})  # type: ignore[misc]
    samples = stream(process, "markov", 50, np.random.default_rng(1))
    for step in range(3000):
        learner.update(next(samples), 0.5 / (1 + step / 300))
    assert np.abs(learner.theta.mean(axis=0) - Q).max() < 0.05


def test_solving_with_sparse_chains_is_the_same() -> None:
    process = process_of(2)
    right = np.random.default_rng(0).normal(size=(3, 2))
    for transposed in (False, True):
        dense: Floats = solve_chain(process.P, 0.7, right, transposed)
        np.testing.assert_allclose(solve_chain(sparse.csr_array(process.P), 0.7, right, transposed), dense, rtol=1e-12)
    with pytest.raises(ValueError, match="no limit"):
        solve_chain(sparse.eye_array(3, format="csr"), 1.0, right)


def test_what_is_refused() -> None:
    states, process = process_of(1), process_of(1, pairs=True)
    for one in (Q_LEARNING, SARSA):
        with pytest.raises(ValueError, match="state-action pairs"):
            one.expected(states, one.checked({}))  # type: ignore[misc]
        with pytest.raises(ValueError, match="state-action pairs"):
            one.learner(states, np.ones((1, 3)), one.checked({}))  # type: ignore[misc]
    with pytest.raises(ValueError, match="epsilon"):
        SARSA.expected(process, SARSA.checked({"epsilon": 1.5}))  # type: ignore[misc]
    with pytest.raises(ValueError, match="epsilon"):
        SARSA.learner(process, np.ones((1, 3)), SARSA.checked({"epsilon": -0.1}))  # type: ignore[misc]
    one_sided = linear_process(star_control(solid_probability=1.0))
    with pytest.raises(ValueError, match="leaves some out"):
        SARSA.learner(one_sided, np.ones((1, 15)), {"epsilon": 0.1})  # type: ignore[misc]
    # two states that never meet: how often each is visited depends on where it began
    apart = FiniteMDP.from_arrays([np.eye(2), np.eye(2)], np.zeros((2, 2)))
    problem = Problem.from_mdp(apart, np.eye(4).reshape(2, 2, 4), gamma=0.9, state_distribution=[0.5, 0.5])
    split = linear_process(problem)
    with pytest.raises(ValueError, match="separate parts"):
        SARSA.expected(split, {"epsilon": 0.1}).at(np.zeros(4), 0.1)  # type: ignore[misc]
