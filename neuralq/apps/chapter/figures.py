"""Figures 13.2 and 13.3, and exercise 13.1: the small grid world and one update of its table."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from neuralq.apps.pages.grids import policy_grid, q_grid, short
from neuralq.exact import evaluate, optimal_policies, solve
from neuralq.mdp import FiniteMDP
from neuralq.runs.report.claims import ChapterPage, Row, claim, misprint, number, own
from neuralq.tabular import Experience, apply
from neuralq_envs import mitchell

__all__ = ["all_policies", "exercise_13_1", "figure_13_2", "figure_13_3"]

CELLS = ("top left", "top middle", "top right", "bottom left", "bottom middle", "bottom right")
SIGNS = "..G..."
_PRINTED_V = (90.0, 100.0, 0.0, 81.0, 90.0, 100.0)
# (cell, action) -> the number on the arrow; 72 stands where 0.9 · 81 = 72.9 belongs.
_PRINTED_Q = {
    (0, 1): 90.0, (0, 2): 72.0,
    (1, 1): 100.0, (1, 2): 81.0, (1, 3): 81.0,
    (3, 0): 81.0, (3, 1): 81.0,
    (4, 0): 90.0, (4, 1): 90.0, (4, 3): 72.0,
    (5, 0): 100.0, (5, 3): 81.0,
}  # fmt: skip
_CUT_SHORT = "0.9 · 81 = 72.9, printed without its last digit"


def figure_13_2() -> ChapterPage:
    """Figure 13.2: the exact V* and Q of the small grid world, number by number.

    Source: Mitchell 1997, Figure 13.2.

    Example:
        >>> figure_13_2().reproduced
        True
    """
    mdp = mitchell.mdp()
    answer = solve(mdp, mitchell.GAMMA)
    rows = [number(f"V*({CELLS[s]})", _PRINTED_V[s], float(answer.v[s])) for s in range(6)]
    for (s, a), printed in _PRINTED_Q.items():
        what, ours = f"Q({CELLS[s]}, {mitchell.ACTIONS[a]})", float(answer.q[s, a])
        row = misprint(what, printed, 72.9, ours, _CUT_SHORT) if printed == 72.0 else number(what, printed, ours)
        rows.append(row)
    rows.append(own("guaranteed largest error of V*", answer.bound))
    text = (
        "Entering G pays 100 and ends the episode; every other move pays nothing. A cell n moves away from G is worth "
        " 100 · 0.9ⁿ⁻¹: the reward does not shrink, but it comes later, and later counts less.",
        "Q(s, a) is what the first move pays plus 0.9 times the value of the cell it leads to. The best of the numbers "
        "around a cell is the cell's own value, and acting by the best number needs no map of the world.",
    )
    drawings = (
        policy_grid("V* and every optimal move", SIGNS, 3, answer.v, answer.optimal_actions),
        q_grid("Q: the value of each move", SIGNS, 3, answer.q),
    )
    return ChapterPage("fig-13.2", "The small grid world, solved exactly", "13.2", text, tuple(rows), drawings)


def figure_13_3() -> ChapterPage:
    """Figure 13.3: one step to the right changes one entry of the table, from 72.9 to 90.

    Source: Mitchell 1997, Figure 13.3, rule 13.7.

    Example:
        >>> figure_13_3().reproduced
        True
    """
    east = mitchell.ACTIONS.index("east")
    before = np.where(mitchell.mdp().legal, 0.0, np.nan)
    before[0, east] = 72.9
    before[1] = [np.nan, 100.0, 81.0, 66.0]
    step = Experience(
        np.array([0]), np.array([east]), np.array([0.0]), np.array([mitchell.GAMMA]), np.array([1]), np.array([False])
    )
    after = apply(before, step, step_size="deterministic").q
    changed = int(np.count_nonzero(np.nan_to_num(after) != np.nan_to_num(before)))
    rows = (
        own("Q̂(s₁, right) before", float(before[0, east])),
        own("largest Q̂(s₂, ·)", float(np.nanmax(before[1]))),
        number("Q̂(s₁, right) after", 90.0, float(after[0, east])),
        claim("entries changed", "one", changed, changed == 1),
    )
    text = (
        "The agent moves right from s₁ (top left) to s₂ and is paid nothing. The new estimate is the reward plus 0.9 "
        "times the best in s₂: 0 + 0.9 · max(66, 81, 100) = 90. The old estimate, 72.9, is not averaged in: in "
        "a deterministic world one look at a move tells everything about it.",
    )
    drawings = (
        q_grid("the table before the move", SIGNS, 3, np.where(before == 0, np.nan, before)),
        q_grid("the table after the move", SIGNS, 3, np.where(after == 0, np.nan, after)),
    )
    return ChapterPage("fig-13.3", "One update of the table", "13.3.2", text, rows, drawings)


def exercise_13_1() -> ChapterPage:
    """Exercise 13.1: every optimal policy of Figure 13.2, found twice.

    Once from the optimal actions, once by trying all policies.

    Source: Mitchell 1997, exercise 13.1.

    Example:
        >>> exercise_13_1().reproduced
        True
    """
    mdp = mitchell.mdp()
    answer = solve(mdp, mitchell.GAMMA)
    policies = list(optimal_policies(answer))
    tried = all_policies(mdp)
    best = [p for p in tried if np.max(np.abs(evaluate(mdp, p, mitchell.GAMMA) - answer.v)) < 1e-9]
    same = sorted(p.tolist() for p in best) == sorted(p.tolist() for p in policies)
    rows: list[Row] = [
        own("deterministic policies in all", len(tried)),
        claim("optimal policies", "all of them", len(policies), same, "trying every policy finds the same ones"),
    ]
    free = [s for s in range(6) if answer.optimal_actions[s].sum() > 1]
    for s in free:
        names = " or ".join(mitchell.ACTIONS[a] for a in np.flatnonzero(answer.optimal_actions[s]))
        rows.append(own(f"{CELLS[s]}: V* = {short(float(answer.v[s]))}", names))
    text = (
        "A policy is optimal exactly if it takes, in every cell, a move whose Q is the largest there. Two cells have "
        "two such moves each and the others one, so there are 2 · 2 optimal policies, all with the same values.",
    )
    one_hot = np.eye(mdp.num_actions, dtype=bool)
    drawings = tuple(
        policy_grid(f"optimal policy {i} of {len(policies)}", SIGNS, 3, answer.v, one_hot[p] & (p >= 0)[:, None])
        for i, p in enumerate(policies, 1)
    )
    return ChapterPage("ex-13.1", "All optimal policies of the small grid world", "13.2", text, tuple(rows), drawings)


def all_policies(mdp: FiniteMDP) -> list[NDArray[np.int64]]:
    """Every deterministic policy, ``[S]`` each, −1 where there is no action.

    Example:
        >>> len(all_policies(mitchell.mdp()))  # 2 · 3 · 2 · 3 · 2
        72
    """
    choices = [np.flatnonzero(row).tolist() or [-1] for row in mdp.legal]
    return [np.array(policy, dtype=np.int64) for policy in itertools.product(*choices)]
