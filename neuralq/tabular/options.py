"""Options (skills): a policy that runs until its end condition, as one decision that lasts.

What a decision earned and how long it took is all that SMDP Q-learning asks for (`smdp_q_update`, with the rate
−log γ): an option is learned about as an action is.

Source: Sutton, Precup & Singh 1999, "Between MDPs and semi-MDPs", Artificial Intelligence 112; Lin 1993, for skills.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium

from neuralq.checks import check_discount, check_whole

__all__ = ["OptionOutcome", "run_option"]


class OptionOutcome(NamedTuple):
    """What came of running an option.

    Args:
        r_t: Σ γⁱ r over its steps.
        duration: how many steps it took, at least 1.
        s_t: the observation in which it ended.
        terminated: whether the world did.
        truncated: whether the environment broke the episode off.
    """

    r_t: float
    duration: int
    s_t: Any
    terminated: bool
    truncated: bool


def run_option(
    env: gymnasium.Env[Any, Any],
    s: Any,
    act: Callable[[Any], Any],
    ends: Callable[[Any], bool],
    *,
    gamma: float = 1.0,
    most_steps: int | None = None,
) -> OptionOutcome:
    """Acts until the option ends, the episode does, or so many steps are taken; at least once.

    Args:
        env: has been reset, and is in ``s``.
        s: the observation that the option begins in.
        act: its policy: the action for an observation.
        ends: its end condition, asked of every observation that it comes to.
        gamma: γ per step.
        most_steps: after which it ends in any case; None for never.

    Raises:
        ValueError: γ or the number of steps out of range.

    Example:
        East until a landmark, which costs .05 a step; then the value of where it ended, through SMDP Q-learning.

        >>> import neuralq_envs, numpy as np
        >>> env = gymnasium.make("neuralq/Landmarks-v0", tasks=("AC",))
        >>> s, _ = env.reset(options={"state": 8})
        >>> east = run_option(env, s, lambda s: 1, lambda s: s % 64 in (9, 46, 49))
        >>> east.duration, int(east.s_t) - 64, round(east.r_t, 9)  # A, from where the second stage begins
        (1, 9, -0.05)
    """
    check_discount("gamma", gamma)
    if most_steps is not None:
        check_whole("most_steps", most_steps)
    earned, weight, duration = 0.0, 1.0, 0
    while True:
        s, reward, terminated, truncated, _ = env.step(act(s))
        earned += weight * float(reward)
        weight *= gamma
        duration += 1
        if terminated or truncated or ends(s) or duration == most_steps:
            return OptionOutcome(earned, duration, s, bool(terminated), bool(truncated))
