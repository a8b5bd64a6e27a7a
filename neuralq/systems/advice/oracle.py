"""What must be exact: units are the logic of their rules, the network around them stays, and a step is autograd's."""

from __future__ import annotations

import itertools
import math
from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuralq.learners import smdp_network_update, smdp_network_values
from neuralq.q import MLP, ActionOutputQ, Rule, insert_rules
from neuralq.runs.report.claims import Row, number
from neuralq.systems.advice.rules import GOOD
from neuralq.systems.advice.studies import GAMMA, STEP_SIZE, as_network, compiled
from neuralq_envs.pengo_kernels import NUM_ACTIONS, NUM_INPUTS

__all__ = ["insertion_difference", "oracle", "step_difference", "unit_outputs"]

_Conditions = list[tuple[int, float, float]]

_RULES = [rule for kind in GOOD.values() for rule in kind]


def oracle() -> tuple[Row, ...]:
    """As rows."""
    holds, other = unit_outputs()
    return (
        number("a rule's unit where all its conditions are true: least", 0.9526, holds, tol=5e-5, note="σ(3)"),
        number(
            "a rule's unit where one or more are false: most",
            0.0474,
            other,
            tol=5e-5,
            note="σ(−3); 16 rules, all logic",
        ),
        number(
            "what insertion adds to the values, less what logic says",
            0.0,
            insertion_difference(),
            tol=1e-12,
            note="200 states in which every condition is plainly true or false",
        ),
        number(
            "a step of learning: difference from autograd", 0.0, step_difference(), tol=1e-12, note="60 steps, 36 units"
        ),
    )


def _new(seed: int) -> ActionOutputQ:
    return ActionOutputQ(NUM_INPUTS, NUM_ACTIONS, MLP((20,), activation="sigmoid"), rng=seed, dtype=torch.float64)


def unit_outputs() -> tuple[float, float]:
    """The least that a rule's unit says where the rule holds, and the most where not, over rules and all logic.

    Example:
        >>> [round(x, 4) for x in unit_outputs()]
        [0.9526, 0.0474]
    """
    least, most = 1.0, 0.0
    plain = _new(0)
    for rule in _RULES:
        conditions = cast("_Conditions", list(rule.conditions))
        states = torch.zeros(2 ** len(conditions), NUM_INPUTS, dtype=torch.float64)
        for state, logic in zip(states, itertools.product((0, 1), repeat=len(conditions)), strict=True):
            for (i, *ends), true in zip(conditions, logic, strict=True):
                state[i] = ends[true]
        said = (insert_rules(plain, [rule]).all(states) - plain.all(states)).detach()[:, rule.action]
        least, most = min(least, float(said[-1])), max(most, float(said[:-1].max()))
    return least, most


def insertion_difference(seed: int = 0, num_states: int = 200) -> float:
    """The largest difference between what all rules together add to a value and Σ σ(6 (Σ t − N + ½)) in plain Python.

    Example:
        >>> insertion_difference(num_states=20) < 1e-12
        True
    """
    rng, plain = np.random.default_rng(seed), _new(seed)
    states = torch.from_numpy(rng.integers(2, size=(num_states, NUM_INPUTS)).astype(float))
    states[:, 20:] *= 0.5  # sectors say that of what is two steps away
    added = (insert_rules(plain, _RULES).all(states) - plain.all(states)).detach()
    return max(
        abs(float(added[s, a]) - sum(_logic(rule, states[s]) for rule in _RULES if rule.action == a))
        for s in range(num_states)
        for a in range(NUM_ACTIONS)
    )


def _logic(rule: Rule, state: Tensor) -> float:
    true = sum(float(state[i]) == high for i, _, high in cast("_Conditions", rule.conditions))
    return 1 / (1 + math.exp(-6 * (true - len(rule.conditions) + 0.5)))


def step_difference(seed: int = 0, num_steps: int = 60) -> float:
    """The largest difference in any weight between compiled Q-learning and gradient descent by autograd.

    Example:
        >>> step_difference(num_steps=5) < 1e-12
        True
    """
    rng, told = np.random.default_rng(seed), insert_rules(_new(seed), _RULES)
    network = compiled(told)
    for _ in range(num_steps):
        x_tm1, x_t = rng.random((2, NUM_INPUTS)) * rng.integers(2, size=(2, NUM_INPUTS))
        a, reward, goes_on = int(rng.integers(NUM_ACTIONS)), float(rng.normal()), bool(rng.integers(2))
        smdp_network_values(network, x_t)
        v_t = float(network.q.max()) if goes_on else 0.0
        smdp_network_update(network, x_tm1, a, reward, 1.0, -math.log(GAMMA), v_t, STEP_SIZE, np.inf)
        with torch.no_grad():
            target = reward + GAMMA * goes_on * told.all(torch.from_numpy(x_t)).max()
        gradient = torch.autograd.grad(
            0.5 * (target - told.all(torch.from_numpy(x_tm1))[a]) ** 2, list(told.parameters())
        )
        for parameter, slope in zip(told.parameters(), gradient, strict=True):
            parameter.data -= STEP_SIZE * slope
    ours = as_network(network).parameters()
    return max(float((p - q).detach().abs().max()) for p, q in zip(ours, told.parameters(), strict=True))
