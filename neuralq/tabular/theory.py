"""The quantities of the convergence theorems, computed on real runs (Mitchell 1997, theorems 13.1 and 13.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_whole
from neuralq.tabular.control import apply
from neuralq.tabular.kernels.acting import step_length
from neuralq.tabular.policies import StepSizeLike, step_code
from neuralq.tabular.results import Experience

__all__ = ["Sweeps", "robbins_monro_sums", "sweep_errors"]


@dataclass(frozen=True, eq=False)
class Sweeps:
    """A run of rule 13.7 cut into the shortest intervals in which every legal pair is updated at least once.

    Args:
        ends: number of transitions up to the end of each interval, ``[I]``.
        errors: max |Q̂ − Q| before the first interval and after each, ``[I + 1]``.
    """

    ends: NDArray[np.int64]
    errors: NDArray[np.float64]

    @property
    def ratios(self) -> NDArray[np.float64]:
        """Factor by which each interval shrank the error, ``[I]``; theorem 13.1: at most γ on a deterministic MDP."""
        return self.errors[1:] / np.maximum(self.errors[:-1], np.finfo(np.float64).tiny)


def sweep_errors(q: ArrayLike, experience: Experience, exact_q: ArrayLike) -> Sweeps:
    """The error of rule 13.7 after every interval that updates every pair: theorem 13.1, measured.

    Args:
        q: values to start from, ``[S, A]``, NaN where illegal.
        experience: recorded transitions.
        exact_q: Q, ``[S, A]``.

    Source: Mitchell 1997, theorem 13.1.

    Example:
        >>> steps = Experience([0, 1] * 2, [0] * 4, [0.0, 8.0] * 2, [0.5, 0.0] * 2, [1, 1] * 2, [False, True] * 2)
        >>> sweeps = sweep_errors([[0.0], [0.0]], steps, [[4.0], [8.0]])
        >>> sweeps.errors.tolist()
        [8.0, 4.0, 0.0]
    """
    values, exact = np.array(q, dtype=np.float64), np.asarray(exact_q, dtype=np.float64)
    legal = np.isfinite(values)
    errors, ends, begin = [float(np.max(np.abs(values - exact)[legal]))], [], 0
    missing = set(np.flatnonzero(legal).tolist())
    pairs = experience.s_tm1 * values.shape[1] + experience.a_tm1
    for t, pair in enumerate(pairs.tolist()):
        missing.discard(pair)
        if not missing:
            e = experience
            part = slice(begin, t + 1)
            piece = Experience(e.s_tm1[part], e.a_tm1[part], e.r_t[part], e.discount_t[part], e.s_t[part],
                               e.last_t[part], e.next_actions[part])  # fmt: skip
            values = apply(values, piece, step_size="deterministic").q
            errors.append(float(np.max(np.abs(values - exact)[legal])))
            ends.append(t + 1)
            begin, missing = t + 1, set(np.flatnonzero(legal).tolist())
    return Sweeps(np.array(ends, dtype=np.int64), np.array(errors))


def robbins_monro_sums(step_size: StepSizeLike, num_visits: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Partial sums Σ α_n and Σ α_n²: theorem 13.2 asks the first to grow without bound and the second not to.

    Args:
        step_size: the rule.
        num_visits: n runs from 1 to this.

    Returns:
        Both running sums, ``[num_visits]`` each.

    Source: Robbins & Monro 1951; Mitchell 1997, theorem 13.2.

    Example:
        >>> sums, squares = robbins_monro_sums("visits", 3)  # 1/2, 1/3, 1/4
        >>> sums.round(4).tolist(), squares.round(4).tolist()
        ([0.5, 0.8333, 1.0833], [0.25, 0.3611, 0.4236])
    """
    check_whole("num_visits", num_visits)
    rule = step_code(step_size, num_visits)
    alpha = np.array([step_length(rule, n) for n in range(1, num_visits + 1)])
    return np.cumsum(alpha), np.cumsum(alpha**2)
