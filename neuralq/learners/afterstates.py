"""TD(λ) over afterstates: values of an action set that is another one in every state.

Where every action leads to a known afterstate x(s, a) with a known reward, and only what comes later is uncertain,
q(s, a) = r(s, a) + discount · V(x(s, a)) is an action value for however many actions there are, and only V is learned.
V is a network with one layer of sigmoid units, V(x) = c + Σⱼ vⱼ σ(bⱼ + Σᵢ xᵢ wᵢⱼ).

After an episode of afterstates x₀ … x_T, of which x₀ is what it began with, V is moved towards λ-returns in one pass
backwards, so that every row bootstraps from what the rows after it have just taught:

    G_t = r_{t+1} + discount_{t+1} · [(1 − λ) V(x_{t+1}) + λ G_{t+1}],   θ ← θ + α (G_t − V(x_t)) ∇V(x_t)

With small α that is `neuralq.rules.lambda_returns`. All functions are compiled, and can be called from compiled loops.

Sources: Tesauro 1992 and Zhang & Dietterich 1995 (learning after the episode, backwards); Sutton & Barto 2018, section
6.8 (afterstates).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import Seed, uniform

__all__ = ["ValueNetwork", "choose_afterstate", "learn_afterstates", "new_value_network", "value_of"]

Reals = NDArray[np.float64]


class ValueNetwork(NamedTuple):
    """V of F features with H hidden units.

    Args:
        w: ``[H, F]``.
        b: ``[H]``.
        v: ``[H]``.
        c: ``[1]``.
        hidden: what the hidden units gave last, ``[H]``.
    """

    w: Reals
    b: Reals
    v: Reals
    c: Reals
    hidden: Reals


def new_value_network(num_features: int, num_hidden: int, seed: Seed) -> ValueNetwork:
    """A network that has learned nothing: hidden weights uniform within ±F^−½, and V is 0 everywhere.

    Args:
        num_features: F.
        num_hidden: H.
        seed: of the weights.

    Raises:
        ValueError: a size below 1.

    Example:
        >>> network = new_value_network(3, 5, seed=0)
        >>> network.w.shape, value_of(network, np.ones(3))
        ((5, 3), 0.0)
    """
    check_whole("num_features", num_features)
    check_whole("num_hidden", num_hidden)
    width = num_features**-0.5
    w = np.random.default_rng(seed).uniform(-width, width, (num_hidden, num_features))
    return ValueNetwork(w, np.zeros(num_hidden), np.zeros(num_hidden), np.zeros(1), np.zeros(num_hidden))


@lean_kernel
def value_of(network: ValueNetwork, x: Reals) -> Any:
    """V(x) of an afterstate ``x [F]``.

    Example:
        σ(0) = ½ of each of the two units, and c.

        >>> zeros = np.zeros(2)
        >>> value_of(ValueNetwork(np.zeros((2, 1)), zeros, np.array([1.0, 3.0]), np.array([5.0]), zeros), np.ones(1))
        7.0
    """
    total = network.c[0]
    for j in range(len(network.b)):
        z = network.b[j]
        for i in range(len(x)):
            z += network.w[j, i] * x[i]
        network.hidden[j] = 1.0 / (1.0 + np.exp(-z))
        total += network.v[j] * network.hidden[j]
    return total


@lean_kernel
def choose_afterstate(
    network: ValueNetwork,
    rewards: Reals,
    discounts: Reals,
    afterstates: Reals,
    count: int,
    epsilon: float,
    rng: NDArray[np.uint64],
) -> Any:
    """ε-greedy in r + discount · V(x) among as many actions as there are; the first of the best.

    Args:
        network: V.
        rewards: of each action, ``[M]``.
        discounts: γ, or 0 where an action ends the episode, ``[M]``.
        afterstates: what each action leads to, ``[M, F]``.
        count: how many of the M rows are actions, at least 1.
        epsilon: chance of drawing one of them.
        rng: a stream of `neuralq.tabular.new_stream`; advanced.

    Example:
        V is 0 at first, and so the reward decides.

        >>> from neuralq.tabular import new_stream
        >>> network, discounts = new_value_network(2, 4, seed=0), np.ones(3)
        >>> choose_afterstate(network, np.array([1.0, 2.0, 9.0]), discounts, np.eye(3, 2), 2, 0.0, new_stream(0))
        1
    """
    if epsilon > 0.0 and uniform(rng) < epsilon:
        return int(uniform(rng) * count)
    best, chosen = -np.inf, 0
    for a in range(count):
        q = rewards[a]
        if discounts[a] != 0.0:
            q += discounts[a] * value_of(network, afterstates[a])
        if q > best:
            best, chosen = q, a
    return chosen


@lean_kernel
def learn_afterstates(
    network: ValueNetwork, x_tm1: Reals, r_t: Reals, discount_t: Reals, x_t: Reals, lambda_: float, step_size: float
) -> Any:
    """Moves V towards the λ-returns of one episode, from its last row to its first; returns the mean squared error.

    Args:
        network: changed in place.
        x_tm1: afterstates that were left, ``[T, F]``.
        r_t: rewards, ``[T]``.
        discount_t: γ, or 0 where the world terminated, ``[T]``.
        x_t: afterstates that followed, ``[T, F]``; not looked at where the discount is 0. The last row bootstraps
        fully. lambda_: λ in [0, 1].
        step_size: α.

    Example:
        V is 0 and its hidden units give ½: c moves by α (1 − 0), each of four weights v by half of that.

        >>> network = new_value_network(2, 4, seed=0)
        >>> network.w[:] = 0
        >>> learn_afterstates(network, np.ones((1, 2)), np.ones(1), np.zeros(1), np.ones((1, 2)), 0.7, 0.1)
        1.0
        >>> network.c.tolist(), network.v.tolist(), round(value_of(network, np.ones(2)), 3)
        ([0.1], [0.05, 0.05, 0.05, 0.05], 0.2)
    """
    num_rows, num_features = x_tm1.shape
    following, squares = 0.0, 0.0
    for t in range(num_rows - 1, -1, -1):
        target = r_t[t]
        if discount_t[t] != 0.0:
            value = value_of(network, x_t[t])
            if t == num_rows - 1:
                following = value
            target += discount_t[t] * ((1.0 - lambda_) * value + lambda_ * following)
        error = target - value_of(network, x_tm1[t])
        squares += error * error
        step = step_size * error
        network.c[0] += step
        for j in range(len(network.b)):
            h = network.hidden[j]
            slope = step * network.v[j] * h * (1.0 - h)
            network.v[j] += step * h
            network.b[j] += slope
            for i in range(num_features):
                network.w[j, i] += slope * x_tm1[t, i]
        following = target
    return squares / num_rows
