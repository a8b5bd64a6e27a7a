"""Expected backups of action values along a trace: Sarsa, tree backup, Retrace and naive Q, which differ in one cut.

Over pairs these back up the target's expectation, δ = r + γ Σ_a π(a|s') q(s', a) − q(s, a), along a trace cut by a
coefficient of the pair that was entered, z = γ c(s, a) z + x, and share the operator

    A = Xᵀ D (I − γP_c)⁻¹ (I − γP) X,   P_c(s, a → s', a') = p(s'|s, a) μ(a'|s') c(s', a')

    Sarsa(λ)  λρ      tree backup(λ)  λπ(a|s)      Retrace(λ)  λ min(1, ρ)      naive Q(λ)  λ
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import sparse

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.chains import pairs_of
from neuralq.lab.methods.operators import ahead, traced_flow
from neuralq.lab.methods.record import LAMBDA, Expected, Method, Options, SampledUpdate
from neuralq.lab.methods.trace import Trace
from neuralq.types import Floats

__all__ = ["EXPECTED_SARSA", "NAIVE_Q", "RETRACE", "TREE_BACKUP"]


class _PairTrace:
    """Expected backups along a trace; ``cut`` is c(s, a) of every row, ``[n]``."""

    def __init__(self, process: Process, w0: Floats, cut: Floats) -> None:
        self.theta = w0.copy()
        self._cut, self._state = cut, process.state
        self._trace = Trace(w0.shape)
        weight = process.target_policy[process.pairs[:, 0], process.pairs[:, 1]]  # type: ignore[index]
        choose = sparse.csr_array(
            (weight, (process.state, np.arange(process.num_rows))), shape=(len(process.target_policy), process.num_rows)
        )
        self._mean = choose @ process.X  # what the target expects to see in each state

    def update(self, sample: SampledTransition, step_size: float) -> None:
        z = self._trace.advance(sample, fade=self._cut[sample.next_row])
        change = sample.discount[:, None] * self._mean[self._state[sample.next_row]] - sample.x  # discount 0 at an end
        delta = sample.reward + np.einsum("nd,nd->n", self.theta, change)
        self.theta += step_size * delta[:, None] * z


Cut = Callable[[Floats, Floats], Floats]  # (π, μ) of every row -> c / λ of every row


def _cut(process: Process, options: Options, name: str, cut: Cut) -> Floats:
    """c(s, a) of every row, ``[n]``; 0 where the behaviour never enters."""
    pairs_of(process, name)
    s, a = process.pairs[:, 0], process.pairs[:, 1]  # type: ignore[index]
    mu = process.behaviour_policy[s, a]
    entered = np.where(mu > 0, mu, 1.0)
    c: Floats = np.where(mu > 0, options["lambda_"] * cut(process.target_policy[s, a], entered), 0.0)
    return c


def _pair_method(name: str, title: str, source: str, cut: Cut, **more: Any) -> Method:
    def expected(process: Process, options: Options) -> Expected:
        c = _cut(process, options, name, cut)
        P_c = process.P_mu * c if isinstance(process.P_mu, np.ndarray) else process.P_mu @ sparse.diags_array(c)
        return traced_flow(process, process.D, P_c, process.gamma, ahead(process), process.r)

    def learner(process: Process, w0: Floats, options: Options) -> SampledUpdate:
        return _PairTrace(process, w0, _cut(process, options, name, cut))

    return Method(name, title, source, {"lambda_": LAMBDA}, expected, learner, rows="pairs", **more)


EXPECTED_SARSA = _pair_method(
    "expected-sarsa", "expected Sarsa(λ), by importance", "van Seijen et al. 2009; Sutton & Barto 2018, section 12.8",
    lambda pi, mu: pi / mu, place=80,
)  # fmt: skip
TREE_BACKUP = _pair_method("tree-backup", "tree backup(λ)", "Precup, Sutton & Singh 2000", lambda pi, mu: pi, place=81)
RETRACE = _pair_method("retrace", "Retrace(λ)", "Munos et al. 2016", lambda pi, mu: np.minimum(1.0, pi / mu), place=82)
NAIVE_Q = _pair_method(
    "naive-q", "Q(λ) without cuts", "Harutyunyan et al. 2016", lambda pi, mu: np.ones_like(pi),
    note="a contraction only where λ is small against the distance between the policies, even for a table", place=83,
)  # fmt: skip
