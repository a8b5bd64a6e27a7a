"""Exercises 13.2 and 13.4: a grid by hand, and why one policy is best from everywhere."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from neuralq.apps.chapter.figures import CELLS, all_policies
from neuralq.apps.pages.grids import policy_grid, q_grid
from neuralq.exact import evaluate, solve
from neuralq.mdp import FiniteMDP
from neuralq.runs.report.claims import ChapterPage, Chart, Row, Series, claim, number, own
from neuralq.tabular import Experience, apply
from neuralq_envs import mitchell

__all__ = ["exercise_13_2", "exercise_13_4", "perimeter_walk"]

NORTH, EAST, SOUTH, WEST = range(4)
_SIGNS = "....G."
_VALUES = (8.0, 10.0, 8.0, 10.0, 0.0, 10.0)
# Episode by episode: the entry that changes, and its new value.
_CHANGES = (((5, WEST), 10.0), ((2, SOUTH), 8.0), ((1, EAST), 6.4))


def exercise_13_2() -> ChapterPage:
    """Exercise 13.2: V*, Q and two changed rewards, then Q-learning round the perimeter, episode by episode.

    Source: Mitchell 1997, exercise 13.2.

    Example:
        >>> exercise_13_2().reproduced
        True
    """
    mdp = mitchell.mdp(mitchell.EXERCISE_GOAL, mitchell.EXERCISE_REWARD)
    gamma = mitchell.EXERCISE_GAMMA
    answer = solve(mdp, gamma)
    rows: list[Row] = [number(f"V*({CELLS[s]})", _VALUES[s], float(answer.v[s])) for s in range(6)]
    rows += _changed_rewards(mdp, gamma)
    table = np.where(mdp.legal, 0.0, np.nan)
    drawings = [
        policy_grid("V* and every optimal move", _SIGNS, 3, answer.v, answer.optimal_actions),
        q_grid("Q", _SIGNS, 3, answer.q),
    ]
    for episode, ((s, a), value) in enumerate(_CHANGES, 1):
        after = apply(table, perimeter_walk(), step_size="deterministic").q
        changed = int(np.count_nonzero(np.nan_to_num(after) != np.nan_to_num(table)))
        rows.append(number(f"episode {episode}: Q̂({CELLS[s]}, {mitchell.ACTIONS[a]})", value, float(after[s, a])))
        rows.append(claim(f"episode {episode}: entries changed", "one", changed, changed == 1))
        table = after
    drawings.append(q_grid("Q̂ after three episodes", _SIGNS, 3, table))
    text = (
        "G is the bottom middle cell and pays 10; γ = 0.8. Cells beside it are worth 10, the two others 8.",
        "Doubling the reward of G doubles Q and leaves the best moves as they were. Making a bad move worse lowers "
        "its Q and nothing else: V* looks at the best moves only.",
        "An agent that walks clockwise round the grid from the bottom left learns one entry per episode. In the first "
        "only the last move is paid; in the second the move before it finds a successor that is worth something; and "
        "so on. Updating each episode backwards would have done all of it at once (see the page order).",
    )
    return ChapterPage(
        "ex-13.2", "A grid solved, changed and learned by hand", "13.3", text, tuple(rows), tuple(drawings)
    )


def perimeter_walk() -> Experience:
    """Clockwise from the bottom left into G: north, east, east, south, west.

    Example:
        >>> perimeter_walk().s_t.tolist()
        [0, 1, 2, 5, 4]
    """
    gamma = mitchell.EXERCISE_GAMMA
    return Experience(
        np.array([3, 0, 1, 2, 5]),
        np.array([NORTH, EAST, EAST, SOUTH, WEST]),
        np.array([0.0, 0.0, 0.0, 0.0, mitchell.EXERCISE_REWARD]),
        np.array([gamma, gamma, gamma, gamma, 0.0]),
        np.array([0, 1, 2, 5, 4]),
        np.array([False, False, False, False, True]),
    )


def _changed_rewards(mdp: FiniteMDP, gamma: float) -> list[Row]:
    """A change that keeps the optimal moves, and one that keeps V*."""
    before = solve(mdp, gamma)
    doubled = solve(dataclasses.replace(mdp, reward=2 * mdp.reward, outcomes=None), gamma)
    worse_move = mdp.reward.copy()
    worse_move[mdp.row_index[1, WEST]] -= 1.0
    worse = solve(dataclasses.replace(mdp, reward=worse_move, outcomes=None), gamma)
    same_moves = bool((doubled.optimal_actions == before.optimal_actions).all())
    changed = _num_changed(before.q, doubled.q), _num_changed(before.q, worse.q)
    same_values = float(np.max(np.abs(worse.v - before.v)))
    return [
        claim("G pays 20: entries of Q that change", "some", changed[0], changed[0] > 0),
        claim("G pays 20: optimal moves", "the same", "the same" if same_moves else "others", same_moves),
        claim("leaving the top middle westwards costs 1: entries of Q that change", "some", changed[1], changed[1] > 0),
        number("leaving the top middle westwards costs 1: change of V*", 0.0, same_values),
    ]


def _num_changed(q: NDArray[np.float64], other: NDArray[np.float64]) -> int:
    return int(np.count_nonzero(np.abs(np.nan_to_num(q - other)) > 1e-9))


def exercise_13_4(num_models: int = 30) -> ChapterPage:
    """Exercise 13.4: in every MDP tried, one policy is best from every start at once.

    Args:
        num_models: random models to try.

    Source: Mitchell 1997, exercise 13.4; the models are Garnets (Archibald, McKinnon & Thomas 1995).

    Example:
        >>> exercise_13_4(num_models=3).reproduced
        True
    """
    gamma, num_states, num_actions = 0.9, 4, 3
    agreeing = disagreeing = 0
    worst = 0.0
    for seed in range(num_models):
        mdp = FiniteMDP.garnet(num_states, num_actions, 2, seed=seed)
        values = np.array([evaluate(mdp, policy, gamma) for policy in all_policies(mdp)])
        best_by_start = values.max(axis=0)
        agreeing += bool((values >= best_by_start - 1e-9).all(axis=1).any())
        worst = max(worst, float(np.max(np.abs(solve(mdp, gamma).v - best_by_start))))
        blind = np.array([evaluate(mdp, np.full(num_states, a), gamma) for a in range(num_actions)])
        disagreeing += not bool((blind >= blind.max(axis=0) - 1e-9).all(axis=1).any())
    rows = (
        own("policies tried in each model", num_actions**num_states),
        claim("models in which one policy is best from every start", str(num_models), agreeing, agreeing == num_models),
        number("largest difference between V* and the best of all policies", 0.0, worst, tol=1e-8),
        own("models in which no single blind policy is best from every start", disagreeing, "blind: one action always"),
    )
    text = (
        "Take the best policy for one start and the best for another, and play in each state whichever action promises "
        "more. In a Markov world what can be earned from a state does not depend on how one came there, so the mixture "
        "is at least as good as both from everywhere; improving until nothing improves gives one policy for all. "
        "Here every policy of small random worlds is evaluated exactly, and the claim holds in each.",
        "It needs an agent that sees the state. Of the policies that always take the same action, one is often best "
        "from here and another from there.",
    )
    order = np.argsort(values.sum(axis=1))
    ranks = range(1, len(order) + 1)
    curves = tuple(Series(f"from state {s}", ranks, values[order, s]) for s in range(num_states))
    charts = (Chart("the last model: the best policy is last from every start", "policy", "value", curves),)
    return ChapterPage("ex-13.4", "One policy is best from every start", "13.2", text, rows, charts)
