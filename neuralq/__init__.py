"""neuralq: value functions learned by any representation, beside the exact answer.

``import neuralq`` is cheap. Each name and each submodule is loaded when it is first used, so PyTorch is imported only
by what needs it, and ``neuralq --help`` answers at once.
"""

from __future__ import annotations

TYPE_CHECKING = False  # known to type checkers; importing `typing` would cost more than all the rest here
if TYPE_CHECKING:
    from neuralq import exact as exact
    from neuralq import lab as lab
    from neuralq import learners as learners
    from neuralq import q as q
    from neuralq import rules as rules
    from neuralq import runs as recipes
    from neuralq import tabular as tabular
    from neuralq.apps.filming import record as record
    from neuralq.learners.replay.buffer import ReplayBuffer as ReplayBuffer
    from neuralq.mdp import FiniteMDP as FiniteMDP
    from neuralq.q import ActionInputQ as ActionInputQ
    from neuralq.q import ActionOutputQ as ActionOutputQ
    from neuralq.q import LinearQ as LinearQ
    from neuralq.q import SeparateQ as SeparateQ
    from neuralq.q import TableQ as TableQ
    from neuralq.runs import Run as Run
    from neuralq.runs import RunConfig as RunConfig
    from neuralq.runs import evaluate as evaluate
    from neuralq.runs import export as export
    from neuralq.runs import load as load
    from neuralq.runs import report as report
    from neuralq.runs import resume as resume
    from neuralq.runs import solve as solve
    from neuralq.runs import train as train
    from neuralq.runs import with_preset as with_preset
    from neuralq.types import QFunction as QFunction
    from neuralq.types import Transition as Transition

__version__ = "0.4.0"

__all__ = [
    "ActionInputQ",
    "ActionOutputQ",
    "FiniteMDP",
    "LinearQ",
    "QFunction",
    "ReplayBuffer",
    "Run",
    "RunConfig",
    "SeparateQ",
    "TableQ",
    "Transition",
    "__version__",
    "evaluate",
    "exact",
    "export",
    "lab",
    "learners",
    "load",
    "q",
    "recipes",
    "record",
    "report",
    "resume",
    "rules",
    "solve",
    "tabular",
    "train",
    "with_preset",
]

# Where each name lives. A name here must not be the name of a module of this package: importing the module would
# rebind the name (hence neuralq/runs/loop.py and not train.py).
_HOMES = {
    "ActionInputQ": "neuralq.q",
    "ActionOutputQ": "neuralq.q",
    "FiniteMDP": "neuralq.mdp",
    "LinearQ": "neuralq.q",
    "QFunction": "neuralq.types",
    "ReplayBuffer": "neuralq.learners.replay.buffer",
    "Run": "neuralq.runs",
    "RunConfig": "neuralq.runs",
    "SeparateQ": "neuralq.q",
    "TableQ": "neuralq.q",
    "Transition": "neuralq.types",
    "evaluate": "neuralq.runs",
    "export": "neuralq.runs",
    "load": "neuralq.runs",
    "record": "neuralq.apps.filming",
    "resume": "neuralq.runs",
    "solve": "neuralq.runs",
    "train": "neuralq.runs",
    "with_preset": "neuralq.runs",
}
# Modules that are known by a shorter name than the way to their room.
_ROOMS = {"recipes": "neuralq.runs", "report": "neuralq.runs.report"}


if not TYPE_CHECKING:  # a type checker would believe that every name exists

    def __getattr__(name: str) -> object:
        """Loads a public name, or any submodule, at its first use.

        Raises:
            AttributeError: when there is neither.
        """
        from importlib import import_module

        if name in _HOMES:
            value: object = getattr(import_module(_HOMES[name]), name)
            globals()[name] = value
            return value
        if not name.startswith("_"):
            module = _ROOMS.get(name, f"{__name__}.{name}")
            try:
                return import_module(module)
            except ModuleNotFoundError as error:
                if error.name != module:  # it exists, but something that it needs does not
                    raise
        instead = None if name.startswith("_") else import_module("neuralq.apps.elsewhere").instead_of(name)
        hint = f"its public names are {', '.join(__all__)}" if instead is None else f"there is {instead}"
        raise AttributeError(f"module 'neuralq' has no attribute {name!r}; {hint}")


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted(__all__)
