"""TD(λ) and ridge TD.

With D = diag of how often each row is updated:

    TD(λ)      A = Xᵀ D (I − γλP)⁻¹ (I − γP) X,   w += α δ z,  z = ρ (γλ z + x)
    ridge      A + η I

The ratio multiplies the trace, once; multiplying δ by it as well would count it twice.
"""

from __future__ import annotations

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.operators import td
from neuralq.lab.methods.record import LAMBDA, RIDGE, Expected, Method, Options, flow
from neuralq.lab.methods.trace import Trace, errors
from neuralq.types import Floats

__all__ = ["TD"]


class _TD:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._trace, self._eta = Trace(w0.shape, options["lambda_"]), options["eta"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w = self.theta
        z = self._trace.advance(sample, sample.rho)
        w += step_size * (errors(w, sample)[:, None] * z - self._eta * w)


def _expected_td(process: Process, options: Options) -> Expected:
    A, b = td(process, options["lambda_"])
    return flow(A + options["eta"] * np.eye(len(b)), b)


TD = Method(
    "td", "TD(λ)", "Sutton 1988; with importance ratios Precup, Sutton & Singh 2000",
    {"lambda_": LAMBDA, "eta": RIDGE}, _expected_td, _TD, place=10,
)  # fmt: skip
