"""The divergence lab: what the mathematics predicts of a method on a problem, then what training does.

    diagnose(problem, method)       verdict, growth, step-size bounds, fixed point, an explanation
    critical(problem, parameter)    where stability begins or ends; `scan` gives every boundary
    prescribe(problem)              what to change so that it converges, best first
    run(problem, method)            the errors of a run over many seeds
    matrix(problems, methods)       all of them, predicted and measured side by side

Whatever needs PyTorch (networks, the star's five representations, the monitor of a run) is loaded at its first use.
"""

from __future__ import annotations

# Functions that bear the name of their module must be bound here, at once: the import of a module binds its name in the
# package to the module, and only what is bound afterwards stays.
from neuralq.lab.critical import CRITICAL_PARAMETERS, NoBoundary, StabilityScan, critical, scan
from neuralq.lab.diagnose import Diagnosis, diagnose
from neuralq.lab.matrix import Cell, Matrix, matrix
from neuralq.lab.methods import METHODS, Method, method
from neuralq.lab.prescribe import Remedy, prescribe
from neuralq.lab.problems import PROBLEMS, Problem, problem
from neuralq.lab.run import Run, run

TYPE_CHECKING = False  # known to type checkers
if TYPE_CHECKING:
    from neuralq.lab.baird import BairdPrediction as BairdPrediction
    from neuralq.lab.baird import BairdResult as BairdResult
    from neuralq.lab.baird import predict_baird as predict_baird
    from neuralq.lab.baird import run_baird as run_baird
    from neuralq.lab.expected import ExpectedBackup as ExpectedBackup
    from neuralq.lab.expected import expected_backup as expected_backup
    from neuralq.lab.expected import expected_td_step as expected_td_step
    from neuralq.lab.expected import local_growth as local_growth
    from neuralq.lab.monitor import DivergenceMonitor as DivergenceMonitor

__all__ = [
    "CRITICAL_PARAMETERS",
    "METHODS",
    "PROBLEMS",
    "BairdPrediction",
    "BairdResult",
    "Cell",
    "Diagnosis",
    "DivergenceMonitor",
    "ExpectedBackup",
    "Matrix",
    "Method",
    "NoBoundary",
    "Problem",
    "Remedy",
    "Run",
    "StabilityScan",
    "critical",
    "diagnose",
    "expected_backup",
    "expected_td_step",
    "local_growth",
    "matrix",
    "method",
    "predict_baird",
    "prescribe",
    "problem",
    "run",
    "run_baird",
    "scan",
]

# Where the names live that need PyTorch; none of them is the name of a module here.
_HOMES = {
    "BairdPrediction": "neuralq.lab.baird",
    "BairdResult": "neuralq.lab.baird",
    "DivergenceMonitor": "neuralq.lab.monitor",
    "ExpectedBackup": "neuralq.lab.expected",
    "expected_backup": "neuralq.lab.expected",
    "expected_td_step": "neuralq.lab.expected",
    "local_growth": "neuralq.lab.expected",
    "predict_baird": "neuralq.lab.baird",
    "run_baird": "neuralq.lab.baird",
}

if not TYPE_CHECKING:  # a type checker would believe that every name exists

    def __getattr__(name: str) -> object:
        """Loads a name that needs PyTorch at its first use.

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
