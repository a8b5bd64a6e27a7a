"""A model with its discount, ready for solvers: rows as kernels read them, and what a residual proves.

Let T be the Bellman optimality operator and d = T V − V on the states that act, with m ≤ d ≤ M. Let W(s) be the largest
expected discounted number of steps that any policy takes from s, `reach` its maximum, and c the least mass, discounted,
with which a row leads to states that act. Then, T being monotone,

    lo ≤ V* − T V ≤ hi,   hi = (reach − 1) M if M ≥ 0, else c/(1 − c) M;   lo likewise from m    (MacQueen 1966).

If every row goes on with modulus γ, then W = 1/(1 − γ) and this is Puterman 1994, theorem 6.3.3 and section 6.6.
With γ = 1 W is finite iff every policy ends its episodes (Bertsekas & Tsitsiklis 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from neuralq.exact.kernels import Floats, Rows, look_ahead
from neuralq.mdp import FiniteMDP

__all__ = [
    "Found",
    "PlanningProblem",
    "default_tolerance",
    "is_close_enough",
    "prepare",
    "q_of_rows",
    "rows_of",
    "trapped_rows",
]


_NEAR_FLOOR = 16.0
_TOL, _TOL_OF_REWARD = 1e-8, 1e-6


class Found(NamedTuple):
    """What a method hands over: values, how often it went round, backups of rows, and its policy where it has one.

    ``policy`` is a row for each state. With γ = 1 it matters: of actions that tie some may never lead to an end.
    """

    v: Floats
    iterations: int
    backups: int
    policy: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """A model and γ as solvers see them.

    Args:
        mdp: the model.
        gamma: γ.
        rows: its rows.
        acts: states that have an action, ``[S]``.
        reach: largest expected discounted number of steps; infinite where a policy may go on for ever undiscounted.
        least_modulus: c, the least discounted mass of a row that goes on.
        longest: most successors of a row.
        largest_reward: max |r|.
    """

    mdp: FiniteMDP
    gamma: float
    rows: Rows
    acts: NDArray[np.bool_]
    reach: float
    least_modulus: float
    longest: int
    largest_reward: float

    @property
    def uniform(self) -> bool:
        """Whether all rows go on with one modulus, but for rounding: then a constant error is known, and removed."""
        return abs((1 - self.least_modulus) * self.reach - 1) < 1e-6  # rounding of the modulus, times a reach of 10⁹

    def rounding(self, v: Floats) -> float:
        """What rounding can do to one backup: each of its sums is off by half a unit in the last place."""
        size = self.largest_reward + max(float(v.max()), -float(v.min()))
        return (self.longest + 4) * float(np.finfo(np.float64).eps) * size

    def interval(self, least: float, largest: float) -> tuple[float, float]:
        """Bounds on V* − T V from the least and the largest change T V − V, rounding left out."""
        sure = self.least_modulus / (1 - self.least_modulus) if self.least_modulus < 1 else 0.0
        # (reach − 1) · 0 is 0 also where reach is infinite: V = T V leaves no error in exact arithmetic.
        up = sure * largest if largest <= 0 else (self.reach - 1) * largest
        down = sure * least if least >= 0 else (self.reach - 1) * least
        return down, up


def default_tolerance(problem: PlanningProblem) -> float:
    """1e-8, or a millionth of the largest |reward| where that is less: the unit of rewards must not decide alone."""
    return min(_TOL, _TOL_OF_REWARD * problem.largest_reward) or _TOL


def is_close_enough(bound: float, tol: float, v: Floats, floor: float) -> bool:
    """Whether a bound is what was asked for: ``tol``, or where rounding allows no less, ``tol`` times the largest |v|.

    ``floor`` is the bound that rounding leaves. A method that ends within a small factor of it has done what can be
    done, and whether that is enough must not depend on the unit in which rewards are counted.
    """
    near = _NEAR_FLOOR * floor
    return bool(bound <= tol or bound <= near <= tol * float(np.abs(v).max()))


def rows_of(mdp: FiniteMDP, gamma: float) -> Rows:
    """The rows of a model for kernels; the transition matrix is shared, not copied."""
    transition = mdp.transition
    kind = np.dtype(f"u{transition.indptr.itemsize}")
    return Rows(
        mdp.row_starts.astype(kind),
        transition.indptr.view(kind),
        transition.indices.view(kind),
        transition.data,
        mdp.reward,
        gamma * mdp.row_discount,
    )


def prepare(mdp: FiniteMDP, gamma: float) -> PlanningProblem:
    """The problem of a model and γ. Where γ does not discount, ``reach`` is still to be found: it is infinite here."""
    rows = rows_of(mdp, gamma)
    acts = ~mdp.is_terminal
    goes_on = mdp.row_mass if acts.all() else mdp.transition @ acts.astype(np.float64)
    modulus = goes_on * rows.decay
    largest, least = float(modulus.max()), float(modulus.min())
    reach = 1 / (1 - largest) if largest < 1 - 1e-12 else np.inf
    longest = int(np.max(np.diff(mdp.transition.indptr), initial=0))
    size = max(float(mdp.reward.max()), -float(mdp.reward.min()))
    return PlanningProblem(mdp, gamma, rows, acts, reach, least, longest, size)


def trapped_rows(problem: PlanningProblem, among: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """Rows by which some policy stays for ever without discount: those of the largest set that need not be left.

    With ``among`` (a mask of rows) only these are taken.

    Each of them loses nothing and leads only to states that have such a row (the maximal end components, de Alfaro
    1997). Empty iff every policy ends its episodes.
    """
    mdp = problem.mdp
    loses_nothing = problem.rows.decay * mdp.row_mass >= 1 - 1e-9
    if among is not None:
        loses_nothing &= among
    pattern = sparse.csr_array(
        ((mdp.transition.data > 0).astype(np.float64), mdp.transition.indices, mdp.transition.indptr),
        shape=mdp.transition.shape,
    )
    stays = problem.acts.copy()
    while True:
        inside = loses_nothing & (pattern @ (~stays).astype(np.float64) == 0)
        kept = np.zeros(mdp.num_states, dtype=bool)
        kept[mdp.s_tm1[inside]] = True
        kept &= stays
        if np.array_equal(kept, stays):
            return np.flatnonzero(inside & stays[mdp.s_tm1])
        stays = kept


def q_of_rows(problem: PlanningProblem, v: Floats) -> Floats:
    """One look ahead from ``v``, a value for each row, ``[K]``."""
    out = np.empty(problem.mdp.num_rows)
    look_ahead(problem.rows, v, out)
    return out
