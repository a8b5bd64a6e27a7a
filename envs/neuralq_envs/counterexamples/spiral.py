"""The spiral of Tsitsiklis & Van Roy (1997): on-policy TD diverges with one parameter, because V is not linear in it.

Three states in a cycle, P = ½(I + shift), every reward 0. The values are a curve V(θ) with dV/dθ = (Q + εI) V,
Q = 11ᵀ + P − Pᵀ, in the plane 1ᵀV = 0. There Q acts as S = P − Pᵀ, which is skew with S² = −k², k = √3/2, so that

    V(θ) = e^{εθ} [V₀ cos kθ + (S V₀/k) sin kθ],        ‖V(θ)‖² = ‖V₀‖² e^{2εθ}:

a spiral that widens with θ. On the plane P = ¼ + S/2, so expected TD(0) with d = 1/3 is the differential equation

    θ' = ⅓ (dV/dθ)ᵀ(γP − I)V = κ ‖V(θ)‖²,        κ = ⅓ [⅜γ − ε(1 − γ/4)],

whose solution is θ(t) = −ln(1 − t/t*) / (2ε) with t* = 1/(2εκ‖V₀‖²). It reaches infinity at the finite time t* if
ε < ⅜γ/(1 − γ/4); beyond that κ < 0, θ falls for ever and the values go to 0, as they should.

The curve must not be computed as expm(θ(Q + εI)) V₀. Q has the eigenvalue 3 along 1, where V₀ has only its rounding
error, which grows as e^{3θ}: at θ = 12 it is a tenth of V, at 15 a thousand times V. The closed form stays in the
plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from neuralq.checks import check_discount
from neuralq.mdp import FiniteMDP
from neuralq.types import Floats
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["SpiralValue", "blow_up_time", "critical_epsilon", "spiral", "theta_at"]


K = math.sqrt(3.0) / 2
START = (100.0, -70.0, -30.0)
START_SQUARED = sum(value**2 for value in START)  # ‖V₀‖² = 15800
_LARGEST_EXPONENT = 300.0
CYCLE = ((0.5, 0.0, 0.5), (0.5, 0.5, 0.0), (0.0, 0.5, 0.5))


@dataclass(frozen=True)
class SpiralValue:
    """V(θ) = e^{εθ} [V₀ cos kθ + (S V₀/k) sin kθ] and its derivatives, in closed form.

    From εθ = 300 on the factor stays at e^{300}: large enough for any cap, and its square is still a finite number.

    Args:
        epsilon: ε, how fast the spiral widens.

    Example:
        >>> curve = SpiralValue(epsilon=0.05)
        >>> curve.values(np.zeros(1)).tolist()
        [100.0, -70.0, -30.0]
        >>> curve.jacobian(np.zeros(1)).round(6).reshape(-1).tolist()
        [25.0, 61.5, -86.5]
    """

    epsilon: float

    def values(self, theta: Floats) -> Floats:
        """V(θ), ``[1] -> [3]``."""
        growth, along, _ = self._frame(theta)
        return growth * along

    def jacobian(self, theta: Floats) -> Floats:
        """dV/dθ = e^{εθ} (ε u + k u⊥), ``[1] -> [3, 1]``."""
        growth, along, across = self._frame(theta)
        return (growth * (self.epsilon * along + K * across))[:, None]

    def hessian(self, theta: Floats) -> Floats:
        """d²V/dθ² = e^{εθ} ((ε² − k²) u + 2εk u⊥), ``[1] -> [3, 1, 1]``."""
        growth, along, across = self._frame(theta)
        return (growth * ((self.epsilon**2 - K**2) * along + 2 * self.epsilon * K * across))[:, None, None]

    def _frame(self, theta: Floats) -> tuple[float, Floats, Floats]:
        """e^{εθ}, the turned start u, and u⊥ a quarter turn ahead."""
        (angle,) = np.asarray(theta, dtype=np.float64)
        first, second = np.array(START), _quarter_turn()
        cosine, sine = math.cos(K * angle), math.sin(K * angle)
        growth = math.exp(min(self.epsilon * angle, _LARGEST_EXPONENT))
        return growth, cosine * first + sine * second, cosine * second - sine * first


def spiral(epsilon: float = 0.05, gamma: float = 0.9) -> Problem:
    """Three states on-policy whose values spiral outwards with the one parameter θ.

    Raises:
        ValueError: ε that is negative or not finite, or γ outside [0, 1].

    Example:
        >>> problem = spiral()
        >>> problem.value is not None, problem.features.round(6).reshape(-1).tolist()
        (True, [25.0, 61.5, -86.5])
    """
    limit = critical_epsilon(gamma)
    curve = SpiralValue(_checked(epsilon))
    origin = np.zeros(1)
    only = np.ones((3, 1))
    return Problem(
        name="spiral",
        mdp=FiniteMDP.from_arrays([np.array(CYCLE)], np.zeros((3, 1))),
        features=curve.jacobian(origin),
        target_policy=only,
        behaviour_policy=only,
        state_distribution=np.full(3, 1 / 3),
        initial_weights=origin,
        gamma=gamma,
        step_size=1e-5,
        title="The spiral",
        source="Tsitsiklis & Van Roy 1997",
        known=f"On-policy, yet TD(0) diverges iff ε < .375γ/(1 − γ/4) = {limit:.4f}; in continuous time θ is infinite "
        f"at t* = {blow_up_time(epsilon, gamma):.6g}.",
        value=curve,
    )


def theta_at(t: float, epsilon: float = 0.05, gamma: float = 0.9) -> float:
    """θ(t) = −ln(1 − t/t*)/(2ε) of expected TD(0) in continuous time, from θ(0) = 0; κ‖V₀‖² t where ε = 0.

    Raises:
        ValueError: t negative or not below the blow-up time, or what `spiral` refuses.

    Example:
        >>> round(theta_at(0.9 * blow_up_time()), 6)
        23.025851
    """
    if not 0 <= t < blow_up_time(epsilon, gamma):
        raise ValueError(f"t must be at least 0 and below t* = {blow_up_time(epsilon, gamma)}, got {t}")
    speed = _kappa(epsilon, gamma) * START_SQUARED
    return speed * t if epsilon == 0 else -math.log1p(-2 * epsilon * speed * t) / (2 * epsilon)


def blow_up_time(epsilon: float = 0.05, gamma: float = 0.9) -> float:
    """θ is infinite at t* = 1/(2εκ‖V₀‖²); inf where κ ≤ 0 (the values vanish) or ε = 0 (they circle).

    Raises:
        ValueError: what `spiral` refuses.

    Example:
        >>> round(blow_up_time(), 12)
        0.006355595572
    """
    rate = 2 * _checked(epsilon) * _kappa(epsilon, gamma) * START_SQUARED
    return 1 / rate if rate > 0 else math.inf


def critical_epsilon(gamma: float = 0.9) -> float:
    """Expected TD(0) diverges iff ε < ⅜γ/(1 − γ/4).

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> round(critical_epsilon(0.9), 6), critical_epsilon(1.0)
        (0.435484, 0.5)
    """
    check_discount("gamma", gamma)
    return 0.375 * gamma / (1 - gamma / 4)


def _kappa(epsilon: float, gamma: float) -> float:
    """The speed of θ per ‖V‖²."""
    check_discount("gamma", gamma)
    return (0.375 * gamma - epsilon * (1 - gamma / 4)) / 3


def _checked(epsilon: float) -> float:
    if not (math.isfinite(epsilon) and epsilon >= 0):
        raise ValueError(f"epsilon must be a finite number of at least 0, got {epsilon}; below 0 the spiral narrows")
    return epsilon


def _quarter_turn() -> Floats:
    """S V₀/k: the start turned by a right angle in the plane 1ᵀV = 0."""
    cycle = np.array(CYCLE)
    turned: Floats = (cycle - cycle.T) @ np.array(START) / K
    return turned
