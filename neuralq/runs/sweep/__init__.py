"""Many runs: combinations of options times seeds, each a run folder of its own, under one sweep folder.

    sweep.json    what is asked for; marks a sweep   config.json   the options that all runs share
    seed-7/       run folder of seed 7, or            NAME/seed-7/  of seed 7 with the options that NAME tells
    seed-7.log    what its process printed            summary.json  result of the last time it ran
    sweep.lock    held by the one process that runs it

Nothing is remembered but what the run folders say (`neuralq.runs.sweep.states`). So a sweep that was killed goes on
where each run's newest checkpoint stands. What makes the runs is an `Engine`: processes of this machine
(`LocalProcesses`), or a cluster's.

Each name is loaded when it is first used, so that telling how far a sweep is needs no PyTorch.
"""

from __future__ import annotations

TYPE_CHECKING = False  # known to type checkers
if TYPE_CHECKING:
    from neuralq.runs.sweep.asked import Asked as Asked
    from neuralq.runs.sweep.asked import read_asked as read_asked
    from neuralq.runs.sweep.engine import Ended as Ended
    from neuralq.runs.sweep.engine import Engine as Engine
    from neuralq.runs.sweep.engine import run_sweep as run_sweep
    from neuralq.runs.sweep.engine import share_of as share_of
    from neuralq.runs.sweep.folder import Member as Member
    from neuralq.runs.sweep.folder import Sweep as Sweep
    from neuralq.runs.sweep.folder import ask as ask
    from neuralq.runs.sweep.folder import create_sweep as create_sweep
    from neuralq.runs.sweep.folder import is_sweep_folder as is_sweep_folder
    from neuralq.runs.sweep.folder import open_sweep as open_sweep
    from neuralq.runs.sweep.local import LocalProcesses as LocalProcesses
    from neuralq.runs.sweep.local import num_cores as num_cores
    from neuralq.runs.sweep.results import RunResult as RunResult
    from neuralq.runs.sweep.results import Status as Status
    from neuralq.runs.sweep.results import SweepResult as SweepResult
    from neuralq.runs.sweep.states import RunState as RunState
    from neuralq.runs.sweep.states import state_of as state_of
    from neuralq.runs.sweep.task import Task as Task
    from neuralq.runs.sweep.work import perform as perform

__all__ = [
    "Asked",
    "Ended",
    "Engine",
    "LocalProcesses",
    "Member",
    "RunResult",
    "RunState",
    "Status",
    "Sweep",
    "SweepResult",
    "Task",
    "ask",
    "create_sweep",
    "is_sweep_folder",
    "num_cores",
    "open_sweep",
    "perform",
    "read_asked",
    "run_sweep",
    "share_of",
    "state_of",
]

_HOMES = {
    **dict.fromkeys(("Asked", "read_asked"), "neuralq.runs.sweep.asked"),
    **dict.fromkeys(("Ended", "Engine", "run_sweep", "share_of"), "neuralq.runs.sweep.engine"),
    **dict.fromkeys(
        ("Member", "Sweep", "ask", "create_sweep", "is_sweep_folder", "open_sweep"), "neuralq.runs.sweep.folder"
    ),
    **dict.fromkeys(("LocalProcesses", "num_cores"), "neuralq.runs.sweep.local"),
    **dict.fromkeys(("RunResult", "Status", "SweepResult"), "neuralq.runs.sweep.results"),
    **dict.fromkeys(("RunState", "state_of"), "neuralq.runs.sweep.states"),
    "Task": "neuralq.runs.sweep.task",
    "perform": "neuralq.runs.sweep.work",
}

if not TYPE_CHECKING:  # a type checker would believe that every name exists

    def __getattr__(name: str) -> object:
        """Loads a name at its first use.

        Raises:
            AttributeError: there is no such name.
        """
        from importlib import import_module

        if name not in _HOMES:
            raise AttributeError(f"module 'neuralq.runs.sweep' has no attribute {name!r}; it has {', '.join(__all__)}")
        value: object = getattr(import_module(_HOMES[name]), name)
        globals()[name] = value
        return value
