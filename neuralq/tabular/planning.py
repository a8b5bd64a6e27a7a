"""Learning with a learned model: Dyna-Q, Dyna-Q+, prioritized sweeping and queue-Dyna (Mitchell 1997, 13.3.6)."""

from __future__ import annotations

import math
from typing import Any

from neuralq.checks import check_whole
from neuralq.tabular.engine import RunOptions, Source, learn, new_table
from neuralq.tabular.kernels.acting import Log, Table, Walk
from neuralq.tabular.kernels.dyna import BACKUPS as DYNA_BACKUPS
from neuralq.tabular.kernels.dyna import new_recall, run_dyna
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.kernels.sweeping import BACKUPS, FULL, OVERFLOW, SAMPLE, new_memory, run_sweeping
from neuralq.tabular.model import Model, ModelArrays
from neuralq.tabular.policies import ActingCode, PolicyLike, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Learned

__all__ = ["DynaLearner", "SweepingLearner", "dyna_q", "prioritized_sweeping", "queue_dyna"]


class DynaLearner:
    """The learner that `neuralq.tabular.kernels.dyna.run_dyna` runs.

    Args:
        table: values and visits, changed in place.
        policy: how to act.
        step_size: α by updates of the pair, real or imagined.
        num_planning: imagined updates after each real one.
        kappa: κ of the bonus κ √τ.
        untried: whether actions never taken are planned with.
    """

    def __init__(
        self, table: Table, policy: ActingCode, step_size: StepCode, num_planning: int, kappa: float, untried: bool
    ) -> None:
        check_whole("num_planning", num_planning, 0)
        if not (math.isfinite(kappa) and kappa >= 0):
            raise ValueError(f"kappa must be a finite number of at least 0, got {kappa}")
        self.table = table
        self.policy = policy
        self.on_policy = False
        self._recall = new_recall(*table.q.shape)
        self._step_size = step_size
        self._rest = (num_planning, float(kappa), untried)

    @property
    def num_backups(self) -> int:
        """Updates so far, real and imagined."""
        return int(self._recall.counters[DYNA_BACKUPS])

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` real transitions from the model, or from the log if it replays."""
        run_dyna(
            model, self.policy, self.table, walk, log, self._step_size, self._recall, *self._rest, gamma, num_steps
        )


class SweepingLearner:
    """The learner that `neuralq.tabular.kernels.sweeping.run_sweeping` runs.

    Args:
        table: values and visits, changed in place.
        policy: how to act.
        step_size: α by backups of the pair.
        kind: FULL or SAMPLE.
        max_outcomes: outcomes that a pair can have.
        num_planning: backups after each real step.
        threshold: Bellman errors up to this are left alone.
        bored: pairs tried fewer times are worth ``optimistic``.
        optimistic: that value.

    Raises:
        ValueError: an argument out of range.
    """

    def __init__(
        self,
        table: Table,
        policy: ActingCode,
        step_size: StepCode,
        kind: int,
        max_outcomes: int,
        num_planning: int,
        threshold: float,
        bored: int = 0,
        optimistic: float = 0.0,
    ) -> None:
        check_whole("num_planning", num_planning, 0)
        check_whole("max_outcomes", max_outcomes)
        check_whole("bored_after", bored, 0)
        if not (math.isfinite(threshold) and threshold >= 0):
            raise ValueError(f"threshold must be a finite number of at least 0, got {threshold}")
        self.table = table
        self.policy = policy
        self.on_policy = False
        self._memory = new_memory(len(table.q), table.q.size, max_outcomes)
        self._step_size = step_size
        self._rest = (kind, num_planning, float(threshold), bored, float(optimistic))

    @property
    def num_backups(self) -> int:
        """Backups so far."""
        return int(self._memory.counters[BACKUPS])

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` real transitions from the model, or from the log if it replays.

        Raises:
            ValueError: a pair had more different outcomes than there is room for.
        """
        run_sweeping(
            model, self.policy, self.table, walk, log, self._step_size, self._memory, *self._rest, gamma, num_steps
        )
        if self._memory.counters[OVERFLOW]:
            room = self._memory.times.shape[1]
            raise ValueError(f"a pair had more than max_outcomes={room} different outcomes; raise max_outcomes")


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
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces.
        num_steps: real transitions.
        gamma: γ in [0, 1].
        num_planning: imagined updates after each real one, from the last outcome of a pair.
        kappa: κ of the bonus κ √τ in imagined rewards, τ steps after the pair was last taken. Above 0, actions never
            taken are planned with too.
        policy: how to act.
        step_size: α by updates of the pair, real or imagined.
        seed: of the random stream.
        options: what to start from and what to record.

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
    learner = DynaLearner(table, acting_code(policy), alpha, num_planning, kappa, kappa > 0)
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
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces.
        num_steps: real transitions.
        gamma: γ in [0, 1]; below 1 if ``bored_after`` is above 0.
        num_planning: backups after each real step.
        threshold: Bellman errors up to this are left alone.
        bored_after: a pair tried fewer times is worth ``optimistic_reward / (1 − γ)``: the paper's optimism.
        optimistic_reward: r_opt, as large as the best reward of a step.
        max_outcomes: room for different outcomes of a pair, where the source does not tell.
        policy: how to act.
        seed: of the random stream.
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
    learner = SweepingLearner(
        table, acting_code(policy), step_code(1.0, 1), FULL, room, num_planning, threshold, bored_after, optimistic
    )
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
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces.
        num_steps: real transitions.
        gamma: γ in [0, 1].
        num_planning: updates after each real step.
        threshold: prediction differences up to this are left alone.
        max_outcomes: room for different outcomes of a pair, where the source does not tell.
        policy: how to act.
        step_size: α by updates of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

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
    learner = SweepingLearner(table, acting_code(policy), alpha, SAMPLE, room, num_planning, threshold)
    return learn(learner, ready, num_steps, gamma, seed, options)
