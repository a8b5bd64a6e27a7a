"""n-step Q-learning, Sarsa and expected Sarsa; `neuralq.tabular.kernels.n_step` has the formula."""

from __future__ import annotations

from numpy.typing import ArrayLike

from neuralq.checks import check_choice, check_whole
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import BOOTSTRAPS, SARSA, Table
from neuralq.tabular.kernels.n_step import new_window, run_n_step
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.learner import Learner
from neuralq.tabular.policies import PolicyLike, StepCode, StepSizeLike, acting_code, check_expectation, step_code
from neuralq.tabular.results import Experience, Learned

__all__ = ["apply_n_step", "n_step", "n_step_learner"]


def n_step(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    n: int = 4,
    rule: str = "q-learning",
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """n-step learning sums n rewards before it bootstraps: Q^(n) of the book.

    Args:
        n: rewards in a target.
        rule: "q-learning", "sarsa" or "expected-sarsa": what the target bootstraps from.

    Raises:
        ValueError: an argument out of range.

    Source: Mitchell 1997, section 13.5; Watkins 1989.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> n_step(mdp, 2, gamma=0.5, n=2, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    table, ready = new_table(source, options)
    learner = n_step_learner(table, policy, step_code(step_size, num_steps), rule, n)
    return learn(learner, ready, num_steps, gamma, seed, options)


def apply_n_step(
    q: ArrayLike,
    experience: Experience,
    *,
    n: int,
    rule: str = "q-learning",
    step_size: StepSizeLike = "visits",
    policy: PolicyLike = "epsilon-greedy",
) -> Learned:
    """The same updates on recorded transitions; pairs whose n rewards have not all come at the end stay as they are.

    Args:
        n: rewards in a target.
        rule: "q-learning", "sarsa" or "expected-sarsa".

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> apply_n_step([[0.0], [0.0]], steps, n=2, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    return replay(n_step_learner(table_from(q), policy, step_code(step_size, len(experience)), rule, n), experience)


def n_step_learner(table: Table, policy: PolicyLike, step_size: StepCode, rule: str, n: int) -> Learner:
    """What `n_step` runs.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> n_step_learner(table_from([[0.0]]), "greedy", step_code(1.0, 1), "sarsa", 3).on_policy
        True
    """
    acting = acting_code(policy)
    check_choice("rule", rule, BOOTSTRAPS)
    check_whole("n", n)
    check_expectation(rule, acting)
    window = new_window(int(n))
    arguments = (step_size, window, BOOTSTRAPS.index(rule))
    return Learner(run_n_step, table, acting, arguments, rule == BOOTSTRAPS[SARSA], connections=(window.counters,))
