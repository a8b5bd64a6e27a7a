"""Random problems: a Garnet model (Archibald, McKinnon & Thomas 1995) with random features and random policies.

Features are standard normal. Policies nearly always take one action in each state: probabilities are .9 Dirichlet(.1) +
.1/A, so that ratios stay below 10 A. All is drawn by one seed. On-policy, where each state is updated as often as the
target visits it, XᵀD(I − γP)X is positive definite and TD(0) converges (Tsitsiklis & Van Roy 1997). Off-policy nothing
is promised: whether it converges has to be computed, for which these problems are the test. With evenly mixed policies,
few features or many branches divergence is rare; with the defaults one in seven diverges.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["garnet"]


def garnet(
    num_states: int = 10,
    num_actions: int = 3,
    branching: int = 2,
    num_features: int = 8,
    gamma: float = 0.99,
    seed: int = 0,
    updates: Literal["behaviour", "target", "random"] = "behaviour",
) -> Problem:
    """A random model, features and two policies; states are updated as often as the behaviour visits them.

    Args:
        num_states: of the model.
        num_actions: legal in every state.
        branching: successors of each pair.
        num_features: d.
        gamma: γ.
        seed: of all that is random.
        updates: ``"behaviour"``; ``"target"`` for the target as behaviour, on-policy; or ``"random"`` for a random
            distribution that has nothing to do with either policy, as a replay memory of unknown origin amounts to: TD
            diverges more often there.

    Raises:
        ValueError: a number below 1, γ outside [0, 1], other updates, or a model that falls into separate parts (see
            `FiniteMDP`); more branches prevent that.

    Example:
        >>> problem = garnet(seed=1)
        >>> problem.features.shape, bool(problem.state_distribution.min() > 0)
        ((10, 8), True)
        >>> bool((garnet(seed=1, updates="target").importance_ratio == 1).all())
        True
    """
    check_whole("num_features", num_features)
    check_whole("seed", seed, minimum=0)
    check_choice("updates", updates, ("behaviour", "target", "random"))
    model = FiniteMDP.garnet(num_states, num_actions, branching, seed=seed)
    rng = np.random.default_rng([seed, 1])  # not the stream that drew the model
    features = rng.standard_normal((num_states, num_features))
    target, behaviour = (_policy(rng, num_states, num_actions) for _ in range(2))
    skewed = np.random.default_rng([seed, 2]).dirichlet(np.full(num_states, 0.5)) if updates == "random" else None
    name, words = {
        "behaviour": ("garnet", ""),
        "target": ("garnet-on-policy", ", on-policy"),
        "random": ("garnet-skewed", ", updated at random"),
    }[updates]
    return Problem.from_mdp(
        model,
        features,
        gamma=gamma,
        target_policy=target,
        behaviour_policy=target if updates == "target" else behaviour,
        state_distribution=skewed,
        step_size=0.05,
        name=name,
        title=f"Random problem {seed}{words}",
        source="Archibald, McKinnon & Thomas 1995",
        known="On-policy: TD(0) converges for every γ below 1."
        if updates == "target"
        else "Off-policy: nothing is promised.",
    )


def _policy(rng: np.random.Generator, num_states: int, num_actions: int) -> NDArray[np.float64]:
    """Probabilities ``[S, A]``, at least .1/A, that lean on one action."""
    leaning: NDArray[np.float64] = rng.dirichlet(np.full(num_actions, 0.1), size=num_states)
    return 0.9 * leaning + 0.1 / num_actions
