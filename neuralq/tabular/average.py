"""R-learning: the most reward per step, without a discount; `neuralq.tabular.kernels.r_learning` has the formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuralq.checks import check_fraction
from neuralq.tabular.engine import RunOptions, Source, learn, new_table
from neuralq.tabular.kernels.acting import Table
from neuralq.tabular.kernels.r_learning import run_r_learning
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.learner import Learner
from neuralq.tabular.model import Model
from neuralq.tabular.policies import PolicyLike, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Learned

__all__ = ["r_learner", "r_learning"]


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
        beta: step size of the gain ρ, in [0, 1].

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
    learner = r_learner(table, policy, step_code(step_size, num_steps), beta)
    learned = learn(learner, ready, num_steps, 1.0, seed, options)
    return replace(learned, average_reward=float(learner.arguments[1][0]))


def r_learner(table: Table, policy: PolicyLike, step_size: StepCode, beta: float) -> Learner:
    """What `r_learning` runs; the gain ρ is the first entry of its second argument.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> from neuralq.tabular.engine import table_from
        >>> r_learner(table_from([[0.0]]), "greedy", step_code(0.1, 1), 0.01).arguments[1].tolist()
        [0.0, 0.0]
    """
    check_fraction("beta", beta)
    gain = np.zeros(2)

    def check() -> None:
        if gain[1]:
            raise ValueError("R-learning is for worlds that go on for ever, but an episode of this one ended")

    return Learner(run_r_learning, table, acting_code(policy), (step_size, gain, float(beta)), check=check)
