"""Learning with a learned model: Dyna-Q, Dyna-Q+, prioritized sweeping and queue-Dyna (Mitchell 1997, 13.3.6)."""

from __future__ import annotations

import math

from neuralq.checks import check_whole
from neuralq.tabular.engine import RunOptions, Source, learn, new_table
from neuralq.tabular.kernels import dyna, sweeping
from neuralq.tabular.kernels.acting import Table
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.kernels.sweeping import FULL, SAMPLE, Memory, new_memory
from neuralq.tabular.learner import Learner
from neuralq.tabular.model import Model
from neuralq.tabular.policies import PolicyLike, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Learned

__all__ = ["dyna_learner", "dyna_q", "prioritized_sweeping", "queue_dyna", "sweeping_learner"]


def dyna_q(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    num_planning: int = 5,
    kappa: float = 0.0,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = 0.1,
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Dyna-Q learns from each real step and from ``num_planning`` imagined ones; with ``kappa`` > 0 it is Dyna-Q+.

    Args:
        num_planning: imagined updates after each real one, from the last outcome of a pair.
        kappa: κ of the bonus κ √τ in imagined rewards, τ steps after the pair was last taken. Above 0, actions never
            taken are planned with too.
        step_size: α by updates of the pair, real or imagined.

    Raises:
        ValueError: an argument out of range.

    Source: Sutton 1990; Sutton 1991.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> learned = dyna_q(mdp, 2, gamma=0.5, num_planning=20, step_size=1.0)
        >>> learned.q.tolist(), learned.num_backups
        ([[4.0], [8.0]], 42)
    """
    table, ready = new_table(source, options)
    alpha = step_code(step_size, num_steps * (num_planning + 1))
    learner = dyna_learner(table, policy, alpha, num_planning, kappa)
    return learn(learner, ready, num_steps, gamma, seed, options)


def prioritized_sweeping(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    num_planning: int = 5,
    threshold: float = 1e-4,
    bored_after: int = 0,
    optimistic_reward: float = 0.0,
    max_outcomes: int = 16,
    policy: PolicyLike = "epsilon-greedy",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Prioritized sweeping backs up the pairs of a counted model whose values are most wrong, first.

    Args:
        gamma: γ in [0, 1]; below 1 if ``bored_after`` is above 0.
        num_planning: backups after each real step.
        threshold: Bellman errors up to this are left alone.
        bored_after: a pair tried fewer times is worth ``optimistic_reward / (1 − γ)``: the paper's optimism.
        optimistic_reward: r_opt, as large as the best reward of a step.
        max_outcomes: room for different outcomes of a pair, where the source does not tell.
        options: what to start from and what to record. With optimism values start at its value.

    Raises:
        ValueError: an argument out of range, or more different outcomes than there is room for.

    Source: Moore & Atkeson 1993.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> learned = prioritized_sweeping(mdp, 2, gamma=0.5)
        >>> learned.q.tolist(), learned.num_backups
        ([[4.0], [8.0]], 2)
    """
    if bored_after and gamma >= 1:
        raise ValueError("optimism is worth r / (1 − γ), which needs gamma below 1; set bored_after=0")
    table, ready = new_table(source, options)
    optimistic = optimistic_reward / (1 - gamma) if bored_after else 0.0
    if bored_after:
        table.q[table.q > -math.inf] = optimistic
    room = ready.max_outcomes if isinstance(ready, Model) else max_outcomes
    memory = new_memory(table.q.shape, room)
    planning = (num_planning, threshold, bored_after, optimistic)
    learner = sweeping_learner(table, policy, step_code(1.0, 1), memory, FULL, *planning)
    return learn(learner, ready, num_steps, gamma, seed, options)


def queue_dyna(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    num_planning: int = 5,
    threshold: float = 1e-4,
    max_outcomes: int = 16,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = 1.0,
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Queue-Dyna imagines the last outcome of the pairs whose prediction differs most from it.

    Args:
        num_planning: updates after each real step.
        threshold: prediction differences up to this are left alone.
        max_outcomes: room for different outcomes of a pair, where the source does not tell.

    Raises:
        ValueError: an argument out of range, or more different outcomes than there is room for.

    Source: Peng & Williams 1993.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> queue_dyna(mdp, 2, gamma=0.5).q.tolist()
        [[4.0], [8.0]]
    """
    table, ready = new_table(source, options)
    room = ready.max_outcomes if isinstance(ready, Model) else max_outcomes
    alpha = step_code(step_size, num_steps * max(1, num_planning))
    learner = sweeping_learner(table, policy, alpha, new_memory(table.q.shape, room), SAMPLE, num_planning, threshold)
    return learn(learner, ready, num_steps, gamma, seed, options)


def dyna_learner(table: Table, policy: PolicyLike, step_size: StepCode, num_planning: int, kappa: float) -> Learner:
    """What `dyna_q` runs.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> table, _ = new_table(FiniteMDP.garnet(3, 2, 2, seed=0), RunOptions())
        >>> dyna_learner(table, "greedy", step_code(1.0, 1), 5, 0.0).on_policy
        False
    """
    acting = acting_code(policy)
    check_whole("num_planning", num_planning, 0)
    if not (math.isfinite(kappa) and kappa >= 0):
        raise ValueError(f"kappa must be a finite number of at least 0, got {kappa}")
    recall = dyna.new_recall(*table.q.shape)
    arguments = (step_size, recall, int(num_planning), float(kappa), kappa > 0)
    return Learner(dyna.run_dyna, table, acting, arguments, backups=recall.counters[dyna.BACKUPS :])


def sweeping_learner(
    table: Table,
    policy: PolicyLike,
    step_size: StepCode,
    memory: Memory,
    kind: int,
    num_planning: int,
    threshold: float,
    bored: int = 0,
    optimistic: float = 0.0,
) -> Learner:
    """What `prioritized_sweeping` (``kind`` FULL) and `queue_dyna` (SAMPLE) run; raises if ``memory`` is too small.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> table, _ = new_table(FiniteMDP.garnet(3, 2, 2, seed=0), RunOptions())
        >>> sweeping_learner(table, "greedy", step_code(1.0, 1), new_memory((3, 2), 2), FULL, 5, 0.1).on_policy
        False
    """
    acting = acting_code(policy)
    check_whole("num_planning", num_planning, 0)
    check_whole("bored_after", bored, 0)
    if not (math.isfinite(threshold) and threshold >= 0):
        raise ValueError(f"threshold must be a finite number of at least 0, got {threshold}")

    def check() -> None:
        if memory.counters[sweeping.OVERFLOW]:
            room = memory.times.shape[1]
            raise ValueError(f"a pair had more than max_outcomes={room} different outcomes; raise max_outcomes")

    arguments = (step_size, memory, kind, int(num_planning), float(threshold), int(bored), float(optimistic))
    backups = memory.counters[sweeping.BACKUPS : sweeping.BACKUPS + 1]
    return Learner(sweeping.run_sweeping, table, acting, arguments, backups=backups, check=check)
