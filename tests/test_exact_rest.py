"""γ = 1 where episodes do not end but come to rest: states that lead to themselves at reward 0 are worth 0.

Mutants that die here: rest taken where a reward can still be earned, or where an end can be reached; actions that leave
rest for a loss called optimal; a policy's rest refused; a way out in a message that refuses in its turn.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_exact_criteria import graph, policies, random_model

from neuralq.exact import METHODS, evaluate, solve
from neuralq.mdp import FiniteMDP

GOALS = (0, 15)


def two_goals(bump: float = 0.0) -> FiniteMDP:
    """The 4x4 grid of the textbooks: −1 a move, and goals that lead to themselves, at reward 0 or, north, ``bump``."""

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        if s in GOALS:
            return [(1.0, s, bump if a == 0 else 0.0, False)]
        row, column = s // 4 + (-1, 0, 1, 0)[a], s % 4 + (0, 1, 0, -1)[a]
        return [(1.0, 4 * min(max(row, 0), 3) + min(max(column, 0), 3), -1.0, False)]

    return FiniteMDP.from_functions(16, 4, lambda s: range(4), transitions)


DISTANCE = np.array([min(s // 4 + s % 4, 6 - s // 4 - s % 4) for s in range(16)])


@pytest.mark.parametrize("bump", [0.0, -1.0])
@pytest.mark.parametrize("method", ["auto", "bellman-ford", "policy-iteration"])
def test_goals_that_lead_to_themselves_at_reward_0_are_worth_0(method: str, bump: float) -> None:
    mdp = two_goals(bump)
    answer = solve(mdp, 1.0, method)
    assert answer.converged and answer.v == pytest.approx(-DISTANCE, abs=1e-9)
    assert answer.policy[0] == (0 if bump == 0 else 1)  # the lowest action that rests
    assert answer.optimal_actions[0].tolist() == [bump == 0, True, True, True] and answer.q[0, 0] == bump
    assert evaluate(mdp, answer.policy, 1.0) == pytest.approx(-DISTANCE)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_the_distance_where_no_move_can_be_repeated_for_ever(method: str) -> None:
    # 3 → 2 → 1 → 0, and 0 → 0 at reward 0; from 3 also straight to 1 for −3.
    edges = {(0, 0): (0, 0.0), (1, 0): (0, -1.0), (2, 0): (1, -1.0), (3, 0): (2, -1.0), (3, 1): (1, -3.0)}
    answer = solve(graph(edges, 4), 1.0, method)
    assert answer.converged and answer.v == pytest.approx([0, -1, -2, -3]) and answer.policy[3] == 0


def test_a_class_of_several_states_is_a_rest_too_and_one_that_can_earn_is_none() -> None:
    # 1 and 2 lead to each other by chance at reward 0; nothing else is left.
    class_of_two = {
        0: [(1.0, 1, -4.0, False)],
        1: [(0.5, 2, 0.0, False), (0.5, 1, 0.0, False)],
        2: [(1.0, 1, 0.0, False)],
    }
    for method in ("auto", "value-iteration", "policy-iteration", "linear-programming", "rtdp"):
        answer = solve(FiniteMDP.from_functions(3, 1, lambda s: [0], lambda s, a: class_of_two[s]), 1.0, method)
        assert answer.v.tolist() == [-4.0, 0.0, 0.0] and answer.converged
    nothing = solve(graph({(0, 0): (1, 0.0), (1, 0): (0, 0.0)}, 2), 1.0)
    assert nothing.v.tolist() == [0.0, 0.0] and nothing.converged and nothing.policy.tolist() == [0, 0]
    with pytest.raises(ValueError, match="needs episodes that end"):  # 0 could rest, or earn 1 for ever
        solve(graph({(0, 0): (0, 0.0), (0, 1): (1, 0.0), (1, 0): (0, 1.0)}, 2), 1.0, "policy-iteration")


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_rest_by_enumeration(seed: int) -> None:
    # No row ends, every reward is at most 0: a policy is worth −∞ where it may come to a class that costs.
    model = random_model(seed)
    cost = np.where(np.random.default_rng(seed).random(model.num_rows) < 0.6, 0.0, -np.abs(model.reward))
    mdp = FiniteMDP(model.num_states, 2, model.s_tm1, model.a_tm1, model.transition, cost)
    n, best = mdp.num_states, np.full(mdp.num_states, -np.inf)
    for actions, chain, reward in policies(mdp):
        reach = np.linalg.matrix_power(np.eye(n) + chain, n) > 0
        comes_back = np.array([all(reach[t, s] for t in range(n) if reach[s, t]) for s in range(n)])
        costs = np.array([any(reach[s, t] and comes_back[t] and reward[t] < 0 for t in range(n)) for s in range(n)])
        passing = np.flatnonzero(~comes_back & ~costs)
        value = np.where(costs, -np.inf, 0.0)
        value[passing] = np.linalg.solve(np.eye(len(passing)) - chain[np.ix_(passing, passing)], reward[passing])
        best = np.maximum(best, value)
        if not costs.any():
            assert evaluate(mdp, actions, 1.0) == pytest.approx(value)
        else:
            with pytest.raises(ValueError, match="never does"):
                evaluate(mdp, actions, 1.0)
    if np.isneginf(best).any():
        with pytest.raises(ValueError, match="gamma=1 needs episodes that end"):
            solve(mdp, 1.0)
        return
    answer = solve(mdp, 1.0)
    assert answer.converged and np.abs(answer.v - best).max() <= answer.bound + 1e-9
    assert evaluate(mdp, answer.policy, 1.0) == pytest.approx(best)
    assert answer.q[mdp.s_tm1, mdp.a_tm1] == pytest.approx(mdp.reward + mdp.transition @ best)


def test_the_value_of_a_policy_that_comes_to_rest_is_the_textbooks() -> None:
    # The equiprobable random policy on the 4x4 grid (Sutton & Barto 2018, figure 4.1).
    v = evaluate(two_goals(), np.full((16, 4), 0.25), 1.0).reshape(4, 4)
    assert v == pytest.approx(
        np.array([[0, -14, -20, -22], [-14, -18, -20, -20], [-20, -20, -18, -14], [-22, -20, -14, 0]])
    )


def test_the_way_out_of_a_refusal_works() -> None:
    # Bumping into the border goes on for ever: sweeps are refused, and what the message says is done.
    with pytest.raises(ValueError, match=r"row 4 \(s=1, a=0\) can be repeated for ever") as refusal:
        solve(two_goals(), 1.0, "value-iteration")
    named = re.search("method='(.*)'", str(refusal.value))
    assert named is not None and solve(two_goals(), 1.0, named[1]).v == pytest.approx(-DISTANCE)
    # Where policy iteration refuses as well, it is not what the message advises.
    costly = graph({(0, 0): (0, -1.0), (0, 1): (0, -2.0)}, 1)
    for method in ("value-iteration", "rtdp", "policy-iteration", "bellman-ford"):
        with pytest.raises(ValueError, match="use gamma < 1") as refusal:
            solve(costly, 1.0, method)
        assert "policy-iteration" not in str(refusal.value)
        way = re.search("method='(.*)'", str(refusal.value))
        assert solve(costly, 0.5, method if way is None else way[1]).v == pytest.approx([-2.0])
