"""One configuration over many seeds: each seed a process and a run folder of its own, under one sweep folder.

    sweep.json    seeds and format; marks a sweep      config.json   the configuration that all seeds share
    seed-7/       run folder of seed 7                 seed-7.log    what its process printed
    summary.json  result of the last time it ran       sweep.lock    held by the one process that runs it

Nothing is remembered but what the run folders say: a seed is finished when its summary says so. So a sweep that was
killed goes on where each seed's newest checkpoint stands, and a seed that failed is tried again. Children stop with
their parent, however that ends: they hold the other end of a pipe (`stop_with_parent`).
"""

from __future__ import annotations

from neuralq.runs.sweep.folder import Sweep, create_sweep, is_sweep_folder, open_sweep
from neuralq.runs.sweep.processes import SeedResult, Status, SweepResult, num_cores, run_sweep, stop_with_parent

__all__ = [
    "SeedResult",
    "Status",
    "Sweep",
    "SweepResult",
    "create_sweep",
    "is_sweep_folder",
    "num_cores",
    "open_sweep",
    "run_sweep",
    "stop_with_parent",
]
