"""GQ(λ) and Greedy-GQ: gradient TD for values of state-action pairs, whose target looks at every next action.

    GQ(λ)       x̄' = Σ_a π(a|s') x(s', a),         δ = r + γ w·x̄' − w·x,     e = x + γλ ρ e,   ρ that of the pair itself
                w += α (δe − γ(1−λ)(h·e) x̄'),       h += ηα (δe − (h·x)x)
    Greedy-GQ   the same with λ = 0 and x̄' = x(s', argmax_a w·x(s', a)), ties to the lowest action

The expectation over next actions needs no ratio, so GQ(0) has the expected update of TDC on pairs with less variance,
and no need that the behaviour policy takes every action of the target. With λ > 0 the long-run trace is that of TDC,
XᵀD (I − γλP)⁻¹, since a ratio in front of what is old or behind what is new makes no difference to the mean.

The expected Greedy-GQ is linear as long as the greedy actions stay: with N(θ) = γ E[x̄' | row] the piece at θ is that of
TDC, A = XᵀD (X − N), B = (C − A)ᵀ = NᵀDX. Which stationary point it finds depends on where it starts.
"""

from __future__ import annotations

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.chains import greedy_values, pairs_of
from neuralq.lab.methods.gradient import corrected_flow, with_helpers
from neuralq.lab.methods.operators import covariance, td
from neuralq.lab.methods.record import LAMBDA, STEP_RATIO, Expected, Method, Options
from neuralq.lab.methods.trace import Trace, dot
from neuralq.types import Floats, Indices

__all__ = ["GQ", "GREEDY_GQ", "greedy_rows"]


class _GQ:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        row_of = pairs_of(process, "gq")
        self.theta, self._ratio = with_helpers(w0), options["beta_over_alpha"]
        self._lambda = options["lambda_"]
        self._trace = Trace(w0.shape, self._lambda)
        weight = np.where(row_of >= 0, process.target_policy, 0.0)
        self._mean = np.einsum("sa,sad->sd", weight, process.X[row_of])  # x̄ of every state
        self._state, self._rho = process.state, _own_ratio(process)

    def update(self, sample: SampledTransition, step_size: float) -> None:
        e = self._trace.advance(sample, before=self._rho[sample.row])
        ahead = np.where(sample.next_row[:, None] < 0, 0.0, self._mean[self._state[sample.next_row]])
        self.theta += step_size * _direction(self.theta, sample, e, ahead, self._lambda, self._ratio)


class _GreedyGQ:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self._row_of = pairs_of(process, "greedy-gq")
        self.theta, self._ratio = with_helpers(w0), options["beta_over_alpha"]
        self._X, self._state = process.X, process.state

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w = np.split(self.theta, 2, axis=1)[0]
        choice = self._row_of[self._state[sample.next_row]]
        value = np.where(choice >= 0, np.einsum("nad,nd->na", self._X[choice], w), -np.inf)
        best = np.take_along_axis(choice, np.argmax(value, axis=1)[:, None], axis=1)[:, 0]
        ahead = np.where(sample.next_row[:, None] < 0, 0.0, self._X[best])
        self.theta += step_size * _direction(self.theta, sample, sample.x, ahead, 0.0, self._ratio)


def _direction(
    theta: Floats, sample: SampledTransition, e: Floats, ahead: Floats, lambda_: float, ratio: float
) -> Floats:
    """Where θ goes per unit of α; ``ahead`` is x̄' and 0 at an end."""
    w, h = np.split(theta, 2, axis=1)
    ahead = sample.discount[:, None] * ahead
    uncorrected = (sample.reward[:, None] + dot(w, ahead - sample.x)) * e
    to_w = uncorrected - (1 - lambda_) * dot(e, h) * ahead
    to_h = uncorrected - dot(sample.x, h) * sample.x
    return np.hstack([to_w, ratio * to_h])


def _own_ratio(process: Process) -> Floats:
    """π/μ of each row's own pair, ``[n]``; 0 where the behaviour never takes it, for then it is never entered."""
    assert process.pairs is not None
    here = process.pairs[:, 0], process.pairs[:, 1]
    pi, mu = process.target_policy[here], process.behaviour_policy[here]
    return np.where(mu > 0, pi / np.where(mu > 0, mu, 1.0), 0.0)


def greedy_rows(process: Process, w: Floats) -> Indices:
    """The row of the greedy pair of every state, ``[S]``, ties to the lowest action; -1 where there is no action.

    Args:
        process: of a problem that learns values of pairs.
        w: weights, ``[d]``.

    Raises:
        ValueError: the rows are states.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples.chattering import chattering
        >>> process = linear_process(chattering())  # one state, two actions with the features 1 and 2
        >>> greedy_rows(process, np.array([3.0])).tolist(), greedy_rows(process, np.zeros(1)).tolist()
        ([1], [0])
    """
    row_of = pairs_of(process, "a greedy policy")
    best_action = greedy_values(process, row_of, w).argmax(axis=1)
    best: Indices = np.take_along_axis(row_of, best_action[:, None], axis=1)[:, 0]
    return best


def _expected_gq(process: Process, options: Options) -> Expected:
    pairs_of(process, "gq")
    ratio, (A, b) = options["beta_over_alpha"], td(process, options["lambda_"])
    return corrected_flow(A, b, covariance(process), ratio)


def _expected_greedy_gq(process: Process, options: Options) -> Expected:
    row_of, ratio = pairs_of(process, "greedy-gq"), options["beta_over_alpha"]
    weighted, C = process.D[:, None] * process.X, covariance(process)
    into = np.zeros((process.num_rows, len(row_of)))
    into[np.arange(process.num_rows), process.state] = 1.0
    to_state = process.gamma * (process.P_mu @ into)  # γ times the chance of each next state, whatever is done there
    b = weighted.T @ process.r_mu
    d = process.num_weights

    def at(theta: Floats, step_size: float) -> tuple[Floats, Floats]:
        greedy = greedy_rows(process, theta[:d])
        ahead = to_state @ np.where(greedy[:, None] < 0, 0.0, process.X[greedy])
        return corrected_flow(C - weighted.T @ ahead, b, C, ratio).at(theta, step_size)

    return Expected(2 * d, at, linear=False)


GQ = Method(
    "gq", "GQ(λ)", "Maei & Sutton 2010", {"lambda_": LAMBDA, "beta_over_alpha": STEP_RATIO}, _expected_gq, _GQ,
    rows="pairs", place=30,
)  # fmt: skip
GREEDY_GQ = Method(
    "greedy-gq", "Greedy-GQ", "Maei, Szepesvári, Bhatnagar & Sutton 2010", {"beta_over_alpha": STEP_RATIO},
    _expected_greedy_gq, _GreedyGQ, rows="pairs", note="control: the target policy is greedy in the learned values",
    place=31,
)  # fmt: skip
