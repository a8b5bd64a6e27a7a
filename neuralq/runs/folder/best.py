"""The best parameters of a run: those whose greedy evaluation scored highest, kept beside its checkpoints.

The last parameters need not be the best: value-based learners lose and find good policies on the way. Of evaluations
that score alike the first counts. The evaluation that chose them flatters them a little, being a maximum over noisy
means; `neuralq evaluate RUN --best` plays fresh episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuralq.runs.folder.checkpoint import CheckpointError, load_newest, save
from neuralq.runs.folder.origin import compared
from neuralq.runs.folder.run_folder import is_run_folder, read_changes, read_config

__all__ = ["BEST_FOLDER", "Best", "keep_best", "load_best"]

BEST_FOLDER = "best"
"""Where in a run folder the best parameters are."""


@dataclass(frozen=True, slots=True)
class Best:
    """Parameters and how they scored.

    Args:
        env_steps: environment steps at which they were evaluated.
        greedy_return: mean return of that evaluation.
        parameters: the flat parameter vector.
        normalisation: statistics through which observations were seen then, or None.
        scalings: by what they were divided, as `Encoder.scalings` says it; None where nobody wrote it down.
    """

    env_steps: int
    greedy_return: float
    parameters: Tensor
    normalisation: dict[str, Any] | None = None
    scalings: dict[str, Any] | None = None


def keep_best(run_dir: str | Path, best: Best, origin: Mapping[str, Any] | None = None) -> Path:
    """Keeps these parameters as the best of the run, in one step, in place of those kept before.

    Args:
        run_dir: folder of the run.
        best: what to keep.
        origin: what they were made by, from `neuralq.runs.folder.origin.present`.

    Raises:
        CheckpointError: if the disk refuses; what was kept before is intact.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> _ = keep_best(folder, Best(4096, 31.5, torch.ones(2)))
        >>> load_best(folder).greedy_return
        31.5
    """
    state = {name: getattr(best, name) for name in ("greedy_return", "parameters", "normalisation", "scalings")}
    state["origin"] = None if origin is None else dict(origin)
    return save(Path(run_dir) / BEST_FOLDER, best.env_steps, state, keep=1)


def load_best(run_dir: str | Path) -> Best:
    """The best parameters of a run.

    Raises:
        CheckpointError: if none were kept, the file is damaged, or belongs to a run of another configuration.
    """
    folder = Path(run_dir) / BEST_FOLDER
    if not folder.is_dir():
        raise CheckpointError(f"{run_dir} has kept no best parameters: it was not evaluated yet; leave out --best")
    saved = load_newest(folder)
    state = saved.state
    if is_run_folder(run_dir):
        compared(state.get("origin"), read_config(run_dir), saved.path, read_changes(run_dir))
    try:
        parameters = torch.as_tensor(state["parameters"])
        kept = parameters, state.get("normalisation"), state.get("scalings")
        return Best(saved.step, float(state["greedy_return"]), *kept)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{saved.path} holds no parameters ({error})") from error
