"""The one-step learners by name: each builds a table and a learner, and runs it."""

from __future__ import annotations

from numpy.typing import ArrayLike

from neuralq.checks import check_choice
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import Table
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.onestep import RULES, OneStep
from neuralq.tabular.policies import UPPER_CONFIDENCE, PolicyLike, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Experience, Learned

__all__ = ["apply", "double_q", "expected_sarsa", "q_learning", "sarsa"]


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

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces (slower).
        num_steps: transitions, one update each.
        gamma: γ in [0, 1].
        policy: how to act, a setting or its name.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

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
    return _learn_one_step("q-learning", source, num_steps, gamma, policy, step_size, seed, options)


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

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces (slower).
        num_steps: transitions, one update each.
        gamma: γ in [0, 1].
        policy: how to act, a setting or its name.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: Rummery & Niranjan 1994.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> sarsa(mdp, 100, gamma=0.9, step_size=1.0).q.tolist()
        [[90.0], [100.0]]
    """
    return _learn_one_step("sarsa", source, num_steps, gamma, policy, step_size, seed, options)


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

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces (slower).
        num_steps: transitions, one update each.
        gamma: γ in [0, 1].
        policy: how to act, a setting or its name.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: van Seijen et al. 2009.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> expected_sarsa(mdp, 100, gamma=0.9, policy="random", step_size=1.0).q.tolist()
        [[90.0], [100.0]]
    """
    return _learn_one_step("expected-sarsa", source, num_steps, gamma, policy, step_size, seed, options)


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

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces (slower).
        num_steps: transitions, one update each.
        gamma: γ in [0, 1].
        policy: how to act, a setting or its name.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: van Hasselt 2010, algorithm 1.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[0.0], [100.0]], substochastic=True)
        >>> double_q(mdp, 100, gamma=0.9, step_size=1.0).q.tolist()
        [[90.0], [100.0]]
    """
    return _learn_one_step("double-q", source, num_steps, gamma, policy, step_size, seed, options)


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
        q: values to start from, ``[S, A]``, NaN (or −∞) where illegal; not changed.
        experience: transitions, which carry their own discounts.
        rule: "q-learning", "sarsa", "expected-sarsa" or "double-q".
        step_size: α by visits of the pair, counted from 0.
        policy: whose expectation expected Sarsa takes; without meaning for the other rules.
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
    table = table_from(q)
    learner = _one_step(rule, table, policy, step_size, len(experience))
    return replay(learner, experience, seed)


def _learn_one_step(
    rule: str, source: Source, num_steps: int, gamma: float, policy: PolicyLike, step_size: StepSizeLike, seed: Seed,
    options: RunOptions,
) -> Learned:  # fmt: skip
    table, ready = new_table(source, options)
    return learn(_one_step(rule, table, policy, step_size, num_steps), ready, num_steps, gamma, seed, options)


def _one_step(rule: str, table: Table, policy: PolicyLike, step_size: StepSizeLike, num_steps: int) -> OneStep:
    acting = acting_code(policy)
    if rule == "expected-sarsa" and acting.kind == UPPER_CONFIDENCE:
        raise ValueError("expected Sarsa needs the policy's probabilities, and confidence bounds have none; "
                         'use "epsilon-greedy", "softmax", "k-to-the-q" or "random"')  # fmt: skip
    return OneStep(table, acting, step_code(step_size, num_steps), rule)
