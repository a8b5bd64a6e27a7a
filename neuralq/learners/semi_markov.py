"""SMDP Q-learning by a network of one hidden layer, one decision at a time, in compiled code.

An action lasts here: the next decision comes τ later, and one decision says (`neuralq.rules.smdp_discount`)

    Q(s_tm1, a_tm1) should be  r_t + e^(−βτ) max_a Q(s_t, a).

Several who decide in one world may share a network. Each then learns from its own decisions only: τ and r_t are what
passes until the same one decides again, whatever the others do meanwhile.

The error of a step can be clipped. Where waiting is paid for by its square, one hour of congestion asks for values a
hundred times as large as all others, and a network that follows it forgets what it knew.

Source: Bradtke & Duff 1995; Crites & Barto 1996, who share it among elevators.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_positive, check_whole
from neuralq.jit import lean_reassociating_kernel

__all__ = ["SmdpNetwork", "new_smdp_network", "smdp_network_update", "smdp_network_values"]


class SmdpNetwork(NamedTuple):
    """Weights of I inputs, H sigmoid units and A linear outputs, one an action; and room for a pass through them.

    Args:
        flat: all weights in one vector; the next four are views of it.
        w: from inputs to units, ``[I, H]``.
        b: of the units, ``[H]``.
        v: from units to outputs, ``[A, H]``.
        c: of the outputs, ``[A]``.
        hidden: what the units gave at the latest pass, ``[H]``.
        q: what the outputs gave, ``[A]``.
    """

    flat: NDArray[np.float64]
    w: NDArray[np.float64]
    b: NDArray[np.float64]
    v: NDArray[np.float64]
    c: NDArray[np.float64]
    hidden: NDArray[np.float64]
    q: NDArray[np.float64]


def new_smdp_network(
    num_inputs: int, num_hidden: int, num_actions: int, rng: np.random.Generator, scale: float = 0.1
) -> SmdpNetwork:
    """A network with weights uniform in ±``scale``, and outputs without a bias at first.

    Args:
        num_inputs: I.
        num_hidden: H.
        num_actions: A.
        rng: what draws.
        scale: of the weights.

    Raises:
        ValueError: a size below 1 or a scale that is not positive.

    Example:
        >>> new_smdp_network(47, 20, 2, np.random.default_rng(0)).flat.shape
        (1002,)
    """
    for name, size in (("num_inputs", num_inputs), ("num_hidden", num_hidden), ("num_actions", num_actions)):
        check_whole(name, size)
    check_positive("scale", scale)
    ends = np.cumsum([num_inputs * num_hidden, num_hidden, num_actions * num_hidden, num_actions])
    flat = np.zeros(ends[-1])
    flat[: ends[2]] = rng.uniform(-scale, scale, ends[2])
    w, b, v, c = np.split(flat, ends[:-1])
    w, v = w.reshape(num_inputs, num_hidden), v.reshape(num_actions, num_hidden)
    return SmdpNetwork(flat, w, b, v, c, np.zeros(num_hidden), np.zeros(num_actions))


@lean_reassociating_kernel
def smdp_network_values(network: SmdpNetwork, x: NDArray[np.float64]) -> None:
    """Writes the action values of ``x`` ``[I]`` into ``network.q``.

    Example:
        >>> network = new_smdp_network(3, 4, 2, np.random.default_rng(0))
        >>> network.flat[:], network.c[:] = 0.0, [1.0, 2.0]
        >>> smdp_network_values(network, np.ones(3))
        >>> network.q.tolist()
        [1.0, 2.0]
    """
    hidden, q = network.hidden, network.q
    for j in range(len(hidden)):
        hidden[j] = network.b[j]
    for i in range(len(x)):
        xi = x[i]
        if xi != 0.0:
            for j in range(len(hidden)):
                hidden[j] += xi * network.w[i, j]
    for j in range(len(hidden)):
        hidden[j] = 1.0 / (1.0 + math.exp(-hidden[j]))
    for a in range(len(q)):
        total = network.c[a]
        for j in range(len(hidden)):
            total += network.v[a, j] * hidden[j]
        q[a] = total


@lean_reassociating_kernel
def smdp_network_update(
    network: SmdpNetwork,
    x_tm1: NDArray[np.float64],
    a_tm1: int,
    r_t: float,
    duration_t: float,
    rate: float,
    v_t: float,
    step_size: float,
    max_error: float,
) -> Any:
    """One step of gradient descent for a decision that lasted; returns the TD error before it was clipped.

    Args:
        network: changed in place.
        x_tm1: what was seen when the decision was made, ``[I]``.
        a_tm1: what was decided.
        r_t: ∫ e^(−βt) (rate of reward) dt until the next decision.
        duration_t: τ, how long that took.
        rate: β, per unit of time.
        v_t: the best action's value at the next decision; 0 where the world terminated.
        step_size: α.
        max_error: the error is cut to between − and + this; ``np.inf`` for no cut.

    Example:
        1 + 5 e⁻¹ = 2.8394 is cut to 2, so the output's bias grows by .1 · 2, and its weights by .1 · 2 · ½: units whose
        weights are 0 give ½.

        >>> network = new_smdp_network(3, 4, 2, np.random.default_rng(0))
        >>> network.flat[:] = 0.0
        >>> round(smdp_network_update(network, np.zeros(3), 1, 1.0, 2.0, 0.5, 5.0, 0.1, 2.0), 4)
        2.8394
        >>> network.c.tolist(), network.v[1].tolist()
        ([0.0, 0.2], [0.1, 0.1, 0.1, 0.1])
    """
    smdp_network_values(network, x_tm1)
    hidden = network.hidden
    error = r_t + math.exp(-rate * duration_t) * v_t - network.q[a_tm1]
    step = step_size * min(max(error, -max_error), max_error)
    for j in range(len(hidden)):
        h = hidden[j]
        hidden[j] = step * network.v[a_tm1, j] * h * (1.0 - h)
        network.v[a_tm1, j] += step * h
        network.b[j] += hidden[j]
    network.c[a_tm1] += step
    for i in range(len(x_tm1)):
        xi = x_tm1[i]
        if xi != 0.0:
            for j in range(len(hidden)):
                network.w[i, j] += xi * hidden[j]
    return error
