"""Watkins', Peng's and naive Q(λ), Sarsa(λ) and expected Sarsa(λ); formulas: `neuralq.tabular.kernels.traces`."""

from __future__ import annotations

from numpy.typing import ArrayLike

from neuralq.checks import check_choice, check_fraction
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import Table
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.kernels.traces import RULES, new_traces, run_traces
from neuralq.tabular.learner import Learner
from neuralq.tabular.policies import PolicyLike, StepCode, StepSizeLike, acting_code, check_expectation, step_code
from neuralq.tabular.results import Experience, Learned

__all__ = ["apply_lambda", "q_lambda", "sarsa_lambda", "trace_learner"]


def q_lambda(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    lambda_: float = 0.9,
    rule: str = "watkins",
    trace: str = "accumulating",
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Q(λ) hands each step's error to the pairs that led to it: ``Q(x) ← Q(x) + α δ z(x)``.

    Args:
        lambda_: λ in [0, 1].
        rule: "watkins" (cut at exploring actions), "peng" (uncut, the book's Q^λ) or "naive" (uncut errors).
        trace: "accumulating" or "replacing".

    Raises:
        ValueError: an argument out of range.

    Source: Watkins 1989; Peng & Williams 1996; Mitchell 1997, section 13.5.

    Example:
        The reward of the first episode reaches both steps.

        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> q_lambda(mdp, 2, gamma=0.5, lambda_=0.5, step_size=1.0).q.tolist()
        [[2.0], [8.0]]
    """
    check_choice("rule", rule, RULES[:3])
    table, ready = new_table(source, options)
    learner = trace_learner(table, policy, step_code(step_size, num_steps), rule, lambda_, trace)
    return learn(learner, ready, num_steps, gamma, seed, options)


def sarsa_lambda(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    lambda_: float = 0.9,
    expected: bool = False,
    trace: str = "accumulating",
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Sarsa(λ) hands each step's on-policy error to the pairs that led to it.

    Args:
        lambda_: λ in [0, 1].
        expected: whether the target averages over the next action instead of taking the one drawn.
        trace: "accumulating" or "replacing".

    Raises:
        ValueError: an argument out of range.

    Source: Rummery & Niranjan 1994; Singh & Sutton 1996.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> sarsa_lambda(mdp, 2, gamma=0.5, lambda_=1.0, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    rule = "expected-sarsa" if expected else "sarsa"
    table, ready = new_table(source, options)
    learner = trace_learner(table, policy, step_code(step_size, num_steps), rule, lambda_, trace)
    return learn(learner, ready, num_steps, gamma, seed, options)


def apply_lambda(
    q: ArrayLike,
    experience: Experience,
    *,
    lambda_: float,
    rule: str = "watkins",
    trace: str = "accumulating",
    step_size: StepSizeLike = "visits",
    policy: PolicyLike = "epsilon-greedy",
) -> Learned:
    """The same updates along traces on recorded transitions, in their order.

    Args:
        lambda_: λ in [0, 1].
        rule: "watkins", "peng", "naive", "sarsa" or "expected-sarsa".
        trace: "accumulating" or "replacing".

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> apply_lambda([[0.0], [0.0]], steps, lambda_=1.0, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    code = step_code(step_size, len(experience))
    return replay(trace_learner(table_from(q), policy, code, rule, lambda_, trace), experience)


def trace_learner(
    table: Table, policy: PolicyLike, step_size: StepCode, rule: str, lambda_: float, trace: str
) -> Learner:
    """What `q_lambda` and `sarsa_lambda` run.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> trace_learner(table_from([[0.0]]), "greedy", step_code(1.0, 1), "peng", 0.9, "replacing").on_policy
        False
    """
    acting = acting_code(policy)
    check_choice("rule", rule, RULES)
    check_fraction("lambda_", lambda_, "for Monte Carlo use lambda_=1")
    check_choice("trace", trace, ("accumulating", "replacing"))
    check_expectation(rule, acting)
    traces = new_traces(table.q.size)
    arguments = (step_size, traces, RULES.index(rule), trace == "replacing", float(lambda_))
    return Learner(run_traces, table, acting, arguments, rule == "sarsa", connections=traces)
