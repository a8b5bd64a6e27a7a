"""Methods that solve for the weights instead of stepping towards them.

    LSTD(λ)    w = A_λ⁺ b_λ,   Â += z (x − γx')ᵀ,  b̂ += r z        right even where TD diverges, if A is invertible
    BRM        w = argmin ‖r + γPXw − Xw‖_D                        the residual gradient's limit, from two successors
    fitted     w ← (C + ηI)⁺ Xᵀ D (r + γPXw)                       M = (C + ηI)⁺ H: may diverge, no step size helps
    fitted-q   the same with max_a' Q(s', a') for the backup        piecewise
    LSPI       w ← the LSTD solution for the policy greedy in w      piecewise; may cycle among policies for ever

None of these maps depends on α. ⁺ is the pseudo-inverse, so of many solutions the one of least norm is meant. With
fitted iteration on Xw every sweep is a regression: a hard target network whose period is infinite.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.chains import Chain, chain_of, greedy_policy, pairs_of
from neuralq.lab.methods.operators import ahead, covariance, cross, td
from neuralq.lab.methods.record import LAMBDA, RIDGE, Expected, Method, Options, Piece
from neuralq.lab.methods.trace import Trace
from neuralq.types import Floats

__all__ = ["BRM", "FITTED", "FITTED_Q", "LSPI", "LSTD"]

NEGLIGIBLE = 1e-10
"""Singular values below this share of the largest count as 0 in a pseudo-inverse."""


class _Solver:
    """Sums of left (x − γx')ᵀ and of left r for every seed, solved when the weights are asked for."""

    def __init__(self, w0: Floats, eta: float, left: Callable[[SampledTransition], Floats]) -> None:
        self._left = left
        num_seeds, d = w0.shape
        self._matrix = np.zeros((num_seeds, d, d))
        self._vector = np.zeros((num_seeds, d))
        self._eta, self._count = eta, 0
        self._theta, self._stale = w0.copy(), False

    def update(self, sample: SampledTransition, step_size: float) -> None:
        left, right = self._left(sample), sample.x - sample.discount[:, None] * sample.x_next
        self._matrix += left[:, :, None] * right[:, None, :]
        self._vector += sample.reward[:, None] * left
        self._count += 1
        self._stale = True

    @property
    def theta(self) -> Floats:
        """What the sums so far say, ``[N, d]``; the first weights before there are any."""
        if self._stale:
            ridge = self._eta * np.eye(self._matrix.shape[-1])
            inverse = np.linalg.pinv(self._matrix / self._count + ridge, rcond=NEGLIGIBLE)
            self._theta = np.einsum("nij,nj->ni", inverse, self._vector / self._count)
            self._stale = False
        return self._theta

    @theta.setter
    def theta(self, value: Floats) -> None:
        self._theta, self._stale = value, False


def _lstd(process: Process, w0: Floats, options: Options) -> _Solver:
    trace = Trace(w0.shape, options["lambda_"])
    return _Solver(w0, options["eta"], lambda sample: trace.advance(sample, sample.rho))


def _brm(process: Process, w0: Floats, options: Options) -> _Solver:
    def back(sample: SampledTransition) -> Floats:
        second = sample.discount_second[:, None] * sample.x_second
        return np.asarray(sample.rho[:, None] * (sample.x - second))

    return _Solver(w0, options["eta"], back)


def _pinv(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.pinv(matrix, rcond=NEGLIGIBLE))


def _solution(process: Process, P: Chain) -> Floats:
    """The LSTD(0) weights for another chain."""
    back = process.D[:, None] * process.X
    weights: Floats = _pinv(back.T @ (process.X - process.gamma * (P @ process.X))) @ (back.T @ process.r)
    return weights


def _constant(w: Floats) -> Expected:
    """θ ← w, whatever θ was."""
    return Expected(len(w), lambda theta, step_size: (np.zeros((len(w), len(w))), w.copy()))


def _expected_lstd(process: Process, options: Options) -> Expected:
    A, b = td(process, options["lambda_"])
    return _constant(_pinv(A + options["eta"] * np.eye(len(b))) @ b)


def _expected_brm(process: Process, options: Options) -> Expected:
    difference = ahead(process)
    back = process.D[:, None] * difference
    return _constant(_pinv(back.T @ difference + options["eta"] * np.eye(process.num_weights)) @ (back.T @ process.r))


def _regression(process: Process, eta: float) -> Floats:
    return _pinv(covariance(process) + eta * np.eye(process.num_weights))


def _expected_fitted(process: Process, options: Options) -> Expected:
    inverse = _regression(process, options["eta"])
    M, c = inverse @ cross(process), inverse @ (process.X.T @ (process.D * process.r))
    return Expected(len(c), lambda theta, step_size: (M.copy(), c.copy()))


def _expected_fitted_q(process: Process, options: Options) -> Expected:
    row_of = pairs_of(process, "fitted-q")
    inverse, back = _regression(process, options["eta"]), process.D[:, None] * process.X
    c = inverse @ (back.T @ process.r)

    def at(theta: Floats, step_size: float) -> Piece:
        P = chain_of(process, row_of, greedy_policy(process, row_of, theta))
        return inverse @ (process.gamma * (back.T @ (P @ process.X))), c.copy()

    return Expected(len(c), at, linear=False)


def _expected_lspi(process: Process, options: Options) -> Expected:
    row_of, d = pairs_of(process, "lspi"), process.num_weights

    def at(theta: Floats, step_size: float) -> Piece:
        policy = greedy_policy(process, row_of, theta)
        return np.zeros((d, d)), _solution(process, chain_of(process, row_of, policy))

    return Expected(d, at, linear=False)


LSTD = Method(
    "lstd", "LSTD(λ)", "Bradtke & Barto 1996; Boyan 2002; off-policy Yu 2010", {"lambda_": LAMBDA, "eta": RIDGE},
    _expected_lstd, _lstd, remembers=lambda options: True,
    note="has no step size; its sampled weights solve the averages of all transitions so far, plus η", place=70,
)  # fmt: skip
BRM = Method(
    "brm", "Bellman residual minimisation", "Schweitzer & Seidmann 1985; Baird 1995; Lagoudakis & Parr 2003",
    {"eta": RIDGE}, _expected_brm, _brm, remembers=lambda options: True,
    note="has no step size; needs two independent successors", place=71,
)  # fmt: skip
FITTED = Method(
    "fitted", "fitted iteration, least squares", "Gordon 1995; Tsitsiklis & Van Roy 1996",
    {"eta": RIDGE}, _expected_fitted, None, note="has no step size: one sweep is one regression", place=72,
)  # fmt: skip
FITTED_Q = Method(
    "fitted-q", "fitted Q iteration, least squares", "Gordon 1995; Ernst, Geurts & Wehenkel 2005", {"eta": RIDGE},
    _expected_fitted_q, None, rows="pairs", note="backs up the greedy action: piecewise linear, and has no step size",
    place=73,
)  # fmt: skip
LSPI = Method(
    "lspi", "LSPI", "Lagoudakis & Parr 2003", {}, _expected_lspi, None, rows="pairs",
    note="one sweep is one evaluation and one improvement; it may cycle among policies", place=74,
)  # fmt: skip
