"""TD(λ), ridge TD and the residual methods.

With D = diag of how often each row is updated:

    TD(λ)          A = Xᵀ D (I − γλP)⁻¹ (I − γP) X,   w += α δ z,  z = ρ (γλ z + x)
    ridge          A + η I
    residual(φ)    A_φ = (X − φγPX)ᵀ D (X − γPX),     w += α ρ δ (x − φγ x'')

with x'' a second, independent successor under the target policy. Using x' itself instead (the naive residual gradient)
descends E[ρδ²], another objective where transitions are random (Baird 1995; Sutton & Barto 2018, section 11.5).
The ratio multiplies the trace, once; multiplying δ by it as well would count it twice.
"""

from __future__ import annotations

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import Sample
from neuralq.lab.methods.method import Expected, Method, Options, flow
from neuralq.lab.methods.operators import naive_residual, td
from neuralq.lab.methods.trace import Trace
from neuralq.types import Floats

__all__ = ["NAIVE_RESIDUAL", "RESIDUAL", "TD"]


class _TD:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._trace, self._eta = Trace(w0.shape, options["lambda_"]), options["eta"]

    def update(self, sample: Sample, step_size: float) -> None:
        w = self.theta
        z = self._trace.follow(sample, sample.rho)
        w += step_size * (errors(w, sample)[:, None] * z - self._eta * w)


class _Residual:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._phi = options["phi"]

    def update(self, sample: Sample, step_size: float) -> None:
        second = (self._phi * sample.discount_second)[:, None] * sample.x_second
        self.theta += (step_size * sample.rho * errors(self.theta, sample))[:, None] * (sample.x - second)


class _NaiveResidual:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()

    def update(self, sample: Sample, step_size: float) -> None:
        back = sample.x - sample.discount[:, None] * sample.x_next
        self.theta += (step_size * sample.rho * errors(self.theta, sample))[:, None] * back


def errors(w: Floats, sample: Sample) -> Floats:
    """δ = r + γ w·x' − w·x of every seed, ``[N, d] -> [N]``."""
    change = sample.discount[:, None] * sample.x_next - sample.x
    total: Floats = sample.reward + np.einsum("nd,nd->n", w, change)
    return total


def _expected_td(process: Process, options: Options) -> Expected:
    A, b = td(process, options["lambda_"])
    return flow(A + options["eta"] * np.eye(len(b)), b)


def _expected_residual(process: Process, options: Options) -> Expected:
    ahead = process.X - process.gamma * (process.P @ process.X)
    back = process.D[:, None] * (process.X - options["phi"] * process.gamma * (process.P @ process.X))
    return flow(back.T @ ahead, back.T @ process.r)


def _expected_naive_residual(process: Process, options: Options) -> Expected:
    return flow(*naive_residual(process))


TD = Method(
    "td", "TD(λ)", "Sutton 1988; with importance ratios Precup, Sutton & Singh 2000", {"lambda_": 0.0, "eta": 0.0},
    _expected_td, _TD, remembers=lambda options: options["lambda_"] > 0,
)  # fmt: skip
RESIDUAL = Method(
    "residual", "residual(φ), double-sampled", "Baird 1995", {"phi": 1.0}, _expected_residual, _Residual,
    note="φ = 0 is TD(0), φ = 1 the residual gradient; needs two independent successors",
)  # fmt: skip
NAIVE_RESIDUAL = Method(
    "naive-residual", "residual gradient, one sample", "Baird 1995; Sutton & Barto 2018, equation 11.23", {},
    _expected_naive_residual, _NaiveResidual, note="descends the mean square TD error, not the Bellman error",
)  # fmt: skip
