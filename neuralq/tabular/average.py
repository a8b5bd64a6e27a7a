"""R-learning: relative values and the average reward per step, without a discount (Schwartz 1993; Mahadevan 1996).

    R(s, a) ← R(s, a) + α [r − ρ + max_a' R(s', a') − R(s, a)]
    ρ ← ρ + β [r + max_a' R(s', a') − max_a R(s, a) − ρ]      where the action taken was a best one

ρ estimates the gain, reward per step in the long run, and R the bias of each pair up to a constant. The world must go
on for ever: an end has no successor whose relative value could be compared.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_fraction
from neuralq.jit import lean_kernel
from neuralq.tabular.engine import RunOptions, Source, learn, new_table
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, next_step, step_length
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.model import Model, ModelArrays
from neuralq.tabular.policies import ActingCode, PolicyLike, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Learned

__all__ = ["r_learning", "run_r_learning"]

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


@lean_kernel
def run_r_learning(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    gain: NDArray[np.float64],
    beta: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its update.

    Args:
        model: where transitions come from, unless ``log`` replays.
        policy: how to act.
        table: relative values and visits, changed in place.
        walk: where the agent is, changed in place.
        log: what to record, or to replay.
        step_size: α by visits of the pair.
        gain: ρ, and whether the world ended, ``[2]``, changed in place.
        beta: step size of ρ.
        num_steps: how many.
    """
    q, visits = table.q, table.visits
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, _a_t, _last = next_step(model, policy, table, walk, log, i, 1.0, False)
        if discount_t == 0.0:
            gain[_ONE] = 1.0
        visits[s, a] += 1
        alpha = step_length(step_size, visits[s, a])
        before, after = best_value(q, s), best_value(q, s_t)
        greedy = q[s, a] == before
        rho = gain[_ZERO]
        if greedy:
            gain[_ZERO] = rho + beta * (r_t + after - before - rho)
        q[s, a] += alpha * (r_t - rho + after - q[s, a])


class GainLearner:
    """The learner that `run_r_learning` runs.

    Args:
        table: relative values and visits, changed in place.
        policy: how to act.
        step_size: α by visits of the pair.
        beta: step size of ρ.
    """

    def __init__(self, table: Table, policy: ActingCode, step_size: StepCode, beta: float) -> None:
        check_fraction("beta", beta)
        self.table = table
        self.policy = policy
        self.on_policy = False
        self._step_size, self._beta, self._gain = step_size, float(beta), np.zeros(2)

    @property
    def average_reward(self) -> float:
        """ρ."""
        return float(self._gain[0])

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` transitions from the model, or from the log if it replays; γ has no meaning here.

        Raises:
            ValueError: the world ended.
        """
        run_r_learning(model, self.policy, self.table, walk, log, self._step_size, self._gain, self._beta, num_steps)
        if self._gain[1]:
            raise ValueError("R-learning is for worlds that go on for ever, but an episode of this one ended")


def r_learning(
    source: Source,
    num_steps: int,
    *,
    beta: float = 0.01,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = 0.1,
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """R-learning maximises the reward per step; read the gain from ``.average_reward``.

    Args:
        source: a model or environment that never terminates.
        num_steps: transitions.
        beta: step size of the gain ρ, in [0, 1].
        policy: how to act.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range, or a model whose episodes end.

    Source: Schwartz 1993; Mahadevan 1996.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[1.0, 2.0]])  # earn 1 or 2 for ever
        >>> round(r_learning(mdp, 2000).average_reward, 6)
        2.0
    """
    table, ready = new_table(source, options)
    if isinstance(ready, Model) and ready.arrays.ends.any():
        raise ValueError("R-learning is for worlds that go on for ever, but episodes of this model end; use q_learning")
    learner = GainLearner(table, acting_code(policy), step_code(step_size, num_steps), beta)
    return learn(learner, ready, num_steps, 1.0, seed, options)
