"""The one-step learners by name: Q-learning, Sarsa, expected Sarsa and double Q-learning."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from neuralq.checks import check_choice
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import SARSA, Table
from neuralq.tabular.kernels.one_step import RULES, run_one_step
from neuralq.tabular.kernels.q_learning import run_q_learning
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.learner import Learner
from neuralq.tabular.policies import (
    EPSILON_GREEDY,
    RANDOM,
    PolicyLike,
    StepCode,
    StepSizeLike,
    acting_code,
    check_expectation,
    step_code,
)
from neuralq.tabular.results import Experience, Learned

__all__ = ["apply", "double_q", "expected_sarsa", "one_step_learner", "q_learning", "sarsa"]


def q_learning(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Q-learning from random restarts: ``Q(s, a) ← (1 − α) Q(s, a) + α [r + γ max_a' Q(s', a')]``.

    With ``step_size="deterministic"`` (α = 1) this is Table 13.1 of Mitchell: the action is chosen after the update,
    and episodes restart from the model's start distribution.

    Raises:
        ValueError: an argument out of range.

    Source: Watkins 1989; Mitchell 1997, Table 13.1, rules 13.7, 13.10 and 13.11.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> learned = q_learning(mdp, 100, gamma=0.9, step_size="deterministic")
        >>> learned.q.tolist(), int(learned.visits.sum())
        ([[90.0], [100.0]], 100)
    """
    return _learn("q-learning", source, num_steps, gamma, policy, step_size, seed, options)


def sarsa(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Sarsa learns the value of the policy it follows: ``Q(s, a) ← Q(s, a) + α [r + γ Q(s', a') − Q(s, a)]``.

    a' is drawn before the update and taken next.

    Raises:
        ValueError: an argument out of range.

    Source: Rummery & Niranjan 1994.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> sarsa(mdp, 100, gamma=0.9, step_size=1.0).q.tolist()
        [[90.0], [100.0]]
    """
    return _learn("sarsa", source, num_steps, gamma, policy, step_size, seed, options)


def expected_sarsa(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Expected Sarsa averages over the next action: ``target = r + γ Σ_a' π(a'|s') Q(s', a')``.

    The policy must be a distribution, so confidence bounds are refused.

    Raises:
        ValueError: an argument out of range.

    Source: van Seijen et al. 2009.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> expected_sarsa(mdp, 100, gamma=0.9, policy="random", step_size=1.0).q.tolist()
        [[90.0], [100.0]]
    """
    return _learn("expected-sarsa", source, num_steps, gamma, policy, step_size, seed, options)


def double_q(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Double Q-learning: one of two tables picks the best next action, the other says what it is worth.

    A fair coin decides which table learns; the agent acts on their mean, which is what is returned.

    Raises:
        ValueError: an argument out of range.

    Source: van Hasselt 2010, algorithm 1.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> double_q(mdp, 100, gamma=0.9, step_size=1.0).q.tolist()
        [[90.0], [100.0]]
    """
    return _learn("double-q", source, num_steps, gamma, policy, step_size, seed, options)


def apply(
    q: ArrayLike,
    experience: Experience,
    *,
    rule: str = "q-learning",
    step_size: StepSizeLike = "visits",
    policy: PolicyLike = "epsilon-greedy",
    seed: Seed = 0,
) -> Learned:
    """The same update on recorded transitions, in their order: learning from stored experience.

    Args:
        rule: "q-learning", "sarsa", "expected-sarsa" or "double-q".
        seed: of double Q-learning's coin.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Source: Mitchell 1997, section 13.3.6.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 100.0], [0.9, 0.0], [1, 1], [False, True])
        >>> apply([[0.0], [0.0]], steps, step_size=1.0).q.tolist()
        [[0.0], [100.0]]
    """
    check_choice("rule", rule, RULES)
    return replay(
        one_step_learner(rule, table_from(q), policy, step_code(step_size, len(experience))), experience, seed
    )


def _learn(
    rule: str,
    source: Source,
    num_steps: int,
    gamma: float,
    policy: PolicyLike,
    step_size: StepSizeLike,
    seed: Seed,
    options: RunOptions,
) -> Learned:
    table, ready = new_table(source, options)
    return learn(
        one_step_learner(rule, table, policy, step_code(step_size, num_steps)), ready, num_steps, gamma, seed, options
    )


def one_step_learner(rule: str, table: Table, policy: PolicyLike, step_size: StepCode) -> Learner:
    """What the one-step learners run, by the rule: "q-learning", "sarsa", "expected-sarsa" or "double-q".

    Raises:
        ValueError: expected Sarsa for a policy that is no distribution.

    Example:
        >>> one_step_learner("sarsa", table_from([[0.0, 0.0]]), "greedy", step_code(1.0, 1)).on_policy
        True
    """
    acting = acting_code(policy)
    check_expectation(rule, acting)
    halves = np.stack([table.q, table.q]) if rule == "double-q" else np.zeros((0, 0, 0))
    plain = rule == "q-learning" and acting.kind in (EPSILON_GREEDY, RANDOM)
    return Learner(
        run_one_step, table, acting, (step_size, RULES.index(rule), halves), rule == RULES[SARSA],
        fast=run_q_learning if plain else None, copies=(halves,) if rule == "double-q" else (),
    )  # fmt: skip
