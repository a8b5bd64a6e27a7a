"""What must be exact: values, slopes, the chain of Jacobians, and what the compiled network descends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuralq.learners import SlopeNet, new_slope_net
from neuralq.q.kernels.slopes import slope_gradient
from neuralq.rules import input_slopes, squared, squared_slopes
from neuralq.runs.report.claims import Row, number
from neuralq.systems.ebnn.theory import HORIZON, Theory, explain, learn_theory
from neuralq_envs.linear_quadratic import (
    GAMMA,
    LAW,
    PUSH,
    LinearQuadraticEnv,
    action_value_slopes,
    action_values,
)

__all__ = ["chain_difference", "gradient_difference", "oracle", "slope_difference", "value_difference"]


def oracle() -> tuple[Row, ...]:
    """All of them, as rows."""
    return (
        number("value in closed form: difference from 300 steps of the environment", 0.0, value_difference(), tol=1e-9),
        number("slope in closed form: difference from finite differences", 0.0, slope_difference(), tol=1e-6),
        number(
            "chained Jacobians: difference from autograd of the theory, unrolled",
            0.0,
            chain_difference(),
            tol=1e-6,
            note=f"{HORIZON} steps",
        ),
        number(
            "compiled gradient of values and slopes: difference from autograd", 0.0, gradient_difference(), tol=1e-9
        ),
    )


def value_difference(num_states: int = 5, seed: int = 0) -> float:
    """The largest difference between Q and the discounted rewards of an episode that pushes once.

    Example:
        >>> value_difference(num_states=1) < 1e-9
        True
    """
    env, worst = LinearQuadraticEnv(), 0.0
    for start in np.random.default_rng(seed).uniform(-1, 1, (num_states, 2)):
        env.reset(options={"state": start})
        total = sum(GAMMA**step * env.step(PUSH if step == 0 else LAW)[1] for step in range(300))
        worst = max(worst, abs(total - float(action_values(start, PUSH))))
    return worst


def slope_difference(num_states: int = 20, seed: int = 0, step: float = 1e-4) -> float:
    """The largest difference between ∂Q/∂s and a central difference of Q, which is exact for a quadratic.

    Example:
        >>> slope_difference() < 1e-6
        True
    """
    s = np.random.default_rng(seed).uniform(-1, 1, (num_states, 2))
    numeric = [(action_values(s + step * e, PUSH) - action_values(s - step * e, PUSH)) / (2 * step) for e in np.eye(2)]
    return float(np.abs(np.stack(numeric, axis=-1) - action_value_slopes(s, PUSH)).max())


def chain_difference(num_states: int = 4, seed: int = 0, num_transitions: int = 30) -> float:
    """How far the explained slope is from autograd through the theory's own episode, unrolled.

    Example:
        >>> chain_difference(num_states=1) < 1e-6
        True
    """
    rng = np.random.default_rng(seed)
    theory = learn_theory(num_transitions, rng)
    s = torch.from_numpy(rng.uniform(-1, 1, (num_states, 2))).requires_grad_()
    left, value = _unrolled(theory, s)
    return float(np.abs(explain(theory, left) - input_slopes(value, s).detach().numpy()).max())


def _unrolled(theory: Theory, s: Tensor) -> tuple[NDArray[np.float64], Tensor]:
    """The states that the theory expects, and its discounted return with the whole graph."""

    def outputs(nets: Sequence[SlopeNet], x: Tensor) -> Tensor:
        return torch.cat([net.module()(x) for net in nets], dim=-1)

    left, value = [], torch.zeros(len(s), dtype=torch.float64)
    for step in range(HORIZON):
        left.append(s.detach().numpy())
        value = value + GAMMA**step * outputs([theory.reward], s)[:, 0]
        s = s + outputs(theory.changes[PUSH if step == 0 else LAW], s)
    return np.stack(left), value


def gradient_difference(num_rows: int = 7, num_inputs: int = 3, num_hidden: int = 5, seed: int = 0) -> float:
    """How far the compiled gradient is from PyTorch's through the library's rules.

    Example:
        >>> gradient_difference(num_rows=1, num_inputs=1, num_hidden=2) < 1e-9
        True
    """
    rng = np.random.default_rng(seed)
    net = new_slope_net(num_inputs, num_hidden, rng)
    s, slope = rng.normal(size=(2, num_rows, num_inputs))
    y, mu = rng.normal(size=num_rows), rng.uniform(size=num_rows)
    gradient = np.zeros_like(net.parameters)
    loss = slope_gradient(net.parameters, s, y, slope, mu, gradient, np.zeros(num_hidden), np.zeros(num_inputs))
    module, states = net.module(), torch.from_numpy(s).requires_grad_()
    v = module(states)[:, 0]
    wrong = torch.from_numpy(slope) - input_slopes(v, states)
    theirs = (squared(torch.from_numpy(y) - v) + squared_slopes(wrong, torch.from_numpy(mu))).mean()
    flat = torch.cat([one.flatten() for one in torch.autograd.grad(theirs, list(module.parameters()))]).numpy()
    return max(abs(float(loss) - theirs.item()), float(np.abs(gradient - flat).max()))
