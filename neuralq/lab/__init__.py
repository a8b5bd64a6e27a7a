"""The divergence lab: what the mathematics predicts of a method on a problem, then what training does.

    diagnose(problem, method)       verdict, growth, step-size bounds, fixed point, an explanation
    critical(problem, parameter)    where stability begins or ends; `scan` gives every boundary
    prescribe(problem)              what to change so that it converges, best first
    run(problem, method)            the errors of a run over many seeds
    matrix(problems, methods)       all of them, predicted and measured side by side
    diagnose_fitted(world, support, regressor)    fitted value iteration on continuous states, and why it fails
    run_representations(problem)    one update, learned by a table, linear features and networks

Each name is loaded when it is first used: what watches a run must not load the rest, nor problems without networks
PyTorch.
"""

from __future__ import annotations

TYPE_CHECKING = False  # known to type checkers
if TYPE_CHECKING:
    from neuralq.lab.comparison import Cell, Matrix, matrix
    from neuralq.lab.fitted.diagnosis import FittedDiagnosis, diagnose_fitted
    from neuralq.lab.fitted.grow_support import GrownSupport, grow_support
    from neuralq.lab.fitted.iteration import FittedRun, fitted_iteration
    from neuralq.lab.fitted.network import NetworkRegressor
    from neuralq.lab.fitted.regressors import (
        GridInterpolation,
        KernelSmoothing,
        LeastSquares,
        LocallyWeighted,
        NearestNeighbours,
        Regressor,
        StateAggregation,
        linear_features,
        quadratic_features,
    )
    from neuralq.lab.methods import METHODS, Method, Option, method
    from neuralq.lab.networks.expected import ExpectedBackup, expected_backup, expected_td_step, local_growth
    from neuralq.lab.networks.representations import (
        RepresentationPrediction,
        RepresentationResult,
        predict_representations,
        run_representations,
    )
    from neuralq.lab.problems import PROBLEMS, Problem, problem
    from neuralq.lab.trial import Trial, run
    from neuralq.lab.verdicts.critical import CRITICAL_PARAMETERS, NoBoundary, StabilityScan, critical, scan
    from neuralq.lab.verdicts.diagnosis import Diagnosis, diagnose
    from neuralq.lab.verdicts.remedies import Remedy, prescribe
    from neuralq.lab.watch.monitor import DivergenceMonitor
    from neuralq_envs.counterexamples.boyan_moore import car_on_the_hill, gridworld, puddle_world
    from neuralq_envs.counterexamples.continuous import ContinuousModel, grid_support, random_support

__all__ = [
    "CRITICAL_PARAMETERS",
    "METHODS",
    "PROBLEMS",
    "Cell",
    "ContinuousModel",
    "Diagnosis",
    "DivergenceMonitor",
    "ExpectedBackup",
    "FittedDiagnosis",
    "FittedRun",
    "GridInterpolation",
    "GrownSupport",
    "KernelSmoothing",
    "LeastSquares",
    "LocallyWeighted",
    "Matrix",
    "Method",
    "NearestNeighbours",
    "NetworkRegressor",
    "NoBoundary",
    "Option",
    "Problem",
    "Regressor",
    "Remedy",
    "RepresentationPrediction",
    "RepresentationResult",
    "StabilityScan",
    "StateAggregation",
    "Trial",
    "car_on_the_hill",
    "critical",
    "diagnose",
    "diagnose_fitted",
    "expected_backup",
    "expected_td_step",
    "fitted_iteration",
    "grid_support",
    "gridworld",
    "grow_support",
    "linear_features",
    "local_growth",
    "matrix",
    "method",
    "predict_representations",
    "prescribe",
    "problem",
    "puddle_world",
    "quadratic_features",
    "random_support",
    "run",
    "run_representations",
    "scan",
]

_HOMES = {
    **dict.fromkeys(("Cell", "Matrix", "matrix"), "neuralq.lab.comparison"),
    **dict.fromkeys(("FittedDiagnosis", "diagnose_fitted"), "neuralq.lab.fitted.diagnosis"),
    **dict.fromkeys(("GrownSupport", "grow_support"), "neuralq.lab.fitted.grow_support"),
    **dict.fromkeys(("FittedRun", "fitted_iteration"), "neuralq.lab.fitted.iteration"),
    **dict.fromkeys(
        (
            "GridInterpolation",
            "KernelSmoothing",
            "LeastSquares",
            "LocallyWeighted",
            "NearestNeighbours",
            "Regressor",
            "StateAggregation",
            "linear_features",
            "quadratic_features",
        ),
        "neuralq.lab.fitted.regressors",
    ),
    **dict.fromkeys(("METHODS", "Method", "Option", "method"), "neuralq.lab.methods"),
    **dict.fromkeys(("PROBLEMS", "Problem", "problem"), "neuralq.lab.problems"),
    **dict.fromkeys(("Trial", "run"), "neuralq.lab.trial"),
    **dict.fromkeys(
        ("CRITICAL_PARAMETERS", "NoBoundary", "StabilityScan", "critical", "scan"), "neuralq.lab.verdicts.critical"
    ),
    **dict.fromkeys(("Diagnosis", "diagnose"), "neuralq.lab.verdicts.diagnosis"),
    **dict.fromkeys(("Remedy", "prescribe"), "neuralq.lab.verdicts.remedies"),
    **dict.fromkeys(("car_on_the_hill", "gridworld", "puddle_world"), "neuralq_envs.counterexamples.boyan_moore"),
    **dict.fromkeys(("ContinuousModel", "grid_support", "random_support"), "neuralq_envs.counterexamples.continuous"),
    **dict.fromkeys(("NetworkRegressor",), "neuralq.lab.fitted.network"),
    **dict.fromkeys(
        ("ExpectedBackup", "expected_backup", "expected_td_step", "local_growth"), "neuralq.lab.networks.expected"
    ),
    **dict.fromkeys(
        ("RepresentationPrediction", "RepresentationResult", "predict_representations", "run_representations"),
        "neuralq.lab.networks.representations",
    ),
    **dict.fromkeys(("DivergenceMonitor",), "neuralq.lab.watch.monitor"),
}

if not TYPE_CHECKING:  # a type checker would believe that every name exists

    def __getattr__(name: str) -> object:
        """Loads a name at its first use.

        Raises:
            AttributeError: there is no such name.
        """
        from importlib import import_module

        if name not in _HOMES:
            raise AttributeError(f"module 'neuralq.lab' has no attribute {name!r}; it has {', '.join(__all__)}")
        value: object = getattr(import_module(_HOMES[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted(__all__)
