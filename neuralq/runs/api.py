"""Training, resuming and loading runs: what the command line calls, and what `neuralq.train` and `neuralq.load` are."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from neuralq.runs.folder import checkpoint
from neuralq.runs.agent import Agent
from neuralq.runs.folder.best import load_best
from neuralq.checks import check_whole
from neuralq.runs.evaluation import Evaluation, evaluate_greedy
from neuralq.runs.stream.encoding import discrete_actions
from neuralq.runs.stream import Interaction
from neuralq.q.flat import FlatParameters
from neuralq.runs.recipe.build import build_q, build_session, engine_name, make_envs, normalisation_for, plan_of
from neuralq.runs.recipe.config import RunConfig, config_from_dict, config_to_dict
from neuralq.runs.folder.run_folder import RunFolder, default_run_path, read_config, refuse_old_run
from neuralq.runs.loop import Hook, Progress, Session, fit, restore, seed_for

__all__ = ["Run", "evaluate_run", "load", "resume", "train"]


@dataclass(frozen=True)
class Run:
    """What a run came to.

    Args:
        run_dir: its folder.
        env_steps: environment steps.
        cpu_seconds: CPU time of training, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        greedy_return: mean return of the last greedy evaluation.
        parameters_sha256: of the flat parameter vector's bytes.
        reached: whether ``stop_at_return`` was met; None where none was asked for.
        interrupted_by: name of the signal that ended it early, or None.
        resumability: how exactly it can be resumed, in words.
        engine: what computed values and gradients: "compiled" kernels, "torch", or both, each what it can.
    """

    run_dir: Path
    env_steps: int
    cpu_seconds: float
    wall_seconds: float
    greedy_return: float | None
    parameters_sha256: str
    reached: bool | None
    interrupted_by: str | None
    resumability: str
    engine: str

    def summary(self) -> dict[str, Any]:
        """The same as plain values."""
        return {**dataclasses.asdict(self), "run_dir": str(self.run_dir)}


@contextlib.contextmanager
def _threads(config: RunConfig) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(config.threads)
    try:
        with threadpool_limits(config.threads):
            yield
    finally:
        torch.set_num_threads(before)


def train(config: RunConfig, run_dir: str | Path | None = None, hooks: Sequence[Hook] = ()) -> Run:
    """Train as configured and leave a run folder: configuration, versions, metrics and checkpoints.

    Args:
        config: what to run.
        run_dir: folder for the run; by default one under ``runs/``, named after environment, layout, seed and time.
        hooks: called with every row of metrics.

    Raises:
        ValueError: for environments and settings that do not go together.
        RunFolderError: if the folder already holds a run.
        EnvironmentFault: if the environment breaks its contract while training.
        Diverged: if the parameters stop being finite.

    Example:
        >>> import tempfile
        >>> from neuralq.learners import RolloutSettings
        >>> config = RunConfig(env="CartPole-v1", total_steps=64, evaluation_episodes=1,
        ...                    rollout=RolloutSettings(num_envs=2, num_steps=16))
        >>> train(config, run_dir=tempfile.mkdtemp() + "/run").env_steps >= 64
        True
    """
    default = default_run_path(config.env, config.layout, config.seed, datetime.now())
    path = default if run_dir is None else Path(run_dir)
    refuse_old_run(path)  # `RunFolder.create` does too, but building the session takes seconds
    with _threads(config), contextlib.closing(build_session(config)) as session:
        with RunFolder.create(path, config=config_to_dict(config), seed=config.seed) as folder:
            progress = fit(session, plan_of(config), Progress(), folder, hooks)
            return _conclude(config, session, progress, folder)


def resume(run_dir: str | Path, total_steps: int | None = None, hooks: Sequence[Hook] = ()) -> Run:
    """Go on with a run from its newest valid checkpoint, or from the start if it was stopped before the first.

    On a CPU the continued run ends with the same bits as one that was never stopped, where the environment's state can
    be saved; otherwise every environment starts a new episode.

    Args:
        run_dir: folder of the run.
        total_steps: a new budget, which becomes part of the run's configuration; a finished run goes on only with a
            larger one.
        hooks: called with every row of metrics.

    Raises:
        RunFolderError: if there is no run, or another process is writing it.
        CheckpointError: if no checkpoint is intact.
    """
    config = config_from_dict(read_config(run_dir))
    if total_steps is not None:
        config = dataclasses.replace(config, total_steps=total_steps)
    with _threads(config), RunFolder.open(run_dir) as folder, contextlib.closing(build_session(config)) as session:
        progress = Progress()
        if any(folder.checkpoints_path.glob("step-*")):
            saved = checkpoint.load_newest(folder.checkpoints_path)
            progress = restore(session, saved.state, config.seed)
        folder.truncate_metrics(progress.env_steps)
        if total_steps is not None:
            folder.replace_config(config_to_dict(config))
        reached = config.stop_at_return is not None and progress.reached_at is not None
        if not (progress.finished and (reached or progress.env_steps >= config.total_steps)):
            progress = fit(session, plan_of(config), progress, folder, hooks)
        return _conclude(config, session, progress, folder)


def _conclude(config: RunConfig, session: Session, progress: Progress, folder: RunFolder) -> Run:
    run = Run(
        run_dir=folder.path,
        env_steps=progress.env_steps,
        cpu_seconds=progress.cpu_seconds,
        wall_seconds=progress.wall_seconds,
        greedy_return=progress.greedy_return,
        parameters_sha256=session.learner.engine.flat.sha256(),
        reached=None if config.stop_at_return is None else progress.reached_at is not None,
        interrupted_by=progress.interrupted_by,
        resumability=session.resumability.reason,
        engine=engine_name(session.learner),
    )
    folder.write_summary(run.summary())
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
        ValueError: if the best of a TD-Gammon run is asked for.
    """
    if read_config(run_dir).get("kind") != "td-gammon":
        return _load_agent(run_dir, best)
    if best:
        raise ValueError(f"a TD-Gammon run keeps its newest weights only, and {run_dir} is one; leave best out")
    from neuralq.systems.backgammon.run import load_agent  # its kernels are not everybody's

    return load_agent(run_dir)


def _load_agent(run_dir: str | Path, best: bool) -> Agent:
    config = config_from_dict(read_config(run_dir))
    parameters, statistics = _kept(Path(run_dir), best)
    envs = make_envs(config, 1)
    try:
        seen = normalisation_for(config, envs)
        if seen is not None:
            seen.load_state_dict(statistics)
            seen = seen.frozen()
        stream = Interaction(envs, config.gamma, 0, config.layout == "table", seen)
        q = build_q(config, stream.spec, np.random.default_rng(0))
        FlatParameters(q).load(parameters)  # type: ignore[arg-type]
        _, first_action = discrete_actions(envs.single_action_space)
        scale = config.reward_scale * (1.0 if seen is None else seen.reward_scale)
        return Agent(q, stream.encoder, stream.spec, first_action, scale, seen)
    finally:
        envs.close()


def _kept(run_dir: Path, best: bool) -> tuple[Tensor, Any]:
    """The flat parameters, and the statistics through which observations were seen."""
    if best:
        kept = load_best(run_dir)
        return kept.parameters, kept.normalisation
    saved = checkpoint.load_newest(run_dir / "checkpoints").state
    state = saved["learner"]
    parameters = state["parameters"] if "parameters" in state else state["descent"]["parameters"]
    if state.get("average") is not None:
        parameters = state["average"]["values"]
    return torch.as_tensor(parameters), saved["stream"].get("normalisation")


def evaluate_run(run_dir: str | Path, num_episodes: int = 100, seed: int = 0, best: bool = False) -> Evaluation:
    """Greedy returns of a run's newest checkpoint, or of its best evaluation, on fresh episodes.

    Args:
        run_dir: folder of the run.
        num_episodes: how many episodes.
        seed: of the episodes; unrelated to those seen in training.
        best: play with the parameters whose greedy evaluation scored highest, in place of the newest.
    """
    check_whole("num_episodes", num_episodes)
    check_whole("seed", seed, 0)
    config = config_from_dict(read_config(run_dir))
    agent = _load_agent(run_dir, best)
    with _threads(config):
        envs = make_envs(config, min(num_episodes, 64))
        try:
            stream = Interaction(envs, config.gamma, 0, config.layout == "table", agent.normalisation)
            with torch.no_grad():
                return evaluate_greedy(agent.q.all, stream, num_episodes, seed_for(seed, 7))
        finally:
            envs.close()
