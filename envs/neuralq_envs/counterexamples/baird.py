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

The cause is the mismatch of three things, and taking away any one of them cures the star: updating as often as the
target policy visits (`star_on_policy`), a table (`star_tabular`), or less bootstrapping (`star_low_gamma`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from neuralq.checks import check_fraction, check_whole
from neuralq.mdp import FiniteMDP
from neuralq.mdp.environment import ModelEnv, ModelVectorEnv
from neuralq_envs.counterexamples.problem import Problem

__all__ = [
    "DASHED",
    "SOLID",
    "critical_gamma",
    "make",
    "make_vector",
    "star",
    "star_1995",
    "star_control",
    "star_low_gamma",
    "star_on_policy",
    "star_tabular",
]

DASHED, SOLID = 0, 1


def star(num_upper: int = 6, gamma: float = 0.99) -> Problem:
    """Baird's star with ``num_upper`` upper states; 6 gives the figure of Sutton & Barto 2018.

    Raises:
        ValueError: fewer than one upper state, or γ outside [0, 1].

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
        gamma=gamma,
        step_size=0.01,
        title="Baird's star",
        source="Baird 1995; Sutton & Barto 2018, section 11.2",
        known=f"Expected TD(0) diverges at every step size iff γ > (n + 9)/(2n + 5) = {critical_gamma(n):.4f}.",
    )


def star_1995(num_upper: int = 5, gamma: float = 0.99, termination: float = 0.0) -> Problem:
    """The star as Baird drew it: five upper states, one action, every transition trained equally often.

    Args:
        num_upper: n.
        gamma: γ.
        termination: probability that the lower state ends the episode: .01 is the star of Sutton & Barto 1998.

    Raises:
        ValueError: as `star`, or ``termination`` outside [0, 1].

    Example:
        >>> star_1995().mdp.num_actions, star_1995(termination=0.01).mdp.termination.round(12).tolist()
        (1, [0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    """
    check_fraction("termination", termination)
    problem = star(num_upper, gamma)
    size = num_upper + 1
    transition = np.zeros((size, size))
    transition[:, -1] = 1.0
    transition[-1, -1] = 1.0 - termination
    names = problem.mdp.state_names
    model = FiniteMDP.from_arrays(
        [transition], np.zeros((size, 1)), substochastic=True, state_names=names, action_names=("solid",)
    )
    said: dict[str, Any] = {
        "name": "baird-first-edition",
        "title": "Baird's star with an end",
        "source": "Sutton & Barto 1998, figure 8.12",
        "known": "An end with probability .01 does not help: expected TD(0) still diverges with n = 5 and γ = .99.",
    }
    if termination == 0:
        swings = "With n = 5 and γ = .99 the leading pair is complex: the values swing as they grow."
        said = {"name": "baird-1995", "title": "Baird's star of 1995", "source": "Baird 1995",
                "known": f"{problem.known} {swings}"}  # fmt: skip
    only = np.ones((size, 1))
    return replace(problem, mdp=model, target_policy=only, behaviour_policy=only, **said)


def star_control(num_upper: int = 6, gamma: float = 0.99, solid_probability: float | None = None) -> Problem:
    """The star for Q-learning: Q(s, solid) has the features of the star, Q(s, dashed) a weight of its own.

    Weight 0 is shared, weights 1 to n + 1 belong to ``solid`` in each state, the other n + 1 to ``dashed``. The target
    is greedy. While ``solid`` is greedy everywhere, which holds on the whole way from the initial weights, the growing
    mode is that of `star` slowed down by μ(solid).

    Args:
        num_upper: n.
        gamma: γ.
        solid_probability: μ(solid) in every state; None: 1 / (n + 1), as in `star`. One half makes all pairs equally
            frequent.

    Raises:
        ValueError: as `star`, or ``solid_probability`` outside [0, 1].

    Example:
        >>> problem = star_control()
        >>> problem.features.shape, (problem.features @ problem.initial_weights)[:, SOLID].tolist()
        ((7, 2, 15), [3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 12.0])
    """
    problem = star(num_upper, gamma)
    n = num_upper
    solid = 1 / (n + 1) if solid_probability is None else solid_probability
    check_fraction("solid_probability", solid)
    features = np.zeros((n + 1, 2, 2 * n + 3))
    features[:, SOLID, 0] = problem.features[:, n + 1]
    features[:, SOLID, 1 : n + 2] = problem.features[:, : n + 1]
    features[:, DASHED, n + 2 :] = np.eye(n + 1)
    weights = np.ones(2 * n + 3)
    weights[n + 1] = 10.0
    uniform = solid_probability == 0.5
    return replace(
        problem,
        name="baird-control-uniform" if uniform else "baird-control",
        features=features,
        initial_weights=weights,
        behaviour_policy=np.tile([1 - solid, solid], (n + 1, 1)),
        control=True,
        title="Baird's star for Q-learning" + (", all pairs equally often" if uniform else ""),
        source="Sutton & Barto 2018, exercise 11.3; features of Maei, Szepesvári, Bhatnagar & Sutton 2010",
        known=f"While solid is greedy, as it stays from these weights at γ = .99, expected Q-learning diverges iff γ > "
        f"(n + 9)/(2n + 5) = {critical_gamma(n):.4f}, {solid:.4g} times as fast as prediction does.",
    )


def star_on_policy(num_upper: int = 6, gamma: float = 0.99) -> Problem:
    """The star updated where its target policy goes: always in the lower state.

    Raises:
        ValueError: as `star`.

    Example:
        >>> star_on_policy().state_distribution.tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    """
    problem = star(num_upper, gamma)
    return replace(
        problem,
        name="baird-on-policy",
        behaviour_policy=problem.target_policy,
        state_distribution=np.eye(num_upper + 1)[num_upper],
        title="Baird's star, on-policy",
        known="A has the one nonzero eigenvalue 5(1 − γ): expected TD(0) converges, slowly.",
    )


def star_tabular(num_upper: int = 6, gamma: float = 0.99) -> Problem:
    """The star with one weight per state, which start at the values that the star's own features give.

    Raises:
        ValueError: as `star`.

    Example:
        >>> star_tabular().initial_weights.tolist()
        [3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 12.0]
    """
    problem = star(num_upper, gamma)
    return replace(
        problem,
        name="baird-tabular",
        features=np.eye(num_upper + 1),
        initial_weights=problem.features @ problem.initial_weights,
        title="Baird's star in a table",
        known="The eigenvalues of A are 1/(n + 1), n times, and (1 − γ)/(n + 1): TD(0) converges for every γ below 1.",
    )


def star_low_gamma(gamma: float = 0.85) -> Problem:
    """The star of seven states with γ below 15/17 = .882, where expected TD(0) converges.

    Raises:
        ValueError: γ of 15/17 or more; use `star`.

    Example:
        >>> star_low_gamma().gamma
        0.85
    """
    if gamma >= critical_gamma(6):
        raise ValueError(f"gamma must lie below 15/17 = .882 for the star to converge, got {gamma}; use star(6, gamma)")
    return replace(
        star(6, gamma),
        name="baird-low-gamma",
        title="Baird's star with little bootstrapping",
        known="γ < 15/17: expected TD(0) converges to values of 0.",
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
