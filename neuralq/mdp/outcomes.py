"""What can follow each row of a finite model: every transition with its probability and its own reward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["Outcomes", "short_sum"]


def short_sum(mass: float) -> str:
    """What to tell of a row whose probabilities sum to less than 1."""
    return (
        f"probabilities sum to {mass}, less than 1; if the missing probability is that of the episode's end, "
        "pass substochastic=True"
    )


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Everything that can follow each row: outcomes of row k are ``indptr[k]:indptr[k + 1]``.

    Args:
        indptr: ``[K + 1]``.
        probability: ``[M]``; a row's mass below 1 ends the episode in the state that was left, with reward 0.
        s_t: state that is reached, ``[M]``.
        reward: reward of this very transition, ``[M]``.
        terminated: whether the episode ends here, ``[M]``.

    Example:
        >>> two = Outcomes(*map(np.array, ([0, 2], [0.5, 0.5], [0, 1], [0.0, 4.0], [False, True])))
        >>> two.expected(num_states=2)[1].tolist()
        [2.0]
    """

    indptr: NDArray[np.int64]
    probability: NDArray[np.float64]
    s_t: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]

    @property
    def row(self) -> NDArray[np.int64]:
        """The row of each outcome, ``[M]``."""
        return np.repeat(np.arange(len(self.indptr) - 1), np.diff(self.indptr))

    def check(
        self, s_tm1: NDArray[np.int64], a_tm1: NDArray[np.int64], num_states: int, *, substochastic: bool = False
    ) -> None:
        """Every outcome is a probability, a finite reward and a state, and those of a row sum to 1.

        Raises:
            ValueError: the first that is not, with its row, its pair and its value.
        """
        for what, values, wrong in (
            ("probability", self.probability, ~((self.probability >= 0) & np.isfinite(self.probability))),
            ("reward", self.reward, ~np.isfinite(self.reward)),
            (f"state of 0..{num_states - 1}", self.s_t, (self.s_t < 0) | (self.s_t >= num_states)),
        ):
            bad = np.flatnonzero(wrong)
            if bad.size:
                k = int(self.row[bad[0]])
                raise ValueError(f"row {k} (s={s_tm1[k]}, a={a_tm1[k]}): {values[bad[0]]} is not a valid {what}")
        mass = np.bincount(self.row, weights=self.probability, minlength=len(s_tm1))
        bad = np.flatnonzero(mass > 1 + 1e-9)
        if bad.size:
            k = int(bad[0])
            raise ValueError(f"row {k} (s={s_tm1[k]}, a={a_tm1[k]}): probabilities sum to {mass[k]}, more than 1")
        bad = np.flatnonzero(mass < 1 - 1e-9)
        if bad.size and not substochastic:
            k = int(bad[0])
            raise ValueError(f"row {k} (s={s_tm1[k]}, a={a_tm1[k]}): {short_sum(mass[k])}")

    def expected(self, num_states: int) -> tuple[sparse.csr_array, NDArray[np.float64]]:
        """The continuing transition matrix ``[K, S]`` and the expected reward ``[K]`` of these outcomes."""
        row, k = self.row, len(self.indptr) - 1
        goes_on = ~self.terminated & (self.probability > 0)
        entries = (self.probability[goes_on], (row[goes_on], self.s_t[goes_on]))
        transition = sparse.coo_array(entries, shape=(k, num_states)).tocsr()
        reward = np.bincount(row, weights=self.probability * self.reward, minlength=k)
        return transition, reward.astype(np.float64)
