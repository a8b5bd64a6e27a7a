"""The oracle: exact solutions of finite models and of expected linear TD, sharing no code with any learner."""

from neuralq.exact.average import AverageEvaluation, AverageSolution, evaluate_average, solve_average
from neuralq.exact.evaluation import action_values, evaluate, policy_process
from neuralq.exact.histories import HistorySolution, solve_histories
from neuralq.exact.horizon import HorizonSolution, solve_finite_horizon
from neuralq.exact.memoryless import MemorylessSolution, best_memoryless, evaluate_memoryless
from neuralq.exact.operators import Prediction, predict_expected_td, rmsve, td_operator
from neuralq.exact.planning import METHODS, Solution, count_optimal_policies, optimal_policies, solve
from neuralq.exact.resolvent import resolvent

__all__ = [
    "METHODS",
    "AverageEvaluation",
    "AverageSolution",
    "HistorySolution",
    "HorizonSolution",
    "MemorylessSolution",
    "Prediction",
    "Solution",
    "action_values",
    "best_memoryless",
    "count_optimal_policies",
    "evaluate",
    "evaluate_average",
    "evaluate_memoryless",
    "optimal_policies",
    "policy_process",
    "predict_expected_td",
    "resolvent",
    "rmsve",
    "solve",
    "solve_average",
    "solve_finite_horizon",
    "solve_histories",
    "td_operator",
]
