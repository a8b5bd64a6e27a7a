"""The rules of value learning as pure functions of tensors: no modules, no environments, nothing detached, no state.

Subscripts: ``_tm1`` belongs to the state that was left, ``_t`` to the state that was reached. `discount_t` is γ, or 0
where the world terminated; `last_t` is true where the stream of experience breaks. Shapes: ``[*n]`` are any leading
axes, time first (``[T, *n]``) for returns; action values are ``[*n, A]`` with -∞ for illegal actions.
"""

from __future__ import annotations

from neuralq.rules.distributional import (
    categorical_cross_entropy,
    categorical_projection,
    followed_mass,
    followed_values,
    quantile_huber,
    quantile_levels,
)
from neuralq.rules.losses import huber, residual_gradient_error, semi_gradient_error, squared
from neuralq.rules.munchausen import munchausen, munchausen_bonus, soft_value
from neuralq.rules.policies import epsilon_greedy, greedy, greedy_random_ties, k_to_the_q, sample, softmax
from neuralq.rules.returns import (
    is_greedy,
    lambda_returns,
    n_step_returns,
    off_policy_returns,
    retrace_coefficients,
    tree_backup_coefficients,
    watkins_lambda,
)
from neuralq.rules.schedules import Constant, Exponential, Linear, Power, Schedule
from neuralq.rules.semi_markov import smdp_discount
from neuralq.rules.slopes import input_slopes, lob_star, return_slopes, squared_slopes
from neuralq.rules.target_rule import Followed, Option, Seen, TargetRule, target_rules
from neuralq.rules.targets import (
    double_q,
    expected_sarsa,
    expected_value,
    one_step,
    q_learning,
    sarsa,
    weighted_value,
)
from neuralq.rules.traces import accumulate, cut, dutch, replace, true_online_increment

__all__ = [
    "Constant",
    "Exponential",
    "Followed",
    "Linear",
    "Option",
    "Power",
    "Schedule",
    "Seen",
    "TargetRule",
    "accumulate",
    "categorical_cross_entropy",
    "categorical_projection",
    "cut",
    "double_q",
    "dutch",
    "epsilon_greedy",
    "expected_sarsa",
    "expected_value",
    "followed_mass",
    "followed_values",
    "greedy",
    "greedy_random_ties",
    "huber",
    "input_slopes",
    "is_greedy",
    "k_to_the_q",
    "lambda_returns",
    "lob_star",
    "munchausen",
    "munchausen_bonus",
    "n_step_returns",
    "off_policy_returns",
    "one_step",
    "q_learning",
    "quantile_huber",
    "quantile_levels",
    "replace",
    "residual_gradient_error",
    "retrace_coefficients",
    "return_slopes",
    "sample",
    "sarsa",
    "semi_gradient_error",
    "smdp_discount",
    "soft_value",
    "softmax",
    "squared",
    "squared_slopes",
    "target_rules",
    "tree_backup_coefficients",
    "true_online_increment",
    "watkins_lambda",
    "weighted_value",
]
