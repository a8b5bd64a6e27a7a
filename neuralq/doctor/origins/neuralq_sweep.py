"""neuralq's sweeps: several seeds of one configuration, of which the worst is the subject."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from neuralq.doctor.origins.neuralq_run import NEURALQ_RUN
from neuralq.doctor.origins.record import Origin
from neuralq.doctor.subject import Subject
from neuralq.doctor.weights import CannotLoad
from neuralq.runs.folder.run_folder import RunFolderError
from neuralq.runs.play_off import score_of
from neuralq.runs.sweep.folder import is_sweep_folder, open_sweep

__all__ = ["NEURALQ_SWEEP"]


def _load(path: Path, net: str | None, env: Any) -> Subject:
    try:
        sweep = open_sweep(path)
        states = {member: sweep.state(member) for member in sweep.members()}
        scores = {member: score_of(state.summary) for member, state in states.items() if state.state == "finished"}
    except RunFolderError as error:
        raise CannotLoad(f"cannot load the sweep {path}: {error}") from error
    returns = {member: score.mean for member, score in scores.items() if score is not None}
    if not returns:
        raise CannotLoad(f"no run of the sweep {path} has finished; go on with it: neuralq resume {path}")
    worst = min(returns, key=lambda member: returns[member])
    subject = NEURALQ_RUN.load(path / worst.name, net, env)
    alike = [score for member, score in returns.items() if member.options == worst.options]
    origin = f"{worst.name.replace('seed-', 'seed ')}, the worst of {len(returns)} of the sweep {path}"
    return replace(subject, origin=origin, siblings=tuple(alike))


NEURALQ_SWEEP = Origin("a neuralq sweep folder", is_sweep_folder, _load, place=1)
