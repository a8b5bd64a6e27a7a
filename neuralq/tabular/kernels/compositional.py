"""CQ-L: modules that solve elemental tasks, and a gate that finds which of them a stage of a composite task needs.

A composite task is a sequence of elemental ones. Undiscounted, with the same cost of every step, what an action is
worth in a stage of it differs from what it is worth in the elemental task by a constant K, what the later stages are:

    Q_task,stage(s, a) = Q_m(s, a) + K_task,stage        for the module m that the stage needs.

So modules are shared by all tasks, and a stage has to learn no more than a gate and its K. A module is drawn by the
gate for a whole stage. When the stage is over, modules are compared by how well Q_m + K told what was earned from each
of its last steps on, h ∝ g exp(−mean e² / 2σ²); the gate moves towards h, K towards what was earned, and each module
learns from the stage, from its last step to its first, as far as h says it is its own. Where the stage was not reached,
the module that was drawn loses its share.

Source: Singh 1992, "Transfer of learning by composing solutions of elemental sequential tasks", Machine Learning 8; the
gate for a whole stage, where his is for each step, and what a failed stage says are ours.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import uniform

__all__ = [
    "CompositionalQ",
    "CompositionalRates",
    "compositional_action",
    "compositional_module",
    "compositional_update",
    "compositional_value",
    "new_compositional_q",
]

_FURTHEST = 4.0  # of a gate's logit from 0


class CompositionalQ(NamedTuple):
    """What was learned; made by `new_compositional_q`, and changed in place.

    Args:
        q: values of each module, ``[M, S, A]``.
        gates: logits of the modules for each stage of each task, ``[T, M]``.
        biases: K of each stage, ``[T]``.
        shares: h of the last update, ``[M]``.
    """

    q: NDArray[np.float64]
    gates: NDArray[np.float64]
    biases: NDArray[np.float64]
    shares: NDArray[np.float64]


class CompositionalRates(NamedTuple):
    """Constants.

    Args:
        alpha: step size of the modules.
        epsilon: chance of an action at random.
        temperature: of the softmax over a module's values that draws the other actions.
        sigma: σ, how far what is earned may be from what was told.
        gate_step: by how much of h − g the logits move.
        bias_step: step size of K; 0 leaves it.
        failed: what a module keeps of its share after a stage that was not reached.
        num_judged: the last steps of a stage that modules are judged by.
    """

    alpha: float = 0.5
    epsilon: float = 0.1
    temperature: float = 0.01
    sigma: float = 0.3
    gate_step: float = 1.0
    bias_step: float = 0.2
    failed: float = 0.02
    num_judged: int = 20


def new_compositional_q(num_modules: int, num_states: int, num_actions: int, num_stages: int) -> CompositionalQ:
    """Modules and biases of 0, and gates that prefer none.

    Raises:
        ValueError: a count below 1.

    Example:
        >>> new_compositional_q(3, 64, 4, 10).gates.shape
        (10, 3)
    """
    sizes = {"modules": num_modules, "states": num_states, "actions": num_actions, "stages": num_stages}
    for name, size in sizes.items():
        check_whole(f"num_{name}", size)
    q = np.zeros((num_modules, num_states, num_actions))
    return CompositionalQ(q, np.zeros((num_stages, num_modules)), np.zeros(num_stages), np.zeros(num_modules))


@lean_kernel
def compositional_module(learned: CompositionalQ, stage: int, rng: NDArray[np.uint64]) -> Any:
    """The module for a stage, drawn by its gate.

    Args:
        learned: whose ``shares`` become the gate's probabilities.
        stage: which.
        rng: a stream (`neuralq.tabular.new_stream`); advanced.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> learned = new_compositional_q(2, 1, 1, 1)
        >>> learned.gates[0] = [-40.0, 40.0]
        >>> compositional_module(learned, 0, new_stream(0))
        1
    """
    _gate(learned, stage)
    left = uniform(rng)
    for m in range(len(learned.shares)):
        left -= learned.shares[m]
        if left < 0.0:
            return m
    return len(learned.shares) - 1


@lean_kernel
def compositional_action(
    learned: CompositionalQ, rates: CompositionalRates, module: int, s: int, rng: NDArray[np.uint64]
) -> Any:
    """An action of a module: at random with probability ε, else by a softmax over its values.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> learned = new_compositional_q(1, 1, 3, 1)
        >>> learned.q[0, 0, 2] = 1.0
        >>> compositional_action(learned, CompositionalRates(epsilon=0.0), 0, 0, new_stream(0))
        2
    """
    q = learned.q[module, s]
    if uniform(rng) < rates.epsilon:
        return int(uniform(rng) * len(q))
    largest, total = _largest(learned, module, s), 0.0
    for a in range(len(q)):
        total += math.exp((q[a] - largest) / rates.temperature)
    left = uniform(rng) * total
    for a in range(len(q)):
        left -= math.exp((q[a] - largest) / rates.temperature)
        if left < 0.0:
            return a
    return len(q) - 1


@lean_kernel
def compositional_value(learned: CompositionalQ, stage: int, s: int) -> Any:
    """What a stage is worth where it begins: K + Σ_m g_m max_a Q_m(s, a).

    Example:
        >>> learned = new_compositional_q(2, 1, 1, 1)
        >>> learned.q[:, 0, 0], learned.biases[0] = [1.0, 3.0], 0.5
        >>> compositional_value(learned, 0, 0)
        2.5
    """
    _gate(learned, stage)
    value = learned.biases[stage]
    for m in range(len(learned.shares)):
        value += learned.shares[m] * _largest(learned, m, s)
    return value


@lean_kernel
def compositional_update(
    learned: CompositionalQ,
    rates: CompositionalRates,
    stage: int,
    module: int,
    states: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    num_steps: int,
    following: float,
    reached: bool,
    ended: bool,
) -> None:
    """What a stage that is over says of gate, K and modules.

    Args:
        learned: changed in place.
        rates: constants.
        stage: which.
        module: that was drawn for it.
        states: what it came through, ``[num_steps or more]``; the state in which it ended is not among them.
        actions: that were taken there.
        rewards: that followed.
        num_steps: how many.
        following: what the stages after it are worth (`compositional_value`); 0 where the task ended.
        reached: whether the stage came to its end; else it was broken off.
        ended: whether the task did, so that nothing is after it and K stays as it is.

    Example:
        One step that earned 1, and nothing after it: both modules expected 0, and each learns from half of the stage.

        >>> learned, rates = new_compositional_q(2, 2, 1, 1), CompositionalRates()
        >>> path = np.zeros(1, int), np.zeros(1, int), np.ones(1)
        >>> compositional_update(learned, rates, 0, 0, *path, 1, 0.0, True, True)
        >>> learned.q[:, 0, 0].tolist()
        [0.25, 0.25]
    """
    _gate(learned, stage)
    h = learned.shares
    if reached:
        step_of_bias = _judge(learned, rates, stage, states, actions, rewards, num_steps, following)
    else:
        h[module] *= rates.failed
        step_of_bias = 0.0
    total = 0.0
    for m in range(len(h)):
        total += h[m]
    for m in range(len(h)):
        h[m] /= total
    _move_gate(learned, rates, stage)
    if not reached:
        return
    for m in range(len(h)):
        best = following - learned.biases[stage]
        for i in range(num_steps - 1, -1, -1):
            s, a = states[i], actions[i]
            learned.q[m, s, a] += rates.alpha * h[m] * (rewards[i] + best - learned.q[m, s, a])
            best = _largest(learned, m, s)
    if not ended:
        learned.biases[stage] += step_of_bias


@lean_kernel
def _gate(learned: CompositionalQ, stage: int) -> None:
    """Writes the probabilities of the modules into ``shares``."""
    gates, largest, total = learned.gates[stage], -np.inf, 0.0
    for m in range(len(gates)):
        largest = max(largest, gates[m])
    for m in range(len(gates)):
        learned.shares[m] = math.exp(gates[m] - largest)
        total += learned.shares[m]
    for m in range(len(gates)):
        learned.shares[m] /= total


@lean_kernel
def _largest(learned: CompositionalQ, module: int, s: int) -> float:
    largest = -np.inf
    for a in range(learned.q.shape[2]):
        largest = max(largest, learned.q[module, s, a])
    return largest


@lean_kernel
def _judge(
    learned: CompositionalQ,
    rates: CompositionalRates,
    stage: int,
    states: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    num_steps: int,
    following: float,
) -> float:
    """Weighs ``shares`` by how well each module told what was earned; returns by how much K is to move."""
    judged, least = min(num_steps, rates.num_judged), np.inf
    for m in range(len(learned.shares)):  # once to find the smallest, so that the exponentials do not all vanish
        least = min(least, _errors(learned, m, stage, states, actions, rewards, num_steps, judged, following)[1])
    bias, total = 0.0, 0.0
    for m in range(len(learned.shares)):
        mean, square = _errors(learned, m, stage, states, actions, rewards, num_steps, judged, following)
        learned.shares[m] *= math.exp(-(square - least) / (2.0 * rates.sigma**2))
        total += learned.shares[m]
        bias += learned.shares[m] * mean
    return rates.bias_step * bias / total


@lean_kernel
def _errors(
    learned: CompositionalQ,
    module: int,
    stage: int,
    states: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    num_steps: int,
    judged: int,
    following: float,
) -> tuple[float, float]:
    """Mean and mean square of what was earned from the last steps on, less Q + K."""
    earned, mean, square = following, 0.0, 0.0
    for i in range(num_steps - 1, num_steps - 1 - judged, -1):
        earned += rewards[i]
        error = earned - learned.biases[stage] - learned.q[module, states[i], actions[i]]
        mean += error / judged
        square += error * error / judged
    return mean, square


@lean_kernel
def _move_gate(learned: CompositionalQ, rates: CompositionalRates, stage: int) -> None:
    """The logits move by the step size times h − g, and stay within 4 of 0."""
    gates, largest, total = learned.gates[stage], -np.inf, 0.0
    for m in range(len(gates)):
        largest = max(largest, gates[m])
    for m in range(len(gates)):
        total += math.exp(gates[m] - largest)
    for m in range(len(gates)):
        moved = gates[m] + rates.gate_step * (learned.shares[m] - math.exp(gates[m] - largest) / total)
        gates[m] = min(max(moved, -_FURTHEST), _FURTHEST)
