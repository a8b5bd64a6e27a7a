"""EBNN-Q: one small network for each move, fitted after every episode to returns and to the slopes that explain them.

A return is followed as far as the moves after were greedy, and bootstraps there (Watkins). Its slope is the chain rule
along the states that were observed, through a theory of the moves; LOB* believes it as far as the theory, left to
itself from the same state with the same moves, expects the same return.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neuralq.learners import SlopeNet, fit_slopes
from neuralq.rules import is_greedy, lambda_returns, lob_star, return_slopes, watkins_lambda
from neuralq.systems.thrun_robot.theory import Theory
from neuralq_envs.thrun_robot import MAX_STEPS, ThrunRobotEnv

__all__ = [
    "GAMMA",
    "LARGEST",
    "Carried",
    "Episodes",
    "Nets",
    "action_values",
    "carried",
    "expected_returns",
    "explained_slopes",
    "refit",
    "walk",
]

Array = NDArray[np.float64]
Nets = Sequence[SlopeNet]

GAMMA = 0.9
LARGEST = 0.5
"""Error of the theory from which LOB* believes nothing of it, in units of the return, which is within ±1."""
_NUM_STEPS, _STEP_SIZE = 200, 0.02  # of Adam, for each fit


class Episodes(NamedTuple):
    """Episodes side by side, time-major and padded behind their ends.

    Args:
        s_tm1: states that were left, ``[T, N, 2]``.
        a_tm1: moves, ``[T, N]``.
        r_t: rewards, ``[T, N]``.
        discount_t: γ, or 0 where the target was reached or lost, ``[T, N]``.
        s_t: states that followed, ``[T, N, 2]``.
        last_t: the last row of an episode, and all behind it, ``[T, N]``.
        real: rows that are not padding, ``[T, N]``.
    """

    s_tm1: Array
    a_tm1: NDArray[np.int64]
    r_t: Array
    discount_t: Array
    s_t: Array
    last_t: NDArray[np.bool_]
    real: NDArray[np.bool_]


class Carried(NamedTuple):
    """What each row learns from.

    Args:
        returns: y, ``[T, N]``.
        carry: weight of the next row's return in this one's, ``[T, N]``.
        bootstrap: weight of the best value of the next state, ``[T, N]``.
    """

    returns: Array
    carry: Array
    bootstrap: Array


def action_values(nets: Nets, s: Array) -> Array:
    """Of every move, ``[*n, 2]`` to ``[*n, 3]``."""
    return np.stack([net.values(s) for net in nets], axis=-1)


def walk(nets: Nets, target: Array, random_moves: NDArray[np.int64]) -> Episodes:
    """One episode in the environment, padded to as many steps as it may have.

    Args:
        nets: of each move; the best one is made.
        target: where it is at the start.
        random_moves: ``[T]``, for each step the move that is made instead, or −1.
    """
    env, rows = ThrunRobotEnv(), MAX_STEPS
    one = Episodes(
        np.ones((rows, 1, 2)), np.zeros((rows, 1), np.int64), np.zeros((rows, 1)), np.zeros((rows, 1)),
        np.ones((rows, 1, 2)), np.ones((rows, 1), np.bool_), np.zeros((rows, 1), np.bool_),
    )  # fmt: skip
    s, _ = env.reset(options={"target": target})
    for t in range(rows):
        a = int(random_moves[t]) if random_moves[t] >= 0 else int(action_values(nets, s).argmax())
        s_t, r_t, terminated, _, _ = env.step(a)
        last = terminated or t == rows - 1
        one.s_tm1[t], one.a_tm1[t], one.r_t[t], one.s_t[t] = s, a, r_t, s_t
        one.discount_t[t], one.last_t[t], one.real[t] = 0.0 if terminated else GAMMA, last, True
        if last:
            break
        s = s_t
    return one


def carried(nets: Nets, episodes: Episodes, lambda_: float = 1.0) -> Carried:
    """Watkins's λ-returns of all rows by the present networks; λ = 0 is one-step Q-learning."""
    a_tm1, r_t, discount_t, last_t = map(
        torch.from_numpy, (episodes.a_tm1, episodes.r_t, episodes.discount_t, episodes.last_t)
    )
    q_tm1, q_t = (torch.from_numpy(action_values(nets, s)) for s in (episodes.s_tm1, episodes.s_t))
    lambda_t = watkins_lambda(lambda_, is_greedy(q_tm1, a_tm1))
    returns = lambda_returns(r_t, discount_t, q_t.amax(-1), lambda_t, last_t)
    carry = (discount_t * lambda_t).masked_fill(last_t, 0.0)
    return Carried(returns.numpy(), carry.numpy(), (discount_t - carry).numpy())


def explained_slopes(theory: Theory, nets: Nets, episodes: Episodes, rows: Carried) -> Array:
    """How each return depends on the state that was left, by the theory's Jacobians in the states that were observed.

    Returns:
        ``[T, N, 2]``.
    """
    reward_slopes, jacobians = theory.slopes(episodes.s_tm1, episodes.a_tm1)
    best = action_values(nets, episodes.s_t).argmax(-1)
    every = np.stack([net.slopes(episodes.s_t) for net in nets], axis=-2)
    after = np.take_along_axis(every, best[..., None, None], axis=-2)[..., 0, :]
    bootstrapped = np.einsum("tnij,tni->tnj", jacobians, after) * rows.bootstrap[..., None]
    slopes = return_slopes(
        torch.from_numpy(reward_slopes + bootstrapped),
        torch.from_numpy(rows.carry),
        torch.from_numpy(jacobians),
        torch.zeros(episodes.s_tm1.shape[1:], dtype=torch.float64),
    )
    return slopes.numpy()


def expected_returns(theory: Theory, nets: Nets, episodes: Episodes, rows: Carried) -> Array:
    """The same returns as the theory expects them from each state, by its own successors and the moves that were made.

    Returns:
        ``[T, N]``.
    """
    num_rows = len(episodes.r_t)
    s, total, factor = episodes.s_tm1.copy(), np.zeros(episodes.r_t.shape), episodes.real.astype(np.float64)
    for ahead in range(num_rows):
        begins = np.nonzero(factor[: num_rows - ahead])
        if not len(begins[0]):
            break
        row = (begins[0] + ahead, begins[1])
        reward, after = theory.step(s[begins], episodes.a_tm1[row])
        later = rows.bootstrap[row] * action_values(nets, after).max(-1)
        total[begins] += factor[begins] * (reward + later)
        s[begins] = after
        factor[begins] *= rows.carry[row]
    return total


def refit(nets: Nets, episodes: Episodes, source: Theory | float, weight: float = 1.0) -> tuple[Nets, float]:
    """The networks after they were fitted to all episodes, and how far slopes were believed in the mean.

    Args:
        nets: of each move.
        episodes: seen so far.
        source: a theory that explains slopes, which LOB* weighs; or how much slopes of 0 count, where 0 is for none.
        weight: of an explained slope that is wholly believed.
    """
    rows = carried(nets, episodes)
    slopes, weights = np.zeros(episodes.s_tm1.shape), np.zeros(episodes.r_t.shape)
    if isinstance(source, Theory):
        slopes = explained_slopes(source, nets, episodes, rows)
        expected = torch.from_numpy(expected_returns(source, nets, episodes, rows))
        weights = lob_star(expected, torch.from_numpy(rows.returns), LARGEST).numpy() * weight
    else:
        weights[:] = source
    fitted = []
    for move, net in enumerate(nets):
        of = episodes.real & (episodes.a_tm1 == move)
        given = (episodes.s_tm1[of], rows.returns[of], slopes[of], weights[of])
        fitted.append(fit_slopes(net, *given, num_steps=_NUM_STEPS, step_size=_STEP_SIZE) if of.any() else net)
    return fitted, float(weights[episodes.real].mean())
