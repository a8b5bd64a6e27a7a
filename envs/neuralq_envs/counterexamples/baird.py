"""Baird's star (Baird 1995), in the form of Sutton & Barto 2018, section 11.2, with any number n of upper states.

States 0..n−1 are the upper ones, state n is the lower one. ``dashed`` goes to a random upper state, ``solid`` to the
lower one; every reward is 0, so every true value is 0 and a weight vector that says so exists. The behaviour policy
takes ``solid`` once in n + 1 times, the target policy always, and each state is updated equally often.

    V(i) = 2 w_i + w_{n+1}  (i < n),      V(n) = w_n + 2 w_{n+1}

On the subspace in which all upper states are equal, the expected update of the values has the matrix

    M = 1/(n+1) · [[n+4, 2(1−γ) − (n+4)γ], [2n, 5(1−γ) − 2nγ]],   (n+1) tr M = n+9 − (2n+5)γ,
    (n+1)² det M = (n+20)(1−γ) > 0,

and elsewhere the eigenvalue 4/(n+1). So expected TD(0) diverges at every step size iff γ > (n+9)/(2n+5): for n = 6 that
is 15/17, for n ≤ 4 it never happens. The leading pair is complex, and the divergence swings, iff
(n+9 − (2n+5)γ)² < 4(n+20)(1−γ); so for n = 5 and γ = .99.
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq.simulate import ModelEnv, ModelVectorEnv
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["DASHED", "SOLID", "critical_gamma", "make", "make_vector", "star"]

DASHED, SOLID = 0, 1


def star(num_upper: int = 6) -> Problem:
    """Baird's star with ``num_upper`` upper states; 6 gives the figure of Sutton & Barto 2018.

    Raises:
        ValueError: fewer than one upper state.

    Example:
        >>> problem = star()
        >>> problem.features.shape, (problem.features @ problem.initial_weights).tolist()
        ((7, 8), [3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 12.0])
    """
    check_whole("num_upper", num_upper)
    n = int(num_upper)
    transition = np.zeros((2, n + 1, n + 1))
    transition[DASHED, :, :n] = 1 / n
    transition[SOLID, :, n] = 1.0
    features = np.zeros((n + 1, n + 2))
    features[:n, :n] = 2 * np.eye(n)
    features[:n, n + 1] = 1.0
    features[n, n:] = 1.0, 2.0
    weights = np.ones(n + 2)
    weights[n] = 10.0
    names = [*(f"upper {i}" for i in range(n)), "lower"]
    model = FiniteMDP.from_arrays(transition, np.zeros((n + 1, 2)), state_names=names, action_names=("dashed", "solid"))
    return Problem(
        name="baird",
        mdp=model,
        features=features,
        target_policy=np.tile([0.0, 1.0], (n + 1, 1)),
        behaviour_policy=np.tile([n / (n + 1), 1 / (n + 1)], (n + 1, 1)),
        state_distribution=np.full(n + 1, 1 / (n + 1)),
        initial_weights=weights,
        gamma=0.99,
        step_size=0.01,
        title="Baird's star",
        source="Baird 1995; Sutton & Barto 2018, section 11.2",
        known=f"Expected TD(0) diverges at every step size iff γ > (n + 9)/(2n + 5) = {critical_gamma(n):.4f}.",
    )


def critical_gamma(num_upper: int) -> float:
    """Expected TD(0) on the star diverges at every step size iff γ > (n + 9) / (2n + 5).

    A value of 1 or more means that no γ below 1 diverges.

    Example:
        >>> critical_gamma(6) == 15 / 17, critical_gamma(4)
        (True, 1.0)
    """
    check_whole("num_upper", num_upper)
    return (num_upper + 9) / (2 * num_upper + 5)


def make(num_upper: int = 6, render_mode: str | None = None) -> ModelEnv:
    """What ``gymnasium.make("neuralq/BairdStar-v0")`` calls: the states of the star, for ever.

    Raises:
        ValueError: a render mode; there is nothing to draw.

    Example:
        >>> make().observation_space
        Discrete(7)
    """
    if render_mode is not None:
        raise ValueError(f"the star is not drawn: render_mode must be None, got {render_mode!r}")
    return star(num_upper).mdp.as_env()


def make_vector(num_envs: int = 1, num_upper: int = 6, max_episode_steps: int | None = None) -> ModelVectorEnv:
    """What ``gymnasium.make_vec`` calls in mode ``"vector_entry_point"``.

    Example:
        >>> make_vector(num_envs=4).reset(seed=0)[0].shape
        (4,)
    """
    return star(num_upper).mdp.as_vector_env(num_envs, max_episode_steps=max_episode_steps)
