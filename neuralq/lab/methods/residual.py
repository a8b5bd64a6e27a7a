"""The residual methods: along the TD update, along the gradient of the mean square Bellman error, or between the two.

    residual(φ)    A_φ = (X − φγPX)ᵀ D (X − γPX),     w += α ρ δ (x − φγ x'')

with x'' a second, independent successor under the target policy. Using x' itself instead (the naive residual gradient)
descends E[ρδ²], another objective where transitions are random (Baird 1995; Sutton & Barto 2018, section 11.5).

The adaptive φ is the least that does not raise the mean square Bellman error. The direct (TD) and the residual-gradient
updates go along

    W_d = E[ρ δ x],     W_rg = E[ρ δ (x − γ x'')],

the second straight down the mean square Bellman error. A mix (1−φ) W_d + φ W_rg makes an angle with W_rg of at most
90° as soon as φ reaches

    φ = W_d·W_rg / ((W_d − W_rg)·W_rg).

Where that lies outside [0, 1] the direct update already descends, W_d·W_rg > 0, and φ = 0, the fast one, is taken; so
too where the denominator is 0. (Clipping would take 1 where W_d·W_rg > W_rg·W_rg, for no reason.) Exactly at this φ the
error keeps its value and w slides along a level set, on Baird's star ever further out; so where φ > 0 a ``margin`` is
added to it, up to 1.

The expected update uses the exact W_d and W_rg at w. The sampled one, which sees neither, follows them by exponential
averages with weight ``tracking`` on the newest. Either is nonlinear in w, and both mixes have the same fixed point only
where the values can be represented.
"""

from __future__ import annotations

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.operators import ahead, td
from neuralq.lab.methods.record import Expected, Method, Option, Options, flow
from neuralq.lab.methods.trace import errors
from neuralq.types import Floats

__all__ = ["NAIVE_RESIDUAL", "RESIDUAL", "RESIDUAL_ADAPTIVE", "least_phi"]


def least_phi(direct: Floats, residual: Floats, margin: float = 0.0) -> Floats:
    """The least φ in [0, 1] for which (1−φ) W_d + φ W_rg does not go against W_rg, ``[N, d] × [N, d] -> [N]``.

    Args:
        direct: W_d.
        residual: W_rg.
        margin: added where φ > 0, up to 1.

    Example:
        >>> against, down, along = np.array([[-1.0, 2.0]]), np.array([[1.0, 0.0]]), np.array([[5.0, 1.0]])
        >>> least_phi(against, down).tolist(), least_phi(along, down).tolist(), least_phi(down, 0 * down).tolist()
        ([0.5], [0.0], [0.0])
    """
    along = np.einsum("nd,nd->n", direct, residual)
    opposed = along < 0  # then the denominator is below 0 and φ in (0, 1]; it is neither otherwise
    gap = along - np.einsum("nd,nd->n", residual, residual)
    phi: Floats = np.where(opposed, np.minimum(along / np.where(opposed, gap, 1.0) + margin, 1.0), 0.0)
    return phi


class _Residual:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._phi = options["phi"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        second = (self._phi * sample.discount_second)[:, None] * sample.x_second
        self.theta += (step_size * sample.rho * errors(self.theta, sample))[:, None] * (sample.x - second)


class _ResidualAdaptive:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._tracking, self._margin = options["tracking"], options["margin"]
        self._direct, self._residual = np.zeros_like(w0), np.zeros_like(w0)

    def update(self, sample: SampledTransition, step_size: float) -> None:
        delta = (sample.rho * errors(self.theta, sample))[:, None]
        second = sample.discount_second[:, None] * sample.x_second
        self._direct += self._tracking * (delta * sample.x - self._direct)
        self._residual += self._tracking * (delta * (sample.x - second) - self._residual)
        phi = least_phi(self._direct, self._residual, self._margin)[:, None]
        self.theta += step_size * delta * (sample.x - phi * second)


class _NaiveResidual:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()

    def update(self, sample: SampledTransition, step_size: float) -> None:
        back = sample.x - sample.discount[:, None] * sample.x_next
        self.theta += (step_size * sample.rho * errors(self.theta, sample))[:, None] * back


def _expected_residual(process: Process, options: Options) -> Expected:
    back = process.D[:, None] * ahead(process, options["phi"])
    return flow(back.T @ ahead(process), back.T @ process.r)


def _expected_adaptive(process: Process, options: Options) -> Expected:
    A, b = td(process)
    second = process.gamma * (process.P @ process.X)
    weighted = process.D[:, None] * second
    A_second, b_second = weighted.T @ (process.X - second), weighted.T @ process.r

    def at(theta: Floats, step_size: float) -> tuple[Floats, Floats]:
        direct, further = b - A @ theta, b_second - A_second @ theta
        phi = least_phi(direct[None], (direct - further)[None], options["margin"])[0]
        return np.eye(len(b)) - step_size * (A - phi * A_second), step_size * (b - phi * b_second)

    return Expected(len(b), at, linear=False)


def _expected_naive(process: Process, options: Options) -> Expected:
    """E[ρ (x − γx')(x − γx')ᵀ] and E[ρ r (x − γx')]: half the gradient of the mean square TD error."""
    ways = process.transitions
    back = process.X[ways.row] - ways.discount[:, None] * process.seen(ways.next_row)
    weight = (process.D[ways.row] * ways.probability * ways.rho)[:, None]
    return flow(back.T @ (weight * back), back.T @ (weight[:, 0] * ways.reward))


RESIDUAL = Method(
    "residual", "residual(φ), double-sampled", "Baird 1995",
    {"phi": Option(1.0, 0.0, 1.0, "φ, share of the residual gradient")}, _expected_residual, _Residual,
    note="φ = 0 is TD(0), φ = 1 the residual gradient; needs two independent successors", place=11,
)  # fmt: skip
RESIDUAL_ADAPTIVE = Method(
    "residual-adaptive", "residual, adaptive φ", "Baird 1995, section 4",
    {"tracking": Option(0.01, 1e-4, 1.0, "tracking weight", "log"), "margin": Option(0.1, 0.0, 1.0, "margin")},
    _expected_adaptive, _ResidualAdaptive, remembers=lambda options: True,
    note="the expected update knows the exact directions, the sampled one averages them with weight tracking",
    place=12,
)  # fmt: skip
NAIVE_RESIDUAL = Method(
    "naive-residual", "residual gradient, one sample", "Baird 1995; Sutton & Barto 2018, equation 11.23", {},
    _expected_naive, _NaiveResidual, note="descends the mean square TD error, not the Bellman error", place=13,
)  # fmt: skip
