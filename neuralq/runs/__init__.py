"""Runs: configurations that say everything about one, and the functions that carry them out.

Each name is loaded when it is first used, so that reading a run folder needs no PyTorch.
"""

from __future__ import annotations

TYPE_CHECKING = False  # known to type checkers
if TYPE_CHECKING:
    from neuralq.runs.api import evaluate as evaluate
    from neuralq.runs.api import load as load
    from neuralq.runs.api import resume as resume
    from neuralq.runs.api import train as train
    from neuralq.runs.control import Run as Run
    from neuralq.runs.control import evaluate_run as evaluate_run
    from neuralq.runs.exporting.export import export as export
    from neuralq.runs.recipe.config import RunConfig as RunConfig
    from neuralq.runs.recipe.presets import preset_for as preset_for
    from neuralq.runs.recipe.presets import with_preset as with_preset
    from neuralq.runs.solving import solve as solve

__all__ = [
    "Run",
    "RunConfig",
    "evaluate",
    "evaluate_run",
    "export",
    "load",
    "preset_for",
    "resume",
    "solve",
    "train",
    "with_preset",
]

_HOMES = {
    **dict.fromkeys(("evaluate", "load", "resume", "train"), "neuralq.runs.api"),
    **dict.fromkeys(("Run", "evaluate_run"), "neuralq.runs.control"),
    "export": "neuralq.runs.exporting.export",
    "RunConfig": "neuralq.runs.recipe.config",
    **dict.fromkeys(("preset_for", "with_preset"), "neuralq.runs.recipe.presets"),
    "solve": "neuralq.runs.solving",
}

if not TYPE_CHECKING:  # a type checker would believe that every name exists

    def __getattr__(name: str) -> object:
        """Loads a name at its first use.

        Raises:
            AttributeError: there is no such name.
        """
        from importlib import import_module

        if name not in _HOMES:
            raise AttributeError(f"module 'neuralq.runs' has no attribute {name!r}; it has {', '.join(__all__)}")
        value: object = getattr(import_module(_HOMES[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted(__all__)
