"""The divergence lab: what the mathematics predicts of a method on a problem, then what training does.

    diagnose(problem, method)       verdict, growth, step-size bounds, fixed point, an explanation
    critical(problem, parameter)    where stability begins or ends; `scan` gives every boundary
    prescribe(problem)              what to change so that it converges, best first
    run(problem, method)            the errors of a run over many seeds
    matrix(problems, methods)       all of them, predicted and measured side by side
    diagnose_fitted(world, support, regressor)    fitted value iteration on continuous states, and why it fails

Whatever needs PyTorch (networks, the star's five representations, the monitor of a run) is loaded at its first use, and
so is fitted value iteration.
"""

from __future__ import annotations

from neuralq.lab.comparison import Cell, Matrix, matrix
from neuralq.lab.fitted.grow_support import GrownSupport, grow_support
from neuralq.lab.methods import METHODS, Method, method
from neuralq.lab.problems import PROBLEMS, Problem, problem
from neuralq.lab.trial import Run, run

# Functions that bear the name of their module must be bound here, at once: the import of a module binds its name in the
# package to the module, and only what is bound afterwards stays.
from neuralq.lab.verdicts.critical import CRITICAL_PARAMETERS, NoBoundary, StabilityScan, critical, scan
from neuralq.lab.verdicts.diagnosis import Diagnosis, diagnose
from neuralq.lab.verdicts.remedies import Remedy, prescribe

TYPE_CHECKING = False  # known to type checkers
if TYPE_CHECKING:
    from neuralq.lab.fitted.diagnosis import FittedDiagnosis as FittedDiagnosis
    from neuralq.lab.fitted.diagnosis import diagnose_fitted as diagnose_fitted
    from neuralq.lab.fitted.iteration import FittedRun as FittedRun
    from neuralq.lab.fitted.iteration import fitted_iteration as fitted_iteration
    from neuralq.lab.fitted.network import NetworkRegressor as NetworkRegressor
    from neuralq.lab.fitted.regressors import GridInterpolation as GridInterpolation
    from neuralq.lab.fitted.regressors import KernelSmoothing as KernelSmoothing
    from neuralq.lab.fitted.regressors import LeastSquares as LeastSquares
    from neuralq.lab.fitted.regressors import LocallyWeighted as LocallyWeighted
    from neuralq.lab.fitted.regressors import NearestNeighbours as NearestNeighbours
    from neuralq.lab.fitted.regressors import Regressor as Regressor
    from neuralq.lab.fitted.regressors import StateAggregation as StateAggregation
    from neuralq.lab.fitted.regressors import linear_features as linear_features
    from neuralq.lab.fitted.regressors import quadratic_features as quadratic_features
    from neuralq.lab.networks.baird import BairdPrediction as BairdPrediction
    from neuralq.lab.networks.baird import BairdResult as BairdResult
    from neuralq.lab.networks.baird import predict_baird as predict_baird
    from neuralq.lab.networks.baird import run_baird as run_baird
    from neuralq.lab.networks.expected import ExpectedBackup as ExpectedBackup
    from neuralq.lab.networks.expected import expected_backup as expected_backup
    from neuralq.lab.networks.expected import expected_td_step as expected_td_step
    from neuralq.lab.networks.expected import local_growth as local_growth
    from neuralq.lab.watch.monitor import DivergenceMonitor as DivergenceMonitor
    from neuralq_envs.counterexamples.boyan_moore import car_on_the_hill as car_on_the_hill
    from neuralq_envs.counterexamples.boyan_moore import gridworld as gridworld
    from neuralq_envs.counterexamples.boyan_moore import puddle_world as puddle_world
    from neuralq_envs.counterexamples.continuous import ContinuousModel as ContinuousModel
    from neuralq_envs.counterexamples.continuous import grid_support as grid_support
    from neuralq_envs.counterexamples.continuous import random_support as random_support

__all__ = [
    "CRITICAL_PARAMETERS",
    "METHODS",
    "PROBLEMS",
    "BairdPrediction",
    "BairdResult",
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
    "Problem",
    "Regressor",
    "Remedy",
    "Run",
    "StabilityScan",
    "StateAggregation",
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
    "predict_baird",
    "prescribe",
    "problem",
    "puddle_world",
    "quadratic_features",
    "random_support",
    "run",
    "run_baird",
    "scan",
]

# Where the names live that need PyTorch, or that few need; none of them is the name of a module here.
_HOMES = {
    "BairdPrediction": "neuralq.lab.networks.baird",
    "BairdResult": "neuralq.lab.networks.baird",
    "ContinuousModel": "neuralq_envs.counterexamples.continuous",
    "DivergenceMonitor": "neuralq.lab.watch.monitor",
    "ExpectedBackup": "neuralq.lab.networks.expected",
    "FittedDiagnosis": "neuralq.lab.fitted.diagnosis",
    "FittedRun": "neuralq.lab.fitted.iteration",
    "GridInterpolation": "neuralq.lab.fitted.regressors",
    "KernelSmoothing": "neuralq.lab.fitted.regressors",
    "LeastSquares": "neuralq.lab.fitted.regressors",
    "LocallyWeighted": "neuralq.lab.fitted.regressors",
    "NearestNeighbours": "neuralq.lab.fitted.regressors",
    "NetworkRegressor": "neuralq.lab.fitted.network",
    "Regressor": "neuralq.lab.fitted.regressors",
    "StateAggregation": "neuralq.lab.fitted.regressors",
    "car_on_the_hill": "neuralq_envs.counterexamples.boyan_moore",
    "diagnose_fitted": "neuralq.lab.fitted.diagnosis",
    "expected_backup": "neuralq.lab.networks.expected",
    "expected_td_step": "neuralq.lab.networks.expected",
    "fitted_iteration": "neuralq.lab.fitted.iteration",
    "grid_support": "neuralq_envs.counterexamples.continuous",
    "gridworld": "neuralq_envs.counterexamples.boyan_moore",
    "linear_features": "neuralq.lab.fitted.regressors",
    "local_growth": "neuralq.lab.networks.expected",
    "predict_baird": "neuralq.lab.networks.baird",
    "puddle_world": "neuralq_envs.counterexamples.boyan_moore",
    "quadratic_features": "neuralq.lab.fitted.regressors",
    "random_support": "neuralq_envs.counterexamples.continuous",
    "run_baird": "neuralq.lab.networks.baird",
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
