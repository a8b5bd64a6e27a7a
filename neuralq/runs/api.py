"""Training, resuming and loading runs: what `neuralq.train`, `neuralq.resume` and `neuralq.load` are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuralq.runs.control import CONTROL, Run
from neuralq.runs.kinds import kind_of
from neuralq.runs.loop import Hook
from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.stop_request import pass_on

__all__ = ["load", "resume", "train"]


def train(config: RunConfig, run_dir: str | Path | None = None, hooks: Sequence[Hook] = ()) -> Run:
    """Train as configured and leave a run folder: configuration, versions, metrics and checkpoints.

    Args:
        config: what to run.
        run_dir: folder for the run; by default one under ``runs/``, named after environment, layout, seed and time.
        hooks: called with every row of metrics, and shown the session where they ask for it (docs/hooks.md).

    Raises:
        ValueError: for environments and settings that do not go together.
        RunFolderError: if the folder already holds a run.
        EnvironmentFault: if the environment breaks its contract while training.
        Diverged: if the parameters stop being finite.
        KeyboardInterrupt: at Ctrl-C, once the run is saved; another signal has its effect then, too.

    Example:
        >>> import tempfile
        >>> from neuralq.learners import RolloutSettings
        >>> config = RunConfig(env="CartPole-v1", total_steps=64, evaluation_episodes=1,
        ...                    rollout=RolloutSettings(num_envs=2, num_steps=16))
        >>> train(config, run_dir=tempfile.mkdtemp() + "/run").env_steps >= 64
        True
    """
    run: Run = _passed_on(CONTROL.train(config, run_dir, hooks))
    return run


def resume(run_dir: str | Path, total_steps: int | None = None, hooks: Sequence[Hook] = (), **changes: Any) -> Any:
    """Go on with a run from its newest valid checkpoint, or from the start if it was stopped before the first.

    On a CPU the continued run ends with the same bits as one that was never stopped, where the environment's state can
    be saved; otherwise every environment starts a new episode.

    Args:
        run_dir: folder of the run.
        total_steps: a new budget, which becomes part of the run's configuration; a finished run goes on only with a
            larger one.
        hooks: called with every row of metrics, and shown the session where they ask for it (docs/hooks.md).
        changes: other settings that do not decide what is learned, which become part of the configuration, too:
            ``device="cpu"``, ``stop_at_return=None``, ``evaluate_every=10_000``, ….

    Returns:
        A `Run`; of a system's run the result that the system has for it.

    Raises:
        RunFolderError: if there is no run, or another process is writing it.
        CheckpointError: if no checkpoint is intact, or the newest belongs to another configuration.
        ValueError: for a new budget of a run that does not count environment steps, one that is spent already, and for
            changes that would make another run of it.
    """
    kind = kind_of(run_dir)
    if total_steps is not None and kind.budget != "total_steps":
        raise ValueError(
            f"{run_dir} is {kind.title}, whose budget is {kind.budget} and not total_steps; leave it out here, or "
            "resume the run as its system does"
        )
    return _passed_on(kind.resume(run_dir, total_steps, hooks, changes))


def _passed_on(run: Any) -> Any:
    """The run, unless a signal has ended it: what it was meant to end is the whole program."""
    pass_on(
        run.interrupted_by, f"the run was saved at {run.env_steps:,} steps; go on with: neuralq resume {run.run_dir}"
    )
    return run


def load(run_dir: str | Path, best: bool = False) -> Any:
    """The agent of a run's newest checkpoint, or of its best evaluation.

    Args:
        run_dir: folder of the run.
        best: the parameters whose greedy evaluation scored highest, in place of the newest.

    Returns:
        A `neuralq.runs.agent.Agent`; of a TD-Gammon run a `neuralq.systems.backgammon.BackgammonAgent`.

    Raises:
        RunFolderError: if there is no run in the folder.
        CheckpointError: if no checkpoint is intact.
        ValueError: if the best is asked for of a run that keeps its newest only.
    """
    return kind_of(run_dir).load(Path(run_dir), best)
