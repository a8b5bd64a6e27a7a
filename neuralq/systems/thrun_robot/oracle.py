"""What must be exact: the chain of Jacobians, the moves, the returns, and that every target can be reached."""

from __future__ import annotations

import cmath
import math

import numpy as np
import torch
from torch import Tensor

from neuralq.learners import new_slope_net
from neuralq.rules import input_slopes
from neuralq.runs.report.claims import Row, claim, number
from neuralq.systems.thrun_robot.learning import (
    GAMMA,
    Carried,
    Episodes,
    Nets,
    action_values,
    carried,
    explained_slopes,
)
from neuralq.systems.thrun_robot.theory import Theory, learn_theory
from neuralq.systems.thrun_robot.trainings import HAND, train
from neuralq_envs.thrun_robot import NUM_MOVES, ThrunRobotEnv

__all__ = ["chain_difference", "move_difference", "oracle", "theory_episodes"]

_NUM_ROWS = 8


def oracle() -> tuple[Row, ...]:
    """All of them, as rows."""
    reached = float(train(np.random.SeedSequence(1), HAND, 1).success[-1])
    return (
        number(
            "chained Jacobians: difference from autograd of the theory, unrolled",
            0.0,
            chain_difference(),
            tol=1e-6,
            note=f"from every row of episodes of up to {_NUM_ROWS} steps, with ends, bootstraps and moves that explore",
        ),
        number("moves: difference from a pose on the ground, as complex numbers", 0.0, move_difference(), tol=1e-9),
        claim("targets reached by geometry", "all", f"{reached:.0%}", reached == 1.0),
    )


def move_difference(num_episodes: int = 50, seed: int = 0) -> float:
    """How far observations are from the target seen from a pose (z, heading) that is moved on the ground.

    Example:
        >>> move_difference(num_episodes=2) < 1e-12
        True
    """
    env, rng, worst = ThrunRobotEnv(), np.random.default_rng(seed), 0.0
    for _ in range(num_episodes):
        s, _ = env.reset(seed=int(rng.integers(2**31)))
        target, robot, heading, ended = complex(*s), 0j, 1 + 0j, False
        while not ended:
            move = int(rng.integers(NUM_MOVES))
            s, _, ended, _, _ = env.step(move)
            if move == 0:
                robot += 0.35 * heading
            else:
                heading *= cmath.exp(1j * math.radians(25 if move == 1 else -25))
            worst = max(worst, abs((target - robot) * heading.conjugate() - complex(*s)))
    return worst


def theory_episodes(theory: Theory, nets: Nets, num_episodes: int, rng: np.random.Generator) -> Episodes:
    """Episodes along the theory's own states: their explained slopes are the slopes of what the theory composes."""
    lengths = rng.integers(1, _NUM_ROWS + 1, num_episodes)
    a = rng.integers(NUM_MOVES, size=(_NUM_ROWS, num_episodes))
    s = [rng.uniform(-1, 3, (num_episodes, 2))]
    for row in range(_NUM_ROWS):
        best = action_values(nets, s[-1]).argmax(-1)
        a[row] = np.where(rng.random(num_episodes) < 0.7, best, a[row])
        s.append(theory.step(s[-1], a[row])[1])
    steps = np.arange(_NUM_ROWS)[:, None]
    terminated = (steps == lengths - 1) & (rng.random(num_episodes) < 0.5)
    states = np.stack(s)
    rewards = rng.normal(size=a.shape)
    return Episodes(
        states[:-1], a, rewards, np.where(terminated, 0.0, GAMMA), states[1:], steps >= lengths - 1, steps < lengths
    )


def chain_difference(num_episodes: int = 6, seed: int = 0) -> float:
    """How far explained slopes are from autograd through the theory's returns, unrolled from every row.

    Example:
        >>> chain_difference(num_episodes=2) < 1e-6
        True
    """
    rng = np.random.default_rng(seed)
    theory, nets = learn_theory(20, rng), [new_slope_net(2, 10, rng) for _ in range(NUM_MOVES)]
    episodes = theory_episodes(theory, nets, num_episodes, rng)
    rows = carried(nets, episodes)
    ours, worst = explained_slopes(theory, nets, episodes, rows), 0.0
    for row, column in np.argwhere(episodes.real):
        s = torch.from_numpy(episodes.s_tm1[row, column].copy()).requires_grad_()
        slope = input_slopes(_unrolled(theory, nets, episodes, rows, (row, column), s), s)
        worst = max(worst, float(np.abs(slope.detach().numpy() - ours[row, column]).max()))
    return worst


def _unrolled(
    theory: Theory, nets: Nets, episodes: Episodes, rows: Carried, start: tuple[int, int], s: Tensor
) -> Tensor:
    """The return that the theory composes from one row on, with the whole graph."""
    value, factor, (row, column) = torch.zeros((), dtype=torch.float64), 1.0, start
    while factor:
        move = int(episodes.a_tm1[row, column])
        value = value + factor * theory.rewards[move].module()(s)[0]
        s = s + torch.cat([net.module()(s) for net in theory.changes[move]])
        best = torch.cat([net.module()(s) for net in nets]).max()
        value = value + factor * float(rows.bootstrap[row, column]) * best
        factor *= float(rows.carry[row, column])
        row += 1
    return value
