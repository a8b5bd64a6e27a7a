"""Random problems: a Garnet model (Archibald, McKinnon & Thomas 1995) with random features and random policies.

Features are standard normal. Policies nearly always take one action in each state: probabilities are .9 Dirichlet(.1) +
.1/A, so that ratios stay below 10 A. All is drawn by one seed. On-policy, where each state is updated as often as the
target visits it, XᵀD(I − γP)X is positive definite and TD(0) converges (Tsitsiklis & Van Roy 1997). Off-policy nothing
is promised: whether it converges has to be computed, for which these problems are the test. With evenly mixed policies,
few features or many branches divergence is rare; with the defaults one in seven diverges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["garnet", "garnet_on_policy", "garnet_skewed"]


def garnet(
    num_states: int = 10,
    num_actions: int = 3,
    branching: int = 2,
    num_features: int = 8,
    gamma: float = 0.99,
    seed: int = 0,
) -> Problem:
    """A random model, features and two policies; states are updated as often as the behaviour visits them.

    Raises:
        ValueError: a number below 1, γ outside [0, 1], or a model that falls into separate parts (see `FiniteMDP`);
            more branches prevent that.

    Example:
        >>> problem = garnet(seed=1)
        >>> problem.features.shape, bool(problem.state_distribution.min() > 0)
        ((10, 8), True)
    """
    check_whole("num_features", num_features)
    check_whole("seed", seed, minimum=0)
    model = FiniteMDP.garnet(num_states, num_actions, branching, seed=seed)
    rng = np.random.default_rng([seed, 1])  # not the stream that drew the model
    features = rng.standard_normal((num_states, num_features))
    target, behaviour = (_policy(rng, num_states, num_actions) for _ in range(2))
    return Problem.from_mdp(
        model,
        features,
        gamma=gamma,
        target_policy=target,
        behaviour_policy=behaviour,
        step_size=0.05,
        name="garnet",
        title=f"Random problem {seed}",
        source="Archibald, McKinnon & Thomas 1995",
        known="Off-policy: nothing is promised.",
    )


def garnet_on_policy(
    num_states: int = 10,
    num_actions: int = 3,
    branching: int = 2,
    num_features: int = 8,
    gamma: float = 0.99,
    seed: int = 0,
) -> Problem:
    """The same random model, features and target as `garnet`, with the target as behaviour.

    Raises:
        ValueError: as `garnet`.

    Example:
        >>> bool((garnet_on_policy(seed=1).importance_ratio == 1).all())
        True
    """
    problem = garnet(num_states, num_actions, branching, num_features, gamma, seed)
    return Problem.from_mdp(
        problem.mdp,
        problem.features,
        gamma=gamma,
        target_policy=problem.target_policy,
        step_size=problem.step_size,
        name="garnet-on-policy",
        title=f"Random problem {seed}, on-policy",
        source=problem.source,
        known="On-policy: TD(0) converges for every γ below 1.",
    )


def garnet_skewed(
    num_states: int = 10,
    num_actions: int = 3,
    branching: int = 2,
    num_features: int = 8,
    gamma: float = 0.99,
    seed: int = 0,
) -> Problem:
    """The same as `garnet`, with states updated by a random distribution that has nothing to do with either policy.

    What a replay memory of unknown origin amounts to; TD diverges more often than under `garnet`.

    Raises:
        ValueError: as `garnet`.

    Example:
        >>> bool(np.abs(garnet_skewed(seed=1).state_distribution - garnet(seed=1).state_distribution).max() > 0.05)
        True
    """
    problem = garnet(num_states, num_actions, branching, num_features, gamma, seed)
    rng = np.random.default_rng([seed, 2])
    return replace(
        problem,
        name="garnet-skewed",
        title=f"Random problem {seed}, updated at random",
        state_distribution=rng.dirichlet(np.full(num_states, 0.5)),
    )


def _policy(rng: np.random.Generator, num_states: int, num_actions: int) -> NDArray[np.float64]:
    """Probabilities ``[S, A]``, at least .1/A, that lean on one action."""
    leaning: NDArray[np.float64] = rng.dirichlet(np.full(num_actions, 0.1), size=num_states)
    return 0.9 * leaning + 0.1 / num_actions
