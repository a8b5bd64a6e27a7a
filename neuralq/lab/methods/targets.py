"""Target networks: the value bootstrapped from is that of older weights u.

    w ← w + α (ρ (r + γ u·x' − w·x) x − η w)

    hard       u ← w after every T updates
    Polyak     u ← u + τ (w − u) at every update, from the w before it
    Zhang      u ← Γ_u(u + τ (Γ_w(w) − u)), Γ the projection onto a ball, with a ridge η > 0

While u stands still, w goes towards the regression (C + ηI)⁻¹(b + Hu), at a rate that depends on C alone: stable. After
T updates, with B = I − α(C + ηI) and S_T = I + B + ... + B^{T−1},

    w ← (B^T + α S_T H) w + α S_T b,         S_{2k} = S_k + B^k S_k,

the sums doubled rather than solved for, because C may be singular. T = 1 is TD, T = ∞ fitted iteration. Between them
stability need not change but once: freezing the target also removes what stabilised. Polyak averaging acts on (w, u):
[[B, αH], [τI, (1 − τ)I]]. A ball's projection shrinks a vector, by a factor that depends on it, so that Zhang's
method is linear only while nothing leaves the balls; the piece returned is exact at the θ it was asked for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuralq.checks import check_whole
from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.operators import covariance, cross
from neuralq.lab.methods.record import LARGEST, RIDGE, Expected, Method, Option, Options, Piece
from neuralq.types import Floats

__all__ = ["HARD_TARGET", "POLYAK_TARGET", "PROJECTED_TARGET", "frozen_target_map"]


def frozen_target_map(C: Floats, H: Floats, b: Floats, step_size: float, period: int) -> Piece:
    """T updates towards one frozen target: w ← M_T w + c_T, M_T = B^T + α S_T H, c_T = α S_T b, B = I − αC.

    Args:
        C: XᵀDX, with a ridge if there is one, ``[d, d]``; may be singular.
        H: γXᵀDPX, ``[d, d]``.
        b: XᵀDr, ``[d]``.
        step_size: α.
        period: T, at least 1.

    Raises:
        ValueError: the period is no whole number above 0.

    Source: Fellows, Smith & Whiteson 2023; Che et al. 2024 for T = ∞.

    Example:
        >>> M, c = frozen_target_map(np.array([[1.0]]), np.array([[0.5]]), np.array([1.0]), 0.5, 2)
        >>> M.tolist(), c.tolist()  # from w = u = 1: 1 → .5 + .25 + .5 = 1.25 → .625 + .25 + .5 = 1.375
        ([[0.625]], [0.75])
    """
    check_whole("period", period)
    eye = np.eye(len(b))
    power, total = eye, np.zeros_like(eye)  # B^k and S_k of the bits of T read so far, highest first
    step = eye - step_size * C
    for bit in bin(int(period))[2:]:
        power, total = power @ power, total + power @ total
        if bit == "1":
            power, total = step @ power, eye + step @ total
    return power + step_size * (total @ H), step_size * (total @ b)


class _Hard:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._target, self._age = w0.copy(), 0
        self._period, self._eta = int(options["period"]), options["eta"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        if self._age % self._period == 0:
            self._target = self.theta.copy()
        self.theta += step_size * _direction(self.theta, self._target, sample, self._eta)
        self._age += 1


class _Polyak:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = np.concatenate([w0, w0], axis=1)
        self._d, self._tau, self._eta = w0.shape[1], options["tau"], options["eta"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w, u = self.theta[:, : self._d], self.theta[:, self._d :]
        change = _direction(w, u, sample, self._eta)
        u += self._tau * (w - u)
        w += step_size * change


class _Projected:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = np.concatenate([w0, w0], axis=1)
        self._d, self._tau, self._eta = w0.shape[1], options["tau"], options["eta"]
        self._ball_w, self._ball_u = options["ball_w"], options["ball_u"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        w, u = self.theta[:, : self._d], self.theta[:, self._d :]
        change = _direction(w, u, sample, self._eta)
        shrunk = w * _shrink(w, self._ball_w)
        moved = u + self._tau * (shrunk - u)
        u[:] = moved * _shrink(moved, self._ball_u)
        w += step_size * change


def _direction(w: Floats, u: Floats, sample: SampledTransition, eta: float) -> Floats:
    """ρ (r + γ u·x' − w·x) x − η w of every seed."""
    target = sample.reward + sample.discount * np.einsum("nd,nd->n", u, sample.x_next)
    error = sample.rho * (target - np.einsum("nd,nd->n", w, sample.x))
    change: Floats = error[:, None] * sample.x - eta * w
    return change


def _shrink(points: Floats, radius: float) -> Floats:
    """The factor that projects each point onto the ball, ``[..., d] -> [..., 1]``."""
    length = np.linalg.norm(points, axis=-1, keepdims=True)
    factor: Floats = radius / np.maximum(length, radius)
    return factor


def _parts(process: Process, options: Options) -> tuple[Floats, Floats, Floats]:
    """C + ηI, H and b."""
    C = covariance(process) + options["eta"] * np.eye(process.num_weights)
    return C, cross(process), process.X.T @ (process.D * process.r)


def _expected_hard(process: Process, options: Options) -> Expected:
    period, (C, H, b) = int(options["period"]), _parts(process, options)
    return Expected(
        len(b), lambda theta, step_size: frozen_target_map(C, H, b, step_size, period), updates_per_sweep=period
    )


class _WithTarget:
    """The expected update of (w, u), whose parts are the same at every θ and α."""

    def __init__(self, process: Process, options: Options) -> None:
        self._C, self._H, self._b = _parts(process, options)
        self._tau = options["tau"]

    def at(self, step_size: float, shrink_w: float = 1.0, shrink_u: float = 1.0) -> Piece:
        eye, tau = np.eye(len(self._b)), self._tau
        M = np.block([
            [eye - step_size * self._C, step_size * self._H],
            [shrink_u * tau * shrink_w * eye, shrink_u * (1 - tau) * eye],
        ])  # fmt: skip
        return M, np.concatenate([step_size * self._b, np.zeros(len(eye))])


def _doubled(w0: Floats) -> Floats:
    return np.concatenate([w0, w0])


def _expected_polyak(process: Process, options: Options) -> Expected:
    update = _WithTarget(process, options)
    return Expected(2 * process.num_weights, lambda theta, step_size: update.at(step_size), start=_doubled)


def _expected_projected(process: Process, options: Options) -> Expected:
    ball_w, ball_u = options["ball_w"], options["ball_u"]
    d, tau, update = process.num_weights, options["tau"], _WithTarget(process, options)

    def at(theta: Floats, step_size: float) -> Piece:
        w, u = theta[:d], theta[d:]
        shrink_w = float(_shrink(w, ball_w)[0])
        shrink_u = float(_shrink(u + tau * (shrink_w * w - u), ball_u)[0])
        return update.at(step_size, shrink_w, shrink_u)

    return Expected(2 * d, at, linear=False, start=_doubled)


_TAU = Option(0.01, 1e-4, 1.0, "τ, averaging", "log")
HARD_TARGET = Method(
    "hard-target", "TD with a target network, copied", "Mnih et al. 2015; Fellows, Smith & Whiteson 2023",
    {"period": Option(100.0, 1, 1024, "period of the copy", "whole", most=1e9), "eta": RIDGE}, _expected_hard, _Hard,
    remembers=lambda options: options["period"] > 1,
    note="one sweep of the expected update stands for a whole period", place=60,
)  # fmt: skip
POLYAK_TARGET = Method(
    "polyak-target", "TD with a target network, averaged", "Lillicrap et al. 2016",
    {"tau": _TAU, "eta": RIDGE}, _expected_polyak, _Polyak, place=61,
)  # fmt: skip
PROJECTED_TARGET = Method(
    "projected-target", "TD with a ridge and a projected target network", "Zhang, Yao & Whiteson 2021",
    {"tau": _TAU, "eta": replace(RIDGE, default=0.1),
     "ball_w": Option(100.0, 1.0, 1e3, "radius of the ball of w", "log", LARGEST),
     "ball_u": Option(200.0, 1.0, 1e3, "radius of the ball of the target", "log", LARGEST)},
    _expected_projected, _Projected,
    note="linear only inside the balls; the limit is (A + ηI)⁻¹ b where that lies in them", place=62,
)  # fmt: skip
