"""Gradient TD: methods with a second weight vector h that stay on course off-policy.

θ = (w, h), h starts at 0 and learns with the step size η α; both read the values from before the step. The expected
updates are θ ← θ + α (g − G θ) with g = (b or 0, η b) and

    GTD       [[0, −Aᵀ], [ηA, ηI]]                w += α ρ (x − γx')(x·h),              h += ηα (ρδx − h)
    GTD2(λ)   [[0, −A_λᵀ], [ηA_λ, ηC]]            w += α ((x·h)x − γ(1−λ)(z·h)x'),      h += ηα (δz − (x·h)x)
    TDC(λ)    [[A_λ, B_λ], [ηA_λ, ηC]]            w += α (δz − γ(1−λ)(z·h)x'),          h as GTD2
    TDRC      [[A_λ, B_λ], [ηA_λ, η(C+βI)]]       w as TDC,                             h += ηα (δz − (x·h)x − βh)
    HTD(λ)    [[A_λ, Ā_λᵀ − A_λᵀ], [ηA_λ, ηĀ_λᵀ]]  w += α (δz + (x − γx')((z − z̄)·h)),   h += ηα (δz − (x − γx')(z̄·h))

With traces: let e = γλ z + x before the ratio multiplies it, z = ρ e, and Z(·, s) = d(s) E[e | s] in the long run. What
flows into s either begins there or comes along the target chain, Z = XᵀD + γλ Z P, so Z = XᵀD (I − γλP)⁻¹, and

    E[δ z] = Z (r + γPXw − Xw) = b_λ − A_λ w,      E[γ(1−λ) x' zᵀ] = γ(1−λ) (Z P X)ᵀ = B_λ.

Z (I − γλP) X = C and Z (I − γP) X = A_λ differ by γ(1−λ) Z P X, hence B_λ = (C − A_λ)ᵀ for every λ. The trace z̄ of
HTD follows the behaviour chain (no ratio): E[(x − γx') z̄ᵀ] = Ā_λᵀ, the A_λ of P_mu; on-policy it is z and HTD is TD.

GTD2-MP takes the step of GTD2 halfway, looks at the gradient there, and steps from the old point with it: the mean map
is I − αG + α²G², no flow. G² is that of the *expected* extragradient; one sample used twice has mean E[G_t²] in its
place, which differs at second order in α.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuralq.exact import td_operator
from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.operators import covariance, td
from neuralq.lab.methods.record import LAMBDA, RIDGE, STEP_RATIO, Expected, Method, Options, flow
from neuralq.lab.methods.trace import Trace, dot, errors
from neuralq.types import Floats

__all__ = ["GTD", "GTD2", "GTD2_MP", "HTD", "TDC", "TDRC", "corrected_flow", "with_helpers"]


class _GTD:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta, self._ratio = with_helpers(w0), options["beta_over_alpha"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w, h = np.split(self.theta, 2, axis=1)
        rho, back = sample.rho[:, None], sample.x - sample.discount[:, None] * sample.x_next
        to_w = rho * back * dot(sample.x, h)
        to_h = rho * errors(w, sample)[:, None] * sample.x - h
        self.theta += step_size * np.hstack([to_w, self._ratio * to_h])


class _GTD2:
    def __init__(self, process: Process, w0: Floats, options: Options, extragradient: bool = False) -> None:
        self._extragradient = extragradient
        self.theta, self._ratio = with_helpers(w0), options["beta_over_alpha"]
        self._lambda = options["lambda_"]
        self._trace = Trace(w0.shape, self._lambda)

    def update(self, sample: SampledTransition, step_size: float) -> None:
        z = self._trace.advance(sample, sample.rho)
        looked_at = self.theta
        if self._extragradient:
            looked_at = self.theta + step_size * self._direction(self.theta, sample, z)
        self.theta += step_size * self._direction(looked_at, sample, z)

    def _direction(self, theta: Floats, sample: SampledTransition, z: Floats) -> Floats:
        w, h = np.split(theta, 2, axis=1)
        ahead = sample.discount[:, None] * sample.x_next
        to_w = dot(sample.x, h) * sample.x - (1 - self._lambda) * dot(z, h) * ahead
        to_h = errors(w, sample)[:, None] * z - dot(sample.x, h) * sample.x
        return np.hstack([to_w, self._ratio * to_h])


class _TDC:
    """TDC(λ), and TDRC where β > 0."""

    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta, self._ratio = with_helpers(w0), options["beta_over_alpha"]
        self._lambda, self._beta = options["lambda_"], options.get("beta", 0.0)
        self._trace = Trace(w0.shape, self._lambda)

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w, h = np.split(self.theta, 2, axis=1)
        z = self._trace.advance(sample, sample.rho)
        uncorrected = errors(w, sample)[:, None] * z
        to_w = uncorrected - (1 - self._lambda) * dot(z, h) * sample.discount[:, None] * sample.x_next
        to_h = uncorrected - dot(sample.x, h) * sample.x - self._beta * h
        self.theta += step_size * np.hstack([to_w, self._ratio * to_h])


class _HTD:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta, self._ratio = with_helpers(w0), options["beta_over_alpha"]
        self._target = Trace(w0.shape, options["lambda_"])
        self._behaviour = Trace(w0.shape, options["lambda_"])

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w, h = np.split(self.theta, 2, axis=1)
        z, z_mu = self._target.advance(sample, sample.rho), self._behaviour.advance(sample)
        back = sample.x - sample.discount[:, None] * sample.x_next
        uncorrected = errors(w, sample)[:, None] * z
        to_w = uncorrected + back * dot(z - z_mu, h)
        to_h = uncorrected - back * dot(z_mu, h)
        self.theta += step_size * np.hstack([to_w, self._ratio * to_h])


def with_helpers(w0: Floats) -> Floats:
    """θ = (w, 0), ``[N, d] -> [N, 2d]``."""
    return np.hstack([w0, np.zeros_like(w0)])


def corrected_flow(A: Floats, b: Floats, C: Floats, ratio: float, beta: float = 0.0) -> Expected:
    """The flow of TDC, G = [[A, (C − A)ᵀ], [ηA, η(C + βI)]], from its A, b and C."""
    G = np.block([[A, (C - A).T], [ratio * A, ratio * (C + beta * np.eye(len(b)))]])
    return flow(G, np.concatenate([b, ratio * b]))


def _expected_gtd(process: Process, options: Options) -> Expected:
    ratio, (A, b) = options["beta_over_alpha"], td(process)
    return _descent(A, b, np.eye(len(b)), ratio)


def _expected_gtd2(process: Process, options: Options) -> Expected:
    ratio, (A, b) = options["beta_over_alpha"], td(process, options["lambda_"])
    return _descent(A, b, covariance(process), ratio)


def _descent(A: Floats, b: Floats, metric: Floats, ratio: float) -> Expected:
    G = np.block([[np.zeros_like(A), -A.T], [ratio * A, ratio * metric]])
    return flow(G, np.concatenate([np.zeros_like(b), ratio * b]))


def _expected_tdc(process: Process, options: Options) -> Expected:
    ratio, (A, b) = options["beta_over_alpha"], td(process, options["lambda_"])
    return corrected_flow(A, b, covariance(process), ratio, options.get("beta", 0.0))


def _gtd2_mp(process: Process, w0: Floats, options: Options) -> _GTD2:
    return _GTD2(process, w0, options, extragradient=True)


def _expected_gtd2_mp(process: Process, options: Options) -> Expected:
    generator = _expected_gtd2(process, options).generator
    assert generator is not None
    G, g = generator

    def at(theta: Floats, step_size: float) -> tuple[Floats, Floats]:
        halfway = np.eye(len(g)) - step_size * G
        return np.eye(len(g)) - step_size * G @ halfway, step_size * (g - step_size * G @ g)

    return Expected(len(g), at)


def _expected_htd(process: Process, options: Options) -> Expected:
    ratio, lambda_ = options["beta_over_alpha"], options["lambda_"]
    A, b = td(process, lambda_)
    A_mu, _ = td_operator(process.P_mu, process.r_mu, process.X, process.D, process.gamma, lambda_)
    G = np.block([[A, A_mu.T - A.T], [ratio * A, ratio * A_mu.T]])
    return flow(G, np.concatenate([b, ratio * b]))


_OPTIONS = {"lambda_": LAMBDA, "beta_over_alpha": STEP_RATIO}
GTD = Method(
    "gtd", "GTD", "Sutton, Szepesvári & Maei 2009", {"beta_over_alpha": STEP_RATIO}, _expected_gtd, _GTD, place=20,
)  # fmt: skip
GTD2 = Method(
    "gtd2", "GTD2(λ)", "Sutton, Maei, Precup, Bhatnagar, Silver, Szepesvári & Wiewiora 2009; with traces Maei 2011",
    _OPTIONS, _expected_gtd2, _GTD2, place=21,
)  # fmt: skip
GTD2_MP = Method(
    "gtd2-mp", "GTD2(λ)-MP", "Liu, Liu, Ghavamzadeh, Mahadevan & Petrik 2015; with traces White & White 2016",
    _OPTIONS, _expected_gtd2_mp, _gtd2_mp,
    note="the sampled update uses one transition for both halves, so that its mean differs at second order in α",
    place=22,
)  # fmt: skip
TDC = Method(
    "tdc", "TDC, GTD(λ)", "Sutton, Maei, Precup, Bhatnagar, Silver, Szepesvári & Wiewiora 2009; with traces Maei 2011",
    _OPTIONS, _expected_tdc, _TDC, note="converges where h is fast enough: a large beta_over_alpha", place=23,
)  # fmt: skip
TDRC = Method(
    "tdrc", "TDRC", "Ghiassian, Patterson, Garg, Gupta, White & White 2020",
    {"lambda_": LAMBDA, "beta_over_alpha": replace(STEP_RATIO, default=1.0),
     "beta": replace(RIDGE, default=1.0, label="β, regularisation of h")}, _expected_tdc, _TDC,
    note="beta is the regularisation of h, beta_over_alpha the ratio of the step sizes", place=24,
)  # fmt: skip
HTD = Method(
    "htd", "HTD(λ)", "Hackman 2012; White & White 2016",
    {"lambda_": LAMBDA, "beta_over_alpha": replace(STEP_RATIO, default=1.0)}, _expected_htd, _HTD,
    note="on-policy it is TD(λ)", place=25,
)  # fmt: skip
