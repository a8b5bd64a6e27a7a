"""Learned action values of a finite model held against its exact ones: in numbers, and as a picture of a grid."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neuralq.mdp import FiniteMDP
from neuralq.mdp.grid import GridPlan
from neuralq.runs.evaluation import shown
from neuralq.types import Floats

if TYPE_CHECKING:
    from neuralq.exact import Solution

__all__ = ["DRAWING_NAME", "Answer", "Comparison", "Held"]

DRAWING_NAME = "exact.json"
"""What the picture of a grid is drawn from, in a run's folder."""

_MOST_FACTORED = 3_000  # states up to which a policy is evaluated by factoring a matrix


@dataclass(frozen=True)
class Comparison:
    """What was learned beside what is true, in the environment's units.

    Args:
        q_error_max: largest |Q − Q*| over the pairs that were visited; None where none was.
        q_error_mean: their mean.
        q_error_max_all: the same over the legal pairs of all states in which an episode can be.
        q_error_mean_all: their mean.
        regret: V*(start) − V^π(start) of the greedy policy; infinite where γ = 1 and it never ends.
        optimal_share: share of the visited states in which the greedy action is optimal.
        optimal_share_all: of all states in which an episode can be.
        start_value: max Q at the start, as learned.
        exact_start_value: V* at the start.
    """

    q_error_max: float | None
    q_error_mean: float | None
    q_error_max_all: float
    q_error_mean_all: float
    regret: float
    optimal_share: float | None
    optimal_share_all: float
    start_value: float
    exact_start_value: float

    def lines(self) -> list[str]:
        """The same for people.

        Example:
            >>> print(*Comparison(0.02, 0.01, 0.5, 0.1, 0.0, 1.0, 0.875, 0.54, 0.542).lines(), sep="; ")
            value of the start 0.540, exactly 0.542; the greedy policy earns 0 less than an optimal one; \
optimal actions in 100% of the visited states, 88% of all; |Q − Q*| at most 0.02 (mean 0.01) \
where it has been, 0.5 (mean 0.1) everywhere
        """
        lost = "never ends" if math.isinf(self.regret) else f"earns {self.regret:.3g} less than an optimal one"
        seen = "" if self.optimal_share is None else f"{self.optimal_share:.0%} of the visited states, "
        been = "" if self.q_error_max is None else (
            f"at most {self.q_error_max:.3g} (mean {self.q_error_mean:.3g}) where it has been, "
        )  # fmt: skip
        return [
            f"value of the start {shown(self.start_value)}, exactly {shown(self.exact_start_value)}",
            f"the greedy policy {lost}",
            f"optimal actions in {seen}{self.optimal_share_all:.0%} of all"
            + ("" if self.optimal_share is not None else " states"),
            f"|Q − Q*| {been}{self.q_error_max_all:.3g} (mean {self.q_error_mean_all:.3g}) everywhere",
        ]

    def plain(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Answer:
    """A solved model.

    Args:
        mdp: the model.
        gamma: γ.
        solution: its optimal values and actions.
        start: where episodes begin, ``[S]``.
        alive: states in which an episode can be and go on, ``[S]``: the others count for nothing.
        plan: how its states lie on a grid, if they do.
        limit: steps after which the environment cuts its episodes, which the model does not know.
    """

    mdp: FiniteMDP
    gamma: float
    solution: Solution
    start: Floats
    alive: NDArray[np.bool_]
    plan: GridPlan | None
    limit: int | None

    def line(self) -> str:
        """What was solved, for people."""
        how = f"{self.mdp.num_states:,} states by {self.solution.method}, {self.solution.seconds:.2g} s"
        cut = ""
        if self.limit is not None:
            cut = f"; episodes are cut after {self.limit:,} steps, which the model does not know"
        value = shown(float(self.start @ self.solution.v))
        return f"beside what is learned stands the exact answer ({how}): V* at the start {value}{cut}"


@dataclass(frozen=True, eq=False)
class Held:
    """Learned action values beside a solved model.

    Args:
        answer: the model, solved.
        q: what was learned, in the environment's units, ``[S, A]``.
        legal: which actions can be taken in states where an episode can be, ``[S, A]``.
        visited: which were taken, ``[S, A]``; None where it is not known.
    """

    answer: Answer
    q: Floats
    legal: NDArray[np.bool_]
    visited: NDArray[np.bool_] | None

    def _greedy(self) -> NDArray[np.int64]:
        greedy: NDArray[np.int64] = np.where(self.legal, self.q, -np.inf).argmax(axis=1)
        return greedy

    def _values(self) -> Floats:
        """Max Q of each state, ``[S]``; −∞ where nothing is legal."""
        values: Floats = np.where(self.legal, self.q, -np.inf).max(axis=1)
        return values

    def compared(self) -> Comparison:
        """In numbers."""
        answer, legal, solution, start = self.answer, self.legal, self.answer.solution, self.answer.start
        acts = legal.any(axis=1)
        error = np.abs(self.q - solution.q)
        met = np.zeros_like(legal) if self.visited is None else self.visited & legal
        greedy = np.where(acts, self._greedy(), solution.policy)  # no episode comes where it does not act
        optimal = solution.optimal_actions[np.arange(len(self.q)), greedy]
        states = met.any(axis=1)
        best = np.where(acts, self._values(), 0.0)
        begins = start > 0
        v_start = float(start @ solution.v)
        v_pi = _policy_value(answer, greedy)
        return Comparison(
            q_error_max=float(error[met].max()) if met.any() else None,
            q_error_mean=float(error[met].mean()) if met.any() else None,
            q_error_max_all=float(error[legal].max()),
            q_error_mean_all=float(error[legal].mean()),
            regret=max(0.0, v_start - v_pi),  # below 0 only by rounding
            optimal_share=float(optimal[states].mean()) if states.any() else None,
            optimal_share_all=float(optimal[acts].mean()),
            start_value=float(start[begins] @ best[begins]),
            exact_start_value=v_start,
        )

    def drawing(self) -> dict[str, Any] | None:
        """What a picture of the grid is drawn from, as plain values; None where the states form none.

        The error of a cell is the largest |Q − Q*| over its legal actions.
        """
        plan, solution, acts = self.answer.plan, self.answer.solution, self.answer.alive
        if plan is None:
            return None
        greedy = self._greedy()
        chosen = solution.optimal_actions[np.arange(len(self.q)), greedy]
        error = np.where(self.legal, np.abs(self.q - solution.q), 0.0).max(axis=1)
        return {
            "num_columns": plan.num_columns,
            "signs": ["#" if plan.walls[s] else sign.strip() for s, sign in enumerate(plan.signs)],
            "arrows": [plan.directions[a] if acts[s] else None for s, a in enumerate(greedy.tolist())],
            "optimal": [bool(one) if acts[s] else None for s, one in enumerate(chosen)],
            "learned": [float(x) if acts[s] else None for s, x in enumerate(self._values())],
            "error": [float(x) if acts[s] else None for s, x in enumerate(error)],
            "visited": None if self.visited is None else self.visited.any(axis=1).tolist(),
        }


def _policy_value(answer: Answer, policy: NDArray[np.int64]) -> float:
    """V^π at the start; −∞ where γ = 1 and π never ends."""
    from neuralq.exact import evaluate
    from neuralq.exact.policies import policy_values
    from neuralq.exact.problem import prepare

    mdp = answer.mdp
    if answer.gamma < 1 and mdp.num_states > _MOST_FACTORED:
        acts = np.flatnonzero(~mdp.is_terminal)
        rows = np.zeros(mdp.num_states, np.int64)
        rows[acts] = mdp.row_index[acts, policy[acts]]
        return float(answer.start @ policy_values(prepare(mdp, answer.gamma), rows, answer.solution.v)[0])
    try:
        return float(answer.start @ evaluate(mdp, policy, answer.gamma))
    except ValueError:
        return -math.inf
