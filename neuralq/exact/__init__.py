"""The oracle: exact solutions of finite models and of expected linear TD, sharing no code with any learner."""

from neuralq.exact.evaluation import action_values, evaluate, policy_process
from neuralq.exact.operators import Prediction, predict_expected_td, rmsve, td_operator
from neuralq.exact.planning import Solution, solve

__all__ = [
    "Prediction",
    "Solution",
    "action_values",
    "evaluate",
    "policy_process",
    "predict_expected_td",
    "rmsve",
    "solve",
    "td_operator",
]
