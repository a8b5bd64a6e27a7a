"""neuralq's sweeps: several seeds of one configuration, of which the worst is the subject."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from neuralq.doctor.origins.neuralq_run import NEURALQ_RUN
from neuralq.doctor.origins.record import Origin
from neuralq.doctor.subject import Subject
from neuralq.doctor.weights import CannotLoad
from neuralq.runs.folder.run_folder import RunFolderError, read_summary
from neuralq.runs.play_off import score_of
from neuralq.runs.sweep.folder import has_finished, is_sweep_folder, open_sweep

__all__ = ["NEURALQ_SWEEP"]


def _load(path: Path, net: str | None, env: Any) -> Subject:
    try:
        sweep = open_sweep(path)
        finished = [seed for seed in sweep.seeds if has_finished(sweep, seed)]
        scores = {seed: score_of(read_summary(sweep.run_path(seed))) for seed in finished}
    except RunFolderError as error:
        raise CannotLoad(f"cannot load the sweep {path}: {error}") from error
    returns = {seed: score.mean for seed, score in scores.items() if score is not None}
    if not returns:
        raise CannotLoad(f"no seed of the sweep {path} has finished; go on with it: neuralq resume {path}")
    worst = min(returns, key=lambda seed: returns[seed])
    subject = NEURALQ_RUN.load(sweep.run_path(worst), net, env)
    origin = f"seed {worst}, the worst of {len(returns)} of the sweep {path}"
    return replace(subject, origin=origin, siblings=tuple(returns.values()))


NEURALQ_SWEEP = Origin("a neuralq sweep folder", is_sweep_folder, _load, place=1)
