"""Many runs: combinations of options times seeds, each a run folder of its own, under one sweep folder.

    sweep.json    what is asked for; marks a sweep   config.json   the options that all runs share
    seed-7/       run folder of seed 7, or            NAME/seed-7/  of seed 7 with the options that NAME tells
    seed-7.log    what its process printed            summary.json  result of the last time it ran
    sweep.lock    held by the one process that runs it

Nothing is remembered but what the run folders say (`neuralq.runs.sweep.states`). So a sweep that was killed goes on
where each run's newest checkpoint stands. What makes the runs is an `Engine`: processes of this machine
(`LocalProcesses`), or a cluster's.
"""

from __future__ import annotations

from neuralq.runs.sweep.asked import Asked, read_asked
from neuralq.runs.sweep.engine import Ended, Engine, run_sweep, share_of
from neuralq.runs.sweep.folder import Member, Sweep, ask, create_sweep, is_sweep_folder, open_sweep
from neuralq.runs.sweep.local import LocalProcesses, num_cores
from neuralq.runs.sweep.results import RunResult, Status, SweepResult
from neuralq.runs.sweep.states import RunState, state_of
from neuralq.runs.sweep.work import Task, perform

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
