"""A network that scores an action by what is seen looking in its direction, and learns by Q-learning or actor-critic.

Where actions are each other's mirror images or rotations, one network can judge them all: Q(s, a) is its output for
the input as it looks from the side of a, that is with the inputs in another order. What is learned of one action then
holds for all. With one order only, and a network for each action, the same functions are Q-learning with separate nets.

A network has one layer of hidden units; these and its output u are bounded, tanh(z/2) = 2σ(z) − 1, so that values
lie in (−1, 1). It is taught one pair at a time, by the gradient of ½ (target − u)²:

* Q-learning (`turned_q_update`): target r_t + discount_t max_a Q(s_t, a);
* actor-critic (`turned_actor_critic_update`): a critic V and merits of actions m, with the TD error
  δ = r_t + discount_t V(s_t) − V(s_tm1); V is taught V + δ, and the merit of the action that was taken m + δ.

All functions are compiled, and can be called from compiled loops. Source: Lin 1992, QCON and AHCON with the local
representation of actions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_positive, check_whole
from neuralq.jit import lean_kernel, lean_reassociating_kernel
from neuralq.tabular.kernels.random_numbers import uniform

__all__ = [
    "TurnedNetwork",
    "new_turned_network",
    "turned_action",
    "turned_actor_critic_update",
    "turned_policy",
    "turned_q_update",
    "turned_update",
    "turned_values",
]

Reals = NDArray[np.float64]


class TurnedNetwork(NamedTuple):
    """N networks of I inputs and H hidden units that judge A actions; and room for a pass through them.

    Args:
        w: from inputs to units, ``[N, I, H]``.
        b: of the units, ``[N, H]``.
        v: from units to the output, ``[N, H]``.
        c: of the output, ``[N]``.
        places: input i is input ``places[a, i]`` for who judges action a, ``[A, I]``.
        nets: which network judges an action, ``[A]``.
        hidden: what the units gave at the latest pass, ``[A, H]``.
        q: what the outputs gave, ``[A]``.
    """

    w: Reals
    b: Reals
    v: Reals
    c: Reals
    places: NDArray[np.int64]
    nets: NDArray[np.int64]
    hidden: Reals
    q: Reals


def new_turned_network(
    places: ArrayLike, num_hidden: int, rng: np.random.Generator, *, scale: float = 0.1, shared: bool = True
) -> TurnedNetwork:
    """A network that has learned nothing: weights uniform in ±``scale``.

    Args:
        places: for each action an order of the inputs, ``[A, I]``.
        num_hidden: H.
        rng: what draws.
        scale: of the weights.
        shared: whether one network judges all actions; else there is one for each.

    Raises:
        ValueError: rows that are no orders of 0 to I − 1, or a number that is not positive.

    Example:
        >>> network = new_turned_network([[0, 1, 2], [2, 1, 0]], 4, np.random.default_rng(0))
        >>> network.w.shape, network.q.shape
        ((1, 3, 4), (2,))
    """
    orders = np.array(places)
    if orders.ndim != 2 or orders.size == 0 or (np.sort(orders, axis=1) != np.arange(orders.shape[1])).any():
        raise ValueError(f"places must be a row for each action, an order of 0 to I - 1, got {places!r}")
    check_whole("num_hidden", num_hidden)
    check_positive("scale", scale)
    num_actions, num_inputs = orders.shape
    num_nets = 1 if shared else num_actions
    shapes = (num_inputs, num_hidden), (num_hidden,), (num_hidden,), ()
    w, b, v, c = (rng.uniform(-scale, scale, (num_nets, *shape)) for shape in shapes)
    nets = np.zeros(num_actions, np.int64) if shared else np.arange(num_actions)
    return TurnedNetwork(
        w, b, v, c, orders.astype(np.int64), nets,
        np.zeros((num_actions, num_hidden)), np.zeros(num_actions),
    )  # fmt: skip


@lean_reassociating_kernel
def turned_values(network: TurnedNetwork, x: NDArray[Any]) -> Any:
    """Writes the value of every action at ``x`` ``[I]`` into ``network.q``, and returns the largest.

    Example:
        >>> network = new_turned_network([[0, 1], [1, 0]], 1, np.random.default_rng(0))
        >>> network.w[:], network.b[:], network.v[:], network.c[:] = [[1.0], [3.0]], 0.0, 2.0, 0.0
        >>> bool(turned_values(network, np.array([1, 0])) == network.q[1] > network.q[0])
        True
    """
    best = -np.inf
    for a in range(len(network.q)):
        best = max(best, _pass(network, x, a))
    return best


@lean_reassociating_kernel
def _pass(network: TurnedNetwork, x: NDArray[Any], a: int) -> Any:
    """The value of one action."""
    n, hidden = network.nets[a], network.hidden
    num_hidden = hidden.shape[1]
    for j in range(num_hidden):
        hidden[a, j] = network.b[n, j]
    for i in range(len(x)):
        if x[i] != 0:
            place = network.places[a, i]
            for j in range(num_hidden):
                hidden[a, j] += x[i] * network.w[n, place, j]
    total = network.c[n]
    for j in range(num_hidden):
        hidden[a, j] = 2.0 / (1.0 + math.exp(-hidden[a, j])) - 1.0
        total += network.v[n, j] * hidden[a, j]
    network.q[a] = 2.0 / (1.0 + math.exp(-total)) - 1.0
    return network.q[a]


@lean_reassociating_kernel
def turned_update(network: TurnedNetwork, x: NDArray[Any], a: int, target: float, step_size: float) -> Any:
    """Moves the value of an action towards a target by one step of gradient descent; returns target − value.

    Args:
        network: changed in place.
        x: what was seen, ``[I]``.
        a: the action.
        target: what its value should be.
        step_size: α.

    Example:
        The output of a network of zeros is 0, and its slope ½; so its bias moves by .3 (1 − 0) ½.

        >>> network = new_turned_network([[0, 1]], 2, np.random.default_rng(0))
        >>> network.w[:], network.b[:], network.v[:], network.c[:] = 0.0, 0.0, 0.0, 0.0
        >>> turned_update(network, np.ones(2), 0, 1.0, 0.3), network.c.tolist()
        (1.0, [0.15])
    """
    n, hidden = network.nets[a], network.hidden
    u = _pass(network, x, a)
    error = target - u
    step = step_size * error * 0.5 * (1.0 - u * u)
    network.c[n] += step
    for j in range(hidden.shape[1]):
        h = hidden[a, j]
        hidden[a, j] = step * network.v[n, j] * 0.5 * (1.0 - h * h)
        network.v[n, j] += step * h
        network.b[n, j] += hidden[a, j]
    for i in range(len(x)):
        if x[i] != 0:
            place = network.places[a, i]
            for j in range(hidden.shape[1]):
                network.w[n, place, j] += x[i] * hidden[a, j]
    return error


@lean_kernel
def turned_q_update(
    network: TurnedNetwork,
    x_tm1: NDArray[Any],
    a_tm1: int,
    r_t: float,
    discount_t: float,
    x_t: NDArray[Any],
    step_size: float,
) -> Any:
    """One step of Q-learning; returns the TD error.

    Args:
        network: changed in place.
        x_tm1: what was seen, ``[I]``.
        a_tm1: the action.
        r_t: reward.
        discount_t: γ, or 0 where the world terminated.
        x_t: what was seen then; not looked at where the discount is 0.
        step_size: α.

    Example:
        >>> network, x = new_turned_network([[0, 1], [1, 0]], 5, np.random.default_rng(0)), np.eye(2)
        >>> for _ in range(500):
        ...     _ = turned_q_update(network, x[0], 0, 0.8, 0.0, x[0], 0.3)
        >>> _ = turned_values(network, x[1])
        >>> network.q.round(1).tolist()[1]  # action 1 sees there what action 0 saw
        0.8
    """
    target = r_t
    if discount_t != 0.0:
        target += discount_t * turned_values(network, x_t)
    return turned_update(network, x_tm1, a_tm1, target, step_size)


@lean_kernel
def turned_actor_critic_update(
    merits: TurnedNetwork,
    critic: TurnedNetwork,
    x_tm1: NDArray[Any],
    a_tm1: int,
    r_t: float,
    discount_t: float,
    x_t: NDArray[Any],
    merit_step_size: float,
    critic_step_size: float,
) -> Any:
    """One step of critic and merits; returns the TD error.

    Args:
        merits: of actions; changed in place.
        critic: V, a network of one action; changed in place.
        x_tm1: what was seen, ``[I]``.
        a_tm1: the action.
        r_t: reward.
        discount_t: γ, or 0 where the world terminated.
        x_t: what was seen then; not looked at where the discount is 0.
        merit_step_size: α of the merits.
        critic_step_size: α of the critic.

    Example:
        >>> rng, x = np.random.default_rng(0), np.ones(1)
        >>> merits, critic = (new_turned_network([[0]] * a, 3, rng, shared=False) for a in (2, 1))
        >>> for _ in range(200):
        ...     _ = turned_actor_critic_update(merits, critic, x, 0, 0.5, 0.0, x, 0.1, 0.1)
        ...     _ = turned_actor_critic_update(merits, critic, x, 1, -0.5, 0.0, x, 0.1, 0.1)
        >>> _ = turned_values(merits, x)
        >>> bool(merits.q[0] > 0.5 > -0.5 > merits.q[1])
        True
    """
    target = r_t
    if discount_t != 0.0:
        target += discount_t * turned_values(critic, x_t)
    error = turned_update(critic, x_tm1, 0, target, critic_step_size)
    merit = _pass(merits, x_tm1, a_tm1)
    turned_update(merits, x_tm1, a_tm1, merit + error, merit_step_size)
    return error


@lean_kernel
def turned_policy(network: TurnedNetwork, x: NDArray[Any], a: int, temperature: float) -> Any:
    """The probability of an action under a softmax of that temperature over its values at ``x``.

    Example:
        >>> network = new_turned_network([[0]] * 4, 2, np.random.default_rng(0))
        >>> turned_policy(network, np.ones(1), 2, 0.05)
        0.25
    """
    best, total = turned_values(network, x), 0.0
    for other in range(len(network.q)):
        total += math.exp((network.q[other] - best) / temperature)
    return math.exp((network.q[a] - best) / temperature) / total


@lean_kernel
def turned_action(network: TurnedNetwork, x: NDArray[Any], temperature: float, rng: NDArray[np.uint64]) -> Any:
    """An action drawn from `turned_policy`; with a temperature of 0 the best one, the first of those that tie.

    Args:
        network: of values or merits.
        x: what is seen, ``[I]``.
        temperature: at least 0.
        rng: a stream of `neuralq.tabular.new_stream`; one number is drawn where the temperature is not 0.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> turned_action(new_turned_network([[0]] * 4, 2, np.random.default_rng(0)), np.ones(1), 0.0, new_stream(0))
        0
    """
    best, total, last = turned_values(network, x), 0.0, len(network.q) - 1
    if temperature == 0.0:
        for a in range(last):
            if network.q[a] == best:
                return a
        return last
    for a in range(last + 1):
        network.q[a] = math.exp((network.q[a] - best) / temperature)
        total += network.q[a]
    left = uniform(rng) * total
    for a in range(last):
        if left < network.q[a]:
            return a
        left -= network.q[a]
    return last
